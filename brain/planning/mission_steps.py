"""How each step of a mission is done: what it asks for now, and when it is done or has failed.

Rules. A performer is plain data: `advance(seen)` is called at every step of the brain while the mission runs
and returns what is wanted now, or the outcome; `halt()` is called when the mission is paused: what is done
stays done, and what is left goes on later. Distances and angles are measured by the estimate, as travelled
along the motion that was asked for, so noise at rest does not count. Nothing here looks for obstacles: goals
are planned, and every twist is limited by the stop zone.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from math import atan2, copysign, cos, degrees, hypot, pi, remainder, sin, sqrt
from typing import NamedTuple, Protocol, TypeAlias

from brain.belief import Pose
from brain.bodies.body import Base
from brain.bodies.plane import Twist, motion, moved, wrap
from protocols import messages as msg
from protocols.messages import SECOND, Command, Feedback, Goal, Nanos, Step, seconds

BRAKING, ENDING = 0.4, 2.5
"""Share of the acceleration limits with which a measured motion ends, and 1/s of the last of it: so that what
is late between a command and the estimate (jerk, wheels, filter) does not carry it past its end"""
CREEP, CREEP_TURN = 0.02, 0.05
"""m/s and rad/s at which the last of it is covered"""
LENGTH_TOLERANCE, ANGLE_TOLERANCE = 0.005, 0.01
"""m and rad, of a measured motion"""
ROLLED_OUT, ROLLED_OUT_TURN = 0.3, 0.6
"""m and rad: what a base moved during a pause, if less, was its coming to rest, and counts"""
REST, REST_TURN = 0.02, 0.03
"""m/s and rad/s below which the base stands"""
HEADING_GAIN, HEADING_MOST = 1.5, 0.3
"""1/s and rad/s: how a straight motion keeps its heading"""
NO_PROGRESS: Nanos = 8 * SECOND
"""A motion that gets no further for this long has failed."""
PASS = 0.3
"""m from a point at which the base goes on to the next without stopping"""
POSITION_TOLERANCE, STANDING = 0.03, 0.03
"""rad and rad/s: a joint that is so near its target, and so slow, has reached it"""
HELD_UP: Nanos = 300_000_000
"""A joint that stands for this long, and has not reached its target, is in contact."""
UNTIL_REACHED: Nanos = 5 * SECOND
"""How long a joint may take beyond the time given"""
BEFORE_MARKER, MARKER_AGE = 0.5, 3 * SECOND
"""m straight before the place at a marker, from where it is approached; and how long one must be unseen to be
lost"""
DOCK_SPEED, DOCK_TOLERANCE = 0.1, 0.015
"""m/s and m"""
STRAIGHT, LOOK_AHEAD, ALONG_GAIN, ALONG_MOST = 0.15, 0.1, 3.0, 0.6
"""How the line to the place is followed: the last of it [m] without steering to the side, before that by
heading for a point of it so far ahead [m]; by 1/s of the heading's error, at most so fast [rad/s]"""


class Want(NamedTuple):
    """What a step asks for now. Nothing at all: to stand still."""

    goal: Goal | None = None
    """To be driven to, from now on"""
    passing: bool = False
    """Whether this goal follows the last without a stop"""
    keep: bool = False
    """Whether the goal given before stays"""
    twist: Twist | None = None
    targets: tuple[Command, ...] = ()
    """New targets of joints"""
    seconds: float = 0.0
    """Time in which their positions are to be reached"""
    place: msg.MoveTool | None = None
    """Where the tip of an arm is to be brought"""


STAND = Want()


@dataclass(frozen=True, slots=True)
class Done:
    """The step is done; in words, what came of it."""

    text: str


@dataclass(frozen=True, slots=True)
class Failed:
    """The step has failed, and why."""

    reason: str


Result: TypeAlias = Want | Done | Failed


