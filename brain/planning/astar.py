"""A* on a costmap, a bounded number of expansions at a time.

Rules. Eight neighbours; a diagonal only where both cells beside it may be entered (no corner is cut). A
move costs its length times the multiplier of the cell entered; the octile distance is an admissible
heuristic, since multipliers are >= 1, so the result is optimal in this metric (Hart, Nilsson and Raphael
1968; an entry of the queue is stale once a cheaper path to its cell was found, and cells may be reopened).
Ties are broken by depth and then by cell, so equal queries have equal results. The state is plain lists: it
can be copied and resumed between any two calls of `advance`.
"""

from __future__ import annotations

from dataclasses import dataclass
from heapq import heappop, heappush
from math import inf, sqrt
from typing import TypeAlias

from brain.planning.costmap import UNKNOWN, Costmap

DIAGONAL = sqrt(2.0)


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
    """One search from a cell to a cell; `through_unknown` assumes that unknown ground is passable."""

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
            self._outcome = Unreachable()

    def advance(self, expansions: int) -> Outcome:
        """Expand at most this many cells. Once finished, the outcome does not change."""
        if not isinstance(self._outcome, Searching):
            return self._outcome
        before = self._outcome.expansions
        done, found = self._expand(expansions)
        if found:
            self._outcome = CellPath(self._trace(), self._cost[self.goal] * self.costmap.resolution)
        elif not self._open:
            self._outcome = Unreachable()
        else:
            self._outcome = Searching(before + done)
        return self._outcome

    def _expand(self, limit: int) -> tuple[int, bool]:
        queue, cost, parent, goal = self._open, self._cost, self._parent, self.goal
        level, multiplier, stride = self.costmap.level, self._multiplier, self.costmap.stride
        goal_row, goal_column = divmod(goal, stride)
        excess = DIAGONAL - 2.0
        done = 0
        while queue and done < limit:
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
    """Return the length [cells] of the shortest eight-connected path over an empty map."""
    (row, column), (goal_row, goal_column) = divmod(start, stride), divmod(goal, stride)
    dx, dy = abs(column - goal_column), abs(row - goal_row)
    return dx + dy + (DIAGONAL - 2.0) * min(dx, dy)
