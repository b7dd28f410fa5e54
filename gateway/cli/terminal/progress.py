"""How far long work is, and how long it will take: on the error stream, so that the output stays what it was.

Rules. On a terminal one line moves, and is gone at the end. Elsewhere there is a plain line every ten
seconds, so that what is quick prints nothing.
"""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import TextIO

from gateway.cli.terminal.screen import TerminalLine
from gateway.core.clock import stopwatch
from protocols.messages import SECOND, Nanos

MOVING, PLAIN = SECOND // 2, 10 * SECOND
"""Between two lines: on a terminal, elsewhere."""
KNOWN = 0.01
"""The share from which the time left is told: before, it is a guess."""


def text(what: str, done: float, total: float | None, elapsed: float) -> str:
    """Return how far something is: its share, the time it took [s], and the time left at this rate.

    `total`: of what is `done`; None or 0 if it is not known."""
    if not total:
        return f"{what}: {done:g} so far, {duration(elapsed)}"
    share = min(max(done / total, 0.0), 1.0)
    left = f", about {duration(elapsed * (1.0 - share) / share)} left" if share >= KNOWN else ""
    return f"{what}: {share:.0%} of {total:g}, {duration(elapsed)}{left}"


def duration(seconds: float) -> str:
    """Return a duration in at most two units, as people say it."""
    whole = round(seconds)
    if whole < 60:
        return f"{whole} s"
    if whole < 3600:
        return f"{whole // 60} min {whole % 60:02} s"
    return f"{whole // 3600} h {whole % 3600 // 60:02} min"


class Progress:
    """Shows how far something is: `update` as often as it likes."""

    def __init__(self, what: str, total: float | None, stream: TextIO | None = None) -> None:
        self._what, self._total = what, total
        stream = stream or sys.stderr
        self._line = TerminalLine(stream)
        self._period: Nanos = MOVING if stream.isatty() else PLAIN
        self._began = stopwatch()
        self._shown = self._began - (self._period if stream.isatty() else 0)

    def update(self, done: float) -> None:
        """Show it, if it is time to."""
        now = stopwatch()
        if now - self._shown >= self._period:
            self._shown = now
            self._line.draw(text(self._what, done, self._total, (now - self._began) / SECOND))

    def clear(self) -> None:
        """Remove the line, for something else to be printed; the next update draws it again."""
        self._line.clear()


@contextmanager
def progress(what: str, total: float | None) -> Iterator[Progress]:
    """Show how far something is while inside; the line is gone at the end."""
    shown = Progress(what, total)
    try:
        yield shown
    finally:
        shown.clear()


@contextmanager
def simulation(what: str) -> Iterator[Callable[[Nanos], None]]:
    """Show how much virtual time has passed while inside; yield what takes the time since its last call."""
    passed: Nanos = 0
    with progress(f"{what}, simulated seconds", None) as shown:

        def advance(more: Nanos) -> None:
            nonlocal passed
            passed += more
            shown.update(round(passed / SECOND, 1))

        yield advance
