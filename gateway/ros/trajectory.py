"""A joint trajectory of ROS 2 as samples of positions with velocities: checked once, then a function of time.

Rules. Times are s since its beginning, positions rad (m of a sliding joint) of the joints of the robot file.
Between two points it goes on a cubic where both have velocities, else straight; it begins where the joints
are. What cannot be followed is refused as a whole, with the reason.

A message of some hundred points takes milliseconds to be read: that is done where the sockets are (`packed`),
and a step gets arrays (`unpacked`).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import msgpack
import numpy as np
import numpy.typing as npt

from brain.belief import Floats
from gateway.ros.types import Malformed, decode
from protocols.messages import SECOND, Nanos, Position

MOST_POINTS, MOST_JOINTS, LONGEST = 2000, 64, 600.0
SOONEST = 0.05
"""s: what is to be there sooner is where the joints are already."""


class Refused(ValueError):
    """Why a trajectory cannot be followed."""


class Points(NamedTuple):
    """A trajectory as it came: n points of k joints."""

    joints: tuple[str, ...]
    times: Floats
    """s, n; s since it begins"""
    positions: Floats
    """n × k"""
    velocities: Floats
    """n × k; 0 in points without"""
    moving: npt.NDArray[np.bool_]
    """n: the points that have them"""


class Goal(NamedTuple):
    """A goal of follow_joint_trajectory."""

    trajectory: Points | str
    """Or why it is none"""
    goal_tolerance: Sequence[tuple[str, float]]
    """Joint and position; so is the next"""
    path_tolerance: Sequence[tuple[str, float]]
    goal_time_tolerance: Nanos


def points_of(message: Any) -> Points:  # noqa: ANN401 -- a message
    """Return the points of a message. Raises Refused."""
    joints, given = tuple(message.joint_names), message.points
    count = len(joints)
    for one in given:
        if len(one.positions) != count or len(one.velocities) not in (0, count):
            counts = f"{len(one.positions)} positions and {len(one.velocities)} velocities"
            raise Refused(f"a point has {counts} for {count} joints")
    times = [one.time_from_start.sec + one.time_from_start.nanosec / SECOND for one in given]
    shape = len(given), count
    positions = np.array([one.positions for one in given], dtype=np.float64).reshape(shape)
    moving = np.array([bool(len(one.velocities)) for one in given], dtype=np.bool_)
    velocities = np.zeros(shape)
    if moving.any():
        velocities[moving] = [one.velocities for one in given if len(one.velocities)]
    return Points(joints, np.array(times, dtype=np.float64), positions, velocities, moving)


def packed(type_: str, data: bytes) -> bytes:
    """Return what a step needs of a JointTrajectory, or of the request of a goal: or why it is none."""
    try:
        message = decode(type_, data)
    except Malformed as error:
        return bytes(msgpack.packb([str(error)]))
    goal = getattr(message, "goal", None)
    asked: list[Any] = [] if goal is None else [bytes(message.goal_id.uuid), *_tolerances(goal)]
    try:
        joints, *arrays = points_of(message if goal is None else goal.trajectory)
    except Refused as error:
        return bytes(msgpack.packb([str(error), [], *asked]))
    return bytes(msgpack.packb(["", [joints, *(one.tobytes() for one in arrays)], *asked]))


def _tolerances(goal: Any) -> tuple[Any, ...]:  # noqa: ANN401 -- a message
    kinds = goal.goal_tolerance, goal.path_tolerance
    at_goal, on_path = ([(one.name, float(one.position)) for one in some] for some in kinds)
    span = goal.goal_time_tolerance
    return at_goal, on_path, max(0, int(span.sec) * SECOND + int(span.nanosec))


def unpacked(data: bytes) -> tuple[Points | str, bytes, Goal | None]:
    """Return what was packed: the points or why there are none, and of a goal its id, and the goal. Raises
    Refused if it was no message."""
    why, *content = msgpack.unpackb(data)
    if not content:
        raise Refused(why)
    parts, *asked = content
    points = why or _points(*parts)
    if not asked:
        return points, b"", None
    id_, at_goal, on_path, time = asked
    return points, id_, Goal(points, [(n, p) for n, p in at_goal], [(n, p) for n, p in on_path], time)


def _points(joints: Sequence[str], times: bytes, rows: bytes, speeds: bytes, moving: bytes) -> Points:
    shape = len(moving), len(joints)
    positions, velocities = (np.frombuffer(each).reshape(shape) for each in (rows, speeds))
    mask = np.frombuffer(moving, dtype=np.bool_)
    return Points(tuple(joints), np.frombuffer(times), positions, velocities, mask)


class Trajectory(NamedTuple):
    """A motion of some joints: points, the first of which is where it begins."""

    joints: tuple[str, ...]
    times: Floats
    positions: Floats
    velocities: Floats
    moving: npt.NDArray[np.bool_]

    @property
    def end(self) -> float:
        """s"""
        return float(self.times[-1])

    @property
    def goal(self) -> dict[str, float]:
        """Where each joint is to be at the end."""
        return dict(zip(self.joints, self.positions[-1].tolist(), strict=True))

    def at(self, time: float) -> list[Position]:
        """Return what each joint is given at a time; at the end, and after it, without a velocity."""
        if time >= self.end:
            return [Position(name, each) for name, each in self.goal.items()]
        b = max(1, int(np.searchsorted(self.times, time, "right")))
        a = b - 1
        start, end = self.times[[a, b]].tolist()
        span, share = end - start, (time - start) / (end - start)
        cubic = bool(self.moving[a] and self.moving[b])
        from_, to = self.positions[[a, b]].tolist()
        slopes = self.velocities[[a, b]].tolist()
        found = []
        for k, name in enumerate(self.joints):
            p, q = from_[k], to[k]
            slope = (q - p) / span
            u, v = (slopes[0][k], slopes[1][k]) if cubic else (slope, slope)
            found.append(Position(name, *_cubic(p, q, u * span, v * span, share, span)))
        return found


def _cubic(p: float, q: float, u: float, v: float, s: float, span: float) -> tuple[float, float]:
    """Return position and velocity at the share s of a Hermite cubic (u, v: end slopes by share)."""
    h = (2 * s - 3) * s * s
    position = (1 + h) * p + ((s - 2) * s + 1) * s * u - h * q + (s - 1) * s * s * v
    slope = 6 * s * (s - 1) * (p - q) + ((3 * s - 4) * s + 1) * u + (3 * s - 2) * s * v
    return position, slope / span


def read(points: Points | str, able: Sequence[str], now: Mapping[str, float | None]) -> Trajectory:
    """Return the trajectory of some points, from where the joints are `now`. Raises Refused."""
    if isinstance(points, str):
        raise Refused(points)
    names, count = points.joints, len(points.times)
    if not names or len(set(names)) < len(names) or len(names) > MOST_JOINTS:
        raise Refused("it names no joints, or one twice, or too many")
    if unknown := [name for name in names if name not in able]:
        raise Refused(
            f"there is no joint {unknown[0][:60]!r} that takes positions; there are {', '.join(able)}"
        )
    if not 1 <= count <= MOST_POINTS:
        raise Refused(f"it has {count} points, expected 1 to {MOST_POINTS}")
    starts = [now.get(name) for name in names]
    if None in starts:
        raise Refused(f"where {names[starts.index(None)]} is, is not known")
    numbers = (points.times, points.positions, points.velocities)
    if not all(np.isfinite(each).all() for each in numbers) or points.times.min() < 0.0:
        raise Refused("a number in it is not finite, or a time is negative")
    times = np.concatenate([[0.0, max(float(points.times[0]), SOONEST)], points.times[1:]])
    if len(wrong := np.flatnonzero(np.diff(times) <= 0.0)):
        before, after = times[wrong[0] : wrong[0] + 2].tolist()
        raise Refused(f"its times do not grow: {after:g} s after {before:g} s")
    if times[-1] > LONGEST:
        raise Refused(f"it takes {times[-1]:g} s, expected at most {LONGEST:g} s")
    first = np.array([[float(each or 0.0) for each in starts]])
    return Trajectory(
        names,
        times,
        np.concatenate([first, points.positions]),
        np.concatenate([np.zeros_like(first), points.velocities]),
        np.concatenate([[True], points.moving]),
    )


class Follower(NamedTuple):
    """A trajectory under way."""

    trajectory: Trajectory
    began: Nanos

    def samples(self, now: Nanos) -> list[Position]:
        """Return what the joints are given now."""
        return self.trajectory.at((now - self.began) / SECOND)

    def over(self, now: Nanos) -> bool:
        """Whether its time is over."""
        return (now - self.began) / SECOND >= self.trajectory.end
