"""Receive timestamps of the system clock (the kernel's) mapped onto our own clock, robust to clock steps.

Rules. The system clock may be set while we run (NTP, a person, a leap second): its offset from the monotonic
clock then jumps, and is constant in between (slewing moves both). So each read samples the offset anew. What
a read returns has arrived since the one before: a timestamp taken before the step fits that window with the
old offset alone, and is mapped with it. One that fits the window with neither is invalid, and the time of
reading replaces it. Mapped timestamps never run backwards and are never later than the read.
"""

from __future__ import annotations

from itertools import product

from protocols.messages import MILLISECOND, SECOND, Nanos

LATENCY = 20 * MILLISECOND
"""Longest time a timestamped frame takes from the interrupt to the socket, on a loaded machine."""
STEP = MILLISECOND
"""Two samples of the clock offset agree within this, unless a clock was set."""
OLDEST = SECOND
"""A timestamp older than this, before the last read, is not one of the system clock."""


class TimestampMapper:
    """The timestamps of one bus. Plain data."""

    def __init__(self) -> None:
        self.steps = 0
        """Steps of the system clock that were detected."""
        self.bad = 0
        """Timestamps that fitted no window."""
        self._offset: Nanos | None = None
        self._old_offset: Nanos | None = None
        """The offset before a step that happened since the previous read."""
        self._since: Nanos | None = None
        """The last read that left nothing behind."""
        self._now: Nanos = 0
        self._last: Nanos = 0

    def begin(self, now: Nanos, offset: Nanos | None) -> None:
        """Begin a read. `offset`: the system clock minus ours, in ns; None where ours is simulated."""
        self._old_offset = None
        if self._offset is not None and offset is not None and abs(offset - self._offset) > STEP:
            self._old_offset = self._offset
            self.steps += 1
        self._offset = offset
        self._now = now

    def end(self) -> None:
        """End a read that left nothing behind: what the next one returns has arrived after it began."""
        self._since = self._now

    def map(self, stamp: Nanos | None) -> Nanos:
        """Return a timestamp (nanoseconds since 1970) on our clock; for a frame without one the time of
        reading."""
        mapped = self._now if stamp is None else self._mapped(stamp)
        self._last = max(self._last, min(mapped, self._now))
        return self._last

    def _mapped(self, stamp: Nanos) -> Nanos:
        if self._offset is None:
            return self._now
        t = stamp - self._offset
        if self._old_offset is None:
            if self._fits(t, OLDEST):
                return t
        else:
            for slack, mapped in product((0, LATENCY), (t, stamp - self._old_offset)):
                if self._fits(mapped, slack):
                    return mapped
        self.bad += 1
        return self._now

    def _fits(self, t: Nanos, slack: Nanos) -> bool:
        """True if a frame of this time can have arrived since the last read that left nothing behind.

        It may have arrived after `now`: reading takes time."""
        earliest = -slack if self._since is None else self._since - slack
        return earliest <= t <= self._now + slack