@dataclass(frozen=True, slots=True)
class Seen:
    """What the steps go by."""

    now: Nanos
    body: Base | None = None
    pose: Pose | None = None
    """None for bare joints"""
    linear: float = 0.0
    """m/s of the origin, and"""
    angular: float = 0.0
    """rad/s: as estimated"""
    free: bool = True
    """Whether the base may move now"""
    obstructed: str = ""
    """Why it stands, if an obstacle is in its way"""
    ended: int = 0
    """Number of goals (of an arm: of places for its tip) that have ended,"""
    why: str = ""
    """and why the last of them was given up; "" if it was reached"""
    joints: Mapping[str, Feedback] | None = None
    """The newest of each joint"""
    marker: Callable[[int], Pose | None] = lambda _: None
    """Returns the pose of a marker on the map, its x axis out of its face"""


class Performer(Protocol):
    """Does one step."""

    def advance(self, seen: Seen) -> Result:
        """Return what is wanted now, or the outcome."""

    def halt(self) -> None:
        """Be ready to go on after a pause."""


def perform(step: Step) -> Performer:
    """Return what does this step. Repeat and Try are no such steps: `Missions` unrolls them."""
    match step:
        case Goal():
            return _Going(step)
        case msg.Follow(points):
            return _Following(points)
        case msg.Move():
            return _Moving(step)
        case msg.Turn(angle):
            return _Turning(angle)
        case msg.Wait(span):
            return _Waiting(round(span * SECOND))
        case msg.Dock():
            return _Docking(step)
        case msg.Reach():
            return _Reaching(step)
        case msg.MoveTool():
            return _Placing(step)
    raise TypeError(f"{step!r} is no single step")


def text(step: Step) -> str:
    """Return a step in words."""
    match step:
        case Goal(x, y, yaw, near):
            turned = "" if yaw is None else f", {degrees(yaw):.0f}°"
            return f"go {'near' if near else 'to'} ({x:g}, {y:g}{turned})"
        case msg.Follow(points):
            return f"follow {len(points)} points to ({points[-1][0]:g}, {points[-1][1]:g})"
        case msg.Move(linear, lateral, angular, span, distance):
            speeds = [f"{linear:g} m/s"] if linear or not (lateral or angular) else []
            speeds += [f"{abs(lateral):g} m/s to the {'left' if lateral > 0 else 'right'}"] if lateral else []
            speeds += [f"{degrees(angular):.0f}°/s"] if angular else []
            length = [f"{distance:g} m"] if distance is not None else []
            length += [f"{span:g} s"] if span is not None else []
            return f"drive {', '.join(speeds)} for {' or '.join(length)}"
        case msg.Turn(angle):
            return f"turn {abs(degrees(angle)):.0f}° to the {'left' if angle >= 0 else 'right'}"
        case msg.Wait(span):
            return f"wait {span:g} s"
        case msg.Dock(marker, distance):
            return f"dock {distance:g} m before marker {marker}"
        case msg.Reach(targets, _, contact):
            return f"{'close' if contact else 'move'} {', '.join(target.motor for target in targets)}"
        case msg.MoveTool(x, y, z):
            return f"bring the tool to ({x:g}, {y:g}, {z:g})"
        case msg.Repeat(times, steps):
            return f"repeat {len(steps)} steps {f'{times} times' if times else 'without an end'}"
        case msg.Try(steps):
            return f"try {len(steps)} steps"


# -- goals and points --------------------------------------------------------------------------


@dataclass(slots=True)
class _Going:
    goal: Goal
    before: int | None = None
    """How many goals had ended when this one was given"""

    def advance(self, seen: Seen) -> Result:
        if self.before is None:
            self.before = seen.ended
            return Want(goal=self.goal)
        if seen.ended == self.before:
            return Want(keep=True)
        return Failed(seen.why) if seen.why else Done(f"at {_place(seen)}")

    def halt(self) -> None:
        self.before = None


@dataclass(slots=True)
class _Following:
    points: tuple[tuple[float, float], ...]
    at: int = 0
    going: _Going | None = None

    def advance(self, seen: Seen) -> Result:
        last = self.at == len(self.points) - 1
        x, y = self.points[self.at]
        if self.going is None:
            self.going = _Going(Goal(x, y))
        elif not last and seen.pose is not None and hypot(seen.pose.x - x, seen.pose.y - y) < PASS:
            self.at += 1
            self.going.goal = Goal(*self.points[self.at])
            return Want(goal=self.going.goal, passing=True)
        result = self.going.advance(seen)
        if isinstance(result, Failed):
            return Failed(f"point {self.at + 1} of {len(self.points)}: {result.reason}")
        if isinstance(result, Done) and not last:
            self.at, self.going = self.at + 1, None
            return STAND
        return result

    def halt(self) -> None:
        self.going = None


