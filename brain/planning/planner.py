"""One path query, answered over several steps.

Rules. A result is a `Path` (all of it over known free ground), a `FrontierPath` (the known part of the path
that is best if unknown ground is assumed passable: the free-space assumption, as in D* Lite, Koenig and
Likhachev 2002), or a `NoPath` with the reason in words; never an empty or partial path called a path. No
point of a result lies on unknown ground, unless the settings treat unknown ground as free. Known paths are
preferred: a path through unknown ground is used only where no known path exists. What lies beyond the known
map is unknown ground, so a goal there has a `FrontierPath`. Paths are shortened by line of sight where that
costs no more in the search's own metric, so clearance is kept.
"""

from __future__ import annotations

from dataclasses import dataclass
from math import dist, inf
from typing import TypeAlias

import numpy as np

from brain.planning.astar import BEYOND, CellPath, Search, Searching, Unreachable
from brain.planning.costmap import FREE, NEAR, TOUCHING, UNKNOWN, Costmap, Map, PlannerSettings
from brain.planning.polyline import Point
from brain.planning.snapshot import MAX_LINES, Ground, Snapshot, is_blocked, line_cost


@dataclass(frozen=True, slots=True)
class Path:
    """A path to the goal, over known free ground."""

    points: tuple[Point, ...]
    """m; at least start and end"""
    cost: float
    """m, weighted by the nearness of obstacles, from the search"""
    escape: float = 0.0
    """m at its beginning that lead out of a place too near to an obstacle"""


@dataclass(frozen=True, slots=True)
class FrontierPath:
    """A path to the frontier of known ground, from where the goal may become reachable."""

    points: tuple[Point, ...]
    beyond: Point
    """m, the first unknown point on the assumed path to the goal"""
    escape: float = 0.0


@dataclass(frozen=True, slots=True)
class NoPath:
    """No path exists, and why."""

    reason: str


PlanResult: TypeAlias = Path | FrontierPath | NoPath | Searching


