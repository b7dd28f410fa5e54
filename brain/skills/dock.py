"""`dock = 3`: stand before a marker that a camera sees, facing it.

Look for the marker, turning once around; drive to a place before it; then straight up to it.
"""

from __future__ import annotations

from dataclasses import dataclass
from math import atan2, cos, degrees, hypot, pi, remainder, sin

from brain import reading
from brain.belief import Pose
from brain.bodies.body import Base
from brain.bodies.limbs import Abilities
from brain.bodies.plane import Twist, moved, wrap
from brain.skills.goal import Going
from brain.skills.measured import CREEP, HEADING_GAIN, REST, MotionProgress
from brain.skills.skill import STAND, Done, Failed, Intent, Observed, Result, Skill, Words
from brain.skills.turn import Turning
from protocols.messages import SECOND, Dock, Goal, Nanos, Turn

BEFORE_MARKER, MARKER_AGE = 0.5, 3 * SECOND
"""m straight before the place at a marker, from where it is approached; and how long one must be unseen to be
lost"""
DOCK_SPEED, DOCK_TOLERANCE = 0.1, 0.015
"""m/s and m"""
STRAIGHT, LOOK_AHEAD, ALONG_GAIN, ALONG_MOST = 0.15, 0.1, 3.0, 0.6
"""How the line to the place is followed: the last of it [m] without steering to the side, before that by
heading for a point of it so far ahead [m]; by 1/s of the heading's error, at most so fast [rad/s]"""


@dataclass(slots=True)
class _Docking:
    """Look for the marker, turning once around; drive to a place before it; then straight up to it."""

    dock: Dock
    place: Pose | None = None
    """Where the robot is to stand, by the marker when it was seen last"""
    at: Nanos | None = None
    """When the marker was seen last"""
    turning: Turning | None = None
    going: Going | None = None
    near: bool = False
    progress: MotionProgress | None = None

    def advance(self, seen: Observed) -> Result:
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

    def _search(self, seen: Observed, body: Base) -> Result:
        self.turning = self.turning or Turning(Turn(2.0 * pi))
        if body.turning_radius > 0.0:
            return Failed(f"marker {self.dock.marker} is not seen")
        result = self.turning.advance(seen)
        lost = Failed(f"marker {self.dock.marker} is not seen, all around")
        return result if isinstance(result, Intent) else lost

    def _go_before(self, seen: Observed, place: Pose) -> Result:
        start = moved(place, Pose(-BEFORE_MARKER, 0.0, 0.0))
        goal = Goal(start.x, start.y, start.yaw)
        if self.going is None:
            self.going = Going(goal)
        elif self.going.before is not None and _apart(self.going.goal, goal):
            return self.going.turn_to(goal)  # from nearby it is seen better
        result = self.going.advance(seen)
        if isinstance(result, Done):
            self.near, self.at = True, seen.now
            return STAND
        return result

    def _approach(self, seen: Observed, body: Base, pose: Pose, place: Pose) -> Result:
        ahead, aside, turn = _in_frame(pose, place)
        self.progress = self.progress or MotionProgress()
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
            return Intent(twist=Twist(speed, HEADING_GAIN * turn, max(-speed, min(speed, 2.0 * aside))))
        # Where the line is: to the left of the base, measured across it. What turns is the line's direction.
        beside = aside * cos(turn) - ahead * sin(turn)
        toward = turn + (atan2(beside, LOOK_AHEAD) if ahead > STRAIGHT else 0.0)
        return Intent(twist=Twist(speed, max(-ALONG_MOST, min(ALONG_MOST, ALONG_GAIN * toward))))

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


def _parse(words: list[str], _: Abilities) -> Dock:
    if not 1 <= len(words) <= 2:
        raise reading.InvalidError("a marker is needed")
    distance = reading.quantity_of(words[1], ("m",)) if len(words) > 1 else 0.5
    return Dock(reading.integer_of(words[0]), distance)


def _wrong(step: Dock, _: Abilities) -> str:
    near = 0.0 < step.distance <= 5.0 and abs(step.lateral) <= 5.0
    return "" if near else "its place must be within 5 m of the marker, and before it"


skill = Skill(
    name="dock",
    step=Dock,
    own=reading.whole,
    keys={"distance": reading.number, "left": reading.number},
    make=lambda given: Dock(given["dock"], given.get("distance", 0.5), given.get("left", 0.0)),
    words=Words("MARKER [DISTANCE]", "stand before a marker, facing it [m]", _parse),
    needs_base=True,
    wrong=_wrong,
    text=lambda step: f"dock {step.distance:g} m before marker {step.marker}",
    perform=_Docking,
)
