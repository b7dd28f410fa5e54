"""Search by blocks of cells: ways over ground that is too large to be searched cell by cell.

Rules. A block of about `SIDE` metres has one piece, or more, of cells that are connected within it by moves to
four neighbours; pieces are neighbours where a cell of one lies beside a cell of the other, or where four free
cells meet at the blocks' corner. A* leads from piece to piece, from the best place of each to that of the next
(hierarchical path-finding: Botea, Müller and Schaeffer 2004, with connected pieces in place of entrances). Since
A* on cells cuts no corner, it reaches exactly what can be reached by pieces: that there is no way is no estimate.
What a way costs is one. Between two places the way is straight, or else it is searched cell by cell. Equal
queries have equal results, however they are sliced. The state is plain data.
"""

from __future__ import annotations

from functools import cache
from heapq import heappop, heappush
from math import inf, log2
from typing import Any

import numpy as np

from brain.planning.astar import BEYOND, DIAGONAL, CellPath, CellSearch, Searching, Unreachable
from brain.planning.costmap import EXIT, TILE, UNKNOWN, Cells, Floats
from brain.planning.snapshot import CELLS_PER_WORK, LINE_WORK, Snapshot, crossing

SIDE = 0.8
"""m, about, of a block"""
CUT_WORK = 1200
"""Cutting 64 × 64 cells into pieces, in expansions of A*"""
PIECE_WORK = 30
"""Leaving a piece"""
CENTRED = 1e-5
"""What a place is worth that is nearer to the middle of its block, by squared cells, beside its price"""


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
        self._goal_at = beyond if goal == BEYOND else divmod(goal, ground.stride)
        self._side = side = side_of(ground.resolution)
        self._low = side - 2
        """Cells before the snapshot's first, so that its tiles are whole blocks"""
        height, width = (-(-(count + self._low) // side) * side for count in (ground.height, ground.stride))
        self._piece = np.zeros((height + 1, width + 1), np.int32)
        """The number of each cell's piece, 0 where there is none; one row and column before them"""
        self._parts = [(row, column) for row in range(0, height, TILE) for column in range(0, width, TILE)]
        """Not yet cut, the next one last"""
        self._parts.reverse()
        self._places: Floats = np.zeros((1, 3))
        """Row and column of the best place of each piece, and its mean price"""
        self._count = 1
        self._beside: list[list[tuple[int, float]]] = [[]]
        """The neighbours of each piece, and the way's cost [cells]"""
        self._ends: set[int] = set()
        """Pieces from where the way to a goal beyond the snapshot is open"""
        self._cost: dict[int, float] = {}
        self._from: dict[int, int] = {}
        self._done: set[int] = set()
        self._open: list[tuple[float, int]] = []
        self._aim = 0
        """The goal's piece"""
        self._points: list[int] = []
        """Cells that the way leads over, the next one last"""
        self._leg: CellSearch | None = None
        """Where the way to the next of them is not straight"""
        self._cells: list[int] = []
        self._corners: list[int] = []
        """Where in these the way turns"""
        self._paid = 0.0
        """Cells, so far, weighted"""
        self._result: CellPath | Unreachable | None = None

    def advance(self, work: int) -> CellPath | Unreachable | Searching:
        """Continue for about this much work. Once finished, the outcome does not change."""
        end = self.work + work
        while self.work < end and self._result is None:
            if self._parts:
                self._cut(*self._parts.pop())
                if not self._parts:
                    self._begin()
            elif self._points:
                self._connect(end - self.work)
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
        side, plane = self._side, self._piece[1:, 1:][row : row + TILE, column : column + TILE]
        shape = plane.shape
        level = np.zeros(shape, np.uint8)
        first, left = row - self._low, column - self._low
        ground = self.ground.level.reshape(self.ground.height, self.ground.stride)
        known = ground[max(first, 0) : first + shape[0], max(left, 0) : left + shape[1]]
        level[max(-first, 0) :, max(-left, 0) :][: known.shape[0], : known.shape[1]] = known
        blocks = level.reshape(shape[0] // side, side, -1, side).swapaxes(1, 2).reshape(-1, side, side)
        price = self._multiplier[blocks]
        free = price < inf
        piece, count = labelling()(free, WITHIN)
        self.work += CUT_WORK * level.size // TILE**2 + 1
        if count:
            self._add(piece, price, blocks, (row, column), shape, count)
            self._join(row, column, shape)

    def _add(
        self, piece: Any, price: Floats, level: Any, corner: tuple[int, int], shape: Any, count: int
    ) -> None:
        """Add pieces: where the best place of each is, and what it costs there."""
        side, flat = self._side, piece.reshape(-1)
        inside = flat.nonzero()[0]
        of, price = flat[inside], price.reshape(-1)[inside]
        worth = -price - _off_centre(side, len(piece)).reshape(-1)[inside]
        worth[level.reshape(-1)[inside] == EXIT] += 1e6
        best = np.full(count + 1, -inf)
        np.maximum.at(best, of, worth)
        at = (worth == best[of]).nonzero()[0][::-1]
        place = np.zeros(count + 1, np.int64)
        place[of[at]] = inside[at]
        place = place[1:]
        block, within = np.divmod(place, side * side)
        rows, columns = np.divmod(block, shape[1] // side)
        sizes = np.bincount(of, minlength=count + 1)[1:]
        new = np.empty((count, 3))
        new[:, 0] = corner[0] - self._low + rows * side + within // side
        new[:, 1] = corner[1] - self._low + columns * side + within % side
        new[:, 2] = np.bincount(of, price, minlength=count + 1)[1:] / sizes
        if self._count + count > len(self._places):
            more = np.zeros((2 * len(self._places) + count, 3))
            more[: self._count] = self._places[: self._count]
            self._places = more
        self._places[self._count : self._count + count] = new
        self._beside += [[] for _ in range(count)]
        if self.goal == BEYOND:
            exits = level.reshape(-1)[place] == EXIT
            self._ends.update((exits.nonzero()[0] + self._count).tolist())
        numbers = np.where(piece > 0, piece + (self._count - 1), 0)
        whole = numbers.reshape(shape[0] // side, -1, side, side).swapaxes(1, 2).reshape(shape)
        self._piece[1:, 1:][corner[0] : corner[0] + shape[0], corner[1] : corner[1] + shape[1]] = whole
        self._count += count

    def _join(self, row: int, column: int, shape: tuple[int, int]) -> None:
        """Find the neighbours among the pieces of a part, and of the parts before it."""
        side = self._side
        part = self._piece[row : row + shape[0] + 1, column : column + shape[1] + 1]
        before, after = slice(0, -1, side), slice(1, None, side)
        corners = (part[before, before], part[after, after], part[before, after], part[after, before])
        meet = corners[0].astype(bool) & (corners[1] > 0) & (corners[2] > 0) & (corners[3] > 0)
        pairs = (
            (part[before, 1:].reshape(-1), part[after, 1:].reshape(-1)),
            (part[1:, before].reshape(-1), part[1:, after].reshape(-1)),
            (corners[0][meet], corners[1][meet]),
            (corners[2][meet], corners[3][meet]),
        )
        one = np.concatenate([a for a, _ in pairs]).astype(np.int64)
        other = np.concatenate([b for _, b in pairs]).astype(np.int64)
        key = (one << 32 | other)[(one > 0) & (other > 0)]
        key = np.unique(key)
        a, b = key >> 32, key & 0xFFFFFFFF
        (rows, columns, price), to = self._places[a].T, self._places[b].T
        costs = np.hypot(to[0] - rows, to[1] - columns) * (price + to[2]) / 2.0
        beside = self._beside
        for i, j, cost in zip(a.tolist(), b.tolist(), costs.tolist(), strict=True):
            beside[i].append((j, cost))
            beside[j].append((i, cost))

    # -- searching -----------------------------------------------------------------------------

    def _of(self, cell: int) -> int:
        row, column = divmod(cell, self.ground.stride)
        return int(self._piece[row + self._low + 1, column + self._low + 1])

    def _begin(self) -> None:
        """Begin at the start, unless that or the goal is blocked."""
        here = self._of(self.start)
        self._aim = BEYOND if self.goal == BEYOND else self._of(self.goal)
        if not here or not (self._aim or self._spread):
            self._result = Unreachable()
            return
        self._cost[here] = 0.0
        self._open = [(0.0, here)]

    def _ahead(self, piece: int) -> float:
        row, column, _ = self._places[piece].tolist()
        dx, dy = abs(column - self._goal_at[1]), abs(row - self._goal_at[0])
        return float(dx + dy + (DIAGONAL - 2.0) * min(dx, dy))

    def _leave(self) -> None:
        """Go on from the most promising piece to its neighbours, or begin to make a way of what was found."""
        if not self._open:
            self._result = Unreachable()
            return
        _, here = heappop(self._open)
        if here == self._aim:
            self._trace()
            return
        if here in self._done:
            return
        self._done.add(here)
        self.work += PIECE_WORK
        so_far, costs = self._cost[here], self._cost
        for there, price in self._beside[here]:
            cost = so_far + price
            if cost < costs.get(there, inf):
                costs[there], self._from[there] = cost, here
                heappush(self._open, (cost + self._ahead(there), there))
        if here in self._ends:
            cost = so_far + float(self._multiplier[EXIT]) * self._ahead(here)
            if cost < costs.get(BEYOND, inf):
                costs[BEYOND], self._from[BEYOND] = cost, here
                heappush(self._open, (cost, BEYOND))

    # -- the way -------------------------------------------------------------------------------

    def _trace(self) -> None:
        """Find the places that the way leads over."""
        pieces, piece = [], self._aim
        while piece in self._from:
            piece = self._from[piece]
            pieces.append(piece)
        places = self._places[pieces[:-1], :2].astype(np.int64) @ (self.ground.stride, 1)
        goal = [] if self.goal == BEYOND else [self.goal]
        self._points = [*goal, *places.tolist()]
        self._cells, self._corners = [self.start], [0]
        self.work += len(pieces)
        if not self._points:
            self._end()

    def _connect(self, work: int) -> None:
        """Lead the way on to the next place."""
        ground, here, there = self.ground, self._cells[-1], self._points[-1]
        if self._leg is None:
            rows, columns, span = crossing(ground.resolution, ground.centre(here), ground.centre(there))
            cells = (rows - ground.corner[0]) * ground.stride + columns - ground.corner[1]
            price = self._multiplier[ground.level[cells]]
            self.work += LINE_WORK + len(cells) // CELLS_PER_WORK
            if price.max() == inf:
                self._leg = CellSearch(ground, here, there, through_unknown=self._through)
                return
            self._go(cells, [len(cells) - 1], float(price @ span))
            return
        before = self._leg.work
        outcome = self._leg.advance(work)
        self.work += max(self._leg.work - before, 1)
        if isinstance(outcome, CellPath):
            self._leg = None
            self._go(np.array(outcome.cells), outcome.corners(), outcome.cost)
        elif isinstance(outcome, Unreachable):
            self._result = outcome

    def _go(self, cells: Cells, corners: list[int], cost: float) -> None:
        """Take cells that lead to the next place."""
        first = len(self._cells) - 1
        self._cells[-1:] = cells.tolist()
        self._cells[-1] = self._points.pop()
        self._corners += [first + corner for corner in corners if corner]
        self._paid += cost
        if not self._points:
            self._end()

    def _end(self) -> None:
        if self.goal == BEYOND:
            self._cells.append(BEYOND)
            self._corners.append(len(self._cells) - 1)
        self._result = CellPath(tuple(self._cells), self._paid, tuple(self._corners))


class GroundSearch:
    """One search cell by cell, or by blocks once that has taken more than it may."""

    def __init__(self, most: int, ground: Snapshot, start: int, goal: int, **how: Any) -> None:  # noqa: ANN401
        """`most`: the work that it may take cell by cell; the others are those of both kinds."""
        self.work = 0
        self._most, self._asked, self._how = most, (ground, start, goal), how
        self._search: CellSearch | BlockSearch = CellSearch(ground, start, goal, **how)

    def advance(self, work: int) -> CellPath | Unreachable | Searching:
        """Continue for about this much work. Once finished, the outcome does not change."""
        if isinstance(self._search, CellSearch) and self.work >= self._most:
            self._search = BlockSearch(*self._asked, **self._how)
        before = self._search.work
        outcome = self._search.advance(
            min(work, max(self._most - self.work, 1)) if isinstance(self._search, CellSearch) else work
        )
        self.work += max(self._search.work - before, 1)
        return outcome

    def reached(self, window: tuple[slice, slice]) -> Floats:
        """Return what each cell of a part of the snapshot costs, as far as it was reached; else 0."""
        return self._search.reached(window)


def side_of(resolution: float) -> int:
    """Return the cells along a block, of so many m each."""
    return int(min(max(2 ** round(log2(SIDE / resolution)), 4), TILE // 2))


WITHIN = np.zeros((3, 3, 3), np.bool_)
"""Which cells of blocks are neighbours: the four beside, of the same block"""
WITHIN[1] = ((0, 1, 0), (1, 1, 1), (0, 1, 0))


@cache
def labelling() -> Any:  # noqa: ANN401 -- it has no types
    """Return SciPy's function that numbers connected cells."""
    from scipy.ndimage import label  # here, because it takes half a second to import

    return label


@cache
def _off_centre(side: int, count: int) -> Floats:
    """Return what each place of so many blocks is worth less, for its distance from the middle."""
    away = (np.arange(side) - (side - 1) / 2.0) ** 2
    one: Floats = CENTRED * (away[:, None] + away[None, :])
    return np.broadcast_to(one, (count, side, side))
