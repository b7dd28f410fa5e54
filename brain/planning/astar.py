"""A* on a snapshot of the costmap, in batches of cells, a bounded number of expansions at a time.

Rules. Eight neighbours; a diagonal only where both cells beside it may be entered (no corner is cut). A
move costs its length times the multiplier of the cell entered; the octile distance is an admissible
heuristic, since multipliers are >= 1 (Hart, Nilsson and Raphael 1968). Open cells lie in buckets of cost +
heuristic; of the lowest, a batch is expanded at once, whatever the order within it, and a cell that is
reached at less cost later is expanded again (delta-stepping, Meyer and Sanders 2003). The search ends when
no bucket can improve the goal, so the result is optimal in this metric. A goal beyond the snapshot is one
move, an octile path over unknown ground, from each cell of level `EXIT`. Equal queries have equal results.
The memory of cells that were not reached is not touched. The state is plain data: it can be copied and
resumed between any two calls of `advance`.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise
from math import inf, sqrt
from typing import TypeAlias

import numpy as np

from brain.planning.costmap import EXIT, UNKNOWN, Cells, Floats
from brain.planning.snapshot import Snapshot

DIAGONAL = sqrt(2.0)
BEYOND = -1
"""The goal, if it lies beyond the snapshot."""
BATCH = 128
"""Cells expanded at once, at most."""
BATCH_WORK = 130
"""What a batch costs beside its cells, in expansions."""
BUCKET = 1.0
"""Cells, width of a bucket"""
SPREAD, NEARBY = 1.2, 40.0
"""A search that spreads ends at this multiple of the goal's cost, and so many cells more."""
BESIDE = np.array(((0, 0, 1, 1), (2, 3, 2, 3)))
"""The two moves beside each of the diagonal ones."""
ZERO = 5e-324
"""Cost of the start: 0 means not reached, as in untouched memory. It vanishes in every sum."""


@dataclass(frozen=True, slots=True)
class CellPath:
    """The cheapest path."""

    cells: tuple[int, ...]
    """From start to goal, both included; each a neighbour of the one before."""
    cost: float
    """m, weighted by the multipliers"""

    def corners(self) -> list[int]:
        """Return which of the cells are at its turns, or about its ends."""
        count, turns = len(self.cells), np.flatnonzero(np.diff(self.cells, 2)) + 1
        return sorted({0, 1, *turns.tolist(), count - 2, count - 1} & set(range(count)))


@dataclass(frozen=True, slots=True)
class Unreachable:
    """Every reachable cell was expanded; the goal is not among them."""


@dataclass(frozen=True, slots=True)
class Searching:
    """Not finished: call `advance` again."""

    work: int
    """So far, in expansions."""


Outcome: TypeAlias = CellPath | Unreachable | Searching


