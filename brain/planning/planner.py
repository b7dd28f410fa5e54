"""One path query, answered over several steps.

Rules. A result is a `Path` (all of it over known free ground), a `FrontierPath` (the known part of the path
that is best if unknown ground is assumed passable: the free-space assumption, as in D* Lite, Koenig and
Likhachev 2002), or a `NoPath` with the reason in words; never an empty or partial path called a path. No
point of a result lies on unknown ground, unless the settings treat unknown ground as free. Known paths are
preferred: a path through unknown ground is used only where no known path exists. Paths are shortened by line
of sight where that costs no more in the search's own metric, so clearance is kept.
"""

from __future__ import annotations

from dataclasses import dataclass
from math import dist, inf
from typing import TypeAlias

from brain.planning.astar import CellPath, Search, Searching, Unreachable
from brain.planning.costmap import (
    BLOCKED,
    FREE,
    MAX_LINES,
    UNKNOWN,
    Costmap,
    PlannerSettings,
    nearest_cell,
)
from brain.planning.polyline import Point


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
    """One query in progress; deep-copyable between any two calls."""

    def __init__(
        self, costmap: Costmap, occupied: Costmap | None, start: Point, goal: Point, settings: PlannerSettings
    ) -> None:
        """`occupied`: what the path out of a place too near to an obstacle must not cross."""
        self.costmap, self.start, self.goal, self.settings = costmap, start, goal, settings
        self._escape = 0.0
        self._assumed: CellPath | None = None
        self._search: Search | None = None
        self._result: PlanResult = Searching(0)
        cells = self._endpoints(occupied)
        if isinstance(cells, NoPath):
            self._result = cells
        else:
            self._from, self._to = cells
            self._search = Search(costmap, self._from, self._to, through_unknown=True)

    def _endpoints(self, occupied: Costmap | None) -> tuple[int, int] | NoPath:
        here = self.costmap.index(*self.start)
        there = self.costmap.index(*self.goal)
        if here is None:
            return NoPath(f"the robot at {_text(self.start)} is outside of the map")
        if there is None:
            return NoPath(f"the goal {_text(self.goal)} is outside of the map{_extent(self.costmap)}")
        if self.costmap.level[here] == BLOCKED:
            out = nearest_cell(self.costmap, self.start, self.settings.escape, FREE, visible_in=occupied)
            if out is None:
                return NoPath(
                    f"the robot stands too near to an obstacle at {_text(self.start)}, and no place that "
                    f"fits its footprint is within {self.settings.escape:g} m"
                )
            self._escape = dist(self.start, self.costmap.centre(out))
            here = out
        if self.costmap.level[there] == BLOCKED:
            beside = nearest_cell(self.costmap, self.goal, self.settings.slack, UNKNOWN)
            if beside is None:
                return NoPath(_too_near(self.costmap, self.goal))
            there = beside
            self.goal = self.costmap.centre(beside)
        return here, there

    def advance(self, expansions: int) -> PlanResult:
        """Continue the search by at most this many expansions. Once finished, the result does not change."""
        if self._search is None:
            return self._result
        outcome = self._search.advance(expansions)
        if isinstance(outcome, Searching):
            return outcome
        self._result, self._search = self._conclude(outcome)
        return self._result

    def _conclude(self, outcome: CellPath | Unreachable) -> tuple[PlanResult, Search | None]:
        """Return what a finished search means: a result, or one more search."""
        if self._assumed is not None:
            return (
                self._path(outcome) if isinstance(outcome, CellPath) else self._frontier_path(self._assumed)
            ), None
        if isinstance(outcome, Unreachable):
            return NoPath(
                f"everything between {_text(self.start)} and the goal {_text(self.goal)} is closed"
            ), None
        level = self.costmap.level
        if not any(level[cell] == UNKNOWN for cell in outcome.cells):
            return self._path(outcome), None
        self._assumed = outcome
        if level[self._to] == UNKNOWN:
            return self._frontier_path(outcome), None
        return Searching(0), Search(self.costmap, self._from, self._to)

    def _path(self, found: CellPath) -> Path:
        points = [self.costmap.centre(cell) for cell in found.cells]
        return Path(self._points(points, self.goal), found.cost, self._escape)

    def _frontier_path(self, assumed: CellPath) -> FrontierPath | NoPath:
        level = self.costmap.level
        first = next(i for i, cell in enumerate(assumed.cells) if level[cell] == UNKNOWN)
        points = [self.costmap.centre(cell) for cell in assumed.cells[:first]]
        if not points:
            return NoPath(f"the robot at {_text(self.start)} stands on unknown ground")
        beyond = self.costmap.centre(assumed.cells[first])
        return FrontierPath(self._points(points, None), beyond, self._escape)

    def _points(self, points: list[Point], end: Point | None) -> tuple[Point, ...]:
        """Return the path from the robot's position to the end, shortened by line of sight."""
        if self._escape == 0.0:
            points[0] = self.start
        if end is not None:
            points = [*points[:-1], end] if len(points) > 1 else [points[0], end]
        short = shortcut(self.costmap, points)
        return (self.start, *short) if self._escape > 0.0 else short


SHORTCUT_CORNERS = 30
"""Corners ahead to which a shortcut is tried."""


def shortcut(costmap: Costmap, points: list[Point]) -> tuple[Point, ...]:
    """Return the path with fewer corners: a straight line replaces a part where it costs no more. After
    `MAX_LINES` comparisons the rest stays as it is."""
    corners = [
        points[0],
        *(b for a, b, c in zip(points, points[1:], points[2:], strict=False) if _bends(a, b, c)),
    ]
    corners += points[-1:] if len(points) > 1 else []
    costs: dict[int, float] = {}

    def cost(leg: int) -> float:
        if leg not in costs:
            costs[leg] = costmap.line_cost(corners[leg], corners[leg + 1])
        return costs[leg]

    kept, at, left = [corners[0]], 0, MAX_LINES
    while at < len(corners) - 1:
        best = at + 1
        for ahead in range(at + 2, min(at + SHORTCUT_CORNERS, len(corners), at + 2 + left)):
            so_far = sum(map(cost, range(at, ahead)))
            left -= 1
            straight = costmap.line_cost(corners[at], corners[ahead])
            if straight == inf:
                break
            if straight <= so_far + 1e-9:
                best = ahead
        kept.append(corners[best])
        at = best
    return tuple(kept)


def _extent(costmap: Costmap) -> str:
    far = costmap.centre(len(costmap.level) - costmap.stride - 2)
    half = costmap.resolution / 2
    return f", which reaches from {_text(costmap.origin)} to {_text((far[0] + half, far[1] + half))}"


def _too_near(costmap: Costmap, goal: Point) -> str:
    text = f"the goal {_text(goal)} is too near to an obstacle for the footprint"
    fits = nearest_cell(costmap, goal, 2.0, FREE)
    return text if fits is None else f"{text}; the nearest place that fits is {_text(costmap.centre(fits))}"


def _bends(a: Point, b: Point, c: Point) -> bool:
    return abs((b[0] - a[0]) * (c[1] - b[1]) - (b[1] - a[1]) * (c[0] - b[0])) > 1e-12


def _text(point: Point) -> str:
    return f"({point[0]:.2f}, {point[1]:.2f})"
