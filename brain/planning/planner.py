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
from math import hypot, inf, isfinite
from typing import TypeAlias

import numpy as np

from brain.planning.astar import Cells, NoWay, Search, Searching
from brain.planning.costmap import BLOCKED, FREE, UNKNOWN, Costmap, Map, Mask, build, origin
from brain.planning.line import Point
from protocols.words import MILLISECOND, SECOND, Nanos


@dataclass(frozen=True, slots=True)
class PlannerSettings:
    """How the planner plans and when the mission asks it to. SI."""

    expansions_per_step: int = 1000
    """A* expansions in one step of the brain: about 2 µs each."""
    margin: float = 0.05
    """m, kept between the footprint and what is occupied, beyond the footprint's radius"""
    comfort: float = 0.4
    """m, the distance within which being near to obstacles costs more"""
    dislike: float = 3.0
    """How much more a metre next to an obstacle costs than one far from any."""
    unknown_multiplier: float = 1.2
    """What a metre through unknown ground is guessed to cost, where nothing known leads to the goal.
    The larger, the longer the search."""
    unknown_is_free: bool = False
    """Plan through unknown ground as if it were free. For open ground only."""
    escape: float = 0.5
    """m, how far the start may lie from the nearest place that fits the footprint"""
    slack: float = 0.1
    """m, how far a goal too close to an obstacle is moved to a place that fits"""
    period: Nanos = 250 * MILLISECOND
    """Between two looks at the map: is the path still free, does a better one show?"""
    explore: Nanos = 500 * MILLISECOND
    """While nothing known leads to the goal: between two plans."""
    patience: Nanos = 8 * SECOND
    """Without any path to a goal for so long, the goal is given up."""
    drive_timeout: Nanos = 500 * MILLISECOND
    """A Drive that is not repeated for so long ends: a lost operator means stop."""

    def __post_init__(self) -> None:
        for name in ("margin", "comfort", "dislike", "slack"):
            if not (isfinite(getattr(self, name)) and getattr(self, name) >= 0.0):
                raise ValueError(f"{name} must be 0 or more, not {getattr(self, name)}")
        for name in ("expansions_per_step", "escape", "period", "explore", "patience", "drive_timeout"):
            if not (isfinite(getattr(self, name)) and getattr(self, name) > 0.0):
                raise ValueError(f"{name} must be more than 0, not {getattr(self, name)}")
        if not (isfinite(self.unknown_multiplier) and self.unknown_multiplier >= 1.0):
            raise ValueError(f"unknown_multiplier must be 1 or more, not {self.unknown_multiplier}")


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
class Toward:
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


Answer: TypeAlias = Path | Toward | NoPath | Searching


def survey(
    grid: Map,
    radius: float,
    settings: PlannerSettings,
    *,
    standing: Point,
    given_up: tuple[Point, ...] = (),
) -> Costmap:
    """The costmap of the grid as it is now, for a footprint circle of this radius [m].

    Unknown ground under the robot is free: it stands there. Unknown ground about the places `given_up`,
    which stayed unknown when seen from near, counts as blocked."""
    resolution, corner = grid.resolution, origin(grid)
    blocked, unknown = grid.blocked(radius + settings.margin), grid.unknown
    unknown = unknown & ~_disc(unknown.shape, corner, resolution, standing, radius)
    for place in given_up:
        blocked = blocked | (unknown & _disc(unknown.shape, corner, resolution, place, radius))
    return build(
        blocked,
        unknown,
        resolution=resolution,
        origin=corner,
        comfort=settings.comfort,
        dislike=settings.dislike,
        unknown_multiplier=settings.unknown_multiplier,
        unknown_is_free=settings.unknown_is_free,
    )


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

    def _toward(self, guess: Cells) -> Toward | NoPath:
        level = self.costmap.level
        first = next(i for i, cell in enumerate(guess.cells) if level[cell] == UNKNOWN)
        points = [self.costmap.centre(cell) for cell in guess.cells[:first]]
        if not points:
            return NoPath(f"the robot at {_said(self.start)} stands on unknown ground")
        beyond = self.costmap.centre(guess.cells[first])
        return Toward(self._finish(points, None), beyond, guess.cost, self._escape)

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


def nearest(
    costmap: Costmap, place: Point, within: float, lowest: int, seen_through: Costmap | None = None
) -> int | None:
    """The nearest cell of at least this level; with `seen_through`, on a straight line free in that map."""
    rows = len(costmap.level) // costmap.stride
    level = np.frombuffer(costmap.level, np.uint8).reshape(rows, costmap.stride)
    near = _disc((rows - 2, costmap.stride - 2), costmap.origin, costmap.resolution, place, within)
    row, column = np.nonzero((level[1:-1, 1:-1] >= lowest) & near)
    cells = [int(c) for c in (row + 1) * costmap.stride + column + 1]
    for _, cell in sorted((_distance(place, costmap.centre(cell)), cell) for cell in cells):
        if seen_through is None or not seen_through.is_blocked(place, costmap.centre(cell)):
            return cell
    return None


def _disc(shape: tuple[int, ...], corner: Point, resolution: float, centre: Point, radius: float) -> Mask:
    x = corner[0] + (np.arange(shape[1]) + 0.5) * resolution - centre[0]
    y = corner[1] + (np.arange(shape[0]) + 0.5) * resolution - centre[1]
    inside: Mask = x[None, :] ** 2 + y[:, None] ** 2 <= radius**2
    return inside


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
