"""Positions that go on beyond the range in which a device reports them: by its velocity, meanwhile.

Rules. Inside the range the position is the reported one, and the turns that were counted. A jump of half the
range is a report that wraps. What is counted is as good as the velocity: for wheels, not for joints.
"""

from __future__ import annotations

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