class CellSearch:
    """One search from a cell to a cell; `beyond` is the row and column of a goal beyond the snapshot;
    `through_unknown` is the assumed cost of a metre through unknown ground, if it may be entered. With
    `spread` it goes on without aim until each cell that costs not much more than the goal has its cost."""

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
        """Done so far, in expansions."""
        self._spread = spread
        self._multiplier = ground.multiplier.copy()
        if through_unknown < inf:
            self._multiplier[UNKNOWN:] = np.minimum(self._multiplier[UNKNOWN:], through_unknown)
        self._goal_at = beyond if goal == BEYOND else divmod(goal, ground.stride)
        side = ground.stride
        self._moves = np.array((side, -side, 1, -1, side + 1, side - 1, -side + 1, -side - 1))[:, None]
        self.cost = np.zeros(len(ground.level))
        """Cells, from the start to each; 0 where not reached"""
        self._came = np.zeros(len(ground.level), np.uint8)
        """The move to each cell that was reached."""
        self.cost[start] = ZERO
        self._open: dict[int, list[Cells]] = {}
        """Cells by cost + heuristic, in buckets."""
        self._best = (inf, start)
        """Cost of the goal, and the last cell on the way to it."""
        self.most = inf
        """Cells: what costs more is of no use."""
        self._cells: list[int] = []
        """The path found, from the goal as far back as it was traced."""
        self._closed = goal != BEYOND and not spread and self._multiplier[ground.level[goal]] == inf
        self._put(np.array([start]))

    def advance(self, work: int) -> Outcome:
        """Expand cells, or trace the path back, for about this much work. Once finished, the outcome does not
        change."""
        end = self.work + work
        while self.work < end and not self._closed and not self._cells:
            self.work += self._expand()
        if self._closed:
            return Unreachable()
        cells, moves = self._cells, self._moves[:, 0].tolist()
        while cells and cells[-1] != self.start and self.work < end:
            cells.append(self._best[1] if cells[-1] == BEYOND else cells[-1] - moves[self._came[cells[-1]]])
            self.work += 3
        if not cells or cells[-1] != self.start:
            return Searching(self.work)
        return CellPath(tuple(reversed(cells)), self._best[0] * self.ground.resolution)

    def reached(self, window: tuple[slice, slice]) -> Floats:
        """Return what each cell of a part of the snapshot costs, as far as it was reached; else 0."""
        found: Floats = self.cost.reshape(self.ground.height, self.ground.stride)[window]
        return found

    def _take(self) -> Cells:
        """Return the next batch, from the lowest bucket; expanding a cell in vain does no harm."""
        bucket = min(self._open)
        stack, taken, count = self._open[bucket], [], 0
        while stack and count < BATCH:
            cells = stack.pop()
            if len(cells) > BATCH - count:
                split = len(cells) - (BATCH - count)
                stack.append(cells[:split])
                cells = cells[split:]
            taken.append(cells)
            count += len(cells)
        if not stack:
            del self._open[bucket]
        return np.concatenate(taken)

    def _expand(self) -> int:
        """Expand a batch of cells; return the work."""
        if not self._open or min(self._open) * BUCKET >= self.most:
            self._closed = self._best[0] == inf
            self._cells = [self.goal]
            return 1
        cells = self._take()
        count, cost = len(cells), self.cost
        there = cells + self._moves
        step = self._multiplier[self.ground.level[there]]
        step[4:] *= DIAGONAL
        step[4:][step[BESIDE[0]] + step[BESIDE[1]] == inf] = inf
        new = cost[cells] + step
        old = cost[there]
        old[old == 0.0] = inf
        found = (new < old).reshape(-1).nonzero()[0]
        there, new = there.reshape(-1)[found], new.reshape(-1)[found]
        cost[there[cost[there] == 0.0]] = inf
        np.minimum.at(cost, there, new)
        kept = new == cost[there]
        there = there[kept]
        self._came[there] = found[kept] // count
        there.sort()
        first = np.ones(len(there), np.bool_)
        first[1:] = there[1:] != there[:-1]
        self._put(there[first])
        return count + BATCH_WORK

    def _put(self, cells: Cells) -> None:
        """Put cells into their buckets, unless the goal is reached at less than they promise."""
        costs = self.cost[cells]
        rows, columns = np.divmod(cells, self.ground.stride)
        dx, dy = np.abs(columns - self._goal_at[1]), np.abs(rows - self._goal_at[0])
        ahead = dx + dy + (DIAGONAL - 2.0) * np.minimum(dx, dy)
        if self._spread:
            ahead *= 0.0
        if self.goal == BEYOND:
            exits = (self.ground.level[cells] == EXIT).nonzero()[0]
            if len(exits):
                whole = costs[exits] + self._multiplier[EXIT] * ahead[exits]
                first = int(np.argmin(whole))
                self._best = min(self._best, (float(whole[first]), int(cells[exits[first]])))
        elif self.cost[self.goal] > 0.0:
            self._best = (float(self.cost[self.goal]), self.goal)
        promise = costs + ahead
        buckets = (promise * (1.0 / BUCKET)).astype(np.int64)
        order = buckets.argsort(kind="stable")
        if self._best[0] < inf:
            self.most = SPREAD * self._best[0] + NEARBY if self._spread else self._best[0]
            order = order[promise[order] < self.most]
        cells, buckets = cells[order], buckets[order]
        cuts = ((buckets[1:] != buckets[:-1]).nonzero()[0] + 1).tolist()
        for first, last in pairwise((0, *cuts, len(cells)) if len(cells) else ()):
            self._open.setdefault(int(buckets[first]), []).append(cells[first:last])
