"""How well a loop keeps its time, and in which words a person is told that it does not.

Rules. On real buses a loop that is late misses ticks; in a world that is simulated in this process nothing is
missed: the world is in slow motion. Either is told once in a run, when it begins to matter, and at its end,
with what to do.
"""

from __future__ import annotations

from dataclasses import dataclass

from gateway.core.clock import Clock, PacedClock, stopwatch, thread_time
from protocols.messages import MILLISECOND, SECOND, Nanos

WINDOW: Nanos = 10 * SECOND
"""Over which missed ticks are judged, in the loop's time."""
TOLERATED = 0.01
"""Share of the ticks in it that may be missed."""
PACE_WINDOW: Nanos = SECOND
"""Over which the pace is averaged at least, in the machine's time."""
SLOW = 0.9
"""Pace below which it is called slow motion."""


@dataclass(slots=True)
class LoopStats:
    """What a live loop counts."""

    ticks: int = 0
    missed: int = 0
    """Deadlines that passed while a step was still running."""
    longest_step: Nanos = 0
    """In the machine's time, or in the loop's where that is longer; of a paced loop in the machine's."""
    longest_at: Nanos = 0
    """When the longest step began, in the loop's time."""
    longest_work: Nanos = 0
    """How much of the longest step this thread was computing: the rest of it, it waited."""
    sent: int = 0
    """Packets"""
    received: int = 0
    """Packets"""
    busy: dict[str, Nanos] | None = None
    """`transmission_times`; None: nobody has asked for them, and they are not counted."""
    pace: float = 1.0
    """Of a paced clock over the machine's, in the last second: below `SLOW` it is slow motion."""
    trouble: str = ""
    """How the loop does not keep its time, and what to do; "" if it does."""
    stalled: str = ""
    """Why the loop has left: it stood for so long that the watchdog has stopped the motors; "" if not."""

    def transmission_times(self) -> dict[str, Nanos]:
        """Return by bus the transmission time of everything sent and received since this was first called: to
        count bits costs a quarter of a step. The loop goes on adding to it."""
        if self.busy is None:
            self.busy = {}
        return self.busy


@dataclass(slots=True)
class _Since:
    """The beginning of a window."""

    loop: Nanos
    """By the loop's clock."""
    machine: Nanos
    """By the clock that a paced one follows; 0 for another."""
    missed: int
    """Until then."""


class StepTiming:
    """Watches the steps of one run."""

    def __init__(self, stats: LoopStats, period: Nanos, clock: Clock) -> None:
        self._stats, self._period, self._clock = stats, period, clock
        self._machine = clock.machine if isinstance(clock, PacedClock) else None
        self._run = self._since = self._mark(clock.now())
        self._told = False
        self._began: Nanos = 0
        self._worked: Nanos = 0

    def _mark(self, now: Nanos) -> _Since:
        return _Since(now, self._machine.now() if self._machine else 0, self._stats.missed)

    def begin(self) -> None:
        """Take that a step begins."""
        self._began, self._worked = stopwatch(), thread_time()

    def end(self, now: Nanos) -> str:
        """Take that the step at `now` has ended; return what a person is to be told, if there is anything."""
        stats = self._stats
        took = max(stopwatch() - self._began, self._clock.now() - now if self._machine is None else 0)
        if took > stats.longest_step:
            stats.longest_step, stats.longest_at = took, now
            stats.longest_work = thread_time() - self._worked
        if self._machine is not None:
            self._keep_pace(now)
        else:
            self._keep_deadlines(now)
        told, self._told = self._told, self._told or bool(stats.trouble)
        return "" if told else stats.trouble

    def _keep_pace(self, now: Nanos) -> None:
        here = self._mark(now)
        if here.machine - self._since.machine >= PACE_WINDOW:
            self._stats.pace = pace = _pace(self._since, here)
            self._stats.trouble = slow_motion(pace) if pace < SLOW else ""
            self._since = here

    def _keep_deadlines(self, now: Nanos) -> None:
        many = self._stats.missed - self._since.missed > TOLERATED * WINDOW / self._period
        over = now - self._since.loop >= WINDOW
        if many or over:
            self._stats.trouble = self._missed(self._since, now) if many else ""
        if over:
            self._since = self._mark(now)

    def summary(self) -> str:
        """Return what a person is to be told of the whole run, if there is anything."""
        run, end = self._run, self._mark(self._clock.now())
        if self._machine is not None:
            pace = _pace(run, end) if end.machine - run.machine >= PACE_WINDOW else 1.0
            return slow_motion(pace) if pace < SLOW else ""
        many = end.missed - run.missed > TOLERATED * (end.loop - run.loop) / self._period
        return self._missed(run, end.loop) if many else ""

    def _missed(self, since: _Since, now: Nanos) -> str:
        """Return how many ticks were missed, the longest step, and what to do about it."""
        stats, ticks = self._stats, (now - since.loop) // self._period + 1
        late = stats.missed - since.missed
        if 2 * stats.longest_work > stats.longest_step:
            remedy = "the step is too long for this machine: lower rate_hz, or give the brain less to do"
        else:
            remedy = "other processes had the processor: end them, lower rate_hz, or run with --realtime"
        return (
            f"{late} of {ticks} ticks missed ({late / ticks:.0%}); the longest step, at "
            f"{stats.longest_at / SECOND:.1f} s, took {stats.longest_step / MILLISECOND:.1f} ms of "
            f"{self._period / MILLISECOND:g} ms, {stats.longest_work / MILLISECOND:.1f} ms of it computing; "
            f"{remedy}"
        )


def _pace(since: _Since, until: _Since) -> float:
    return (until.loop - since.loop) / (until.machine - since.machine)


def slow_motion(pace: float) -> str:
    """Return that the simulated world is slower than real time, and what to do about it."""
    return (
        f"slow motion: the simulated world goes at {pace:.2f} of real time, since this machine is too busy "
        "for more: end other processes, or lower rate_hz"
    )
