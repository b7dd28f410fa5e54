"""A map given by pictures, and what the planner's parts make of it."""

from __future__ import annotations

from collections.abc import Sequence
from math import cos, hypot, inf, sin

import numpy as np
import numpy.typing as npt

from brain.belief import Pose
from brain.planning.astar import Searching
from brain.planning.costmap import TILE, Costmap, Mask, PlannerSettings
from brain.planning.footprint import Footprint, Shape
from brain.planning.planner import PathQuery, PlanResult
from brain.planning.polyline import Point
from brain.planning.snapshot import Snapshot
from brain.region import Region, Tile

RADIUS = 0.25
EVERYTHING = 10**9
"""More work than any query needs."""


class PlainMap:
    """A map, of 0.1 m per cell unless told, written to directly; around it, everything is unknown."""

    def __init__(
        self,
        occupied: Mask,
        unknown: Mask | None = None,
        low: tuple[int, int] = (-20, -10),
        resolution: float = 0.1,
    ) -> None:
        self.version, self.resolution, self.low = 1, resolution, low
        self.window: Region | None = None
        """The tiles that are kept, if not all: what is outside of it is forgotten."""
        self.occupied = occupied
        self.unknown = np.zeros_like(occupied) if unknown is None else unknown
        self._tiles: dict[Tile, npt.NDArray[np.int8]] = {}
        self._changed: dict[Tile, int] = {}

    def _picture(self) -> tuple[int, int, int, int]:
        rows, columns = self.occupied.shape
        return (self.low[0], self.low[1], self.low[0] + rows, self.low[1] + columns)

    def tile(self, row: int, column: int) -> npt.NDArray[np.int8] | None:
        return self._tiles.get((row, column))

    def changed(self, since: int) -> list[Tile]:
        """Cut into tiles again, and compared."""
        bottom, left, top, right = self._picture()
        down, west = bottom // TILE, left // TILE
        rows, columns = -(-top // TILE) - down, -(-right // TILE) - west
        known = np.where(self.unknown, 0, np.where(self.occupied, 1, -1))
        low, first = bottom - down * TILE, left - west * TILE
        values = np.zeros((rows * TILE, columns * TILE), np.int8)
        height, width = known.shape
        values[low : low + height, first : first + width] = known
        blocks = values.reshape(rows, TILE, columns, TILE).swapaxes(1, 2)
        tiles = {
            (down + r, west + c): blocks[r, c] for r, c in np.ndindex(rows, columns) if blocks[r, c].any()
        }
        for row, column in list(tiles):
            if self.window and not (row in self.window[0] and column in self.window[1]):
                del tiles[row, column]
        for key in tiles.keys() | self._tiles.keys():
            if not np.array_equal(tiles.get(key, 0), self._tiles.get(key, 0)):
                self._changed[key] = self.version
        self._tiles = tiles
        return [key for key, version in self._changed.items() if version > since]

    def middles(self) -> tuple[npt.NDArray[np.float64], npt.NDArray[np.float64]]:
        """x and y [m] of every cell's middle."""
        rows, columns = np.indices(self.occupied.shape)
        return np.asarray(columns + self.low[1] + 0.5) * 0.1, np.asarray(rows + self.low[0] + 0.5) * 0.1

    def blocked(self, radius: float) -> Mask:
        """Cells whose middle is within the radius [m] of an occupied cell, one obstacle after the other."""
        x, y = self.middles()
        blocked = self.occupied.copy()
        for row, column in np.argwhere(self.occupied):
            dx = np.maximum(np.abs(x - x[row, column]) - 0.05, 0.0)
            dy = np.maximum(np.abs(y - y[row, column]) - 0.05, 0.0)
            blocked |= np.hypot(dx, dy) < radius - 1e-9
        return blocked

    def clearance(self, x: float, y: float) -> float:
        """To the nearest occupied cell's edge [m]."""
        best = inf
        for row, column in np.argwhere(self.occupied):
            dx = max(abs((self.low[1] + column + 0.5) * 0.1 - x) - 0.05, 0.0)
            dy = max(abs((self.low[0] + row + 0.5) * 0.1 - y) - 0.05, 0.0)
            best = min(best, hypot(dx, dy))
        return best


def two_rooms(height: int = 40, width: int = 60, door: tuple[int, int] = (16, 26)) -> Mask:
    """Walls all around, and one in the middle with a doorway of 1 m."""
    occupied = np.zeros((height, width), bool)
    occupied[[0, -1], :] = occupied[:, [0, -1]] = True
    occupied[:, 30] = True
    occupied[door[0] : door[1], 30] = False
    return occupied


def drawn(grid: PlainMap, radius: float = RADIUS, settings: PlannerSettings | None = None) -> Costmap:
    """The costmap, with every tile up to date."""
    costmap = Costmap(grid.resolution, radius, settings or PlannerSettings())
    costmap.update(grid, (0.0, 0.0), EVERYTHING)
    while costmap.pending:
        costmap.update(grid, (0.0, 0.0), 1)
    return costmap


def query(
    grid: PlainMap,
    start: Point,
    goal: Point,
    settings: PlannerSettings | None = None,
    unreachable: tuple[Point, ...] = (),
    radius: float = RADIUS,
) -> tuple[PathQuery, Costmap]:
    costmap = Costmap(grid.resolution, radius, settings or PlannerSettings())
    costmap.update(grid, start, 0)
    region = Snapshot(costmap, start, goal, unreachable)
    return PathQuery(region, start, goal, costmap.settings), costmap


def plan(grid: PlainMap, start: Point, goal: Point, settings: PlannerSettings | None = None) -> PlanResult:
    asked, costmap = query(grid, start, goal, settings)
    for _ in range(10_000):
        found = asked.advance(200, costmap, grid)
        if not isinstance(found, Searching):
            assert asked.advance(1, costmap, grid) == found
            return found
    raise AssertionError("the planner does not end")


DIFFBOT = Shape(
    0.12,
    hypot(0.2, 0.1),
    (
        (0.2, -0.1),
        (0.2, 0.1),
        (0.05, 0.12),
        (-0.05, 0.12),
        (-0.2, 0.1),
        (-0.2, -0.1),
        (-0.05, -0.12),
        (0.05, -0.12),
    ),
)
"""The outline of fixtures/robots/diffbot.toml."""
CAR = Shape(0.15, hypot(0.45, 0.15), ((0.45, -0.15), (0.45, 0.15), (-0.15, 0.15), (-0.15, -0.15)), 0.5)
"""A car of 0.6 × 0.3 m, its origin on the rear axle, that turns with a radius of 0.5 m."""


def ask(
    occupied: Mask,
    shape: Shape,
    start: Pose,
    goal: tuple[float, float, float | None],
    settings: PlannerSettings | None = None,
    *,
    unknown: Mask | None = None,
    near: bool = False,
) -> tuple[PlanResult, Snapshot]:
    """What is planned for a shape on a picture of 0.05 m per cell from (0, 0) m on, and the ground."""
    grid, here = PlainMap(occupied, unknown, (0, 0), 0.05), (start.x, start.y)
    costmap = Costmap(0.05, shape.inner, settings or PlannerSettings(), shape.outer)
    costmap.update(grid, here, 0)
    region = Snapshot(costmap, here, goal[:2], ())
    asked = PathQuery(
        region,
        here,
        goal[:2],
        costmap.settings,
        Footprint(shape, 0.05),
        yaw=start.yaw,
        goal_yaw=goal[2],
        near=near,
    )
    for _ in range(20_000):
        found = asked.advance(2500, costmap, grid)
        if not isinstance(found, Searching):
            return found, region
    raise AssertionError("the planner does not end")


def touches(occupied: Mask, shape: Shape, poses: Sequence[tuple[float, float, float]]) -> bool:
    """Whether the middle of an occupied cell of 0.05 m is inside the outline at any of these poses: each
    pose against each cell, by the side of each edge."""
    rows, columns = np.nonzero(occupied)
    x, y = (columns + 0.5) * 0.05, (rows + 0.5) * 0.05
    assert shape.corners is not None
    for px, py, yaw in poses:
        inside = np.hypot(x - px, y - py) < shape.outer
        world = [
            (px + cos(yaw) * a - sin(yaw) * b, py + sin(yaw) * a + cos(yaw) * b) for a, b in shape.corners
        ]
        for (ax, ay), (bx, by) in zip(world, [*world[1:], world[0]], strict=True):
            inside &= (bx - ax) * (y - ay) - (by - ay) * (x - ax) > 0.0
        if inside.any():
            return True
    return False


def ground(
    occupied: Mask,
    unknown: Mask | None = None,
    comfort: float = 0.0,
    dislike: float = 0.0,
    *,
    free: bool = False,
) -> Snapshot:
    """A complete snapshot of a picture from (0, 0) m on, whose occupied cells alone are blocked."""
    settings = PlannerSettings(margin=0.0, comfort=comfort, dislike=dislike, unknown_is_free=free)
    grid = PlainMap(occupied, unknown, (0, 0))
    costmap = drawn(grid, 0.0, settings)
    found = Snapshot(costmap, (0.05, 0.05), (0.05, 0.05), ())
    assert found.assemble(costmap, grid, EVERYTHING) > 0
    return found
