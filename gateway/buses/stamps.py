"""Stamps of the system's clock (a kernel's receive stamps) moved onto our own clock, safe from its steps.

Rules. The system's clock may be set while we run (NTP, a person, a leap second): the difference between it
and the monotonic clock then changes from one moment to the next, and stays constant in between (slewing moves
both). So each reading looks at the difference anew. What a reading brings has arrived since the one before: a
stamp taken before the clock was set fits that window with the old difference alone, and is moved by it. A
stamp that fits the window with neither is worth nothing, and the moment of reading stands in its place.
Moved stamps never run backwards and are never later than the reading.
"""

from __future__ import annotations

from itertools import product

from protocols.messages import MILLISECOND, SECOND, Nanos

LATE = 20 * MILLISECOND
"""So long may a stamped frame take from the interrupt to the socket, on a loaded machine."""
STEP = MILLISECOND
"""Two looks at the difference between the clocks agree within this, unless a clock was set."""
OLDEST = SECOND
"""A stamp older than this, before what was read last, is no stamp of the system's clock."""


class Stamps:
    """The stamps of one bus. Plain data."""

    def __init__(self) -> None:
        self.steps = 0
        """How often the system's clock was found set."""
        self.bad = 0
        """Stamps that fitted no window."""
        self._offset: Nanos | None = None
        self._before: Nanos | None = None
        self._since: Nanos | None = None
        self._now: Nanos = 0
        self._last: Nanos = 0

    def begin(self, now: Nanos, offset: Nanos | None) -> None:
        """A reading begins. `offset`: the system's clock minus ours, in ns; None where ours is simulated."""
        self._before = None
        if self._offset is not None and offset is not None and abs(offset - self._offset) > STEP:
            self._before = self._offset
            self.steps += 1
        self._offset = offset
        self._now = now

    def end(self) -> None:
        """The reading has left nothing behind: what the next one brings will have come after this."""
        self._since = self._now

    def move(self, stamp: Nanos) -> Nanos:
        """A stamp (nanoseconds since 1970) on our clock."""
        self._last = max(self._last, min(self._moved(stamp), self._now))
        return self._last

    def none(self) -> Nanos:
        """For a frame without a stamp: the moment of reading."""
        self._last = max(self._last, self._now)
        return self._last

    def _moved(self, stamp: Nanos) -> Nanos:
        if self._offset is None:
            return self._now
        t = stamp - self._offset
        if self._before is None:
            if self._fits(t, OLDEST):
                return t
        else:
            for slack, moved in product((0, LATE), (t, stamp - self._before)):
                if self._fits(moved, slack):
                    return moved
        self.bad += 1
        return self._now

    def _fits(self, t: Nanos, slack: Nanos) -> bool:
        """Whether a frame of this time can have come since the last reading that left nothing behind.

        It may have come after `now`: a reading takes its time."""
        earliest = -slack if self._since is None else self._since - slack
        return earliest <= t <= self._now + slack
