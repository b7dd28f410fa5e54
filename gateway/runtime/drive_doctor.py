"""Why a base does not drive as it should, above the wires: watched while it runs, live or replayed.

Rules. It only looks: at the events, instructions and belief of each step, with bounded work and memory. What
is found stays found, with the time when it was first seen; each finding says what was seen, why it matters,
and the one command to type. Two causes are two findings.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Iterator, Mapping, Sequence
from itertools import pairwise

from brain.belief import Belief, Pose
from brain.bodies.body import Base
from brain.bodies.plane import Twist, wrap
from brain.perception.mount import Mount
from gateway.core.robot import Robot
from gateway.core.tick import Tick
from gateway.runtime.doctor import Finding
from protocols.messages import SECOND, Event, Feedback, Goal, Imu, Instruction, LaserScan, Nanos, seconds

WAIT: Nanos = 4 * SECOND
"""So long a base may do nothing about a goal,"""
STILL = 0.02
"""while its wheels roll less than this [m]."""
PERIOD: Nanos = SECOND // 5
"""Between two samples of what is believed,"""
KEPT: Nanos = 12 * SECOND
"""which are kept for this time."""
FROZEN = 0.12
"""m that wheels roll while the believed pose stays within a tenth of it"""
ROUNDS = 1.6 * 2.0 * math.pi
"""rad turned to one side within `KEPT`, without coming nearer to the goal, that are a spin"""
LONG, REPLANNED = 2.5, 12
"""Times the straight way, and paths within `KEPT`, from which on a path is odd"""
OCCUPIED = 0.62
"""Log-odds of a cell that is an obstacle"""
_STAMPED = Feedback, LaserScan, Imu
JUMP: Nanos = SECOND
"""By so much a stamp may differ from the moment it came, or a step follow the last"""
UPSIDE = -5.0
"""m/s² along the robot's vertical that an IMU reads with the ground above it"""
SLOWEST, WEAKEST = 0.05, 0.05
"""m/s, and m/s², below which limits are too small to drive anywhere"""
MOST = 40
"""Findings"""


