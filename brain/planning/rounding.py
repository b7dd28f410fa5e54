"""Corners of a path made round, as far as the footprint fits and it costs hardly more.

Rules. A corner is replaced by a Bézier curve of fifth order whose first and last three control points lie on
its two legs: its heading and its curvature are continuous, and the curvature is 0 where it begins and ends.
The largest curve is taken that fits; if none does, the corner stays, and the base turns there, if it can.
"""

from __future__ import annotations

from functools import cache
from math import atan2, dist, inf

import numpy as np

from brain.belief import Floats
from brain.planning.polyline import Point
from brain.planning.snapshot import LINE_WORK, line_cost
from brain.planning.ways import POSE_WORK, Ways

LARGEST = 0.8
"""m from a corner to the beginning of its curve, at most"""
SHARES = (1.0, 0.7, 0.5, 0.35, 0.25)
"""Of the room that there is for a curve, those tried"""
SMALLEST = 0.04
"""m from a corner to the beginning of its curve"""
DEARER = 1.02
"""How much more a curve may cost than its corner"""
STRAIGHT = 0.02
"""rad: less is no corner"""
BACK = (1.0, 2.0 / 3.0, 1.0 / 3.0)
"""Where the control points lie on each leg, as shares of the way to the corner"""


class Rounding:
    """A path whose corners are made round, one after the other. State is plain data."""

    def __init__(self, corners: tuple[Point, ...]) -> None:
        self._corners, self._at = corners, 1
        self.points: list[Point] = [corners[0]]
        """The path so far."""
        self.fits = True
        """Whether the footprint fits so far."""
        self._share = 0
        """Of SHARES, the curve that is tried"""
        self._curve: list[Point] = []
        self._seen, self._left = 0, 0.0
        """Lines of the curve that were looked at; the cost [m] that is left for the others"""

    @property
    def finished(self) -> bool:
        """True if all corners were seen, or the footprint does not fit."""
        return self._at >= len(self._corners) or not self.fits

    def advance(self, ways: Ways) -> None:
        """Look at one line of a curve, or begin one; count the work there."""
        corners, at = self._corners, self._at
        if at + 1 >= len(corners):
            self._take(ways, [corners[at]])
        elif not self._curve:
            self._begin(ways, corners[at], corners[at + 1])
        elif self._seen + 1 < len(self._curve):
            a, b = self._curve[self._seen : self._seen + 2]
            self._left -= _cost(ways, a, b)
            self._seen += 1
            if self._left < 0.0:
                self._curve, self._share = [], self._share + 1
        elif _fits(ways, self._curve):
            self._take(ways, self._curve)
        else:
            self._curve, self._share = [], self._share + 1

    def _begin(self, ways: Ways, here: Point, after: Point) -> None:
        """Begin to try a curve; keep the corner if it is straight, or no smaller curve is left."""
        before = self.points[-1]
        legs = dist(before, here), dist(here, after)
        room = min(legs[0], legs[1] if self._at + 2 == len(self._corners) else legs[1] / 2.0, LARGEST)
        far = room * SHARES[self._share] if self._share < len(SHARES) else 0.0
        if far < SMALLEST:
            self._take(ways, [here])
            return
        (ux, uy), (vx, vy) = (
            ((b[0] - a[0]) / leg, (b[1] - a[1]) / leg)
            for a, b, leg in ((before, here, legs[0]), (here, after, legs[1]))
        )
        if abs(atan2(ux * vy - uy * vx, ux * vx + uy * vy)) < STRAIGHT:
            self._take(ways, [here])
            return
        (ax, ay), (bx, by) = (-far * ux, -far * uy), (far * vx, far * vy)
        control = [(ax * k, ay * k) for k in BACK] + [(bx * k, by * k) for k in reversed(BACK)]
        count = max(8, min(24, int(2.0 * far / ways.ground.resolution)))
        self._curve = [(x, y) for x, y in (_bernstein(count) @ np.array(control) + np.array(here)).tolist()]
        usual = _cost(ways, self._curve[0], here) + _cost(ways, here, self._curve[-1])
        self._seen, self._left = 0, DEARER * usual if usual < inf else -1.0

    def _take(self, ways: Ways, curve: list[Point]) -> None:
        """Go on along a curve, or to a corner and turn there; note whether the footprint fits."""
        begin, here, at = self.points[-1], self._corners[self._at], self._at
        self.points += curve
        self._curve, self._share, self._at = [], 0, at + 1
        if ways.footprint.shape.corners is None:
            return
        ways.spend(POSE_WORK * (2 + int(dist(begin, curve[0]) / ways.ground.resolution)))
        self.fits = ways.footprint.line_fits(ways.ground, begin, curve[0])
        if len(curve) == 1 and at + 1 < len(self._corners) and self.fits:
            after = self._corners[at + 1]
            headings = (atan2(b[1] - a[1], b[0] - a[0]) for a, b in ((begin, here), (here, after)))
            ways.spend(POSE_WORK * 30)
            self.fits = ways.footprint.turn_fits(ways.ground, here, *headings)


def _cost(ways: Ways, a: Point, b: Point) -> float:
    ways.spend(LINE_WORK)
    return line_cost(ways.ground, a, b)


def _fits(ways: Ways, track: list[Point]) -> bool:
    """Return whether the footprint fits along each of these lines."""
    if ways.footprint.shape.corners is None:
        return True
    x, y = (np.array(track[1:]) + np.array(track[:-1])).T / 2.0
    dx, dy = np.diff(np.array(track), axis=0).T
    return bool(ways.factors(x, y, np.arctan2(dy, dx)).max() < inf)


@cache
def _bernstein(count: int) -> Floats:
    """Return the weights of the six control points at points of the curve."""
    t = np.linspace(0.0, 1.0, count + 1)
    return np.stack([n * t**k * (1.0 - t) ** (5 - k) for k, n in enumerate((1, 5, 10, 10, 5, 1))], axis=1)
