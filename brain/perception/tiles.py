"""The cells of an unbounded plane, of which those are kept that were written to.

Rules. The cell (row, column) of a position is (floor(y / resolution), floor(x / resolution)): global
integers, without an origin. Cells lie in tiles, TILE × TILE each. A tile is made when the first of its cells
is written to; where it is in memory is in a dict. There are at most so many; then the one farthest from the
window's middle is forgotten, which is none of the window's. A cell's place in memory is that of its tile's
first cell, plus those before it in the tile; the places below `AREA` are of no tile, and hold what was never
written: 0.

Many cells at once are found by a window: the tiles about a position as an array, whose sides are a power of
two, so that a cell's tile is its indices without their lower and upper bits. Cells beyond it read as 0.
"""

from __future__ import annotations

import math

import numpy as np
import numpy.typing as npt

from brain.belief import Floats, MapView
from brain.perception.body_scan import Bools
from brain.perception.lines import AREA, TILE, Lines, Records
from brain.region import Tile

Cells = npt.NDArray[np.int64]
"""n × 2: column, row"""
Indices = npt.NDArray[np.int64]
Values = npt.NDArray[np.int8]
"""Log-odds in steps of `UNIT`"""

BITS = TILE.bit_length() - 1
UNIT = 1.0 / 32.0
"""Log-odds"""
GROWTH = 64
"""Tiles by which their memory grows"""