class DriveDoctor:
    """Watches one robot. `take` is called after each step; plain data, but for the robot."""

    def __init__(self, robot: Robot, mounts: Mapping[str, Mount] | None = None) -> None:
        self._robot, self._name = robot, robot.name
        self._mounts = {n: one.mount for n, one in robot.sensors.items()} if mounts is None else dict(mounts)
        self._base: Base | None = robot.brain.base
        self._found: dict[str, Finding] = {}
        """By what it is"""
        self._since: Nanos = 0
        self._last: Nanos | None = None
        self._scans: dict[str, int] = {}
        self._rays: dict[str, int] = {}
        self._angles: dict[str, float] = {}
        self._rolled = 0.0
        """m, of the wheel that rolled farthest, by its own angle"""
        self._goal: Goal | None = None
        self._goal_since: Nanos = 0
        self._rolled_at_goal = 0.0
        self._asked: dict[str, int] = {}
        self._past: deque[tuple[Nanos, Pose, float, float, int]] = deque()
        """Time, pose, unwrapped yaw, way by the wheels, version of the path"""
        self._way = 0.0
        """m along, forward or backward, by the wheels at the samples"""
        self._sampled: tuple[float, ...] | None = None
        """rad of the joints at the newest sample"""
        self._yaw = 0.0
        self._gravity: dict[str, tuple[float, int]] = {}

    def take(self, tick: Tick, belief: Belief) -> None:
        """Look at a step."""
        self.look(tick.now, tick.outputs.events, tick.inputs.instructions, belief)

    def look(
        self, now: Nanos, events: Sequence[Event], instructions: Sequence[Instruction], belief: Belief
    ) -> None:
        """Look at what came, what was asked for, and what is believed after it."""
        self._since = self._since or now
        self._look_at_clock(now, events)
        for event in events:
            self._look_at(event)
        if self._base is None or len(self._found) >= MOST:
            return
        for text in belief.explained:
            self._explained(text)
        for one in instructions:
            if isinstance(one, Goal):
                self._asked["goal"] = self._asked.get("goal", 0) + 1
        self._look_at_goal(now, belief)
        if belief.estimate is not None and (not self._past or now - self._past[-1][0] >= PERIOD):
            self._sample(now, belief)

    def findings(self) -> list[Finding]:
        """Return what was found, the grave first."""
        found = [*self._found.values(), *self._missing(), *from_file(self._robot)]
        return sorted(found, key=lambda one: not one.grave)

    # -- what is looked at ----------------------------------------------------------------------------

    def _say(self, key: str, finding: Finding) -> None:
        self._found.setdefault(key, finding)

    def _look_at_clock(self, now: Nanos, events: Sequence[Event]) -> None:
        if self._last is not None and not 0 <= now - self._last <= JUMP:
            text = f"{seconds(now - self._last):+.1f} s passed between two steps"
            slept = "everything that was heard is old, and every motor times out"
            self._say("steps", Finding(True, "clock", text, slept, "gateway run ROBOT --realtime"))
        self._last = now
        for event in events:
            if isinstance(event, _STAMPED) and abs(now - event.t) > JUMP:
                name = event.motor if isinstance(event, Feedback) else event.sensor
                text = f"its stamps are {seconds(now - event.t):+.1f} s off the moment they came"
                old = "what is stamped in the past is too old, and what is ahead cannot be placed"
                self._say(
                    f"stamp {name}",
                    Finding(True, name, text, old, f"gateway inspect FILE  (clock of {name})"),
                )

    def _look_at(self, event: Event) -> None:
        if isinstance(event, LaserScan):
            self._scans[event.sensor] = self._scans.get(event.sensor, 0) + 1
            if not self._rays.get(event.sensor):
                hits = sum(event.range_min <= one < event.range_max for one in event.ranges)
                self._rays[event.sensor] = hits
        elif isinstance(event, Imu) and event.sensor in self._mounts:
            self._on_imu(event)
        elif isinstance(event, Feedback) and self._base is not None and event.position is not None:
            self._on_angle(self._base, event.motor, event.position)

    def _on_imu(self, event: Imu) -> None:
        """Sum what it reads along the robot's vertical."""
        row, read = self._mounts[event.sensor].rotation()[2], event.linear_acceleration
        total, count = self._gravity.get(event.sensor, (0.0, 0))
        total, count = total + sum(a * b for a, b in zip(row, read, strict=True)), count + 1
        self._gravity[event.sensor] = total, count
        if count >= 100 and total / count < UPSIDE:
            text = f"it reads {total / count:.1f} m/s² upward, +9.8 are expected: it is mounted upside down"
            turned = "its rate has the wrong sign: the base believes to turn to the other side"
            todo = f"roll = 3.1416 in [sensors.{event.sensor}] mount; then: gateway check {self._name}"
            self._say(f"upside {event.sensor}", Finding(True, event.sensor, text, turned, todo))

    def _on_angle(self, base: Base, motor: str, angle: float) -> None:
        """Add what a wheel has rolled."""
        if motor in base.joints:
            turned = abs(angle - self._angles.get(motor, angle))
            self._rolled += base.rolling[base.joints.index(motor)] * turned / len(base.joints)
            self._angles[motor] = angle

    def _explained(self, text: str) -> None:
        geometry = "wheel" in text and "sign" not in text and "swapped" not in text
        about = text.split(":", 1)[0] if text.split(":", 1)[0] in self._mounts else "wheels"
        todo = f"gateway calibrate base {self._name}"
        if not geometry and about == "wheels":
            todo = f"gateway jog {self._base.joints[0] if self._base else 'MOTOR'} {self._name}"
        matters = "wheels, gyro and scans contradict each other: the base stops, or its map is wrong"
        self._say(f"explained {text}", Finding(True, about, text.removeprefix(f"{about}: "), matters, todo))

    def _look_at_goal(self, now: Nanos, belief: Belief) -> None:
        goal = belief.goal
        if goal != self._goal:
            self._goal, self._goal_since, self._rolled_at_goal = goal, now, self._rolled
            self._past.clear()
        if goal is None:
            self._look_at_given_up(belief)
            return
        if reason := self._pathless(belief):
            self._no_path(belief, goal, reason)
        elif now - self._goal_since >= WAIT:
            if self._rolled - self._rolled_at_goal < STILL:
                self._no_motion(belief)
            self._goal_since, self._rolled_at_goal = now, self._rolled

    def _pathless(self, belief: Belief) -> str:
        reasons = [belief.reason, *(one.reason for one in belief.systems)]
        return next((one for one in reasons if one.startswith("no path")), "")

    def _look_at_given_up(self, belief: Belief) -> None:
        if reason := self._pathless(belief):
            self._no_path(belief, None, reason)

    def _no_path(self, belief: Belief, goal: Goal | None, reason: str) -> None:
        if goal is not None and is_occupied(belief, goal, self._base.inner_radius if self._base else 0.1):
            text = f"the goal ({goal.x:g}, {goal.y:g}) is inside an obstacle of the map"
            never = "there is no place for the robot: no path will ever be found"
            self._say("inside", Finding(True, "planning", text, never, f"gateway ask {self._name} drop"))
            return
        ways = "what is between is closed, or too narrow for the robot's radius, footprint and planner.margin"
        self._say("path", Finding(True, "planning", reason, ways, f"gateway ask {self._name} view"))

    def _no_motion(self, belief: Belief) -> None:
        control = next((one for one in belief.systems if one.name == "control"), None)
        why = belief.reason or (control.reason if control is not None else "")
        if control is not None and control.state == "standing":
            text = f"a goal is taken, and the base stands: {control.reason}"
            self._say("stands", Finding(True, "control", text, NEAR, f"gateway ask {self._name} view"))
        elif why:
            text = f"a goal is taken, and nothing moves: {why}"
            self._say(
                "waits",
                Finding(True, "brain", text, "the goal waits for it", f"gateway ask {self._name} status"),
            )
        else:
            text = "a goal is taken, a path is there, and the wheels do not turn"
            self._say(
                "still",
                Finding(True, "wheels", text, STUCK, f"gateway tune {self._name} {_first(self._base)}"),
            )

    def _sample(self, now: Nanos, belief: Belief) -> None:
        assert belief.estimate is not None, "it was asked for"
        pose = belief.estimate.pose
        if self._past:
            self._yaw += wrap(pose.yaw - self._past[-1][1].yaw)
        if self._base is not None and len(self._angles) == len(self._base.joints):
            angles = tuple(self._angles[name] for name in self._base.joints)
            self._way += abs(self._base.travel(self._sampled or angles, angles).distance)
            self._sampled = angles
        self._past.append((now, pose, self._yaw, self._way, belief.path_version))
        while now - self._past[0][0] > KEPT:
            self._past.popleft()
        first = self._past[0]
        rolled, turned = self._way - first[3], self._yaw - first[2]
        moved = max(math.dist((pose.x, pose.y), (one[1].x, one[1].y)) for one in self._past)
        if rolled > FROZEN and moved < rolled / 10.0 and abs(turned) < 0.2:
            text = f"wheels have rolled {rolled:.2f} m, and the believed pose has moved by {moved:.2f} m"
            frozen = (
                "a joint or sensor that perception waits for is silent, or its scans hold the pose in place"
            )
            self._say("frozen", Finding(True, "perception", text, frozen, f"gateway ask {self._name} status"))
        goal = belief.goal
        if goal is None:
            return
        nearer = math.dist((first[1].x, first[1].y), (goal.x, goal.y)) - math.dist(
            (pose.x, pose.y), (goal.x, goal.y)
        )
        if abs(turned) > ROUNDS and nearer < 0.3:
            span = seconds(now - first[0])
            text = f"it has turned by {math.degrees(turned):+.0f}° within {span:.0f} s, and is not nearer"
            spins = "one side drives the wrong way, or the gyro's sign is wrong"
            self._say("spins", Finding(True, "wheels", text, spins, f"gateway calibrate base {self._name}"))
        path, at = belief.path, (pose.x, pose.y)
        here = min(range(len(path)), key=lambda i: math.dist(path[i], at), default=0)
        length = sum(math.dist(a, b) for a, b in pairwise(path[here:]))
        straight = math.dist((pose.x, pose.y), (goal.x, goal.y))
        if straight > 0.5 and length > LONG * straight and _is_free(belief, pose, goal):
            text = f"its path is {length:.1f} m for a goal {straight:.1f} m away"
            around = "the straight way is free on the map: it is too narrow for the robot as it is stated"
            self._say("odd", Finding(False, "planning", text, around, f"gateway ask {self._name} view"))
        if belief.path_version - first[4] > REPLANNED:
            text = f"{belief.path_version - first[4]} paths within {seconds(now - first[0]):.0f} s"
            around = "the map changes under the robot: its pose jumps, or what moves is taken for walls"
            self._say(
                "replanned", Finding(False, "planning", text, around, f"gateway calibrate base {self._name}")
            )

    # -- what did not come ----------------------------------------------------------------------------

    def _missing(self) -> Iterator[Finding]:
        if self._base is None or self._last is None or self._last - self._since < WAIT:
            return
        for name, hits in self._rays.items():
            if hits == 0:
                text = f"{self._scans[name]} scans came, and not one ray of them has a return"
                yield Finding(True, name, f"no map: {text}", NO_MAP, f"gateway watch {self._bus(name)}")
        if not self._scans and self._mounts and self._asked.get("goal"):
            text = "no map: no scan has come, and goals are asked for"
            yield Finding(True, "perception", text, NO_MAP, f"gateway doctor {self._name}")

    def _bus(self, sensor: str) -> str:
        device = self._robot.sensors.get(sensor)
        return self._robot.buses[device.bus].interface if device is not None else "INTERFACE"


