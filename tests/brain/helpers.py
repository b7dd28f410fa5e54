"""A kinematic office, a judge of paths, and small makers: shared by the tests of the brain."""

from __future__ import annotations

from math import inf, sqrt

import numpy as np
from scipy.sparse import csr_array
from scipy.sparse.csgraph import dijkstra as scipy_dijkstra

from brain.planning.costmap import Costmap


def dijkstra(costmap: Costmap, start: int, goal: int) -> float:
    """The optimal cost [m] in the planner's metric, by scipy: an oracle that shares no code with A*."""
    cost = np.asarray(costmap.multiplier)[np.frombuffer(costmap.level, np.uint8)].reshape(-1, costmap.stride)
    rows, columns = cost.shape
    tails: list[int] = []
    heads: list[int] = []
    weights: list[float] = []
    for row in range(rows):
        for column in range(columns):
            for d_row, d_column in ((0, 1), (1, 0), (0, -1), (-1, 0), (1, 1), (1, -1), (-1, 1), (-1, -1)):
                r, c = row + d_row, column + d_column
                if not (0 <= r < rows and 0 <= c < columns) or cost[r, c] == inf or cost[row, column] == inf:
                    continue
                if d_row and d_column and (cost[row, c] == inf or cost[r, column] == inf):
                    continue
                tails.append(row * columns + column)
                heads.append(r * columns + c)
                weights.append(float(cost[r, c]) * (sqrt(2.0) if d_row and d_column else 1.0))
    graph = csr_array((weights, (tails, heads)), shape=(cost.size, cost.size))
    distances = scipy_dijkstra(graph, indices=start)
    return float(distances[goal]) * costmap.resolution
