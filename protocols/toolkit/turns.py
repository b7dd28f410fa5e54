"""Positions that go on beyond the range in which a device reports them: by its velocity, meanwhile.

Rules. Of `Turns`: inside the range the position is the reported one, and the turns that were counted; a jump
of half the range is a report that wraps. Of `Shaft`: the position is where the angle says, in the turn that
is nearest to where the velocity has brought it, or without an angle there. What is counted is as good as the
velocity: for wheels, not for joints.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

from protocols.messages import MILLISECOND, Nanos, seconds

LONGEST: Nanos = 50 * MILLISECOND
"""Time between two reports for which a velocity counts."""


@dataclass(slots=True)
class Turns:
    """One shaft. Plain data."""

    position: float | None = None
    reported: float | None = None
    offset: float = 0.0
    velocity: float = 0.0
    at: Nanos = 0

    def add(self, t: Nanos, reported: float | None, velocity: float | None, end: float) -> float | None:
        """Return the position; `reported` is None beyond ±end [rad]."""
        before = self.velocity
        self.velocity = before if velocity is None else velocity
        expected = reported
        if self.position is not None:
            expected = self.position + 0.5 * (before + self.velocity) * seconds(min(t - self.at, LONGEST))
        there = None not in (reported, self.reported)
        if reported is not None and there and abs(reported - (self.reported or 0.0)) < end:
            expected = reported + self.offset
        elif reported is not None and expected is not None:
            self.offset = expected - reported
        self.position, self.reported, self.at = expected, reported, t
        return expected


FAR = 0.3
"""rad beyond what the velocity explains, by which one report alone moves no position; two steps,
where it is coarse"""


@dataclass(slots=True)
class Shaft:
    """One shaft that reports its angle within a turn, or its velocity alone. Plain data."""

    position: float | None = None
    """rad, with the turns since it was first reported"""
    velocity: float = 0.0
    at: Nanos | None = None
    """When it last reported"""
    doubtful: bool = False
    """The angle in that report cannot be."""
    longest: Nanos = 2 * LONGEST
    """Time between two reports for which a velocity counts."""

    def add(self, t: Nanos, angle: float | None, velocity: float | None, step: float = 0.0) -> None:
        """Record a report [rad, rad/s]. An angle that is coarser, in steps of `step`, confirms where it is
        taken to be, if it can."""
        since = seconds(0 if self.at is None else min(t - self.at, self.longest))
        before, self.at = self.velocity, t
        self.velocity = before if velocity is None else velocity
        if self.position is None:
            self.position = None if angle is None else math.remainder(angle, math.tau)
            return
        expected = self.position + 0.5 * (before + self.velocity) * since
        if angle is None:
            self.position = expected
            return
        off = math.remainder(angle - expected, math.tau)
        most = (2.0 * step or FAR) + abs(self.velocity) * since
        far = abs(off) > most and since < seconds(self.longest)
        self.doubtful = far and not self.doubtful
        if not self.doubtful:
            self.position = expected + (off if abs(off) > step else 0.0)

    def forget(self, position: float | None = None) -> None:
        """Begin anew, at a position [rad] or where it reports next."""
        self.position, self.velocity, self.at = position, 0.0, None
