"""The clock: the only file that imports `time`. Everything else gets its times as arguments.

One clock object serves the loop and every bus, so that receive times and ticks can be compared.
"""

from __future__ import annotations

import time
from datetime import UTC, datetime
from typing import Protocol

from protocols.messages import Nanos

MAX_SPREAD: Nanos = 5_000
"""Two clocks that are read one after the other within this time count as read together."""


class Clock(Protocol):
    """Integer nanoseconds since the clock was made."""

    def now(self) -> Nanos:
        """Return the present time."""
        ...

    def wait(self, until: Nanos) -> None:
        """Return at or soon after `until`; at once if that is past."""
        ...


class WallClock:
    """The machine's monotonic clock."""

    def __init__(self) -> None:
        self._zero = time.monotonic_ns()

    def now(self) -> Nanos:
        """Return the time since the clock was made."""
        return time.monotonic_ns() - self._zero

    def wait(self, until: Nanos) -> None:
        """Sleep until then."""
        rest = until - self.now()
        if rest > 0:
            time.sleep(rest / 1e9)

    def system_offset(self) -> Nanos:
        """Return the system clock (of a kernel's receive stamps) minus this one; changes when that is set."""
        best, width = 0, 1 << 63
        for _ in range(3):
            before, system, after = time.monotonic_ns(), time.time_ns(), time.monotonic_ns()
            if after - before < width:
                best, width = system - (before + after) // 2, after - before
            if width < MAX_SPREAD:
                break
        return best + self._zero


class SimulatedClock:
    """A clock that advances only by `wait`. Never reads the machine's."""

    def __init__(self) -> None:
        self._now: Nanos = 0

    def now(self) -> Nanos:
        """Return the time up to which the clock has advanced."""
        return self._now

    def wait(self, until: Nanos) -> None:
        """Advance to `until`."""
        self._now = max(self._now, until)


def date() -> str:
    """Return the calendar's date and time in UTC, for the head of a recording."""
    return datetime.now(UTC).isoformat(timespec="seconds")


def stopwatch() -> Nanos:
    """Return a monotonic reading for measuring durations."""
    return time.perf_counter_ns()


def processor_time() -> tuple[Nanos, Nanos]:
    """Return the CPU time of this process, and the part of the calling thread."""
    return time.process_time_ns(), time.thread_time_ns()
