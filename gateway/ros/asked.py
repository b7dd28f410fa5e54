"""What a message of the graph asks of the robot: numbers that are checked → instructions, or why not.

Rules. Nothing that is not finite goes on. A header's time is not looked at, since its clock need not be ours:
what counts is when it came. A pose is in the frame of the map, or in none. `Held` keeps who drives by
cmd_vel: one publisher at a time, until it is silent; below a person, and not against a stop: then it must let
go, by zeros or by silence, before it moves the robot again.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from math import asin, atan2, hypot, isfinite, sqrt
from typing import Any

import numpy as np

from gateway.config.mission import cannot
from gateway.core.robot import Robot
from protocols import messages as msg
from protocols.messages import SECOND, Goal, Instruction, Nanos

PERSON: Nanos = 2 * SECOND
"""For how long after a person's instruction nobody else drives."""
MAP, ODOM = "map", "odom"
OCCUPIED = 50
"""Of 100: a cell of a grid from which on it is an obstacle"""
TILT = 0.05
"""rad by which a goal may lean"""
SUREST = 0.001
"""m, rad: a smaller standard deviation of where the robot is counts as this."""


class Refused(ValueError):
    """Why something is not done."""


def finite(*numbers: float) -> None:
    """Raise Refused if a number is not finite."""
    if not all(map(isfinite, numbers)):
        raise Refused("a number in it is not finite")


def drive(robot: Robot, twist: Any) -> msg.Drive:  # noqa: ANN401 -- a message
    """Return what a Twist asks. Raises Refused."""
    asked = msg.Drive(float(twist.linear.x), float(twist.angular.z), float(twist.linear.y))
    finite(asked.linear, asked.angular, asked.lateral)
    return asked if not (wrong := cannot(asked, robot)) else _refuse(wrong)


def _refuse(why: str) -> Any:  # noqa: ANN401 -- it does not return
    raise Refused(why)


def goal(robot: Robot, stamped: Any) -> Goal:  # noqa: ANN401 -- a message
    """Return what a PoseStamped asks. Raises Refused."""
    asked = Goal(*_pose("a goal", stamped.header, stamped.pose))
    return asked if not (wrong := cannot(asked, robot)) else _refuse(wrong)


def located(robot: Robot, stamped: Any) -> msg.Locate:  # noqa: ANN401 -- a message
    """Return where a PoseWithCovarianceStamped says that the robot is. Raises Refused.

    A covariance of zeros is not stated: then it counts as RViz's."""
    pose = _pose("the robot", stamped.header, stamped.pose.pose)
    rows = [[float(one) for one in stamped.pose.covariance[6 * row : 6 * row + 6]] for row in (0, 1, 5)]
    finite(*(one for row in rows for one in row))
    (xx, xy), (yx, yy), yaw = rows[0][:2], rows[1][:2], rows[2][5]
    if min(xx, yy, yaw) < 0.0 or abs(xy - yx) > 1e-6 * (xx + yy) or xy * yx > xx * yy * (1.0 + 1e-6):
        raise Refused(
            f"its covariance is none: x {xx:.3g}, y {yy:.3g}, x and y {xy:.3g} and {yx:.3g}, yaw {yaw:.3g}"
        )
    widest = 0.5 * (xx + yy) + hypot(0.5 * (xx - yy), xy)
    asked = msg.Locate(*pose)
    if widest or yaw:
        asked = msg.Locate(*pose, max(sqrt(widest), SUREST), max(sqrt(yaw), SUREST))
    return asked if not (wrong := cannot(asked, robot)) else _refuse(wrong)


def grid(robot: Robot, message: Any) -> msg.Grid:  # noqa: ANN401 -- a message
    """Return the map of an OccupancyGrid, in the frame of the map or the odometry. Raises Refused."""
    odom, info = message.header.frame_id.lstrip("/") == ODOM, message.info
    header = replace(message.header, frame_id=MAP) if odom else message.header
    x, y, yaw = _pose("a grid", header, info.origin)
    finite(info.resolution)
    values = np.asarray(message.data, np.int8)
    if values.size != info.width * info.height:
        raise Refused(f"{info.width} × {info.height} cells are said, and there are {values.size}")
    cells = np.where(values < 0, 0, np.where(values < OCCUPIED, 1, 2)).astype(np.uint8)
    asked = msg.Grid(x, y, yaw, odom, float(info.resolution), int(info.width), cells.tobytes())
    return asked if not (wrong := cannot(asked, robot)) else _refuse(wrong)


