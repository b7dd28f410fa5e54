"""The clock: the only file that imports `time`. Everything else is given its moments.

One clock object serves the loop and every bus, so that stamps and ticks can be compared.
"""

from __future__ import annotations

import time
from datetime import UTC, datetime
from typing import Protocol

from protocols.messages import Nanos

SHARP: Nanos = 5_000
"""Two clocks that were read one after the other within this were read together."""


class Clock(Protocol):
    """Integer nanoseconds since the clock was made."""

    def now(self) -> Nanos:
        """The present moment."""
        ...

    def wait(self, until: Nanos) -> None:
        """Return at or soon after `until`; at once if that is past."""
        ...


class WallClock:
    """The machine's monotonic clock."""

    def __init__(self) -> None:
        self._zero = time.monotonic_ns()

    def now(self) -> Nanos:
        """Since the clock was made."""
        return time.monotonic_ns() - self._zero

    def wait(self, until: Nanos) -> None:
        """Sleep until then."""
        rest = until - self.now()
        if rest > 0:
            time.sleep(rest / 1e9)

    def system_offset(self) -> Nanos:
        """The system's clock (of a kernel's receive stamps) minus this one, now: another one after a step."""
        best, width = 0, 1 << 63
        for _ in range(3):
            before, system, after = time.monotonic_ns(), time.time_ns(), time.monotonic_ns()
            if after - before < width:
                best, width = system - (before + after) // 2, after - before
            if width < SHARP:
                break
        return best + self._zero


class SimulatedClock:
    """A clock that stands still until somebody waits. Never reads the machine's."""

    def __init__(self, start: Nanos = 0) -> None:
        self._now = start

    def now(self) -> Nanos:
        """Where the last wait has left it."""
        return self._now

    def wait(self, until: Nanos) -> None:
        """Be there."""
        self._now = max(self._now, until)


def date() -> str:
    """The calendar's date and time in UTC, for the head of a recording."""
    return datetime.now(UTC).isoformat(timespec="seconds")


def stopwatch() -> Nanos:
    """A monotonic reading for measuring how long something took."""
    return time.perf_counter_ns()


def processor_time() -> tuple[Nanos, Nanos]:
    """How long this process, and of it the calling thread, has been at work on a processor."""
    return time.process_time_ns(), time.thread_time_ns()