# -- measured motions --------------------------------------------------------------------------


@dataclass(slots=True)
class _Progress:
    """Progress of a motion, and since when there is none."""

    last: Pose | None = None
    so_far: float = 0.0
    best: float = 0.0
    since: Nanos | None = None
    paused: bool = False

    def add(self, seen: Seen, share: Callable[[float, float, float], float]) -> None:
        """Add what was covered since the last call: a share of (distance, turn, sideways)."""
        assert seen.pose is not None
        if self.last is not None:
            distance, turn, sideways = motion(self.last, seen.pose)
            rolled_out = hypot(distance, sideways) < ROLLED_OUT and abs(turn) < ROLLED_OUT_TURN
            if rolled_out or not self.paused:
                self.so_far += share(distance, turn, sideways)
        self.last, self.paused = seen.pose, False
        if self.since is None or not seen.free or self.so_far > self.best + LENGTH_TOLERANCE:
            self.since, self.best = seen.now, max(self.so_far, self.best)

    def stuck(self, seen: Seen) -> str:
        """Return why there was no progress for long; "" if there was."""
        if self.since is None or seen.now - self.since < NO_PROGRESS:
            return ""
        return f"no progress for {seconds(NO_PROGRESS):g} s: {seen.obstructed or 'the base does not move'}"

    def halt(self) -> None:
        self.since, self.paused = None, True


@dataclass(slots=True)
class _Moving:
    move: msg.Move
    progress: _Progress = field(default_factory=_Progress)
    heading: float | None = None
    """rad, of a straight motion"""
    spent: float = 0.0
    """s in motion"""
    at: Nanos | None = None
    ending: bool = False

    def advance(self, seen: Seen) -> Result:
        move, pose = self.move, seen.pose
        assert pose is not None
        assert seen.body is not None
        speed = hypot(move.linear, move.lateral)
        scale = speed or 1.0
        self.progress.add(
            seen, lambda d, t, s: (d * move.linear + s * move.lateral) / scale if speed else abs(t)
        )
        if seen.free and self.at is not None:
            self.spent += seconds(seen.now - self.at)
        self.at = seen.now
        self.heading = pose.yaw if self.heading is None else self.heading
        left = None if move.distance is None else move.distance - self.progress.so_far
        over = move.seconds is not None and self.spent >= move.seconds
        self.ending = self.ending or over or (left is not None and left <= LENGTH_TOLERANCE)
        if self.ending:
            if seen.linear > REST or abs(seen.angular) > REST_TURN:
                return STAND
            covered = f"{self.progress.so_far:.2f} m" if speed else f"{degrees(self.progress.so_far):.0f}°"
            return Done(f"{covered} in {self.spent:.1f} s")
        if why := self.progress.stuck(seen):
            return Failed(why)
        share = 1.0
        if left is not None and speed:
            share = min(1.0, max(_ending(left, seen.body.max_linear_acceleration), CREEP) / speed)
        twist = Twist(move.linear, move.angular, move.lateral).scaled(share)
        if not move.angular:
            keep = HEADING_GAIN * wrap(self.heading - pose.yaw)
            twist = twist._replace(angular=max(-HEADING_MOST, min(HEADING_MOST, keep)))
        return Want(twist=twist)

    def halt(self) -> None:
        self.progress.halt()
        self.heading = self.at = None


@dataclass(slots=True)
class _Turning:
    angle: float
    progress: _Progress = field(default_factory=_Progress)

    def advance(self, seen: Seen) -> Result:
        body, way = seen.body, copysign(1.0, self.angle)
        assert body is not None
        self.progress.add(seen, lambda _, turn, __: way * turn)
        left = abs(self.angle) - self.progress.so_far
        if abs(left) <= ANGLE_TOLERANCE:
            if abs(seen.angular) > REST_TURN or seen.linear > REST:
                return STAND
            return Done(f"turned {degrees(way * self.progress.so_far):.1f}°")
        if why := self.progress.stuck(seen):
            return Failed(why)
        return Want(twist=_turn(body, way * left))

    def halt(self) -> None:
        self.progress.halt()