def _pose(what: str, header: Any, pose: Any) -> tuple[float, float, float]:  # noqa: ANN401 -- messages
    """Return x, y [m] and yaw [rad] in the map. Raises Refused."""
    frame = header.frame_id.lstrip("/")
    if frame not in ("", MAP):
        raise Refused(f"{what} is in the frame {MAP!r}, not in {frame[:60]!r}")
    p, q = pose.position, pose.orientation
    finite(p.x, p.y, q.x, q.y, q.z, q.w)
    norm = q.x * q.x + q.y * q.y + q.z * q.z + q.w * q.w
    if not 0.9 < norm < 1.1:
        raise Refused(f"its orientation is no rotation: its quaternion has the length {norm**0.5:.3g}")
    lean = max(abs(asin(max(-1.0, min(1.0, 2 * (q.w * q.y - q.z * q.x))))), abs(2 * (q.w * q.x + q.y * q.z)))
    if lean > TILT:
        raise Refused("the robot turns about z alone: its orientation leans")
    yaw = atan2(2 * (q.w * q.z + q.x * q.y), 1 - 2 * (q.y * q.y + q.z * q.z))
    return float(p.x), float(p.y), yaw


def targets(robot: Robot, kind: str, values: Any) -> list[Instruction]:  # noqa: ANN401 -- numbers
    """Return what an array asks of the joints, in the order of the robot file. Raises Refused."""
    joints = robot.brain.abilities(robot.motors).joints
    numbers = [float(value) for value in values]
    if len(numbers) != len(joints):
        raise Refused(f"it has {len(numbers)} numbers for {len(joints)} joints: {', '.join(joints)}")
    finite(*numbers)
    make: Any = {"position": msg.Position, "velocity": msg.Velocity, "effort": msg.Torque}[kind]
    asked: list[Instruction] = [make(name, value) for name, value in zip(joints, numbers, strict=True)]
    wrong = next(filter(None, (cannot(one, robot) for one in asked)), "")
    return asked if not wrong else _refuse(wrong)


@dataclass(slots=True)
class Held:
    """Who holds something, by a stream of messages."""

    timeout: Nanos
    writer: bytes = b""
    """b"": nobody"""
    moves: bool = False
    """Whether it moves the robot."""
    since: Nanos = 0
    """The last message of who holds,"""
    barred: bool = False
    """and whether it must let go first."""
    stopped: str = ""
    """Why the robot must not move; "": it may"""
    person: Nanos = -PERSON
    """The last instruction of a person"""

    def take(self, now: Nanos, writer: bytes, *, rests: bool) -> tuple[bool, str]:
        """Take a message; return whether it changes anything, and why it counts for nothing.

        `rests`: it asks for rest, which ends a motion of its own, but none of others (a goal)."""
        if self.writer and now - self.since > self.timeout:
            self.writer, self.barred, self.moves = b"", False, False
        if self.writer not in (b"", writer):
            return False, "another publisher drives: the first one does, until it is silent"
        self.writer, self.since = writer, now
        if rests:
            moved, self.moves, self.barred = self.moves, False, False
            return moved, ""
        if why := self._why_not(now):
            self.moves, self.barred = False, True
            return False, why
        self.moves = True
        return True, ""

    def _why_not(self, now: Nanos) -> str:
        if self.stopped:
            return f"stopped: {self.stopped}"
        if now - self.person < PERSON:
            return f"a person has the robot: for {PERSON // SECOND} s after the last instruction"
        return "after a stop, or a person, it must let go first: by zeros, or silence" if self.barred else ""

    def ended(self, now: Nanos) -> bool:
        """Return whether who moved the robot has just become silent."""
        if not self.writer or now - self.since <= self.timeout:
            return False
        moved, self.writer, self.barred, self.moves = self.moves, b"", False, False
        return moved

    def on_person(self, now: Nanos) -> None:
        """A person asks for something."""
        self.person = now
        self._bar()

    def on_stop(self, reason: str) -> None:
        """Take why the robot must not move."""
        self.stopped = reason
        if reason:
            self._bar()

    def _bar(self) -> None:
        self.barred, self.moves = self.barred or self.moves, False
