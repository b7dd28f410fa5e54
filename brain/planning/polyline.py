"""A polyline parametrised by arc length: projection on it, points along it."""

from __future__ import annotations

from bisect import bisect_left, bisect_right
from itertools import accumulate, pairwise
from math import dist, hypot, inf

Point = tuple[float, float]
"""m, m"""
SAME = 1e-9
"""m between two points that are one"""


class Polyline:
    """A polyline parametrised by the length along it [m]. Immutable."""

    def __init__(self, points: tuple[Point, ...]) -> None:
        self.points = (points[0], *(b for a, b in pairwise(points) if dist(a, b) > SAME))
        steps = (hypot(b[0] - a[0], b[1] - a[1]) for a, b in pairwise(self.points))
        self.at = (0.0, *accumulate(steps))
        """Length [m] along the line, of each point."""

    @property
    def length(self) -> float:
        """Total length [m]."""
        return self.at[-1]

    def point(self, along: float) -> Point:
        """Return the point at this length [m] along the line; beyond its end, straight on."""
        if len(self.points) == 1:
            return self.points[0]
        i = min(max(bisect_right(self.at, along) - 1, 0), len(self.points) - 2)
        (ax, ay), (bx, by) = self.points[i], self.points[i + 1]
        share = (along - self.at[i]) / (self.at[i + 1] - self.at[i])
        return ax + share * (bx - ax), ay + share * (by - ay)

    def straight(self, along: float, longest: float) -> float:
        """Return up to where [m] the line is straight from `along` on, by at most this length [m]."""
        corner = bisect_right(self.at, along)
        return min(along + longest, self.at[min(corner, len(self.at) - 1)])

    def project(self, place: Point, low: float = 0.0, high: float = inf) -> tuple[float, float]:
        """Return (length along the line, distance) [m] of the nearest point between `low` and `high` [m]."""
        best = (low, inf)
        for i in range(max(bisect_left(self.at, low) - 1, 0), len(self.points) - 1):
            begin, end = self.at[i], self.at[i + 1]
            if begin > high:
                break
            (ax, ay), (bx, by) = self.points[i], self.points[i + 1]
            ux, uy = (bx - ax) / (end - begin), (by - ay) / (end - begin)
            run = (place[0] - ax) * ux + (place[1] - ay) * uy
            run = min(max(run, 0.0, low - begin), min(end, high) - begin)
            off = hypot(ax + run * ux - place[0], ay + run * uy - place[1])
            if off < best[1]:
                best = (begin + run, off)
        if best[1] == inf:
            end = min(max(low, 0.0), self.length)
            x, y = self.point(end)
            return end, hypot(x - place[0], y - place[1])
        return best