def _turn(body: Base, left: float) -> Twist:
    """Return the twist for the rest of a turn [rad]: on the spot, or on the narrowest circle, forward."""
    radius = 1.05 * body.turning_radius
    most, acceleration = body.max_angular, body.max_angular_acceleration
    if radius > 0.0:
        most = min(most, body.max_linear / radius)
        acceleration = min(acceleration, body.max_linear_acceleration / radius)
    rate = min(most, max(_ending(abs(left), acceleration), CREEP_TURN))
    return Twist(rate * radius, copysign(rate, left))


def _ending(left: float, acceleration: float) -> float:
    """Return the speed from which a motion comes to rest at its end, which is so far."""
    return min(sqrt(2.0 * BRAKING * acceleration * left), ENDING * left)


@dataclass(slots=True)
class _Waiting:
    left: Nanos
    at: Nanos | None = None

    def advance(self, seen: Seen) -> Result:
        if self.at is not None:
            self.left -= seen.now - self.at
        self.at = seen.now
        return STAND if self.left > 0 else Done("")

    def halt(self) -> None:
        self.at = None


# -- docking -----------------------------------------------------------------------------------


@dataclass(slots=True)
class _Docking:
    """Look for the marker, turning once around; drive to a place before it; then straight up to it."""

    dock: msg.Dock
    place: Pose | None = None
    """Where the robot is to stand, by the marker when it was seen last,"""
    at: Nanos | None = None
    """which was then"""
    turning: _Turning | None = None
    going: _Going | None = None
    near: bool = False
    progress: _Progress | None = None

    def advance(self, seen: Seen) -> Result:
        body, pose = seen.body, seen.pose
        assert body is not None
        assert pose is not None
        if (marker := seen.marker(self.dock.marker)) is not None:
            self.place = moved(marker, Pose(self.dock.distance, -self.dock.lateral, pi))
            self.at = seen.now
        if self.place is None or self.at is None:
            return self._search(seen, body)
        if not self.near:
            return self._go_before(seen, self.place)
        if seen.now - self.at > MARKER_AGE:
            return Failed(f"marker {self.dock.marker} is not seen any more")
        return self._approach(seen, body, pose, self.place)

    def _search(self, seen: Seen, body: Base) -> Result:
        self.turning = self.turning or _Turning(2.0 * pi)
        if body.turning_radius > 0.0:
            return Failed(f"marker {self.dock.marker} is not seen")
        result = self.turning.advance(seen)
        lost = Failed(f"marker {self.dock.marker} is not seen, all around")
        return result if isinstance(result, Want) else lost

    def _go_before(self, seen: Seen, place: Pose) -> Result:
        start = moved(place, Pose(-BEFORE_MARKER, 0.0, 0.0))
        goal = Goal(start.x, start.y, start.yaw)
        if self.going is None:
            self.going = _Going(goal)
        elif self.going.before is not None and _apart(self.going.goal, goal):
            self.going.goal = goal  # from nearby it is seen better
            return Want(goal=goal, passing=True)
        result = self.going.advance(seen)
        if isinstance(result, Done):
            self.near, self.at = True, seen.now
            return STAND
        return result

    def _approach(self, seen: Seen, body: Base, pose: Pose, place: Pose) -> Result:
        ahead, aside, turn = _in_frame(pose, place)
        self.progress = self.progress or _Progress()
        self.progress.add(seen, lambda distance, _, __: distance)
        if ahead <= DOCK_TOLERANCE:
            if seen.linear > REST:
                return STAND
            off = f"{100 * ahead:.1f} cm before its place, {100 * abs(aside):.1f} cm beside it"
            return Done(f"{off}, {degrees(turn):.1f}° off")
        if why := self.progress.stuck(seen):
            return Failed(why)
        speed = max(min(DOCK_SPEED, ahead), CREEP)
        if body.moves_sideways:
            return Want(twist=Twist(speed, HEADING_GAIN * turn, max(-speed, min(speed, 2.0 * aside))))
        # Where the line is: to the left of the base, measured across it. What turns is the line's direction.
        beside = aside * cos(turn) - ahead * sin(turn)
        toward = turn + (atan2(beside, LOOK_AHEAD) if ahead > STRAIGHT else 0.0)
        return Want(twist=Twist(speed, max(-ALONG_MOST, min(ALONG_MOST, ALONG_GAIN * toward))))

    def halt(self) -> None:
        self.going, self.near, self.progress = None, False, None
        if self.turning is not None:
            self.turning.halt()