class Tiles:
    """Values of cells, and the lines in them. Plain data: a deep copy continues exactly as the original."""

    def __init__(self, resolution: float, across: int, most: int) -> None:
        """`across`: tiles along the window's sides, a power of two; `most`: tiles that are kept, at least as
        many as a window has."""
        self.resolution = resolution
        self.version = 0
        """Incremented at each change."""
        self.forgotten = 0
        """Number of tiles forgotten, since there were too many"""
        self.lines = Lines(most)
        self._most = most
        self._at: dict[Tile, int] = {}
        """Place of each tile's first cell"""
        self._values: Values = np.zeros(AREA, dtype=np.int8)
        self._unused: list[int] = []
        self._tiles = np.zeros((most + 1, 2), dtype=np.int64)
        """Row and column of the tile in each part of memory"""
        self._stamps = np.zeros(most + 1, dtype=np.int64)
        """Version at which a class of its cells last changed; 0 if there is none"""
        self._touched = np.zeros(most + 1, dtype=np.int64)
        """Version at which any value in it last changed"""
        self._gone: dict[Tile, int] = {}
        """Version at which each of the tiles forgotten last was, oldest first"""
        self._copies: dict[Tile, Values] = {}
        """Tiles as the last view shows them"""
        self._view: MapView | None = None
        self._across, self._shift = across, across.bit_length() - 1
        self._first = -across // 2, -across // 2
        """Row and column of the window's first tile"""
        self._window: Indices = np.zeros(across * across, dtype=np.int64)
        """Where its tiles are; 0: nowhere"""

    # -- reading -------------------------------------------------------------------------------

    def cells(self, points: Floats) -> Cells:
        """Return the cells (column, row) of points (n × 2) [m]."""
        cells: Cells = np.floor(points * (1.0 / self.resolution)).astype(np.int64)
        return cells

    def recenter(self, x: float, y: float) -> None:
        """Move the window if a position [m] is more than a tile off its middle."""
        first = []
        for at, start in zip((y, x), self._first, strict=True):
            off = math.floor(at / self.resolution) - (start + self._across // 2) * TILE
            first.append(start + (round(off / TILE) if abs(off) > TILE else 0))
        if (first[0], first[1]) != self._first:
            self._first = first[0], first[1]
            rows, columns = ([self._index(k, axis) for k in range(self._across)] for axis in (0, 1))
            self._window[:] = [self._at.get((row, column), 0) for row in rows for column in columns]

    @property
    def middle(self) -> Tile:
        """The tile in the middle of the window."""
        return self._first[0] + self._across // 2, self._first[1] + self._across // 2

    def values(self, columns: Indices, rows: Indices) -> Values:
        """Return the values of cells; 0 outside of the window."""
        values = self._values.take(self.places(columns, rows))
        values *= self.inside(columns, rows)
        return values

    def lines_at(self, columns: Indices, rows: Indices) -> Records:
        """Return the lines of cells, which are taken modulo the window."""
        return self.lines.at(self.places(columns, rows))

    def inside(self, columns: Indices, rows: Indices) -> Bools:
        """Return which cells are within the window."""
        # Modulo 2^64, what lies before the first is far beyond the last: one comparison for both.
        side = self._across * TILE
        across = (columns - self._first[1] * TILE).view(np.uint64) < side
        up = (rows - self._first[0] * TILE).view(np.uint64) < side
        inside: Bools = across & up
        return inside

    def places(self, columns: Indices, rows: Indices) -> Indices:
        """Return the places of cells, given by numbers of any shape, which are taken modulo the window."""
        tiles, within = self._parts(columns, rows)
        places: Indices = self._window.take(tiles)
        places += within
        return places

    def _parts(self, columns: Indices, rows: Indices) -> tuple[Indices, Indices]:
        """Return the numbers of cells' tiles in the window, and theirs in the tile."""
        mask = self._across - 1
        tiles = (((rows >> BITS) & mask) << self._shift) + ((columns >> BITS) & mask)
        return tiles, ((rows & (TILE - 1)) << BITS) + (columns & (TILE - 1))

    def _index(self, number: int, axis: int) -> int:
        """Return the row or column of a tile from its number along the window's side."""
        return self._first[axis] + (number - self._first[axis]) % self._across

    def known(self) -> list[Tile]:
        """Return the tiles that there are."""
        return list(self._at)

    def tile(self, row: int, column: int) -> Values | None:
        """Return a copy of the values of a tile, 64 × 64; None if there is none."""
        at = self._at.get((row, column))
        return None if at is None else self._values[at : at + AREA].reshape(TILE, TILE).copy()

    def changed(self, since: int) -> list[Tile]:
        """Return the tiles (row, column) in which a cell's class changed after a version."""
        gone = []
        for tile, version in reversed(self._gone.items()):
            if version <= since:
                break
            gone.append(tile)
        return self._after(self._stamps, since) + gone[::-1]

    def _after(self, stamps: npt.NDArray[np.int64], since: int) -> list[Tile]:
        return [(row, column) for row, column in self._tiles[stamps > since].tolist()]

    def view(self) -> MapView:
        """Return the map as a value, the same object until it changes: only changed tiles are copied."""
        before = self._view
        if before is None or before.version != self.version:
            for at in self._after(self._touched, before.version if before else 0):
                values = self.tile(*at)
                assert values is not None, "it was written to"
                values.setflags(write=False)
                self._copies[at] = values
            tiles = dict(self._copies) or {(0, 0): np.zeros((TILE, TILE), dtype=np.int8)}
            self._view = before = MapView(self.version, self.resolution, tiles, UNIT, here=self.middle)
        return before

    # -- writing -------------------------------------------------------------------------------

    def _placed(self, tiles: Indices, within: Indices) -> Indices:
        """Return the places of cells that will be written to, from the numbers of their tiles in the window
        and theirs in the tile: a tile that does not exist is made."""
        places: Indices = self._window.take(tiles)
        if not places.all():
            del places  # growing copies all values
            asked = np.zeros(self._window.shape, dtype=np.bool_)
            asked.put(tiles, True)
            for number in np.flatnonzero(asked & (self._window == 0)).tolist():
                row, column = divmod(number, self._across)
                self._make((self._index(row, 0), self._index(column, 1)), number)
            places = self._window.take(tiles)
        places += within
        return places

    def _write(self, places: Indices, values: Values | np.int8, changed: Bools) -> None:
        """Set values, and note which cells have changed their class."""
        self._values[places] = values
        tiles = places >> (2 * BITS)
        self._touched.put(tiles, self.version)
        self._stamps.put(tiles[changed], self.version)

    def forget(self) -> None:
        """Forget all that was observed: its tiles change to unknown."""
        self.version += 1
        for tile in self.known():
            self._forget(tile)

    def become(self, other: Tiles) -> None:
        """Take over what another one of the same shape holds, which is given up: all tiles have changed."""
        self.version = max(self.version, other.version) + 1
        gone = [tile for tile in self._at if tile not in other._at]
        for name in ("lines", "_at", "_values", "_unused", "_tiles", "_stamps", "_touched"):
            setattr(self, name, getattr(other, name))
        self._first, self._window = other._first, other._window
        self.forgotten += other.forgotten
        used = np.array(list(self._at.values()), dtype=np.int64) // AREA
        self._stamps[used] = self._touched[used] = self.version
        self._copies.clear()
        self._view = None
        for tile in self._at:
            self._gone.pop(tile, None)
        for tile in gone:
            self._gone.pop(tile, None)
            self._gone[tile] = self.version
        while len(self._gone) > self._most:
            del self._gone[next(iter(self._gone))]

    def put(self, tile: Tile, values: Values) -> int:
        """Set the values of a whole tile, wherever it is; return the place of its first cell."""
        row, column = tile[0] - self._first[0], tile[1] - self._first[1]
        inside = 0 <= row < self._across and 0 <= column < self._across
        mask = self._across - 1
        if tile not in self._at:
            self._make(tile, ((tile[0] & mask) << self._shift) + (tile[1] & mask) if inside else None)
        at = self._at[tile]
        self._values[at : at + AREA] = values.reshape(-1)
        self._touched[at // AREA] = self._stamps[at // AREA] = self.version
        return at

    def _make(self, tile: Tile, number: int | None) -> None:
        """Make room for a tile; `number`: its place in the window, None: it is outside."""
        if len(self._at) >= self._most:
            from_middle = np.abs(2 * (self._tiles[1:] - self._first) - (self._across - 1)).max(axis=1)
            row, column = self._tiles[1 + from_middle.argmax()].tolist()
            self._forget((row, column))
            self.forgotten += 1
        if not self._unused:
            have = len(self._values)
            size = min(have + GROWTH * AREA, (self._most + 1) * AREA)
            self._values.resize(size, refcheck=False)
            self.lines.extend(size)
            self._unused = list(range(size - AREA, have - AREA, -AREA))
        at = self._unused.pop()
        self._at[tile] = at
        if number is not None:
            self._window[number] = at
        self._tiles[at // AREA] = tile
        self._gone.pop(tile, None)

    def _forget(self, tile: Tile) -> None:
        at = self._at.pop(tile)
        self._values[at : at + AREA] = 0
        self._stamps[at // AREA] = self._touched[at // AREA] = 0
        self._window[self._window == at] = 0
        self._copies.pop(tile, None)
        self.lines.drop(at)
        self._unused.append(at)
        self._gone[tile] = self.version
        if len(self._gone) > self._most:
            del self._gone[next(iter(self._gone))]