NO_MAP = "without walls on the map nothing is avoided, and the pose drifts with the wheels"
NEAR = (
    "something is nearer than its stop zone allows: an obstacle, its own part, or a lidar mounted otherwise"
)
STUCK = "its torque or velocity limit is too small to overcome friction, or it is blocked"


def _first(base: Base | None) -> str:
    return base.joints[0] if base is not None else "MOTOR"


def is_occupied(belief: Belief, goal: Goal, radius: float) -> bool:
    """Return whether a goal lies on an obstacle of the map, or nearer to one than the robot is narrow."""
    if belief.map is None:
        return False
    step = belief.map.resolution
    reach = math.ceil(radius / step)
    near = range(-reach, reach + 1)
    return any(
        math.hypot(right, up) <= reach
        and _log_odds(belief, goal.x + right * step, goal.y + up * step) > OCCUPIED
        for right in near
        for up in near
    )


def _is_free(belief: Belief, pose: Pose, goal: Goal) -> bool:
    """Return whether the straight way is known to be free on the map."""
    far = math.dist((pose.x, pose.y), (goal.x, goal.y))
    count = max(2, math.ceil(far / 0.05))
    shares = (number / count for number in range(count + 1))
    places = ((pose.x + s * (goal.x - pose.x), pose.y + s * (goal.y - pose.y)) for s in shares)
    return all(_log_odds(belief, x, y) < 0.0 for x, y in places)