def _apart(one: Goal, other: Goal) -> bool:
    """Return whether two goals for docking differ by more than what the last stretch corrects."""
    turn = remainder((one.yaw or 0.0) - (other.yaw or 0.0), 2.0 * pi)
    return hypot(one.x - other.x, one.y - other.y) > 0.08 or abs(turn) > 0.15


def _in_frame(pose: Pose, place: Pose) -> tuple[float, float, float]:
    """Return where a place lies for the robot: m ahead, m to the left, rad to the left."""
    dx, dy = place.x - pose.x, place.y - pose.y
    c, s = cos(pose.yaw), sin(pose.yaw)
    return c * dx + s * dy, c * dy - s * dx, wrap(place.yaw - pose.yaw)


# -- joints ------------------------------------------------------------------------------------


@dataclass(slots=True)
class _Reaching:
    reach: msg.Reach
    since: Nanos | None = None
    standing: dict[str, Nanos] | None = None
    """Since when each joint stands"""

    def advance(self, seen: Seen) -> Result:
        reach, joints = self.reach, seen.joints or {}
        if self.since is None:
            self.since, self.standing = seen.now, {}
            return Want(targets=reach.targets, seconds=reach.seconds)
        assert self.standing is not None
        spent = seen.now - self.since
        for target in reach.targets:
            speed = joints[target.motor].velocity if target.motor in joints else None
            if speed is not None and abs(speed) < STANDING:
                self.standing.setdefault(target.motor, seen.now)
            else:
                self.standing.pop(target.motor, None)
        open_ = [target for target in reach.targets if self._is_open(target, seen, joints)]
        if not open_ and spent >= round(reach.seconds * SECOND) * (not reach.contact):
            held = ", ".join(f"{t.motor} at {_position(joints, t.motor)}" for t in reach.targets)
            return Done(f"{'held up: ' if reach.contact else ''}{held}")
        if spent < round(reach.seconds * SECOND) + UNTIL_REACHED:
            return STAND
        if reach.contact:
            return Failed(f"{open_[0].motor} met nothing: it is at {_position(joints, open_[0].motor)}")
        where = _position(joints, open_[0].motor)
        return Failed(f"{open_[0].motor} stands at {where}, not at its target")

    def _is_open(self, target: Command, seen: Seen, joints: Mapping[str, Feedback]) -> bool:
        """Return whether a joint is still to do what it should."""
        since = (self.standing or {}).get(target.motor)
        position = joints[target.motor].position if target.motor in joints else None
        there = (
            isinstance(target, msg.Position)
            and position is not None
            and abs(position - target.position) < POSITION_TOLERANCE
        )
        if self.reach.contact:
            assert self.since is not None
            return there or since is None or seen.now - max(since, self.since + HELD_UP) < HELD_UP
        return isinstance(target, msg.Position) and (not there or since is None)

    def halt(self) -> None:
        self.since = None


@dataclass(slots=True)
class _Placing:
    place: msg.MoveTool
    before: int | None = None
    """How many places had ended when this one was given"""

    def advance(self, seen: Seen) -> Result:
        if self.before is None:
            self.before = seen.ended
            return Want(place=self.place)
        if seen.ended == self.before:
            return STAND
        return Failed(seen.why) if seen.why else Done("")

    def halt(self) -> None:
        self.before = None


def _position(joints: Mapping[str, Feedback], motor: str) -> str:
    position = joints[motor].position if motor in joints else None
    return "an unknown position" if position is None else f"{position:.3f} rad"


def _place(seen: Seen) -> str:
    return "an unknown place" if seen.pose is None else f"({seen.pose.x:.2f}, {seen.pose.y:.2f})"
