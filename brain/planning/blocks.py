"""Search by blocks of cells: ways over ground that is too large to be searched cell by cell.

Rules. A block of some 0.8 to 1.6 m has one piece, or more, of cells that are connected within it by moves to
four neighbours; pieces are neighbours where a cell of one lies beside a cell of the other, or where four free
cells meet at the blocks' corner. A* leads from piece to piece, from the best place of each to that of the
next (hierarchical path-finding: Botea, Müller and Schaeffer 2004, with connected pieces in place of
entrances). What can be reached by pieces is exactly what A* on cells can reach, since that cuts no corner:
that there is no way is certain. What a way costs is an estimate. Between two places the way is straight, or
else it is searched cell by cell. Equal queries have equal results, however they are sliced. The state is
plain data.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache
from heapq import heappop, heappush
from math import inf
from typing import Any

import numpy as np

from brain.planning.astar import BEYOND, DIAGONAL, CellPath, CellSearch, Searching, Unreachable
from brain.planning.costmap import EXIT, TILE, UNKNOWN, Cells, Floats
from brain.planning.snapshot import CELLS_PER_WORK, LINE_WORK, Part, Snapshot, cells_in, crossing

SHORTEST = 0.6
"""m, least side of a block"""
MOST_BLOCKS = 20_000
"""Blocks of a snapshot, from which on larger ones are taken"""
LONGEST = 8
"""Blocks over which a way may lead straight on to its next place"""
MOST_BEHIND = 400
"""Pieces about the goal that are looked at to find that it lies in a closed room"""
NO_EDGE = -1
NOWHERE = -2
"""The aim of a search that is to find all that can be reached"""
PART = 128
"""Cells along a side of a part of the ground that is cut into pieces at once"""
CUT_WORK = 2300
"""Cutting it, in expansions of A*"""
PIECE_WORK = 30
"""Leaving a piece"""
PREFERRED = 0.01
"""What a place is worth more from where the way to a goal beyond the snapshot is open, beside its price"""
CENTRED = 1e-5
"""What a place is worth that is nearer to the middle of its block, by squared cells, beside its price"""


@dataclass(frozen=True, slots=True)
class CornerPath:
    """A way that is not much dearer than the cheapest."""

    cells: tuple[int, ...]
    """From start to goal, both included: straight lines lead from each to the next"""
    cost: float
    """m, weighted by the multipliers"""
    frontier: tuple[int, int, int] | None
    """Where it leads over unknown ground: how many of the cells are before that, the last known cell and the
    first that is not"""


class BlockSearch:
    """One search from a cell to a cell, with the arguments of `astar.CellSearch`."""

    def __init__(
        self,
        ground: Snapshot,
        start: int,
        goal: int,
        *,
        beyond: tuple[int, int] = (0, 0),
        through_unknown: float = inf,
        spread: bool = False,
    ) -> None:
        self.ground, self.start, self.goal = ground, start, goal
        self.work = 0
        """Done so far, in expansions of A*."""
        self._through, self._spread = through_unknown, spread
        self._multiplier = ground.multiplier.copy()
        if through_unknown < inf:
            self._multiplier[UNKNOWN:] = np.minimum(self._multiplier[UNKNOWN:], through_unknown)
        self._worth = -self._multiplier
        """Of a place by its level; of what ways begin that lead beyond, a little more"""
        self._worth[EXIT] += PREFERRED
        self._goal_at = beyond if goal == BEYOND else divmod(goal, ground.stride)
        self._side = side = side_of(ground)
        self._low = side - 2
        """Cells before the snapshot's first, so that its tiles are whole blocks"""
        height, width = (-(-(count + self._low) // PART) * PART for count in (ground.height, ground.stride))
        self._piece = np.zeros((height + 2, width + 2), np.int32)
        """The number of each cell's piece, 0 where there is none or not yet; around it one row, column"""
        self._uncut = {(row, column) for row in range(0, height, PART) for column in range(0, width, PART)}
        """First row and column of the parts of the ground that are not cut"""
        self._places: Floats = np.zeros((1, 3))
        """Row and column of the best place of each piece, and its mean price"""
        self._count = 1
        self._edges: list[int] = [NO_EDGE]
        """The last edge that leaves each piece"""
        self._to: list[int] = []
        """The piece that each edge leads to"""
        self._prices: list[float] = []
        """What it costs [cells]"""
        self._before: list[int] = []
        """The edge before it that leaves the same piece. Flat, since the garbage collector scans lists"""
        self._ahead: list[float] = [0.0]
        """Cells from the place of each to the goal, at least"""
        self._ends: set[int] = set()
        """Pieces from where the way to a goal beyond the snapshot is open"""
        self._cost: dict[int, float] = {}
        self._from: dict[int, int] = {}
        self._done: set[int] = set()
        self._open: list[tuple[float, int]] = []
        self._aim = 0
        """The goal's piece"""
        self._wanted: list[tuple[int, int]] = []
        """Parts to be cut before the search goes on"""
        self._back: list[int] = []
        """Pieces from which the goal can be reached, whose neighbours are not known to"""
        self._behind: set[int] = set()
        """All of these"""
        self._points: list[int] = []
        """Cells that the way leads over, the next one last"""
        self._leg: CellSearch | None = None
        """Where the way to the next of them is not straight"""
        self._corners: list[int] = []
        """The cells that it leads over so far"""
        self._frontier: tuple[int, int, int] | None = None
        self._paid = 0.0
        """Cells, so far, weighted"""
        self._result: CornerPath | Unreachable | None = None

    def advance(self, work: int) -> CornerPath | Unreachable | Searching:
        """Continue for about this much work. Once finished, the outcome does not change."""
        end = self.work + work
        while self.work < end and self._result is None:
            if self._wanted:
                self._cut(*self._wanted.pop())
            elif self._points:
                self._connect(end - self.work)
            elif not self._cost:
                self._begin()
            else:
                self._leave()
        return Searching(self.work) if self._result is None else self._result

    def reached(self, window: tuple[slice, slice]) -> Floats:
        """Return what each cell of a part of the snapshot costs, about, as far as it was reached; else 0."""
        low = self._low + 1
        rows, columns = (slice(part.start + low, part.stop + low) for part in window)
        costs = np.zeros(self._count)
        for piece, cost in self._cost.items():
            costs[piece] = max(cost, 1e-9)
        found: Floats = costs[self._piece[rows, columns]]
        return found

    # -- cutting -------------------------------------------------------------------------------

    def _cut(self, row: int, column: int) -> None:
        """Cut a part of the ground into pieces, and find which are neighbours of each other and of those cut
        before."""
        side = self._side
        self._uncut.discard((row, column))
        level = np.zeros((PART, PART), np.uint8)
        first, left = row - self._low, column - self._low
        ground = self.ground.level.reshape(self.ground.height, self.ground.stride)
        there = ground[max(first, 0) : first + PART, max(left, 0) : left + PART]
        level[max(-first, 0) :, max(-left, 0) :][: there.shape[0], : there.shape[1]] = there
        blocks = level.reshape(-1, side, PART // side, side).swapaxes(1, 2).reshape(-1, side, side)
        worth = self._worth[blocks]
        piece, count = labelling()(worth > -inf, WITHIN)
        self.work += CUT_WORK
        if count:
            self._add(piece, worth + _off_centre(side), count, (first, left))
            whole = np.where(piece > 0, piece + (self._count - count - 1), 0)
            whole = whole.reshape(-1, PART // side, side, side).swapaxes(1, 2).reshape(PART, PART)
            self._piece[1:-1, 1:-1][row : row + PART, column : column + PART] = whole
            self._join(row, column)

    def _add(self, piece: Cells, worth: Floats, count: int, corner: tuple[int, int]) -> None:
        """Add pieces: where the best place of each is, and what a move costs in it."""
        side, of, worth = self._side, piece.reshape(-1), worth.reshape(-1)
        best = np.full(count + 1, -inf)
        np.maximum.at(best, of, worth)
        best[0] = inf
        at = (worth == best[of]).nonzero()[0][::-1]
        place = np.zeros(count + 1, np.int64)
        place[of[at]] = at
        block, within = np.divmod(place[1:], side * side)
        new = np.empty((3, count))
        new[0] = corner[0] + block // (PART // side) * side + within // side
        new[1] = corner[1] + block % (PART // side) * side + within % side
        new[2] = -np.bincount(of, worth)[1:] / np.bincount(of)[1:]
        if self._count + count > len(self._places):
            self._places = np.concatenate([self._places, np.zeros((len(self._places) + count, 3))])
        self._places[self._count : self._count + count] = new.T
        self._edges += [NO_EDGE] * count
        dx, dy = np.abs(new[1] - self._goal_at[1]), np.abs(new[0] - self._goal_at[0])
        self._ahead += (dx + dy + (DIAGONAL - 2.0) * np.minimum(dx, dy)).tolist()
        if self.goal == BEYOND:
            exits = self.ground.level[new[:2].astype(np.int64).T @ (self.ground.stride, 1)] == EXIT
            self._ends.update((exits.nonzero()[0] + self._count).tolist())
        self._count += count

    def _join(self, row: int, column: int) -> None:
        """Find the neighbours among the pieces of a part, and of those around it that are cut."""
        side = self._side
        part = self._piece[row : row + PART + 2, column : column + PART + 2]
        before, after = slice(0, -1, side), slice(1, None, side)
        corners = (part[before, before], part[after, after], part[before, after], part[after, before])
        meet = corners[0].astype(bool) & (corners[1] > 0) & (corners[2] > 0) & (corners[3] > 0)
        pairs = (
            (part[before, 1:-1].reshape(-1), part[after, 1:-1].reshape(-1)),
            (part[1:-1, before].reshape(-1), part[1:-1, after].reshape(-1)),
            (corners[0][meet], corners[1][meet]),
            (corners[2][meet], corners[3][meet]),
        )
        one = np.concatenate([a for a, _ in pairs]).astype(np.int64)
        other = np.concatenate([b for _, b in pairs]).astype(np.int64)
        key = (one << 32 | other)[(one > 0) & (other > 0)]
        key.sort()
        key = key[np.flatnonzero(np.diff(key, prepend=0))]
        a, b = key >> 32, key & 0xFFFFFFFF
        (rows, columns, price), to = self._places[a].T, self._places[b].T
        costs = np.hypot(to[0] - rows, to[1] - columns) * (price + to[2]) / 2.0
        edges, number = self._edges, len(self._to)
        for i, j, cost in zip(a.tolist(), b.tolist(), costs.tolist(), strict=True):
            self._to += j, i
            self._prices += cost, cost
            self._before += edges[i], edges[j]
            edges[i], edges[j] = number, number + 1
            number += 2

    # -- searching -----------------------------------------------------------------------------

    def _of(self, cell: int) -> int:
        """Return the piece of a cell."""
        row, column = divmod(cell, self.ground.stride)
        return int(self._piece[row + self._low + 1, column + self._low + 1])

    def _want(self, row: int, column: int, reach: int = 0) -> bool:
        """Ask for the parts about a cell of the snapshot that are not cut; return whether there are any."""
        row, column = row + self._low, column + self._low
        for down in range((row - reach) // PART, (row + reach) // PART + 1):
            for right in range((column - reach) // PART, (column + reach) // PART + 1):
                if (down * PART, right * PART) in self._uncut:
                    self._wanted.append((down * PART, right * PART))
        return bool(self._wanted)

    def _begin(self) -> None:
        """Begin at the start, unless that or the goal is blocked."""
        if self._want(*divmod(self.start, self.ground.stride)):
            return
        if self.goal != BEYOND and self._want(*self._goal_at):
            return
        here = self._of(self.start)
        if self._spread:
            self._aim = NOWHERE
        else:
            self._aim = BEYOND if self.goal == BEYOND else self._of(self.goal)
        if not here or not self._aim:
            self._result = Unreachable()
            return
        self._cost[here] = 0.0
        self._open = [(0.0, here)]
        if self._aim > 0:
            self._back, self._behind = [self._aim], {self._aim}

    def _leave(self) -> None:
        """Go on from the most promising piece to its neighbours, or begin to make a way of what was found.

        In turn the pieces are found from where the goal can be reached: it may lie in a closed room."""
        if not self._open:
            self._result = Unreachable()
            return
        here = self._open[0][1]
        if here == self._aim:
            self._trace()
            return
        if here not in self._done and self._want_about(here):
            return
        if self._back and self._want_about(self._back[0]):
            return
        heappop(self._open)
        if here not in self._done:
            self._done.add(here)
            self._expand(here)
        if self._back:
            self._look_back()

    def _want_about(self, piece: int) -> bool:
        """Ask for the parts about a piece that are not cut; return whether there are any."""
        row, column, _ = self._places[piece].tolist()
        return self._want(int(row), int(column), self._side)

    def _expand(self, here: int) -> None:
        """Find what the neighbours of a piece cost."""
        self.work += PIECE_WORK
        so_far, costs = self._cost[here], self._cost
        edge = self._edges[here]
        while edge != NO_EDGE:
            there, cost, edge = self._to[edge], so_far + self._prices[edge], self._before[edge]
            if cost < costs.get(there, inf):
                costs[there], self._from[there] = cost, here
                heappush(self._open, (cost + self._ahead[there], there))
        if here in self._ends:
            cost = so_far + float(self._multiplier[EXIT]) * self._ahead[here]
            if cost < costs.get(BEYOND, inf):
                costs[BEYOND], self._from[BEYOND] = cost, here
                heappush(self._open, (cost, BEYOND))

    def _look_back(self) -> None:
        """Find the neighbours of a piece from where the goal can be reached: until it is known to be closed
        in, or to lie in no small room."""
        self.work += PIECE_WORK
        edge, met = self._edges[self._back.pop(0)], False
        while edge != NO_EDGE:
            there, edge = self._to[edge], self._before[edge]
            met |= there in self._cost
            if there not in self._behind:
                self._behind.add(there)
                self._back.append(there)
        if not self._back:
            self._result = Unreachable()
        elif len(self._behind) > MOST_BEHIND or met:
            self._back = []

    # -- the way -------------------------------------------------------------------------------

    def _trace(self) -> None:
        """Find the places that the way leads over, but for those where it goes straight on."""
        pieces, piece = [], self._aim
        while piece in self._from:
            piece = self._from[piece]
            pieces.append(piece)
        rows, columns = self._places[pieces[:-1], :2].astype(np.int64).T
        places = rows * self.ground.stride + columns
        straight = np.zeros(len(places), np.bool_)
        straight[1:-1] = (np.diff(rows, 2) == 0) & (np.diff(columns, 2) == 0)
        straight[::LONGEST] = False
        goal = [] if self.goal == BEYOND else [self.goal]
        self._points, self._corners = [*goal, *places[~straight].tolist()], [self.start]
        self.work += len(pieces)
        if not self._points:
            self._end()

    def _connect(self, work: int) -> None:
        """Lead the way on to the next place."""
        ground, here, there = self.ground, self._corners[-1], self._points[-1]
        if self._leg is None:
            rows, columns, span = crossing(ground.resolution, ground.centre(here), ground.centre(there))
            cells = (rows - ground.corner[0]) * ground.stride + columns - ground.corner[1]
            price = self._multiplier[ground.level[cells]]
            self.work += LINE_WORK + len(cells) // CELLS_PER_WORK
            if price.max() < inf:
                self._go(cells, [there], float(price @ span))
            else:
                self._leg = self._detour(here, there)
            return
        before = self._leg.work
        outcome = self._leg.advance(work)
        self.work += max(self._leg.work - before, 1)
        if isinstance(outcome, CellPath):
            cells = cells_in(self._leg.ground, np.array(outcome.cells), ground)
            self._leg = None
            self._go(cells, cells[outcome.corners()[1:]].tolist(), outcome.cost)
        elif isinstance(outcome, Unreachable):
            self._result = outcome

    def _detour(self, here: int, there: int) -> CellSearch:
        """Begin a search cell by cell in the blocks of two places and those around them, where there is a
        way."""
        ground, ranges = self.ground, []
        for a, b, most in zip(
            divmod(here, ground.stride),
            divmod(there, ground.stride),
            (ground.height, ground.stride),
            strict=True,
        ):
            ranges.append(range(max(min(a, b) - self._side, 0), min(max(a, b) + self._side + 1, most)))
        part = Part(ground, *ranges)
        self.work += len(part.level) // CELLS_PER_WORK
        start, goal = cells_in(ground, np.array((here, there)), part).tolist()
        return CellSearch(part, start, goal, through_unknown=self._through)

    def _go(self, cells: Cells, corners: list[int], cost: float) -> None:
        """Take cells that lead to the next place."""
        unknown = self.ground.level[cells] >= UNKNOWN
        if self._frontier is None and unknown.any():
            first = int(unknown.argmax())
            self._frontier = len(self._corners), int(cells[max(first - 1, 0)]), int(cells[first])
        self._corners += corners
        self._paid += cost
        self._points.pop()
        if not self._points:
            self._end()

    def _end(self) -> None:
        if self.goal == BEYOND:
            self._corners.append(BEYOND)
        self._result = CornerPath(tuple(self._corners), self._paid, self._frontier)


class GroundSearch:
    """One search cell by cell, or by blocks once that has taken more than it may."""

    def __init__(self, most: int, ground: Snapshot, start: int, goal: int, **how: Any) -> None:  # noqa: ANN401
        """`most`: the work that it may take cell by cell; the others are those of both kinds."""
        self.work = 0
        self._most, self._asked, self._how = most, (ground, start, goal), how
        self._search: CellSearch | BlockSearch = CellSearch(ground, start, goal, **how)

    def advance(self, work: int) -> CellPath | CornerPath | Unreachable | Searching:
        """Continue for about this much work. Once finished, the outcome does not change."""
        if isinstance(self._search, CellSearch):
            work = min(work, self._most - self.work)
            if work <= 0:
                self._search, work = BlockSearch(*self._asked, **self._how), 1
        before = self._search.work
        outcome = self._search.advance(work)
        self.work += max(self._search.work - before, 1)
        return outcome

    def reached(self, window: tuple[slice, slice]) -> Floats:
        """Return what each cell of a part of the snapshot costs, as far as it was reached; else 0."""
        return self._search.reached(window)


def side_of(ground: Snapshot) -> int:
    """Return the cells along a block: a power of 2, so that tiles are of whole blocks."""
    side, cells = 4, len(ground.level)
    while side < TILE // 2 and (side * ground.resolution < SHORTEST or cells > MOST_BLOCKS * side**2):
        side *= 2
    return side


WITHIN = np.zeros((3, 3, 3), np.bool_)
"""Which cells of blocks are neighbours: the four beside, of the same block"""
WITHIN[1] = ((0, 1, 0), (1, 1, 1), (0, 1, 0))


@cache
def labelling() -> Any:  # noqa: ANN401 -- it has no types
    """Return SciPy's function that numbers connected cells."""
    from scipy.ndimage import label  # here, because it takes half a second to import

    return label


@cache
def _off_centre(side: int) -> Floats:
    """Return what each place of a block is worth, for its distance from the middle."""
    away = (np.arange(side) - (side - 1) / 2.0) ** 2
    worth: Floats = -CENTRED * (away[:, None] + away[None, :])
    return worth
