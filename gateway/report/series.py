"""Signals and paths of any length in bounded memory. Pure.

Rules. A signal is the lowest and the highest value in each interval of time, in the order in which they came,
so that no peak is lost. When there are too many intervals, all signals join theirs in pairs. A path keeps a
point where it has gone on by some distance, which doubles when there are too many points.
"""

from __future__ import annotations

from collections.abc import Iterator
from math import hypot, isfinite

from brain.belief import Pose
from brain.bodies.plane import wrap
from protocols.messages import SECOND, Nanos

INTERVALS = 2000
"""The most intervals of all signals: as many as a screen has columns."""
POINTS = 2000
"""The most points of a path."""
APART = 0.01
"""m between two points of a path, at first"""
TURNING = 0.2
"""m that count as much as a turn of 1 rad"""


class Signal:
    """One signal: intervals that have values, and of each the lowest, the highest, and which came last."""

    def __init__(self) -> None:
        self.at: list[int] = []
        """Number of the interval."""
        self.low: list[float] = []
        self.high: list[float] = []
        self.rising: list[bool] = []
        """Whether the highest value came after the lowest."""

    def add(self, at: int, low: float, high: float, rising: bool) -> None:
        """Add values, lowest and highest, in the last interval or behind it."""
        if not self.at or self.at[-1] != at:
            self.at.append(at)
            self.low.append(low)
            self.high.append(high)
            self.rising.append(rising)
            return
        lower, higher = low < self.low[-1], high > self.high[-1]
        if lower or higher:
            self.rising[-1] = rising if lower and higher else higher
            self.low[-1], self.high[-1] = min(low, self.low[-1]), max(high, self.high[-1])

    def joined(self) -> Signal:
        """Return the signal over intervals of twice the length."""
        half = Signal()
        for at, low, high, rising in zip(self.at, self.low, self.high, self.rising, strict=True):
            half.add(at // 2, low, high, rising)
        return half

    @property
    def range(self) -> tuple[float, float]:
        """The lowest and the highest value of all."""
        return min(self.low), max(self.high)


class Signals:
    """Signals by name over one axis of time.

    Args:
        width: length of an interval at first [ns].
        most: intervals.
    """

    def __init__(self, width: Nanos, most: int = INTERVALS) -> None:
        self.width, self._most = width, most
        self.start: Nanos | None = None
        self._at = 0
        self._signals: dict[tuple[str, ...], Signal] = {}

    def move_to(self, now: Nanos) -> None:
        """Go on to a time [ns]; what is added next has this time."""
        if self.start is None:
            self.start = now
        self._at = (now - self.start) // self.width
        while self._at >= self._most:
            self._join()

    def add(self, value: float, *name: str) -> None:
        """Add a value to the signal of this name; one that is not finite is left out."""
        if value - value != 0.0:
            return
        signal = self._signals.get(name)
        if signal is None:
            signal = self._signals[name] = Signal()
        signal.add(self._at, value, value, True)

    def get(self, *name: str) -> Signal | None:
        """Return the signal of this name; None if it has no value."""
        return self._signals.get(name)

    def shrink(self, points: int) -> None:
        """Join intervals until all signals together have at most this many points, gaps counted as well."""
        while 2 * (self._at + 1) * len(self._signals) > points and self._at:
            self._join()

    def times(self) -> list[float]:
        """Return the time axis [s] from the first value: two points for each interval."""
        return [half * self.width / (2 * SECOND) for half in range(2 * (self._at + 1))]

    def values(self) -> Iterator[tuple[tuple[str, ...], list[float | None]]]:
        """Yield each name with its values on the time axis, None where it has none."""
        for name, signal in self._signals.items():
            values: list[float | None] = [None] * (2 * (self._at + 1))
            for at, low, high, rising in zip(signal.at, signal.low, signal.high, signal.rising, strict=True):
                values[2 * at : 2 * at + 2] = (low, high) if rising else (high, low)
            yield name, values

    def _join(self) -> None:
        self.width *= 2
        self._at //= 2
        self._signals = {name: signal.joined() for name, signal in self._signals.items()}


class DrivenTrack:
    """A path driven: poses with their times, where it has gone on by some distance; the last one always."""

    def __init__(self, most: int = POINTS) -> None:
        self._most, self._apart = most, APART
        self._points: list[tuple[Nanos, Pose]] = []
        self._last: tuple[Nanos, Pose] | None = None
        self.length = 0.0
        """m, of all poses that were added, in steps of `APART`"""
        self._measured: Pose | None = None

    def add(self, t: Nanos, pose: Pose) -> None:
        """Add a pose; one that is not finite is left out."""
        if not isfinite(pose.x + pose.y + pose.yaw):
            return
        self._measure(pose)
        self._last = (t, pose)
        if self._points and _distance(self._points[-1][1], pose) < self._apart:
            return
        self._points.append((t, pose))
        if len(self._points) > self._most:
            self._apart *= 2.0
            points, self._points = self._points, []
            for point in points:
                if not self._points or _distance(self._points[-1][1], point[1]) >= self._apart:
                    self._points.append(point)

    def _measure(self, pose: Pose) -> None:
        before = self._measured or pose
        step = hypot(pose.x - before.x, pose.y - before.y)
        if self._measured is None or step >= APART:
            self.length += step
            self._measured = pose

    @property
    def points(self) -> list[tuple[Nanos, Pose]]:
        """The points kept, in order of time, and the last pose."""
        if self._last is None or self._points[-1] == self._last:
            return list(self._points)
        return [*self._points, self._last]


def _distance(a: Pose, b: Pose) -> float:
    return hypot(b.x - a.x, b.y - a.y) + TURNING * abs(wrap(b.yaw - a.yaw))
