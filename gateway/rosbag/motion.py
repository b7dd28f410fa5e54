"""How the base moved, as what its joints did: a recording has twists, poses or angles of joints.

Rules. Of twists, each joint's angle is the integral by the trapezium rule; of poses, what the joints turn on
the one arc from each to the next; angles of joints are taken as they are. What steers is where the body's
inverse kinematics set it.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

from brain.belief import Pose
from brain.bodies.body import Base
from brain.bodies.plane import Twist, arc, sinc, wrap
from protocols.messages import SECOND, Feedback, Nanos, seconds


@dataclass(frozen=True, slots=True)
class OdometryReading:
    """One reading of the base's motion."""

    t: Nanos
    linear: float
    """m/s"""
    angular: float
    """rad/s"""
    pose: Pose
    lateral: float = 0.0
    """m/s to the left"""


class JointsReading(NamedTuple):
    """Angles of the body's joints, in the order of `Body.joints`."""

    t: Nanos
    angles: tuple[float, ...]
    """rad"""


class Wheels:
    """Joint angles from the motion of the base: of wheels as they roll, of what steers as set."""

    def __init__(self, body: Base) -> None:
        self._body = body
        self._angles = [0.0] * len(body.joints)
        """rad"""
        self._last: tuple[Nanos, list[float]] | None = None
        """Time of the last reading, and the joints' speeds then [rad/s]."""
        self._before: OdometryReading | None = None

    def feedback(self, reading: OdometryReading) -> list[Feedback]:
        """Return the feedback of every joint for a twist; to be called once per reading, in order."""
        setpoints = self._body.inverse(Twist(reading.linear, reading.angular, reading.lateral), self._angles)
        speeds = [one.velocity or 0.0 for one in setpoints]
        if self._last is not None:
            t, before = self._last
            half = seconds(reading.t - t) / 2.0
            for i, (old, new) in enumerate(zip(before, speeds, strict=True)):
                self._angles[i] += half * (old + new)
        for i, one in enumerate(setpoints):
            if one.position is not None:
                self._angles[i] = one.position
        self._last = (reading.t, speeds)
        return self._feedback(reading.t, speeds)

    def feedback_of_pose(self, reading: OdometryReading) -> list[Feedback]:
        """Return the same for a pose. [] for one of the same time as the last: its motion is in the next."""
        before, self._before = self._before, reading
        speeds = [0.0] * len(self._angles)
        if before is not None:
            distance, turn, sideways = between(before.pose, reading.pose, sideways=self._body.moves_sideways)
            setpoints = self._body.inverse(Twist(distance, turn, sideways), self._angles)
            span = seconds(reading.t - before.t)
            for i, one in enumerate(setpoints):
                if one.position is not None:
                    self._angles[i] = one.position
                else:
                    self._angles[i] += one.velocity or 0.0
                    speeds[i] = (one.velocity or 0.0) / span if span > 0.0 else 0.0
            if not reading.t > before.t:
                return []
        return self._feedback(reading.t, speeds)

    def _feedback(self, t: Nanos, speeds: Sequence[float]) -> list[Feedback]:
        moving = zip(self._body.joints, self._angles, speeds, strict=True)
        return [Feedback(name, t, angle, speed) for name, angle, speed in moving]


def between(a: Pose, b: Pose, *, sideways: bool) -> tuple[float, float, float]:
    """Return the motion from one pose to another on one arc: m ahead, rad to the left, m to the left.

    A base that cannot move sideways goes by the chord's length, forward or backward."""
    turn = wrap(b.yaw - a.yaw)
    heading = a.yaw + turn / 2.0
    c, s = math.cos(heading), math.sin(heading)
    dx, dy = b.x - a.x, b.y - a.y
    ahead, aside = c * dx + s * dy, c * dy - s * dx
    if sideways:
        return ahead / sinc(turn / 2.0), turn, aside / sinc(turn / 2.0)
    return math.copysign(math.hypot(dx, dy), ahead) / sinc(turn / 2.0), turn, 0.0


def never_filled_in(readings: Sequence[OdometryReading]) -> bool:
    """Whether the twists are all 0 while the poses are not all alike."""
    if any(one.linear or one.angular or one.lateral for one in readings):  # also if it is no number
        return False
    return len({(one.pose.x, one.pose.y, one.pose.yaw) for one in readings}) > 1


def with_twists(readings: Sequence[OdometryReading], *, sideways: bool) -> list[OdometryReading]:
    """Return readings of poses with the twists that lead from each to the next."""
    found: list[OdometryReading] = []
    before: OdometryReading | None = None
    for one in readings:
        if before is not None and one.t > before.t:
            span = (one.t - before.t) / SECOND
            distance, turn, aside = between(before.pose, one.pose, sideways=sideways)
            one = replace(one, linear=distance / span, angular=turn / span, lateral=aside / span)
        found.append(one)
        before = one
    return found


def rolled(readings: Sequence[OdometryReading]) -> list[OdometryReading]:
    """Return readings of twists with the poses that they lead to."""
    found: list[OdometryReading] = []
    pose, before = Pose(0.0, 0.0, 0.0), None
    for one in readings:
        if before is not None:
            half = (one.t - before.t) / SECOND / 2.0
            pose = arc(
                pose,
                half * (before.linear + one.linear),
                half * (before.angular + one.angular),
                half * (before.lateral + one.lateral),
            )
        found.append(replace(one, pose=pose))
        before = one
    return found


def of_joints(body: Base, readings: Sequence[JointsReading]) -> Iterator[OdometryReading]:
    """Yield the motion that the angles of joints show."""
    pose, before = Pose(0.0, 0.0, 0.0), None
    for one in readings:
        linear = angular = lateral = 0.0
        if before is not None:
            travel = body.travel(before.angles, one.angles)
            pose = arc(pose, travel.distance, travel.turn, travel.sideways)
            if one.t > before.t:
                span = (one.t - before.t) / SECOND
                linear, angular, lateral = travel.distance / span, travel.turn / span, travel.sideways / span
        yield OdometryReading(one.t, linear, angular, pose, lateral)
        before = one
