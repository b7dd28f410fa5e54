"""The map as nav_msgs/OccupancyGrid, drawn in slices: some tiles in each step, however large it is.

Rules. Only a tile that has changed is drawn again, and a message shows one version, whole. A map with more
cells than `MAX_CELLS` is drawn at a half of its resolution, or a quarter …: of the cells that become one, the
one that is occupied most counts; if none is, the one that is free most; if none is, it is unknown.
"""

from __future__ import annotations

from typing import Any, NamedTuple, TypeAlias

import numpy as np
import numpy.typing as npt

from brain.belief import MapView
from gateway.recording.ros_messages import UNKNOWN, percent
from gateway.recording.ros_views import MAP_PERIOD
from protocols.messages import Nanos

MAX_CELLS = 1 << 19
"""Of a message: 36 m × 36 m, of 5 cm each."""
TILES = 4
"""That are drawn in one step."""

Tile: TypeAlias = npt.NDArray[Any]


class MapLayout(NamedTuple):
    """Where a map is, and how it is drawn."""

    corner: tuple[float, float]
    """m: of the tile (0, 0)"""
    cell: float
    """m: of the map"""
    tile: tuple[int, int]
    """Rows and columns of a tile."""
    factor: int
    """So many rows and columns of the map become one."""
    row: int
    """Of tiles: the lowest,"""
    column: int
    """the one at the left,"""
    rows: int
    """and how many there are."""
    columns: int

    @property
    def resolution(self) -> float:
        """m"""
        return self.cell * self.factor

    @property
    def origin(self) -> tuple[float, float]:
        """m: of the lower left corner"""
        (x, y), (height, width) = self.corner, self.tile
        return x + self.column * width * self.cell, y + self.row * height * self.cell


class Rectangle(NamedTuple):
    """Cells of what is drawn: the lower left one, and how many."""

    x: int
    y: int
    width: int
    height: int

    def bands(self, most: int) -> list[Rectangle]:
        """Return it in parts, one above the other, of so many cells at most, or of one row."""
        rows = max(1, most // max(1, self.width))
        ends = range(self.y, self.y + self.height, rows)
        return [self._replace(y=y, height=min(rows, self.y + self.height - y)) for y in ends if self.width]


NOTHING = MapLayout((0.0, 0.0), 1.0, (1, 1), 1, 0, 0, 0, 0)


class Drawing:
    """The map as it is drawn."""

    def __init__(self) -> None:
        self.t: Nanos = 0
        """Of the version that is drawn."""
        self.cells: npt.NDArray[np.int8] = np.empty((0, 0), np.int8)
        """Percent, row by row from the lower left."""
        self.layout = NOTHING
        self._view: MapView | None = None
        """Which is drawn, or on its way."""
        self._began: Nanos | None = None
        self._drawn: dict[tuple[int, int], Tile] = {}
        self._left: list[tuple[tuple[int, int], Tile | None]] = []
        """What is still to be drawn of it; None where it has no tile any more."""
        self._changed: set[tuple[int, int]] = set()
        """Tiles that were drawn since the changes were taken."""

    def anew(self) -> None:
        """Take the newest version next, without delay."""
        self._view = self._began = None
        self._left.clear()

    def draw(self, now: Nanos, t: Nanos, view: MapView) -> bool:
        """Draw some tiles of the version on its way, else of this one, if it is due; return whether one has
        become whole.

        Args:
            now: any clock: versions are `MAP_PERIOD` apart.
            t: the time of the map.
            view: the newest version.
        """
        if not self._left:
            early = self._began is not None and now - self._began < MAP_PERIOD
            if view is self._view or early:
                return False
            self._view, self._began, self.t = view, now, t
            self._begin(view)
        self._draw(self._left[-TILES:], view.unit)
        del self._left[-TILES:]
        return not self._left

    def take_changes(self) -> Rectangle:
        """Return the cells about all that was drawn since the last call."""
        rows, columns = ([tile[i] for tile in self._changed] for i in (0, 1))
        self._changed.clear()
        if not rows:
            return Rectangle(0, 0, 0, 0)
        layout = self.layout
        height, width = (size // layout.factor for size in layout.tile)
        return Rectangle(
            (min(columns) - layout.column) * width,
            (min(rows) - layout.row) * height,
            (max(columns) - min(columns) + 1) * width,
            (max(rows) - min(rows) + 1) * height,
        )

    def _begin(self, view: MapView) -> None:
        layout, drawn = _layout(view), self._drawn
        if layout != self.layout:
            self.layout = layout
            (height, width), factor = layout.tile, layout.factor
            shape = layout.rows * height // factor, layout.columns * width // factor
            self.cells = np.full(shape, UNKNOWN, np.int8)
            drawn.clear()
            self._changed.clear()
        rows, columns = view.region
        shown = {at: tile for at, tile in view.tiles.items() if at[0] in rows and at[1] in columns}
        self._left += [(key, tile) for key, tile in shown.items() if drawn.get(key) is not tile]
        self._left += [(key, None) for key in drawn if key not in shown]

    def _draw(self, tiles: list[tuple[tuple[int, int], Tile | None]], unit: float) -> None:
        _, _, (height, width), factor, first_row, first_column, _, _ = self.layout
        height, width = height // factor, width // factor
        new = [tile for _, tile in tiles if tile is not None]
        drawn = iter(percent(coarser(np.stack(new), factor) * unit) if new else ())
        for (row, column), tile in tiles:
            self._changed.add((row, column))
            y, x = (row - first_row) * height, (column - first_column) * width
            self.cells[y : y + height, x : x + width] = UNKNOWN if tile is None else next(drawn)
            if tile is None:
                del self._drawn[row, column]
            else:
                self._drawn[row, column] = tile


def _layout(view: MapView) -> MapLayout:
    rows, columns = view.region
    height, width = next(iter(view.tiles.values())).shape
    cells, factor = len(rows) * height * len(columns) * width, 1
    while cells > MAX_CELLS * factor**2 and not height % (2 * factor) and not width % (2 * factor):
        factor *= 2
    count = len(rows), len(columns)
    return MapLayout(view.corner, view.resolution, (height, width), factor, rows.start, columns.start, *count)


def coarser(tiles: Tile, factor: int) -> Tile:
    """Return tiles with so many times fewer rows and columns."""
    most = least = tiles
    for _ in range(factor.bit_length() - 1):
        quarters = [(slice(None), slice(y, None, 2), slice(x, None, 2)) for y in (0, 1) for x in (0, 1)]
        most = np.maximum.reduce([most[quarter] for quarter in quarters])
        least = np.minimum.reduce([least[quarter] for quarter in quarters])
    return np.where(most > 0, most, least)
