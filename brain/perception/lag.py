"""By how much the stamps of a lidar are late or early, beside those of wheels and gyro: found, and used.

Rules. What a base turns between two scans is known twice: by matching, and by wheels and gyro. Had the scans
been taken some time before their stamps, the second would be that of an earlier span. For some such times
the squares of the differences are summed, over scans between which these times matter; if they are clearly
least for another time than 0, the stamps are off by that. A slip at a time, however large, counts little.
From then on a scan is searched where the motion of those spans predicts it. Which of the two clocks is wrong
nothing tells: the pose believed for a scan's stamp remains the one at which it was taken. A clock that is
seconds off is another matter: it is named where recordings are read.
"""

from __future__ import annotations

from collections import deque

import numpy as np

from brain.belief import Floats, Pose
from brain.bodies.plane import seen_from, wrap
from protocols.messages import SECOND, Nanos, seconds

LAGS = np.linspace(-0.25, 0.25, 21)
"""s, that are compared"""
LEAST = 0.03
"""s: a smaller lag is none: so far off stamps often are"""
MATTERS = 0.02
"""rad that the turn at these lags must differ by, for a scan to count"""
COUNT, FADES = 40, 0.995
"""Such scans before a lag is known; share that each sum keeps at the next one"""
CLEARLY = 0.35
"""Share of the squares without a lag, below which those with one are clearly less: of wheels that merely
slip it was 0.5"""
NOISE, MOST = 0.004, 0.1
"""rad: of a difference, in any case; beyond which it is no larger"""
KEPT: Nanos = 2 * SECOND


class Lag:
    """Compares the stamps of lidars with those of the base's motion. Plain data."""

    def __init__(self) -> None:
        self.found: dict[str, float] = {}
        """s by which a lidar's stamps are late"""
        self._path: deque[tuple[Nanos, float, float, float]] = deque()
        """Time, and pose by wheels and gyro: m, m, rad, not wrapped"""
        self._scans: dict[str, deque[tuple[Nanos, float]]] = {}
        """By lidar: time and matched yaw of scans to be compared"""
        self._squares: dict[str, Floats] = {}
        """By lidar: sums of squares, by lag [rad²],"""
        self._counts: dict[str, float] = {}
        """and of how many"""

    def on_motion(self, t: Nanos, pose: Pose) -> None:
        """Add the pose by wheels and gyro."""
        if self._path and t <= self._path[-1][0]:
            return
        before = self._path[-1][3] if self._path else pose.yaw
        self._path.append((t, pose.x, pose.y, before + wrap(pose.yaw - before)))
        while t - self._path[0][0] > KEPT:
            self._path.popleft()

    def motion(self, name: str, since: Nanos, until: Nanos) -> Pose | None:
        """Return the motion between two stamps of a lidar, where its lag is known; None where it is not, or
        the base has not yet told of that motion."""
        lag = round(self.found.get(name, 0.0) * SECOND)
        if not lag or not self._path:
            return None
        if not self._path[0][0] <= since - lag <= until - lag <= self._path[-1][0]:
            return None
        path = np.array(self._path, dtype=np.float64)
        times = np.array([since, until], dtype=np.float64) - lag - path[0, 0]
        x, y, yaw = (np.interp(times, path[:, 0] - path[0, 0], path[:, k]).tolist() for k in (1, 2, 3))
        return seen_from(Pose(x[0], y[0], yaw[0]), Pose(x[1], y[1], yaw[1]))

    def on_scan(self, name: str, t: Nanos, yaw: float) -> bool:
        """Add where a scan of a lidar, of this time, was placed; return whether a lag was found now."""
        scans = self._scans.setdefault(name, deque(maxlen=8))
        scans.append((t, yaw))
        newest = self._path[-1][0] if self._path else t
        while len(scans) > 1 and seconds(newest - scans[1][0]) > LAGS[-1]:
            (since, first), (until, second) = scans.popleft(), scans[0]
            if self._path[0][0] < since - LAGS[-1] * SECOND:
                self._compare(name, since, until, wrap(second - first))
        return self._decide(name)

    def _compare(self, name: str, since: Nanos, until: Nanos, turn: float) -> None:
        origin = self._path[0][0]
        times, yaws = np.array([(one[0] - origin, one[3]) for one in self._path], dtype=np.float64).T
        at = np.array([[since - origin], [until - origin]]) - SECOND * LAGS
        before, after = np.interp(at, times, yaws)
        turns = after - before
        if float(np.ptp(turns)) < MATTERS:
            return
        off = np.minimum(np.abs(turn - turns), MOST)
        self._squares[name] = FADES * self._squares.get(name, np.zeros(len(LAGS))) + off * off + NOISE**2
        self._counts[name] = FADES * self._counts.get(name, 0.0) + 1.0

    def _decide(self, name: str) -> bool:
        if self._counts.get(name, 0.0) < COUNT:
            return False
        squares, before = self._squares[name], self.found.get(name, 0.0)
        best, known = int(squares.argmin()), int(np.abs(LAGS - before).argmin())
        if squares[best] > CLEARLY * squares[known] or not 0 < best < len(LAGS) - 1:
            return False
        a, b, c = squares[best - 1 : best + 2].tolist()
        lag = float(LAGS[best] + 0.5 * (a - c) / (a - 2.0 * b + c) * (LAGS[1] - LAGS[0]))
        if abs(lag - before) < LEAST:
            return False
        self.found[name] = lag
        return True
