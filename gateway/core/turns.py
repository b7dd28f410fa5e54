"""When a step is one of the brain's, beside lines on which devices speak only when asked: answers on these
are taken in steps between, which do not move those that follow."""

from __future__ import annotations

from protocols.messages import MILLISECOND, Nanos

SOON: Nanos = 100_000
"""A step this much before its time is one of the brain's."""
APART: Nanos = MILLISECOND
"""Least time between two of the brain's, if a driver is due that no line keeps waiting."""
_NEVER: Nanos = -(1 << 62)


class BrainTurns:
    """The brain's turns. State is plain data."""

    def __init__(self, period: Nanos) -> None:
        self._period = period
        self._next: Nanos | None = None
        """When the brain is asked next, in steps of its period from the first one on."""
        self.asked_at = _NEVER
        """When it was last asked."""
        self.left_at = _NEVER
        """When the last frames were last made without it."""

    def ask(self, now: Nanos) -> None:
        """Note a step of the brain: one that is late, or between two, does not move those that follow."""
        self.asked_at = now
        if self._next is None:
            self._next = now + self._period
        elif now >= self._next - SOON:
            self._next += ((now + SOON - self._next) // self._period + 1) * self._period

    def leave(self, now: Nanos) -> None:
        """Note that the last frames are made."""
        self.left_at = now

    @property
    def begun(self) -> bool:
        """True if the brain was asked."""
        return self._next is not None

    def is_early(self, now: Nanos) -> bool:
        """True if the brain was asked, and its next turn has not come."""
        return self._next is not None and now < self._next - SOON

    def is_early_to_leave(self, now: Nanos) -> bool:
        """True if the last frames were made less than a period ago."""
        return now < self.left_at + self._period - SOON

    def earliest(self) -> Nanos:
        """Return the time from which on there may be another turn."""
        return max(self.asked_at, self.left_at) + APART