def _log_odds(belief: Belief, x: float, y: float) -> float:
    """Return that of the cell at a place; 0: unknown."""
    chart = belief.map
    if chart is None or not chart.tiles:
        return 0.0
    side = next(iter(chart.tiles.values())).shape[0]
    column, row = (
        math.floor((at - low) / chart.resolution) for at, low in zip((x, y), chart.corner, strict=True)
    )
    tile = chart.tiles.get((row // side, column // side))
    return 0.0 if tile is None else float(tile[row % side, column % side]) * chart.unit


def from_file(robot: Robot) -> list[Finding]:
    """Return what a robot file says that cannot work, whatever is measured."""
    base = robot.brain.base
    if base is None:
        return []
    found: list[Finding] = []
    for what, value, least, unit in (
        ("max_linear", base.max_linear, SLOWEST, "m/s"),
        ("max_linear_acceleration", base.max_linear_acceleration, WEAKEST, "m/s²"),
        ("max_angular", base.max_angular, SLOWEST, "rad/s"),
        ("max_angular_acceleration", base.max_angular_acceleration, WEAKEST, "rad/s²"),
    ):
        if value < least:
            text = f"{what} = {value:g} {unit}: too small to move"
            found.append(Finding(True, f"brain.{base.kind}", text, SMALL, f"gateway check {robot.name}"))
    fastest = Twist(base.max_linear)
    wanted = zip(base.joints, base.inverse(fastest, (None,) * len(base.joints)), strict=True)
    for name, one in wanted:
        motor = robot.motors.get(name)
        if motor is None or one.velocity is None:
            continue
        limit = motor.joint.limits.velocity
        if limit < 0.2 * abs(one.velocity):
            able = base.max_linear * limit / abs(one.velocity)
            text = (
                f"its velocity limit, {limit:g} rad/s, lets the base drive {able:.2g} of "
                f"{base.max_linear:g} m/s"
            )
            found.append(Finding(able < SLOWEST, name, text, SMALL, f"gateway check {robot.name}"))
    return found


SMALL = "commands are cut to the limits: the base creeps, or does not overcome its friction"


def explained(robot: Robot, texts: Sequence[str]) -> list[Finding]:
    """Return findings of what a calibration has named."""
    todo = f"gateway calibrate base {robot.name}"
    matters = "odometry, map and stops are wrong by as much"
    return [Finding(True, robot.name, text, matters, todo) for text in texts]
