"""What measured motions share: how far they have come, by the estimate, and how they end.

Rules. Distances and angles are measured as travelled along the motion that was asked for, so noise at rest
does not count.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from math import hypot, sqrt

from brain.belief import Pose
from brain.bodies.plane import motion
from brain.skills.skill import Observed
from protocols.messages import SECOND, Nanos, seconds

BRAKING, ENDING = 0.4, 2.5
"""Share of the acceleration limits with which a measured motion ends, and 1/s of the last of it: so that what
is late between a command and the estimate (jerk, wheels, filter) does not carry it past its end"""
CREEP, CREEP_TURN = 0.02, 0.05
"""m/s and rad/s at which the last of it is covered"""
LENGTH_TOLERANCE = 0.005
"""m, of a measured motion"""
ROLLED_OUT, ROLLED_OUT_TURN = 0.3, 0.6
"""m and rad: what a base moved during a pause, if less, was its coming to rest, and counts"""
REST, REST_TURN = 0.02, 0.03
"""m/s and rad/s below which the base stands"""
HEADING_GAIN = 1.5
"""1/s: how a straight motion keeps its heading"""
NO_PROGRESS: Nanos = 8 * SECOND
"""A motion that gets no further for this long has failed."""


@dataclass(slots=True)
class MotionProgress:
    """Progress of a motion, and since when there is none."""

    last: Pose | None = None
    so_far: float = 0.0
    best: float = 0.0
    since: Nanos | None = None
    paused: bool = False

    def add(self, seen: Observed, share: Callable[[float, float, float], float]) -> None:
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

    def stuck(self, seen: Observed) -> str:
        """Return why there was no progress for long; "" if there was."""
        if self.since is None or seen.now - self.since < NO_PROGRESS:
            return ""
        return f"no progress for {seconds(NO_PROGRESS):g} s: {seen.obstructed or 'the base does not move'}"

    def halt(self) -> None:
        """Be ready to go on after a pause."""
        self.since, self.paused = None, True


def ending(left: float, acceleration: float) -> float:
    """Return the speed from which a motion comes to rest at its end, which is so far."""
    return min(sqrt(2.0 * BRAKING * acceleration * left), ENDING * left)
