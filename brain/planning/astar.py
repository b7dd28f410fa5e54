"""A* on a snapshot of the costmap, a bounded number of expansions at a time.

Rules. Eight neighbours; a diagonal only where both cells beside it may be entered (no corner is cut). A
move costs its length times the multiplier of the cell entered; the octile distance is an admissible
heuristic, since multipliers are >= 1, so the result is optimal in this metric (Hart, Nilsson and Raphael
1968; an entry of the queue is stale once a cheaper path to its cell was found, and cells may be reopened).
A goal beyond the snapshot is one move, an octile path over unknown ground, from each cell of level `EXIT`.
Ties are broken by depth and then by cell, so equal queries have equal results. Only cells that were reached
have a state. It is plain data: it can be copied and resumed between any two calls of `advance`.
"""

from __future__ import annotations

from dataclasses import dataclass
from heapq import heappop, heappush
from math import inf, sqrt
from typing import TypeAlias

import numpy as np

from brain.planning.costmap import EXIT, UNKNOWN
from brain.planning.snapshot import Snapshot

DIAGONAL = sqrt(2.0)
BEYOND = -1
"""The goal, if it lies beyond the snapshot."""


@dataclass(frozen=True, slots=True)
class CellPath:
    """The cheapest path."""

    cells: tuple[int, ...]
    """From start to goal, both included; each a neighbour of the one before."""
    cost: float
    """m, weighted by the multipliers"""


@dataclass(frozen=True, slots=True)
class Unreachable:
    """Every reachable cell was expanded; the goal is not among them."""


@dataclass(frozen=True, slots=True)
class Searching:
    """Not finished: call `advance` again."""

    expansions: int
    """So far."""


Outcome: TypeAlias = CellPath | Unreachable | Searching


class Search:
    """One search from a cell to a cell; `beyond` is the row and column of a goal beyond the snapshot;
    `through_unknown` is the assumed cost of a metre through unknown ground, if it may be entered."""

    def __init__(
        self,
        ground: Snapshot,
        start: int,
        goal: int,
        *,
        beyond: tuple[int, int] = (0, 0),
        through_unknown: float = inf,
    ) -> None:
        self.ground, self.start, self.goal = ground, start, goal
        self.expansions = 0
        multiplier = ground.multiplier.copy()
        if through_unknown < inf:
            multiplier[UNKNOWN:] = np.minimum(multiplier[UNKNOWN:], through_unknown)
        self._multiplier: list[float] = multiplier.tolist()
        self._goal_at = beyond if goal == BEYOND else divmod(goal, ground.stride)
        self._cost = {start: 0.0}
        self._parent: dict[int, int] = {}
        self._open = [(0.0, 0.0, start)]
        self._cells: list[int] = []
        """The path found, from the goal as far back as it was traced."""
        self._closed = goal != BEYOND and self._multiplier[ground.level[goal]] == inf

    def advance(self, work: int) -> Outcome:
        """Expand, or trace back, at most this many cells. Once finished, the outcome does not change."""
        if not self._cells and not self._closed:
            work -= self._expand(work)
        if self._closed:
            return Unreachable()
        cells = self._cells
        while cells and cells[-1] != self.start and work > 0:
            cells.append(self._parent[cells[-1]])
            work -= 1
            self.expansions += 1
        if not cells or cells[-1] != self.start:
            return Searching(self.expansions)
        return CellPath(tuple(reversed(cells)), self._cost[self.goal] * self.ground.resolution)

    def _expand(self, limit: int) -> int:
        queue, cost, parent, goal = self._open, self._cost, self._parent, self.goal
        level, multiplier, stride = self.ground.level, self._multiplier, self.ground.stride
        (goal_row, goal_column), known = self._goal_at, cost.get
        excess = DIAGONAL - 2.0
        done = 0
        while queue and done < limit:
            _, minus, cell = heappop(queue)
            done += 1
            here = -minus
            if here > cost[cell]:
                continue
            if cell == goal:
                self._cells.append(goal)
                break
            east = multiplier[level[cell + 1]]
            west = multiplier[level[cell - 1]]
            north = multiplier[level[cell + stride]]
            south = multiplier[level[cell - stride]]
            moves = [
                (cell + 1, here + east),
                (cell - 1, here + west),
                (cell + stride, here + north),
                (cell - stride, here + south),
            ]
            if north < inf:
                if east < inf:
                    moves.append((cell + stride + 1, here + DIAGONAL * multiplier[level[cell + stride + 1]]))
                if west < inf:
                    moves.append((cell + stride - 1, here + DIAGONAL * multiplier[level[cell + stride - 1]]))
            if south < inf:
                if east < inf:
                    moves.append((cell - stride + 1, here + DIAGONAL * multiplier[level[cell - stride + 1]]))
                if west < inf:
                    moves.append((cell - stride - 1, here + DIAGONAL * multiplier[level[cell - stride - 1]]))
            if goal == BEYOND and level[cell] == EXIT:
                row, column = divmod(cell, stride)
                dx, dy = abs(column - goal_column), abs(row - goal_row)
                moves.append((goal, here + multiplier[EXIT] * (dx + dy + excess * min(dx, dy))))
            for there, new in moves:
                if new < known(there, inf):
                    cost[there] = new
                    parent[there] = cell
                    row, column = divmod(there, stride) if there != BEYOND else self._goal_at
                    dx, dy = abs(column - goal_column), abs(row - goal_row)
                    heappush(queue, (new + dx + dy + excess * (dx if dx < dy else dy), -new, there))
        else:
            self._closed = not queue
        self.expansions += done
        return done
