"""A map that another program has perceived: its newest grid, in the cells of our own map.

Rules. A grid takes the place of the one before. Each of our cells has the value of the cell of the grid in
which its middle lies; outside of the grid nothing is known. Only tiles that differ count as changed.
"""

from __future__ import annotations

from math import ceil, cos, floor, sin
from typing import Any

import numpy as np
import numpy.typing as npt

from brain.belief import MapView, Pose
from brain.bodies.plane import moved
from brain.region import Tile
from protocols.messages import Grid

SIDE = 64
"""Cells along a side of a tile"""
MOST_TILES = 24 * 24
"""Of a grid, for which a step of the robot waits: 16 × 16, whichever way it is turned"""
MOST_GONE = 4 * MOST_TILES
"""Tiles that are no longer in the grid, of which it is known when they went: planning looks in each step"""
LOG_ODDS = 2.0
"""Of a cell that is occupied; less it of one that is free"""
NOTHING = {(0, 0): np.zeros((SIDE, SIDE), np.int8)}
VALUES = np.array([0, -1, 1], np.int8)
"""Of our cells, by those of a grid: not known, free, occupied"""


class GivenMap:
    """The newest grid. State is plain data."""

    def __init__(self, resolution: float) -> None:
        self.resolution, self.version = resolution, 0
        self._tiles: dict[Tile, npt.NDArray[np.int8]] = {}
        self._changed: dict[Tile, int] = {}
        """The version in which a tile changed last"""

    def take(self, grid: Grid, frame: Pose) -> str:
        """Take a grid of which the frame is here on the map; return why not, or ""."""
        if wrong := _wrong(grid, self.resolution):
            return wrong
        corner = moved(frame, Pose(grid.x, grid.y, grid.yaw))
        rows = len(grid.cells) // grid.columns
        width, height = grid.columns * grid.resolution, rows * grid.resolution
        corners = [moved(corner, Pose(x, y, 0.0)) for x in (0.0, width) for y in (0.0, height)]
        side = SIDE * self.resolution
        tile_rows = range(floor(min(c.y for c in corners) / side), ceil(max(c.y for c in corners) / side))
        tile_columns = range(floor(min(c.x for c in corners) / side), ceil(max(c.x for c in corners) / side))
        if len(tile_rows) * len(tile_columns) > MOST_TILES:
            return f"it covers {width:g} × {height:g} m: at most {16 * side:g} × {16 * side:g} m are taken"
        sampled = {
            (row, column): self._sampled(grid, corner, row, column)
            for row in tile_rows
            for column in tile_columns
        }
        tiles = {tile: part for tile, part in sampled.items() if part.any()}
        self.version += 1
        for tile in self._tiles.keys() | tiles.keys():
            before, now = self._tiles.get(tile), tiles.get(tile)
            if before is None or now is None or not np.array_equal(before, now):
                self._changed.pop(tile, None)
                self._changed[tile] = self.version
        self._tiles = tiles
        gone = [tile for tile in self._changed if tile not in tiles]  # the first that went come first
        for tile in gone[: max(0, len(gone) - MOST_GONE)]:
            del self._changed[tile]
        return ""

    def _sampled(self, grid: Grid, corner: Pose, row: int, column: int) -> npt.NDArray[np.int8]:
        """Return our cells of a tile."""
        y = (np.arange(SIDE) + row * SIDE + 0.5) * self.resolution - corner.y
        x = (np.arange(SIDE) + column * SIDE + 0.5) * self.resolution - corner.x
        c, s = cos(corner.yaw) / grid.resolution, sin(corner.yaw) / grid.resolution
        columns = np.floor(c * x[None, :] + s * y[:, None]).astype(np.int64)
        rows = np.floor(c * y[:, None] - s * x[None, :]).astype(np.int64)
        cells = np.frombuffer(grid.cells, np.uint8).reshape(-1, grid.columns)
        if (
            rows.max() < 0
            or rows.min() >= cells.shape[0]
            or columns.max() < 0
            or columns.min() >= cells.shape[1]
        ):
            return np.zeros((SIDE, SIDE), np.int8)
        inside = (rows >= 0) & (rows < cells.shape[0]) & (columns >= 0) & (columns < cells.shape[1])
        found = np.zeros(inside.shape, np.int8)
        found[inside] = VALUES[np.minimum(cells[rows[inside], columns[inside]], 2)]
        return found

    def tile(self, row: int, column: int) -> npt.NDArray[Any] | None:
        """Return the values of a tile, as `brain.planning.costmap.Map` has them."""
        return self._tiles.get((row, column))

    def changed(self, since: int) -> list[Tile]:
        """Return the tiles that changed after this version."""
        return [tile for tile, version in self._changed.items() if version > since]

    def view(self) -> MapView:
        """Return it for observers."""
        return MapView(self.version, self.resolution, self._tiles or NOTHING, LOG_ODDS)


def _wrong(grid: Grid, resolution: float) -> str:
    """Return why a grid cannot be taken, or ""."""
    rows, rest = divmod(len(grid.cells), grid.columns) if grid.columns > 0 else (0, 1)
    if rest or not rows:
        return f"a grid of {grid.columns} columns has {len(grid.cells)} cells: whole rows are expected"
    if not 0.99 * resolution <= grid.resolution <= 10.0:
        return (
            f"its cells are {grid.resolution:g} m: {resolution:g} m, as of the robot's map (map.resolution), "
            "to 10 m are expected"
        )
    return ""
