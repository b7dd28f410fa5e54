"""The cheapest way across a house of rooms, from corner to corner: ours, scikit-image, SciPy.

Rules. Everybody moves to eight neighbours and pays for the length. Ours and the graph for SciPy cut no
corners; scikit-image does. SciPy's graph has to be made anew for each map, reported apart: on a map that
changes with each scan it is part of the price.
"""

from __future__ import annotations

from itertools import pairwise
from math import sqrt
from typing import Any

import numpy as np
import numpy.typing as npt

from benchmarks.measure import Call, Effort, in_turn, rival
from benchmarks.rows import Row, against
from brain.planning.astar import CellPath, CellSearch
from brain.planning.costmap import TILE, Costmap, PlannerSettings
from brain.planning.footprint import Shape
from brain.planning.snapshot import Snapshot
from brain.region import Tile
from protocols.messages import Nanos

GROUP = "the cheapest way through a house of rooms, corner to corner"
SEED = 20
ROOMS = 8
"""Along each side."""
SIZES = (200, 1000)
Mask = npt.NDArray[np.bool_]
POINT = Shape.circle(0.0)
EVERYTHING: Nanos = 1 << 40
"""More expansions than any of these maps has cells."""


def paths(effort: Effort) -> list[Row]:
    """Two sizes."""
    rounds = {200: effort.of(30, 2), 1000: effort.of(5, 1)}
    return [_row(size, rounds[size]) for size in SIZES]


def _row(size: int, rounds: int) -> Row:
    blocked = rooms(size)
    ground = ground_of(blocked)
    skimage = rival("skimage.graph", "scikit-image")
    scipy, sparse = rival("scipy.sparse.csgraph", "scipy"), rival("scipy.sparse", "scipy")
    mcp, route = f"{skimage.name}: MCP_Geometric", f"{skimage.name}: route_through_array"
    both, search = f"{scipy.name}: make the graph, dijkstra", f"{scipy.name}: dijkstra alone"
    contestants: dict[str, Call] = {"ours": lambda: ours(ground, size)}
    if not skimage.why_not:
        cost = np.where(blocked, -1.0, 1.0)
        contestants[mcp] = lambda: _mcp(skimage.module, cost)
        contestants[route] = lambda: _route(skimage.module, cost)
    if not scipy.why_not:
        made = graph(sparse.module, blocked)
        contestants[both] = lambda: length(scipy.module, graph(sparse.module, blocked))
        contestants[search] = lambda: length(scipy.module, made)
    found = in_turn(contestants, rounds)
    beside = against(found, mcp, route, both, search, missing=(skimage, scipy))
    return Row(GROUP, f"{size} × {size} cells", found["ours"], beside)


def rooms(size: int) -> Mask:
    """Walls round 8 × 8 rooms, each with a door wherever two rooms meet. The same for the same size."""
    random = np.random.Generator(np.random.PCG64(SEED))
    blocked = np.zeros((size, size), dtype=np.bool_)
    edges = np.linspace(0, size, ROOMS + 1).astype(int)
    door = max(2, size // (6 * ROOMS))
    for wall in edges[1:-1]:
        blocked[wall, :] = blocked[:, wall] = True
    for wall in edges[1:-1]:
        for low, high in pairwise(edges):
            across, down = random.integers(low + 1, high - door, size=2)
            blocked[wall, across : across + door] = False
            blocked[down : down + door, wall] = False
    return blocked


class Picture:
    """A map that does not change: cells blocked or free."""

    version = 1

    def __init__(self, blocked: Mask, resolution: float) -> None:
        self.resolution = resolution
        tiles = -(-len(blocked) // TILE)
        padded = np.pad(np.where(blocked, 1, -1), (0, tiles * TILE - len(blocked)), constant_values=1)
        self._tiles = padded.astype(np.int8).reshape(tiles, TILE, tiles, TILE).swapaxes(1, 2)

    def tile(self, row: int, column: int) -> npt.NDArray[np.int8] | None:
        """1 where blocked, -1 where free."""
        inside = 0 <= row < len(self._tiles) and 0 <= column < len(self._tiles)
        return self._tiles[row, column] if inside else None

    def changed(self, since: int) -> list[Tile]:
        """All of them, at first."""
        return [(row, column) for row, column in np.ndindex(self._tiles.shape[:2]) if since < self.version]


def ground_of(blocked: Mask, resolution: float = 1.0, shape: Shape = POINT) -> Snapshot:
    """All that is not a wall is free, and costs the same everywhere."""
    house, corner = Picture(blocked, resolution), (0.5, 0.5)
    settings = PlannerSettings(margin=0.0, comfort=0.0, dislike=0.0)
    costmap = Costmap(resolution, shape.inner, settings, shape.outer)
    costmap.update(house, corner, 0)
    ground = Snapshot(costmap, corner, corner, ())
    ground.assemble(costmap, house, EVERYTHING)
    return ground


def ours(ground: Snapshot, size: int) -> float:
    """The length of the way, in cells; every house of ours has one."""
    start, end = ground.index(0.5, 0.5), ground.index(size - 0.5, size - 0.5)
    assert start is not None
    assert end is not None
    outcome = CellSearch(ground, start, end).advance(EVERYTHING)
    assert isinstance(outcome, CellPath), f"no way through {size} × {size} cells: {outcome}"
    return outcome.cost


def graph(sparse: Any, blocked: Mask) -> Any:  # noqa: ANN401 -- SciPy has no types here
    """The moves between free cells as a sparse matrix; no corner is cut."""
    free = ~blocked
    cells = np.arange(blocked.size).reshape(blocked.shape)
    here, there, costs = [], [], []
    right, down = free[:, :-1] & free[:, 1:], free[:-1] & free[1:]
    square = right[:-1] & right[1:]
    for usable, one, other, cost in (
        (right, cells[:, :-1], cells[:, 1:], 1.0),
        (down, cells[:-1], cells[1:], 1.0),
        (square, cells[:-1, :-1], cells[1:, 1:], sqrt(2.0)),
        (square, cells[:-1, 1:], cells[1:, :-1], sqrt(2.0)),
    ):
        here.append(one[usable])
        there.append(other[usable])
        costs.append(np.full(len(here[-1]), cost))
    shape = (blocked.size, blocked.size)
    moves = (np.concatenate(costs), (np.concatenate(here), np.concatenate(there)))
    return sparse.coo_array(moves, shape=shape).tocsr()


def length(csgraph: Any, moves: Any) -> float:  # noqa: ANN401 -- SciPy has no types here
    """The length of SciPy's way, in cells; the way itself can be read from its predecessors."""
    costs, _ = csgraph.dijkstra(moves, directed=False, indices=0, return_predecessors=True)
    return float(costs[-1])


def _mcp(skimage: Any, cost: npt.NDArray[np.float64]) -> object:  # noqa: ANN401 -- scikit-image has no types
    end = (cost.shape[0] - 1, cost.shape[1] - 1)
    search = skimage.MCP_Geometric(cost)
    search.find_costs([(0, 0)], [end])
    return search.traceback(end)


def _route(skimage: Any, cost: npt.NDArray[np.float64]) -> object:  # noqa: ANN401 -- scikit-image has no types
    end = (cost.shape[0] - 1, cost.shape[1] - 1)
    return skimage.route_through_array(cost, (0, 0), end, fully_connected=True, geometric=True)
