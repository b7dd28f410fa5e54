"""A joint trajectory of ROS 2 as samples of positions with velocities: checked once, then a function of time.

Rules. Times are s since its beginning, positions rad (m of a sliding joint) of the joints of the robot file.
Between two points it goes on a cubic where both have velocities, else straight; it begins where the joints
are. What cannot be followed is refused as a whole, with the reason.
"""

from __future__ import annotations

from bisect import bisect_right
from collections.abc import Mapping, Sequence
from math import isfinite
from typing import Any, NamedTuple

from protocols.messages import SECOND, Nanos, Position

MOST_POINTS, MOST_JOINTS, LONGEST = 2000, 64, 600.0
SOONEST = 0.05
"""s: what is to be there sooner is where the joints are already."""


class Refused(ValueError):
    """Why a trajectory cannot be followed."""


class Point(NamedTuple):
    """Where the joints are to be."""

    time: float
    positions: tuple[float, ...]
    velocities: tuple[float, ...] | None


class Trajectory(NamedTuple):
    """A motion of some joints."""

    joints: tuple[str, ...]
    points: tuple[Point, ...]

    @property
    def end(self) -> float:
        """s"""
        return self.points[-1].time

    @property
    def goal(self) -> dict[str, float]:
        """Where each joint is to be at the end."""
        return dict(zip(self.joints, self.points[-1].positions, strict=True))

    def at(self, time: float) -> list[Position]:
        """Return what each joint is given at a time; at the end, and after it, without a velocity."""
        if time >= self.end:
            return [Position(name, each) for name, each in self.goal.items()]
        index = max(1, bisect_right([one.time for one in self.points], time))
        a, b = self.points[index - 1], self.points[index]
        span, share = b.time - a.time, (time - a.time) / (b.time - a.time)
        found = []
        for k, name in enumerate(self.joints):
            p, q = a.positions[k], b.positions[k]
            slope = (q - p) / span
            u, v = (
                (slope, slope)
                if a.velocities is None or b.velocities is None
                else (a.velocities[k], b.velocities[k])
            )
            found.append(Position(name, *_cubic(p, q, u * span, v * span, share, span)))
        return found


def _cubic(p: float, q: float, u: float, v: float, s: float, span: float) -> tuple[float, float]:
    """Return position and velocity at the share s of a Hermite cubic (u, v: end slopes by share)."""
    h = (2 * s - 3) * s * s
    position = (1 + h) * p + ((s - 2) * s + 1) * s * u - h * q + (s - 1) * s * s * v
    slope = 6 * s * (s - 1) * (p - q) + ((3 * s - 4) * s + 1) * u + (3 * s - 2) * s * v
    return position, slope / span


def read(message: Any, able: Sequence[str], now: Mapping[str, float | None]) -> Trajectory:  # noqa: ANN401
    """Return the trajectory of a message, from where the joints are `now`. Raises Refused."""
    names = tuple(message.joint_names)
    if not names or len(set(names)) < len(names) or len(names) > MOST_JOINTS:
        raise Refused("it names no joints, or one twice, or too many")
    if unknown := [name for name in names if name not in able]:
        raise Refused(
            f"there is no joint {unknown[0][:60]!r} that takes positions; there are {', '.join(able)}"
        )
    if not 1 <= len(message.points) <= MOST_POINTS:
        raise Refused(f"it has {len(message.points)} points, expected 1 to {MOST_POINTS}")
    starts = [now.get(name) for name in names]
    if None in starts:
        raise Refused(f"where {names[starts.index(None)]} is, is not known")
    still = (0.0,) * len(names)
    points = [Point(0.0, tuple(float(each or 0.0) for each in starts), still)]
    for one in message.points:
        point = _point(one, len(names))
        if point.time <= points[-1].time and not (len(points) == 1 and point.time <= SOONEST):
            raise Refused(f"its times do not grow: {point.time:g} s after {points[-1].time:g} s")
        points.append(point._replace(time=max(point.time, SOONEST)) if len(points) == 1 else point)
    if points[-1].time > LONGEST:
        raise Refused(f"it takes {points[-1].time:g} s, expected at most {LONGEST:g} s")
    return Trajectory(names, tuple(points))


def _point(one: Any, count: int) -> Point:  # noqa: ANN401
    time = one.time_from_start.sec + one.time_from_start.nanosec / SECOND
    positions, velocities = tuple(map(float, one.positions)), tuple(map(float, one.velocities))
    if len(positions) != count or len(velocities) not in (0, count):
        raise Refused(
            f"a point has {len(positions)} positions and {len(velocities)} velocities for {count} joints"
        )
    if not all(map(isfinite, (time, *positions, *velocities))) or time < 0.0:
        raise Refused("a number in it is not finite, or a time is negative")
    return Point(time, positions, velocities or None)


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
