"""By how much the stamps of a lidar are late or early, beside those of wheels and gyro: found, and used.

Rules. What a base turns between two scans is known twice: by matching, and by wheels and gyro. Had the scans
been taken some time before their stamps, the second would be that of an earlier span. For some such times
the squares of the differences are summed, over scans between which these times matter; if they are clearly
least for another time than 0, the stamps are off by that. A slip at a time, however large, counts little. A
clock that is seconds off is another matter: it is named where recordings are read.
"""

from __future__ import annotations

import math
from collections import deque

import numpy as np

from brain.belief import Floats
from brain.bodies.plane import wrap
from protocols.messages import SECOND, Nanos, seconds

LAGS = np.linspace(-0.25, 0.25, 21)
"""s, that are compared"""
LEAST = 0.03
"""s: a smaller lag is none: so far off stamps often are"""
MATTERS = 0.02
"""rad that the turn at these lags must differ by, for a scan to count"""
COUNT, FADES = 25, 0.995
"""Such scans before a lag is known; share that each sum keeps at the next one"""
CLEARLY = 0.6
"""Share of the squares without a lag, below which those with one are clearly less"""
NOISE, MOST = 0.004, 0.1
"""rad: of a difference, in any case; beyond which it is no larger"""
LARGEST = 0.3
"""s, of all lags found"""
KEPT: Nanos = 2 * SECOND


class Lag:
    """Compares the stamps of lidars with those of the base's motion. Plain data."""

    def __init__(self) -> None:
        self.found: dict[str, float] = {}
        """s by which a lidar's stamps are late"""
        self._turned: deque[tuple[Nanos, float]] = deque()
        """Time, and yaw by wheels and gyro [rad], not wrapped"""
        self._scans: dict[str, deque[tuple[Nanos, float]]] = {}
        """By lidar: time and matched yaw of scans to be compared"""
        self._squares: dict[str, Floats] = {}
        """By lidar: sums of squares, by lag [rad²],"""
        self._counts: dict[str, float] = {}
        """and of how many"""

    def on_motion(self, t: Nanos, yaw: float) -> None:
        """Add the yaw by wheels and gyro."""
        if self._turned and t <= self._turned[-1][0]:
            return
        before = self._turned[-1][1] if self._turned else yaw
        self._turned.append((t, before + wrap(yaw - before)))
        while t - self._turned[0][0] > KEPT:
            self._turned.popleft()

    def on_scan(self, name: str, t: Nanos, yaw: float) -> float:
        """Add where a scan of a lidar, of this time, was placed; return the lag [s] if one was found now."""
        scans = self._scans.setdefault(name, deque(maxlen=8))
        scans.append((t, yaw))
        newest = self._turned[-1][0] if self._turned else t
        while len(scans) > 1 and seconds(newest - scans[1][0]) > LAGS[-1]:
            (since, first), (until, second) = scans.popleft(), scans[0]
            if self._turned[0][0] < since - LAGS[-1] * SECOND:
                self._compare(name, since, until, wrap(second - first))
        return self._decide(name)

    def _compare(self, name: str, since: Nanos, until: Nanos, turn: float) -> None:
        origin = self._turned[0][0]
        times, yaws = np.array(self._turned).T
        at = (np.array([[since], [until]]) - origin) / SECOND - LAGS
        before, after = np.interp(at, (times - origin) / SECOND, yaws)
        turns = after - before
        if float(np.ptp(turns)) < MATTERS:
            return
        off = np.minimum(np.abs(turn - turns), MOST)
        self._squares[name] = FADES * self._squares.get(name, np.zeros(len(LAGS))) + off * off + NOISE**2
        self._counts[name] = FADES * self._counts.get(name, 0.0) + 1.0

    def _decide(self, name: str) -> float:
        if self._counts.get(name, 0.0) < COUNT:
            return 0.0
        squares = self._squares[name]
        best, none = int(squares.argmin()), len(LAGS) // 2
        if squares[best] > CLEARLY * squares[none] or not 0 < best < len(LAGS) - 1:
            return 0.0
        a, b, c = squares[best - 1 : best + 2].tolist()
        lag = float(LAGS[best] + 0.5 * (a - c) / (a - 2.0 * b + c) * (LAGS[1] - LAGS[0]))
        whole = self.found.get(name, 0.0) + lag
        if abs(lag) < LEAST or abs(whole) > LARGEST or not math.isfinite(lag):
            return 0.0
        self.found[name] = whole
        del self._squares[name], self._counts[name], self._scans[name]
        return lag
