"""The motion that a source has integrated, between any two times of the last seconds."""

from __future__ import annotations

import math
from bisect import bisect_left
from typing import NamedTuple

from brain.bodies.plane import sinc
from protocols.messages import MILLISECOND, SECOND, Nanos

KEPT: Nanos = 4 * SECOND
"""Integrated motion is kept for this time."""
SLIP_SHARE = 0.35
"""Share of the wheels' way by which the base may lag behind it."""
GAP: Nanos = 250 * MILLISECOND
"""After so long without feedback a track begins anew: what comes then may be stamped late."""
AHEAD: Nanos = 60 * MILLISECOND
"""A track is extrapolated by at most this much, and a gyro's rate holds for at most this time."""


class Motion(NamedTuple):
    """Motion between two times."""

    x: float
    """m, in the frame of the first"""
    y: float
    heading: float
    """rad that the way has turned by, not wrapped"""
    turn: float
    """rad that the source shows"""
    uncertain: float = 0.0
    """rad by which that may be wrong by slip or bias"""

    def ahead(self) -> tuple[float, float]:
        """Return the way [m] along and across the mean heading: of an arc driven forward, none is across."""
        c, s = math.cos(self.heading / 2.0), math.sin(self.heading / 2.0)
        return c * self.x + s * self.y, c * self.y - s * self.x


_Row = tuple[Nanos, float, float, float, float, float]
"""Time, then x, y, heading, turn and uncertainty since the beginning of the track."""


class SourceTrack:
    """What one source has integrated. Plain data."""

    def __init__(self) -> None:
        self._rows: list[_Row] = [(0, 0.0, 0.0, 0.0, 0.0, 0.0)]

    def add(
        self,
        since: Nanos,
        t: Nanos,
        distance: float,
        heading: float,
        turn: float,
        uncertain: float,
        sideways: float = 0.0,
    ) -> None:
        """Add a motion of constant twist [m, rad] between two times, and what the source shows of its turn;
        after a gap the track begins anew."""
        rows = self._rows
        last, x, y, yaw, turned, total = rows[-1]
        if last != since or t - since > GAP:
            rows[:] = [(since if t - since <= GAP else t, x, y, yaw, turned, total)]
            if t - since > GAP:
                return
        if distance or sideways:
            share, middle = sinc(heading / 2.0), yaw + heading / 2.0
            chord, across, c, s = distance * share, sideways * share, math.cos(middle), math.sin(middle)
            x, y = x + (chord * c - across * s), y + (chord * s + across * c)
        rows.append((t, x, y, yaw + heading, turned + turn, total + uncertain))
        half = len(rows) // 2
        if rows[half][0] < t - KEPT:
            del rows[:half]

    def clear(self) -> None:
        """Forget everything: a motion was lost."""
        del self._rows[:-1]

    def between(self, since: Nanos, t: Nanos) -> Motion | None:
        """Return the motion between two times; None if the track does not reach that far."""
        a, b = self.at(since), self.at(t)
        if a is None or b is None:
            return None
        c, s = math.cos(a[3]), math.sin(a[3])
        dx, dy = b[1] - a[1], b[2] - a[2]
        return Motion(c * dx + s * dy, c * dy - s * dx, b[3] - a[3], b[4] - a[4], b[5] - a[5])

    def at(self, t: Nanos) -> _Row | None:
        """Return the sums at a time."""
        rows = self._rows
        if len(rows) < 2 or not rows[0][0] <= t <= rows[-1][0] + AHEAD:
            return None
        after = len(rows) - 1
        if t < rows[after - 1][0]:
            after = max(bisect_left(rows, (t,)), 1)
        (t0, x0, y0, yaw0, turn0, sum0), (t1, x1, y1, yaw1, turn1, sum1) = rows[after - 1], rows[after]
        p = (t - t0) / max(t1 - t0, 1)
        x, y, yaw = x0 + p * (x1 - x0), y0 + p * (y1 - y0), yaw0 + p * (yaw1 - yaw0)
        return t, x, y, yaw, turn0 + p * (turn1 - turn0), sum0 + p * (sum1 - sum0)
