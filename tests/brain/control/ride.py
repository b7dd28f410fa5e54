"""A base that follows what control commands, with a lag; and its motion, judged by finite differences."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from itertools import pairwise
from math import inf

import numpy as np

from brain.belief import Floats, Pose
from brain.bodies.body import Base
from brain.bodies.plane import REST, Commanded, Twist, arc
from brain.control.motion import MotionControl, MotionInputs
from brain.control.pursuit import PursuitSettings
from brain.planning.polyline import Point
from protocols.messages import MILLISECOND

PERIOD, STEPS = 0.02, 4
"""s between two commands, and steps of the plant within"""


@dataclass
class Path:
    """A path as the planner gives it."""

    points: tuple[Point, ...]
    headings: tuple[float, ...] | None = None
    gears: tuple[int, ...] | None = None


class Free:
    """No obstacle anywhere."""

    def is_too_fast(self, now: Commanded) -> bool:
        return False

    def allowed(self, before: Commanded, desired: Commanded, wanted: Twist, dt: float) -> Commanded:
        return desired


class Ride:
    """A base at 50 Hz whose motion follows the commands as a lag of first order."""

    def __init__(
        self, body: Base, pose: Pose, settings: PursuitSettings | None = None, lag: float = 0.04
    ) -> None:
        self.motion = MotionControl(settings or PursuitSettings(), body, body.joints)
        self.body, self.pose, self.lag, self.now = body, pose, lag, 0
        self.twist = REST
        self.commanded: list[Twist] = [REST]
        self.track: list[Pose] = [pose]
        self.errors: list[float] = []
        self.seen: Callable[[Pose], Pose] = lambda pose: pose
        """What control is told of the pose"""

    def follow(self, path: Path, yaw: float | None = None) -> None:
        self.path = path
        self.motion.follow(path, yaw)

    def run(
        self, span: float, share: float = 1.0, clearance: float = inf, drive: Twist | None = None
    ) -> bool:
        """Return whether it arrived within this time [s]."""
        for _ in range(round(span / PERIOD)):
            self.step(share, clearance, drive)
            if self.motion.arrived:
                return True
        return False

    def step(self, share: float = 1.0, clearance: float = inf, drive: Twist | None = None) -> None:
        self.now += 20 * MILLISECOND
        inputs = MotionInputs(self.seen(self.pose), self.pose, share, True, drive, clearance)
        self.motion.step(self.now, inputs, Free())
        for _ in range(STEPS):
            part = PERIOD / STEPS
            gain = part / max(self.lag, part)
            self.twist = Twist(
                *(v + gain * (c - v) for v, c in zip(self.twist, self.motion.twist, strict=True))
            )
            self.pose = arc(
                self.pose, *(part * v for v in (self.twist.linear, self.twist.angular, self.twist.lateral))
            )
        self.commanded.append(self.motion.twist)
        self.track.append(self.pose)
        self.errors.append(self.motion.pursuit.error)


def off(track: Sequence[Pose], points: Sequence[Point]) -> Floats:
    """Distance [m] of every pose from a chain of straight lines."""
    places = np.array([(pose.x, pose.y) for pose in track])
    best = np.full(len(places), inf)
    for (ax, ay), (bx, by) in pairwise(points):
        line = np.array([bx - ax, by - ay])
        share = np.clip((places - (ax, ay)) @ line / max(float(line @ line), 1e-12), 0.0, 1.0)
        best = np.minimum(best, np.hypot(*(places - (ax, ay) - share[:, None] * line).T))
    return best


def jerk(values: Sequence[float], dt: float = PERIOD) -> float:
    """The largest second difference of a speed."""
    return float(np.abs(np.diff(values, 2)).max(initial=0.0)) / dt**2


def acceleration(values: Sequence[float], dt: float = PERIOD) -> float:
    """The largest difference of a speed."""
    return float(np.abs(np.diff(values)).max(initial=0.0)) / dt
