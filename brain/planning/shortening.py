"""Paths made shorter: straight lines between corners, and corners moved to where the path costs least.

Rules. A change is made only if the path then costs less in the search's own metric, and if the footprint fits
along it. The work is bounded: after so many comparisons the rest stays as it is.
"""

from __future__ import annotations

from itertools import pairwise
from math import cos, dist, inf, pi, sin

from brain.planning.footprint import Footprint
from brain.planning.polyline import Point
from brain.planning.snapshot import CELLS_PER_WORK, LINE_WORK, MAX_LINES, Ground, line_cost

SHORTCUT_CORNERS = 30
"""Corners ahead to which a shortcut is tried."""
LONGEST_LINE = 2000
"""Cells, from which on a straight line is not tried."""


class Shortening:
    """A path that is given fewer corners: a straight line replaces a part where it costs no more. After
    so many comparisons the rest stays as it is."""

    def __init__(
        self, corners: list[Point], footprint: Footprint | None = None, most: int = MAX_LINES
    ) -> None:
        """With a footprint, a line counts only if it fits along it; `most`: comparisons."""
        self.corners = corners
        self._footprint = footprint if footprint and footprint.shape.corners else None
        self.kept = corners[:1]
        """The path so far."""
        self._at, self._best, self._ahead = 0, 1, 2
        """The corner last kept, the farthest that a line from it replaced the path to, and the one to try."""
        self._so_far = 0.0
        """m, cost of the path between the corner last kept and the one before that to be tried"""
        self._left = most
        self._legs: dict[tuple[int, int], float] = {}
        """m, costs of the given path between two corners"""

    @property
    def finished(self) -> bool:
        """True if the last corner is kept."""
        return self._at >= len(self.corners) - 1

    def advance(self, ground: Ground, work: int) -> int:
        """Continue for at most about this much work; return the rest of it."""
        while work > 0 and not self.finished:
            at, ahead = self._at, self._ahead
            straight = inf
            if ahead < min(at + SHORTCUT_CORNERS, len(self.corners)) and self._left > 0:
                if ahead == at + 2:
                    self._so_far, work = self._line(ground, at, at + 1, work)
                leg, work = self._line(ground, ahead - 1, ahead, work)
                straight, work = self._line(ground, at, ahead, work)
                self._so_far += leg
                self._left -= 1
            if straight < inf:
                if straight <= self._so_far + 1e-9 < inf:
                    work -= LINE_WORK * (self._footprint is not None)
                    if self._fits(ground, at, ahead):
                        self._best = ahead
                self._ahead += 1
            else:
                self.kept.append(self.corners[self._best])
                self._at, self._best, self._ahead = self._best, self._best + 1, self._best + 2
                work -= 1
        return work

    def _fits(self, ground: Ground, a: int, b: int) -> bool:
        """Return whether the footprint fits along the straight line between two corners."""
        if self._footprint is None:
            return True
        return self._footprint.line_fits(ground, self.corners[a], self.corners[b])

    def _line(self, ground: Ground, a: int, b: int, work: int) -> tuple[float, int]:
        """Return the cost of the straight line between two corners, and the rest of the work."""
        if (cost := self._legs.get((a, b))) is None:
            start, end = self.corners[a], self.corners[b]
            cells = dist(start, end) / ground.resolution
            cost = line_cost(ground, start, end) if cells < LONGEST_LINE else inf
            work -= LINE_WORK + int(min(cells, LONGEST_LINE)) // CELLS_PER_WORK
            if b == a + 1:
                self._legs[a, b] = cost
        return cost, work


STEPS = (0.4, 0.2, 0.1, 0.05)
"""m by which corners are moved: each until it is of no more use"""
DIRECTIONS = tuple((cos(k * pi / 4.0), sin(k * pi / 4.0)) for k in range(8))
GAIN = 1e-3
"""m that a move must spare"""
MOST_MOVES = 800
"""Places that are tried, of all corners together"""


class Tightening:
    """A path whose inner corners are moved, in turn, to where it costs less (pattern search, Hooke and Jeeves
    1961); one that is of no use is left out."""

    def __init__(self, corners: list[Point], footprint: Footprint | None = None) -> None:
        self.corners = corners
        self._footprint = footprint if footprint and footprint.shape.corners else None
        self._at, self._step, self._idle, self._left = 1, 0, 0, MOST_MOVES
        """The corner that is next; the size of a step; corners in turn that did not move; places left."""
        self._tried = 0
        """Places about the corner, and before them the corner itself, that were compared."""
        self._best = (inf, corners[0])
        """Cost [m] with the corner at the best of them, and that place"""

    @property
    def finished(self) -> bool:
        """True if no corner is to be moved."""
        return len(self.corners) < 3 or self._step >= len(STEPS) or self._left <= 0

    def advance(self, ground: Ground, work: int) -> int:
        """Continue for about this much work; return the rest of it."""
        while work > 0 and not self.finished:
            work = self._compare(ground, work)
        return work

    def _compare(self, ground: Ground, work: int) -> int:
        """Compare one place of a corner with the best so far; return the rest of the work."""
        before, here, after = self.corners[self._at - 1 : self._at + 2]
        if self._tried == 0:
            usual, work = self._cost(ground, (before, here, after), work)
            straight, work = self._cost(ground, (before, after), work)
            if straight <= usual < inf:
                del self.corners[self._at]
                self._at, self._idle = max(1, min(self._at, len(self.corners) - 2)), 0
                return work
            self._best = usual - GAIN, here
        else:
            dx, dy = DIRECTIONS[self._tried - 1]
            place = here[0] + dx * STEPS[self._step], here[1] + dy * STEPS[self._step]
            cost, work = self._cost(ground, (before, place, after), work)
            if cost < self._best[0]:
                self._best = cost, place
            self._left -= 1
        self._tried += 1
        if self._tried > len(DIRECTIONS):
            self._go_on(here)
        return work

    def _go_on(self, here: Point) -> None:
        """Move the corner to the best place, and take the next one."""
        there, inner = self._best[1], len(self.corners) - 2
        self.corners[self._at], self._tried = there, 0
        self._idle = 0 if there != here else self._idle + 1
        self._at = self._at % inner + 1
        if self._idle >= inner:
            self._step, self._idle = self._step + 1, 0

    def _cost(self, ground: Ground, points: tuple[Point, ...], work: int) -> tuple[float, int]:
        """Return the cost [m] of straight lines between points, and the rest of the work."""
        total = 0.0
        for a, b in pairwise(points):
            work -= LINE_WORK + int(dist(a, b) / ground.resolution) // CELLS_PER_WORK
            total += line_cost(ground, a, b)
            if total == inf:
                return inf, work
        if self._footprint is not None:
            for a, b in pairwise(points):
                work -= LINE_WORK
                if not self._footprint.line_fits(ground, a, b):
                    return inf, work
        return total, work