class PathQuery:
    """One query in progress; deep-copyable between any two calls.

    In turn: assemble the snapshot, leave a place too near to an obstacle, search with unknown ground assumed
    passable, search on known ground if that assumption was needed, shorten the path."""

    def __init__(self, ground: Snapshot, start: Point, goal: Point, settings: PlannerSettings) -> None:
        self.ground, self.start, self.goal, self.settings = ground, start, goal, settings
        self._escape = 0.0
        self._ways_out: list[int] | None = None
        """Cells that fit the footprint, the nearest last, from a start that does not."""
        self._from = self._to = BEYOND
        self._assumed: CellPath | None = None
        self._search: Search | None = None
        self._short: Shortening | None = None
        self._found: tuple[float, Point | None] = (0.0, None)
        """Cost of the path that is shortened; for a frontier's, the first unknown point."""
        self._result: PlanResult = Searching(0)

    def advance(self, work: int, costmap: Costmap, grid: Map) -> PlanResult:
        """Continue for at most about this much work. Once finished, the result does not change."""
        while work > 0 and isinstance(self._result, Searching):
            if not self.ground.complete:
                work = self.ground.assemble(costmap, grid, work)
            elif self._ways_out is not None:
                self._result = self._leave(self._ways_out)
                work -= LINE_WORK
            elif self._short is not None:
                work = self._short.advance(self.ground, work)
                if self._short.finished:
                    self._result = self._conclude(tuple(self._short.kept))
            elif self._search is not None:
                before = self._search.work
                outcome = self._search.advance(work)
                work -= max(self._search.work - before, 1)
                if not isinstance(outcome, Searching):
                    self._result = self._judge(outcome)
            else:
                self._result = self._begin()
        return self._result

    def _begin(self) -> PlanResult:
        """Find the cells of start and goal."""
        ground = self.ground
        here, there = ground.index(*self.start), ground.index(*self.goal)
        assert here is not None, "a snapshot contains the robot's place"
        if there is not None:
            if ground.level[there] % UNKNOWN < FREE:
                beside = ground.nearest(self.goal, self.settings.slack, known=False)[:1]
                if not beside:
                    return NoPath(_too_near(ground, self.goal))
                there = beside[0]
                self.goal = ground.centre(there)
            self._to = there
        if ground.level[here] < NEAR:
            self._ways_out = ground.nearest(self.start, self.settings.escape, known=True)[::-1]
            return Searching(0)
        return self._set_out(here)

    def _leave(self, ways_out: list[int]) -> PlanResult:
        """Try one straight way out of a place too near to an obstacle: it must not cross an occupied cell."""
        if not ways_out:
            return NoPath(
                f"the robot stands too near to an obstacle at {_text(self.start)}, and no place that "
                f"fits its footprint is within {self.settings.escape:g} m"
            )
        out = self.ground.centre(ways_out[-1])
        cell = ways_out.pop()
        if is_blocked(self.ground, self.start, out, TOUCHING):
            return Searching(0)
        self._ways_out, self._escape = None, dist(self.start, out)
        return self._set_out(cell)

    def _set_out(self, cell: int) -> Searching:
        self._from = cell
        self._search = Search(
            self.ground,
            cell,
            self._to,
            beyond=self.ground.goal,
            through_unknown=self.settings.unknown_multiplier,
        )
        return Searching(0)

    def _judge(self, outcome: CellPath | Unreachable) -> PlanResult:
        """Process a finished search: begin one more, or begin to shorten the path."""
        if self._assumed is not None:
            known = isinstance(outcome, CellPath)
            return self._shorten(outcome if isinstance(outcome, CellPath) else self._assumed, known=known)
        if isinstance(outcome, Unreachable):
            return NoPath(f"everything between {_text(self.start)} and the goal {_text(self.goal)} is closed")
        level = self.ground.level
        if self.settings.unknown_is_free or not np.any(level[list(outcome.cells)] >= UNKNOWN):
            return self._shorten(outcome, known=True)
        if self._to == BEYOND or level[self._to] >= UNKNOWN:
            return self._shorten(outcome, known=False)
        self._assumed, self._search = outcome, Search(self.ground, self._from, self._to)
        return Searching(0)

    def _shorten(self, found: CellPath, *, known: bool) -> PlanResult:
        """Begin to shorten a path, or the part of it that is known."""
        cells, level, beyond = found.cells, self.ground.level, None
        if not known:
            first = int(np.argmax(level[list(cells)] >= UNKNOWN))
            if first == 0:
                return NoPath(f"the robot at {_text(self.start)} stands on unknown ground")
            cells, beyond = cells[:first], self.ground.centre(cells[first])
        turns = np.flatnonzero(np.diff(cells, 2)) + 1
        kept = sorted({0, 1, *turns.tolist(), len(cells) - 2, len(cells) - 1} & set(range(len(cells))))
        points = [self.ground.centre(cells[i]) for i in kept]
        if known:
            points = [*points[: max(len(points) - 1, 1)], self.goal]
        if self._escape == 0.0:
            points[0] = self.start
        self._found, self._short = (found.cost, beyond), Shortening(points)
        return Searching(0)

    def _conclude(self, short: tuple[Point, ...]) -> PlanResult:
        points = (self.start, *short) if self._escape > 0.0 else short
        cost, beyond = self._found
        if beyond is None:
            return Path(points, cost, self._escape)
        return FrontierPath(points, beyond, self._escape)


SHORTCUT_CORNERS = 30
"""Corners ahead to which a shortcut is tried."""
LINE_WORK = 140
"""The cost of a straight line, in expansions of A*,"""
CELLS_PER_WORK = 10
"""and that of its cells."""
LONGEST_LINE = 2000
"""Cells, from which on a straight line is not tried."""


class Shortening:
    """A path that is given fewer corners: a straight line replaces a part where it costs no more. After
    `MAX_LINES` comparisons the rest stays as it is."""

    def __init__(self, corners: list[Point]) -> None:
        self.corners = corners
        self.kept = corners[:1]
        """The path so far."""
        self._at, self._best, self._ahead = 0, 1, 2
        """The corner last kept, the farthest that a line from it replaced the path to, and the one to try."""
        self._so_far = 0.0
        """m, cost of the path between the corner last kept and the one before that to be tried"""
        self._left = MAX_LINES
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
                self._best = ahead if straight <= self._so_far + 1e-9 < inf else self._best
                self._ahead += 1
            else:
                self.kept.append(self.corners[self._best])
                self._at, self._best, self._ahead = self._best, self._best + 1, self._best + 2
                work -= 1
        return work

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


def _too_near(ground: Snapshot, goal: Point) -> str:
    text = f"the goal {_text(goal)} is too near to an obstacle for the footprint"
    fits = ground.nearest(goal, 2.0, known=True)[:1]
    return f"{text}; the nearest place that fits is {_text(ground.centre(fits[0]))}" if fits else text


def _text(point: Point) -> str:
    return f"({point[0]:.2f}, {point[1]:.2f})"
