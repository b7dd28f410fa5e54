"""One path query, answered over several steps.

Rules. A result is a `Path` (all of it over known free ground), a `FrontierPath` (the known part of the path
that is best if unknown ground is assumed passable: the free-space assumption, as in D* Lite, Koenig and
Likhachev 2002), or a `NoPath` with the reason in words; never an empty or partial path called a path. No
point of a result lies on unknown ground, unless the settings treat unknown ground as free. Known paths are
preferred: a path through unknown ground is used only where no known path exists. What lies beyond the known
map is unknown ground, so a goal there has a `FrontierPath`. Paths are shortened by line of sight where that
costs no more in the search's own metric, so clearance is kept; their corners are made round.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise
from math import copysign, cos, dist, sin
from typing import Any, TypeAlias

import numpy as np

from brain.belief import Pose
from brain.bodies.plane import wrap
from brain.planning.astar import BEYOND, CellPath, Searching, Unreachable
from brain.planning.blocks import CornerPath, GroundSearch
from brain.planning.costmap import FREE, NEAR, TOUCHING, UNKNOWN, Costmap, Map, PlannerSettings
from brain.planning.footprint import Footprint, Shape
from brain.planning.hybrid_astar import HybridSearch
from brain.planning.polyline import Point
from brain.planning.rounding import Rounding
from brain.planning.shortening import Shortening, Tightening
from brain.planning.snapshot import (
    LINE_WORK,
    MAX_LINES,
    Snapshot,
    is_blocked,
)
from brain.planning.ways import Prices, Way, Ways


@dataclass(frozen=True, slots=True)
class Path:
    """A path to the goal, over known free ground."""

    points: tuple[Point, ...]
    """m; at least start and end"""
    cost: float
    """m, weighted by the nearness of obstacles, from the search"""
    escape: float = 0.0
    """m at its beginning that lead out of a place too near to an obstacle"""
    headings: tuple[float, ...] | None = None
    """rad of the base at each point; None: along the way, turning at the corners"""
    gears: tuple[int, ...] | None = None
    """Of each part between two points: 1 forward, -1 backward; None: all forward"""
    short_of: float = 0.0
    """m from its end to the goal that was asked for"""


@dataclass(frozen=True, slots=True)
class FrontierPath:
    """A path to the frontier of known ground, from where the goal may become reachable."""

    points: tuple[Point, ...]
    beyond: Point
    """m, the first unknown point on the assumed path to the goal"""
    escape: float = 0.0
    headings: tuple[float, ...] | None = None
    gears: tuple[int, ...] | None = None


@dataclass(frozen=True, slots=True)
class NoPath:
    """No path exists, and why."""

    reason: str


PlanResult: TypeAlias = Path | FrontierPath | NoPath | Searching


class PathQuery:
    """One query in progress; deep-copyable between any two calls.

    In turn: assemble the snapshot, leave a place too near to an obstacle, search with unknown ground assumed
    passable, search on known ground if that assumption was needed; then shorten the path and make its corners
    round, or, for a base that cannot turn on the spot and where the footprint does not fit along that path,
    search again with headings."""

    def __init__(
        self,
        ground: Snapshot,
        start: Point,
        goal: Point,
        settings: PlannerSettings,
        footprint: Footprint | None = None,
        *,
        yaw: float = 0.0,
        goal_yaw: float | None = None,
        near: bool = False,
    ) -> None:
        """`yaw`: the base's [rad]; `goal_yaw`: wanted at the goal; `near`: a goal that is blocked or closed
        in is approached as near as can be."""
        self.ground, self.start, self.goal, self.settings = ground, start, goal, settings
        self.yaw, self.goal_yaw, self.near = yaw, goal_yaw, near
        shape = Shape.circle(ground.radius)
        self._ways = Ways(
            ground,
            footprint or Footprint(shape, ground.resolution),
            Prices(settings.reverse, settings.switch),
        )
        self._asked = goal
        self._escape: tuple[Point, ...] = ()
        """The way out of a place too near to an obstacle, without its end"""
        self._ways_out: list[int] | None = None
        """Cells that fit the footprint, the nearest last, from a start that does not."""
        self._from = self._to = BEYOND
        self._out = start
        """Where that way ends"""
        self._ends = start, goal
        """Of the path that is shortened"""
        self._assumed: CellPath | CornerPath | None = None
        self._left = settings.expansions_per_search
        """Work that is left for all of it"""
        self._cells = CELLS_WORK
        """Work that is left for searches cell by cell"""
        self._search: GroundSearch | None = None
        self._reach: GroundSearch | None = None
        """Finds every cell that can be reached, if the goal cannot."""
        self._short: Shortening | None = None
        self._tight: Tightening | None = None
        self._round: Rounding | None = None
        self._hybrid: HybridSearch | None = None
        self._found: tuple[float, Point | None] = (0.0, None)
        """Cost of the path that is shortened; for a frontier's, the first unknown point."""
        self._result: PlanResult = Searching(0)

    def advance(self, work: int, costmap: Costmap, grid: Map) -> PlanResult:
        """Continue for at most about this much work. Once finished, the result does not change."""
        if not isinstance(self._result, Searching):
            return self._result
        work = min(work, self._left)
        self._left -= work - min(self._continue(work, costmap, grid), 0)
        if self._left <= 0 and isinstance(self._result, Searching):
            most = self.settings.expansions_per_search
            self._result = NoPath(
                f"the search for a way to {_text(self.goal)} has not ended after {most} expansions"
            )
        return self._result

    def _continue(self, work: int, costmap: Costmap, grid: Map) -> int:
        """Continue for at most about this much work; return the rest of it."""
        while work > 0 and isinstance(self._result, Searching):
            if not self.ground.complete:
                work = self.ground.assemble(costmap, grid, work)
            elif self._ways_out is not None:
                self._result = self._leave(self._ways_out)
                work -= LINE_WORK
            elif self._hybrid is not None or self._round is not None:
                work = self._with_heading(work)
            elif self._short is not None:
                work = self._short.advance(self.ground, work)
                if self._short.finished:
                    self._tight, self._short = Tightening(self._short.kept, self._ways.footprint), None
            elif self._tight is not None:
                work = self._tight.advance(self.ground, work)
                if self._tight.finished:
                    self._round = Rounding(tuple(self._tight.corners))
            elif (search := self._reach or self._search) is not None:
                before = search.work
                outcome = search.advance(work)
                work -= search.work - before
                if not isinstance(outcome, Searching):
                    self._result = (
                        self._judge(outcome) if self._reach is None else self._approach(self._reach)
                    )
            else:
                self._result = self._begin()
        return work

    def _with_heading(self, work: int) -> int:
        """Continue the search with headings, or make a corner round; return the rest of the work."""
        hybrid, ways = self._hybrid, self._ways
        before = hybrid.work if hybrid else ways.work
        if hybrid is not None:
            outcome = hybrid.advance(work)
            if isinstance(outcome, Unreachable):
                self._result = NoPath(f"no way to {_text(self.goal)} is wide enough to turn where it must")
            elif isinstance(outcome, Way):
                self._result = self._conclude_way(hybrid.start, outcome)
            return work - max(hybrid.work - before, 1)
        assert self._round is not None
        if not self._round.finished:  # a path of one point is
            self._round.advance(ways)
        if not self._round.fits:
            self._begin_hybrid()
        elif self._round.finished:
            self._result = self._conclude(tuple(self._round.points), None, None)
        return work - max(ways.work - before, 1)

    def _begin(self) -> PlanResult:
        """Find the cells of start and goal."""
        ground = self.ground
        here, there = ground.index(*self.start), ground.index(*self.goal)
        assert here is not None, "a snapshot contains the robot's place"
        if there is not None:
            if ground.level[there] % UNKNOWN < FREE:
                beside = ground.nearest(self.goal, self.settings.slack, known=False)[:1]
                if not beside and not self.near:
                    return NoPath(_too_near(ground, self.goal))
                if beside:
                    there = beside[0]
                    self.goal = ground.centre(there)
            self._to = there
        if ground.level[here] < NEAR or self._is_stuck(self.start):
            self._ways_out = ground.nearest(self.start, self.settings.escape, known=True)[::-1]
            return Searching(0)
        return self._set_out(here)

    def _is_stuck(self, here: Point) -> bool:
        """True if the footprint of a base that cannot turn on the spot does not fit."""
        return self._ways.radius > 0.0 and not self._ways.footprint.way_fits(self.ground, [here], [self.yaw])

    def _leave(self, ways_out: list[int]) -> PlanResult:
        """Try one straight way out of a place too near to an obstacle: it must not cross an occupied cell."""
        if not ways_out:
            return NoPath(
                f"the robot stands too near to an obstacle at {_text(self.start)}, and no place that "
                f"fits its footprint is within {self.settings.escape:g} m"
            )
        cell = ways_out.pop()
        out = self.ground.centre(cell)
        if self._ways.radius:
            out = self._on_axis(out)
            cell = self.ground.index(*out) or cell
            if self.ground.level[cell] < FREE or self._is_stuck(out):
                return Searching(0)
        if is_blocked(self.ground, self.start, out, TOUCHING):
            return Searching(0)
        self._ways_out, self._escape = None, (self.start,)
        self._out = out
        return self._set_out(cell)

    def _on_axis(self, place: Point) -> Point:
        """Return the point straight ahead of the base, or behind it, as far away as a place."""
        c, s = cos(self.yaw), sin(self.yaw)
        far = copysign(
            dist(self.start, place), c * (place[0] - self.start[0]) + s * (place[1] - self.start[1])
        )
        return self.start[0] + far * c, self.start[1] + far * s

    def _set_out(self, cell: int) -> Searching:
        self._from = cell
        return self._seek(beyond=self.ground.goal, through_unknown=self.settings.unknown_multiplier)

    def _seek(self, **how: Any) -> Searching:  # noqa: ANN401 -- the searches' own
        """Begin one search, with what the last has left."""
        self._cells -= self._search.work if self._search else 0
        self._search = GroundSearch(self._cells, self.ground, self._from, self._to, **how)
        return Searching(0)

    def _judge(self, outcome: CellPath | CornerPath | Unreachable) -> PlanResult:
        """Process a finished search: begin one more, or begin to shorten the path."""
        if self._assumed is not None:
            known = not isinstance(outcome, Unreachable)
            return self._shorten(self._assumed if isinstance(outcome, Unreachable) else outcome, known=known)
        if isinstance(outcome, Unreachable):
            if self.near and self._to != BEYOND:
                self._seek(spread=True)
                self._reach = self._search
                return Searching(0)
            return NoPath(f"everything between {_text(self.start)} and the goal {_text(self.goal)} is closed")
        level = self.ground.level
        if self.settings.unknown_is_free or not self._enters_unknown(outcome):
            return self._shorten(outcome, known=True)
        if self._to == BEYOND or level[self._to] >= UNKNOWN:
            return self._shorten(outcome, known=False)
        self._assumed = outcome
        return self._seek()

    def _approach(self, reach: GroundSearch) -> PlanResult:
        """Go to the place nearest to the goal, of those that can be reached and where every heading fits."""
        self._reach, self.near, ground = None, False, self.ground
        for within in (1.0, NEARBY):
            window, square = ground.around(self._asked, within)
            costs = reach.reached(window)
            level = ground.level.reshape(ground.height, ground.stride)[window]
            rows, columns = np.nonzero((costs > 0.0) & (level >= ground.wide) & (level < UNKNOWN))
            if len(rows):
                best = int(np.lexsort((costs[rows, columns], square[rows, columns]))[0])
                first = window[0].start * ground.stride + window[1].start
                self._to = int(first + rows[best] * ground.stride + columns[best])
                self.goal = ground.centre(self._to)
                return self._set_out(self._from)
        return NoPath(f"no place within {NEARBY:g} m of the goal {_text(self._asked)} can be reached")

    def _frontier(self, found: CellPath | CornerPath) -> tuple[int, int, int]:
        """Return how many cells of a path are before the last that is known, that, and the first unknown."""
        if isinstance(found, CornerPath):
            assert found.frontier is not None
            return found.frontier
        first = int(np.argmax(self.ground.level[list(found.cells)] >= UNKNOWN))
        return max(first - 1, 0), found.cells[max(first - 1, 0)], found.cells[first]

    def _enters_unknown(self, found: CellPath | CornerPath) -> bool:
        if isinstance(found, CornerPath):
            return found.frontier is not None
        return bool(np.any(self.ground.level[list(found.cells)] >= UNKNOWN))

    def _shorten(self, found: CellPath | CornerPath, *, known: bool) -> PlanResult:
        """Begin to shorten a path, or the part of it that is known."""
        cells, centre, beyond = list(found.cells), self.ground.centre, None
        if not known:
            first, last, unknown = self._frontier(found)
            if unknown == cells[0]:
                return NoPath(f"the robot at {_text(self.start)} stands on unknown ground")
            cells, beyond = [*cells[:first], last], centre(unknown)
        kept = CellPath(tuple(cells), 0.0).corners() if isinstance(found, CellPath) else range(len(cells))
        points = [centre(cells[i]) for i in kept]
        if known:
            points = [*points[: max(len(points) - 1, 1)], self.goal]
        if not self._escape:
            points[0] = self.start
        elif self._ways.radius:
            points[0] = self._out
        self._found = found.cost, beyond
        if self._ways.radius:
            self._ends = points[0], points[-1]
            self._begin_hybrid()
        else:
            most = MAX_LINES if isinstance(found, CellPath) else max(MAX_LINES, 2 * len(points))
            self._short = Shortening(points, self._ways.footprint, most)
            self._ends = points[0], points[-1]
        return Searching(0)

    def _begin_hybrid(self) -> None:
        """Begin to search with headings, between the ends of the path found without."""
        self._round = None
        (x, y), end = self._ends
        known = self._found[1] is None
        goal = (*end, self.goal_yaw if known and self._ways.radius else None)
        self._hybrid = HybridSearch(self._ways, Pose(x, y, self.yaw), goal)

    def _conclude_way(self, start: Pose, way: Way) -> PlanResult:
        """Return a path of poses; of a base that turns on the spot, without its turns."""
        poses, gears = (start, *(Pose(x, y, wrap(yaw)) for x, y, yaw in way.poses.tolist())), way.gears
        if not self._ways.radius:
            moved = [dist((a.x, a.y), (b.x, b.y)) > SAME for a, b in pairwise(poses)]
            driven = [i for i, gear in enumerate(gears) if gear and moved[i]]
            poses, gears = (start, *(poses[i + 1] for i in driven)), tuple(gears[i] for i in driven)
        points = tuple((pose.x, pose.y) for pose in poses)
        headings = tuple(pose.yaw for pose in poses) if self._ways.radius else None
        if len(points) == 1:
            points, gears, headings = points * 2, (1,), headings and headings * 2
        self._found = way.cost, self._found[1]
        return self._conclude(points, headings, gears if self._ways.radius or -1 in gears else None)

    def _conclude(
        self, points: tuple[Point, ...], headings: tuple[float, ...] | None, gears: tuple[int, ...] | None
    ) -> PlanResult:
        cost, beyond = self._found
        escape = dist(self.start, points[0]) if self._escape else 0.0
        if self._escape:
            ahead = cos(self.yaw) * (points[0][0] - self.start[0]) + sin(self.yaw) * (
                points[0][1] - self.start[1]
            )
            headings = headings and (self.yaw, *headings)
            gears = gears and (1 if ahead >= 0.0 or headings is None else -1, *gears)
            points = (self.start, *points)
        if beyond is not None:
            return FrontierPath(points, beyond, escape, headings, gears)
        return Path(points, cost, escape, headings, gears, dist(self._asked, self.goal))


CELLS_WORK = 1_000_000
"""Work of a query's searches cell by cell: what is left to be found then is searched by blocks"""
SAME = 1e-6
"""m between two points of a path, at least"""
NEARBY = 10.0
"""m: how far from a goal that cannot be reached a place is searched that can"""


def _too_near(ground: Snapshot, goal: Point) -> str:
    text = f"the goal {_text(goal)} is too near to an obstacle for the footprint"
    fits = ground.nearest(goal, 2.0, known=True)[:1]
    return f"{text}; the nearest place that fits is {_text(ground.centre(fits[0]))}" if fits else text


def _text(point: Point) -> str:
    return f"({point[0]:z.2f}, {point[1]:z.2f})"
