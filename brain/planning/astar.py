"""A* on a costmap, a bounded number of expansions at a time.

Rules. Eight neighbours; a diagonal only where both cells beside it may be entered (no corner is cut). A
move costs its length times the multiplier of the cell entered; the octile distance never overestimates
that, since multipliers are >= 1, so the result is optimal in this metric (Hart, Nilsson and Raphael 1968;
an entry of the queue is stale once a cheaper way to its cell was found, and cells may be opened again).
Equal costs are settled by depth and then by cell, so the same question has the same answer. The state is
plain lists: it can be copied and taken up again between any two calls of `advance`.
"""

from __future__ import annotations

from dataclasses import dataclass
from heapq import heappop, heappush
from math import inf, sqrt
from typing import TypeAlias

from brain.planning.costmap import UNKNOWN, Costmap

DIAGONAL = sqrt(2.0)


@dataclass(frozen=True, slots=True)
class Cells:
    """The cheapest way."""

    cells: tuple[int, ...]
    """Neighbour by neighbour, start and goal included."""
    cost: float
    """m, weighted by the multipliers"""


@dataclass(frozen=True, slots=True)
class NoWay:
    """All that can be reached was searched, and the goal is not among it."""


@dataclass(frozen=True, slots=True)
class Searching:
    """Not done yet: advance again."""

    expansions: int
    """So far."""


Outcome: TypeAlias = Cells | NoWay | Searching


class Search:
    """One search from a cell to a cell; `through_unknown` lets it guess its way over unknown ground."""

    def __init__(self, costmap: Costmap, start: int, goal: int, *, through_unknown: bool = False) -> None:
        self.costmap, self.start, self.goal = costmap, start, goal
        multiplier = list(costmap.multiplier)
        if through_unknown:
            multiplier[UNKNOWN] = costmap.unknown_multiplier
        self._multiplier = tuple(multiplier)
        self._cost = [inf] * len(costmap.level)
        self._parent = [-1] * len(costmap.level)
        self._cost[start] = 0.0
        self._open = [(octile(costmap.stride, start, goal), 0.0, start)]
        self._outcome: Outcome = Searching(0)
        if self._multiplier[costmap.level[goal]] == inf:
            self._outcome = NoWay()

    def advance(self, expansions: int) -> Outcome:
        """Take at most so many cells off the queue. After the end the outcome stays what it is."""
        if not isinstance(self._outcome, Searching):
            return self._outcome
        before = self._outcome.expansions
        done, found = self._expand(expansions)
        if found:
            self._outcome = Cells(self._trace(), self._cost[self.goal] * self.costmap.resolution)
        elif not self._open:
            self._outcome = NoWay()
        else:
            self._outcome = Searching(before + done)
        return self._outcome

    def _expand(self, most: int) -> tuple[int, bool]:
        queue, cost, parent, goal = self._open, self._cost, self._parent, self.goal
        level, multiplier, stride = self.costmap.level, self._multiplier, self.costmap.stride
        goal_row, goal_column = divmod(goal, stride)
        excess = DIAGONAL - 2.0
        done = 0
        while queue and done < most:
            _, minus, cell = heappop(queue)
            done += 1
            here = -minus
            if here > cost[cell]:
                continue
            if cell == goal:
                return done, True
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
            for there, new in moves:
                if new < cost[there]:
                    cost[there] = new
                    parent[there] = cell
                    row, column = divmod(there, stride)
                    dx, dy = abs(column - goal_column), abs(row - goal_row)
                    heappush(queue, (new + dx + dy + excess * (dx if dx < dy else dy), -new, there))
        return done, False

    def _trace(self) -> tuple[int, ...]:
        cells = [self.goal]
        while cells[-1] != self.start:
            cells.append(self._parent[cells[-1]])
        return tuple(reversed(cells))


def octile(stride: int, start: int, goal: int) -> float:
    """The length, in cells, of the shortest eight-connected way over an empty map."""
    (row, column), (goal_row, goal_column) = divmod(start, stride), divmod(goal, stride)
    dx, dy = abs(column - goal_column), abs(row - goal_row)
    return dx + dy + (DIAGONAL - 2.0) * min(dx, dy)
