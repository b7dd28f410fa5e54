"""How much of something there is in a second. State is plain data; time is an argument."""

from __future__ import annotations

from collections import deque

from protocols.messages import SECOND, Nanos

PIECES = 20
"""A window slides by so many steps."""


class Rate:
    """Over a sliding window, or (None) over the whole time since it began."""

    def __init__(self, began: Nanos, window: Nanos | None) -> None:
        self.total = 0
        self._began = began
        self._window = window
        self._recent: deque[tuple[Nanos, int]] = deque()
        self._in_window = 0

    def add(self, t: Nanos, amount: int = 1) -> None:
        """So much at a time; an amount that comes late counts as of now."""
        self.total += amount
        if self._window is None:
            return
        self._in_window += amount
        piece = t - t % (self._window // PIECES)
        if self._recent and self._recent[-1][0] >= piece:
            last, before = self._recent[-1]
            self._recent[-1] = (last, before + amount)
        else:
            self._recent.append((piece, amount))
            self._forget(t, self._window)

    def per_second(self, now: Nanos) -> float:
        """The rate up to now."""
        amount, span = self.total, now - self._began
        if self._window is not None:
            self._forget(now, self._window)
            amount, span = self._in_window, min(span, self._window)
        return amount * SECOND / span if span > 0 else 0.0

    def _forget(self, now: Nanos, window: Nanos) -> None:
        while self._recent and self._recent[0][0] <= now - window:
            self._in_window -= self._recent.popleft()[1]
