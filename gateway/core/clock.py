"""The clock: the only file that imports `time`. Everything else gets its times as arguments.

One clock object serves the loop and every bus, so that receive times and ticks can be compared.
"""

from __future__ import annotations

import select
import time
from collections.abc import Sequence
from datetime import UTC, datetime
from typing import Protocol

from protocols.messages import Nanos

MAX_SPREAD: Nanos = 5_000
"""Two clocks that are read one after the other within this time count as read together."""
MADE_UP: Nanos = 50_000_000
"""What a paced clock makes up for: a hiccup of the machine is none of the world's."""
AWAKE, REST = 100_000_000, 100_000
"""A paced clock that is late for so long [ns] sleeps for a moment [ns] all the same: with real-time priority
nothing else would run. To sleep more often would give the processor away whenever it was granted."""


class Clock(Protocol):
    """Integer nanoseconds since the clock was made."""

    def now(self) -> Nanos:
        """Return the present time."""
        ...

    def wait(self, until: Nanos, files: Sequence[int] = ()) -> None:
        """Return at or soon after `until`; at once if that is past. On the machine's clock: sooner, when one
        of the files can be read, or has hung up."""
        ...


class WallClock:
    """The machine's monotonic clock."""

    def __init__(self) -> None:
        self._zero = time.monotonic_ns()

    def now(self) -> Nanos:
        """Return the time since the clock was made."""
        return time.monotonic_ns() - self._zero

    def wait(self, until: Nanos, files: Sequence[int] = ()) -> None:
        """Sleep until then, or until a file can be read."""
        rest = until - self.now()
        if rest > 0 and files:
            select.select(files, (), (), rest / 1e9)
        elif rest > 0:
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

    def wait(self, until: Nanos, files: Sequence[int] = ()) -> None:  # noqa: ARG002 -- all is simulated
        """Advance to `until`."""
        self._now = max(self._now, until)


class PacedClock:
    """The clock of a world that is simulated in this process: at most as fast as the machine's.

    It advances only by `wait`, as a simulated one does: so the world moves by one period between two steps,
    however long they take. Where that is longer than the period it is slow motion, and nothing is missed."""

    def __init__(self, machine: Clock | None = None) -> None:
        self._now: Nanos = 0
        self.machine: Clock = machine or WallClock()
        """The clock that it follows."""
        self._behind: Nanos = 0
        self._slept: Nanos = 0

    def now(self) -> Nanos:
        """Return the time up to which the clock has advanced."""
        return self._now

    def wait(self, until: Nanos, files: Sequence[int] = ()) -> None:  # noqa: ARG002 -- all is simulated
        """Advance to `until`, when the machine's clock has come as far; at once if it is late."""
        self._now = max(self._now, until)
        now, due = self.machine.now(), self._now + self._behind
        if due <= now and now - self._slept >= AWAKE:
            due = now + REST
        if due > now:
            self.machine.wait(due)
            now = self._slept = self.machine.now()
        self._behind += max(0, now - self._now - self._behind - MADE_UP)


def date() -> str:
    """Return the calendar's date and time in UTC, for the head of a recording."""
    return datetime.now(UTC).isoformat(timespec="seconds")


def stopwatch() -> Nanos:
    """Return a monotonic reading for measuring durations."""
    return time.perf_counter_ns()


def processor_time() -> Nanos:
    """Return the CPU time of this process."""
    return time.process_time_ns()


def thread_time() -> Nanos:
    """Return the CPU time of the calling thread."""
    return time.thread_time_ns()
