"""One question to the planner, answered over several steps: how does one get from here to there?

Rules. An answer is a `Path` (all of it over known free ground), a `Toward` (the known part of the way that
looks best when unknown ground is guessed to be passable: Koenig's free-space assumption, as in D* Lite,
Koenig and Likhachev 2002), or a `NoPath` with the reason in words; never an empty or partial path called
a path. No point of an answer lies on unknown ground, unless the settings call unknown ground free. Known
ways are preferred: a guess is answered only where no known way exists. Corners are cut short by line of
sight where that is not dearer in the search's own metric, hence clearance stays.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise
from math import hypot, inf
from typing import TypeAlias

from brain.planning.astar import Cells, NoWay, Search, Searching
from brain.planning.costmap import BLOCKED, FREE, UNKNOWN, Costmap
from brain.planning.line import Point
from brain.planning.survey import PlannerSettings, nearest


@dataclass(frozen=True, slots=True)
class Path:
    """A way to the goal."""

    points: tuple[Point, ...]
    """m; at least the start's and the end's place"""
    cost: float
    """m, weighted by the nearness of obstacles, as the search found it"""
    escapes: float = 0.0
    """m of it that lead out of a place too near to an obstacle, at its beginning"""


@dataclass(frozen=True, slots=True)
class FrontierPath:
    """A way to the edge of what is known, whence the goal may come into reach."""

    points: tuple[Point, ...]
    beyond: Point
    """m, the first unknown place on the guessed way"""
    cost: float
    """m, of the whole guess"""
    escapes: float = 0.0


@dataclass(frozen=True, slots=True)
class NoPath:
    """There is none, and why."""

    reason: str


Answer: TypeAlias = Path | FrontierPath | NoPath | Searching


class Planning:
    """One question being answered; deep-copyable between any two calls."""

    def __init__(
        self, costmap: Costmap, occupied: Costmap | None, start: Point, goal: Point, settings: PlannerSettings
    ) -> None:
        """`occupied`: what the way out of a place too near to an obstacle must not cross."""
        self.costmap, self.start, self.goal, self.settings = costmap, start, goal, settings
        self._escape = 0.0
        self._guess: Cells | None = None
        self._search: Search | None = None
        self._answer: Answer = Searching(0)
        place = self._begin(occupied)
        if isinstance(place, NoPath):
            self._answer = place
        else:
            self._from, self._to = place
            self._search = Search(costmap, self._from, self._to, through_unknown=True)

    def _begin(self, occupied: Costmap | None) -> tuple[int, int] | NoPath:
        here = self.costmap.index(*self.start)
        there = self.costmap.index(*self.goal)
        if here is None:
            return NoPath(f"the robot at {_said(self.start)} is outside of the map")
        if there is None:
            return NoPath(f"the goal {_said(self.goal)} is outside of the map{_reach(self.costmap)}")
        if self.costmap.level[here] == BLOCKED:
            out = nearest(self.costmap, self.start, self.settings.escape, FREE, seen_through=occupied)
            if out is None:
                return NoPath(
                    f"the robot stands too near to an obstacle at {_said(self.start)}, and no place that "
                    f"fits its footprint is within {self.settings.escape:g} m"
                )
            self._escape = _distance(self.start, self.costmap.centre(out))
            here = out
        if self.costmap.level[there] == BLOCKED:
            beside = nearest(self.costmap, self.goal, self.settings.slack, UNKNOWN)
            if beside is None:
                return NoPath(_too_near(self.costmap, self.goal))
            there = beside
            self.goal = self.costmap.centre(beside)
        return here, there

    def advance(self, expansions: int) -> Answer:
        """Work on, at most so many expansions; after the end the answer stays what it is."""
        if self._search is None:
            return self._answer
        outcome = self._search.advance(expansions)
        if isinstance(outcome, Searching):
            return outcome
        self._answer, self._search = self._conclude(outcome)
        return self._answer

    def _conclude(self, outcome: Cells | NoWay) -> tuple[Answer, Search | None]:
        """What an ended search means: an answer, or one more search."""
        if self._guess is not None:
            return (self._path(outcome) if isinstance(outcome, Cells) else self._toward(self._guess)), None
        if isinstance(outcome, NoWay):
            return NoPath(
                f"everything between {_said(self.start)} and the goal {_said(self.goal)} is closed"
            ), None
        level = self.costmap.level
        if not any(level[cell] == UNKNOWN for cell in outcome.cells):
            return self._path(outcome), None
        self._guess = outcome
        if level[self._to] == UNKNOWN:
            return self._toward(outcome), None
        return Searching(0), Search(self.costmap, self._from, self._to)

    def _path(self, found: Cells) -> Path:
        points = [self.costmap.centre(cell) for cell in found.cells]
        return Path(self._finish(points, self.goal), found.cost, self._escape)

    def _toward(self, guess: Cells) -> FrontierPath | NoPath:
        level = self.costmap.level
        first = next(i for i, cell in enumerate(guess.cells) if level[cell] == UNKNOWN)
        points = [self.costmap.centre(cell) for cell in guess.cells[:first]]
        if not points:
            return NoPath(f"the robot at {_said(self.start)} stands on unknown ground")
        beyond = self.costmap.centre(guess.cells[first])
        return FrontierPath(self._finish(points, None), beyond, guess.cost, self._escape)

    def _finish(self, points: list[Point], end: Point | None) -> tuple[Point, ...]:
        """From where the robot stands to where it is to be, straight where it may be straight."""
        if self._escape == 0.0:
            points[0] = self.start
        if end is not None:
            points = [*points[:-1], end] if len(points) > 1 else [points[0], end]
        short = shortcut(self.costmap, points)
        return (self.start, *short) if self._escape > 0.0 else short


AHEAD = 30
"""Corners"""


def shortcut(costmap: Costmap, points: list[Point]) -> tuple[Point, ...]:
    """The same way with fewer corners: a straight line replaces a piece where it is not dearer."""
    corners = [
        points[0],
        *(b for a, b, c in zip(points, points[1:], points[2:], strict=False) if _bends(a, b, c)),
    ]
    corners += points[-1:] if len(points) > 1 else []
    cost = [costmap.line_cost(a, b) for a, b in pairwise(corners)]
    # AHEAD bounds the work of a step: beyond it, a straighter line is not even looked for.
    kept, at = [corners[0]], 0
    while at < len(corners) - 1:
        best, so_far = at + 1, cost[at]
        for ahead in range(at + 2, min(at + AHEAD, len(corners))):
            so_far += cost[ahead - 1]
            straight = costmap.line_cost(corners[at], corners[ahead])
            if straight == inf:
                break
            if straight <= so_far + 1e-9:
                best = ahead
        kept.append(corners[best])
        at = best
    return tuple(kept)


def _reach(costmap: Costmap) -> str:
    far = costmap.centre(len(costmap.level) - costmap.stride - 2)
    half = costmap.resolution / 2
    return f", which reaches from {_said(costmap.origin)} to {_said((far[0] + half, far[1] + half))}"


def _too_near(costmap: Costmap, goal: Point) -> str:
    said = f"the goal {_said(goal)} is too near to an obstacle for the footprint"
    fits = nearest(costmap, goal, 2.0, FREE)
    return said if fits is None else f"{said}; the nearest place that fits is {_said(costmap.centre(fits))}"


def _bends(a: Point, b: Point, c: Point) -> bool:
    return abs((b[0] - a[0]) * (c[1] - b[1]) - (b[1] - a[1]) * (c[0] - b[0])) > 1e-12


def _distance(a: Point, b: Point) -> float:
    return hypot(b[0] - a[0], b[1] - a[1])


def _said(place: Point) -> str:
    return f"({place[0]:.2f}, {place[1]:.2f})"
