"""The costmap: what it costs to be in each cell of the map, kept up to date tile by tile.

Rules. Cells are the map's own: (row, column) = floor(y / resolution), floor(x / resolution), in tiles of
`TILE` × `TILE`. A cell has one level: occupied; within the footprint's inner radius of an occupied cell, or
within that radius + margin (blocked: the robot's centre must not be there, but for the last, where a path may
pass if no other is nearly as short); or free at one of a few levels, the lowest nearest to blocked cells:
first, unless the robot is a circle, where not every heading fits. Its multiplier (>= 1) is the cost of a
metre through the cell. A cell that was never observed, and is farther than the inner radius from an occupied
cell, has the flag `UNKNOWN` beside its level. Distances are taken between the middles of cells, which is what
the margin is for.

The work of a step does not depend on the map's size: `Costmap.update` draws a few of the tiles that changed,
the nearest first. A search works on a `Snapshot`, which is assembled from the tiles one row of them after
another, draws those that are out of date, and never changes once it is complete. What lies outside of a
snapshot is unknown ground without obstacles.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import cache
from itertools import pairwise, product
from math import ceil, floor, inf
from typing import Annotated, Any, Protocol

import numpy as np
import numpy.typing as npt

from brain.planning.polyline import Point
from brain.planning.zones import MOST_ZONES, Zone, Zones
from brain.region import Region, Tile, joined
from protocols.bounds import Bounds, Duration, Invalid, check
from protocols.messages import MILLISECOND, SECOND

Cells = npt.NDArray[np.int64]
Floats = npt.NDArray[np.float64]
Levels = npt.NDArray[np.uint8]
Mask = npt.NDArray[np.bool_]

TILE = 64
"""Cells along a side of a tile"""
OCCUPIED, TOUCHING, NEAR = 0, 1, 2
"""Blocked: occupied, within the footprint's radius of an occupied cell, within radius + margin."""
FREE = 3
"""The free level nearest to blocked cells; each level above it is one cell farther away."""
UNKNOWN = 128
"""Flag of a cell that was never observed, beside the level that it would have."""
NARROW = 4.0
"""How much more a metre costs where the margin is missing than beside such a place"""
TIGHT = 1.5
"""The same where not every heading fits"""
SLOW = 106
"""Level of the cells of the first slow zone, and one more for each."""
EXIT = 255
"""Level of the cells at the edge of a snapshot from where the straight way to a goal beyond it is open."""
TILE_WORK = 450
"""Drawing a tile, in expansions of A*."""


@dataclass(frozen=True, slots=True)
class PlannerSettings:
    """Parameters of planning and replanning, SI."""

    expansions_per_step: Annotated[int, Bounds(1, 20_000)] = 2500
    """Work of a step of 5 ms, in A* expansions of about 0.2 µs; all other work is converted. Shorter and
    longer steps do in proportion, those of 20 ms and more four times as much."""
    expansions_per_search: Annotated[int, Bounds(1000, 1_000_000_000)] = 50_000_000
    """Work of one search, after which there is no path. The default is enough for 200 m × 200 m."""
    margin: Annotated[float, Bounds(0.0, 1.0, "m")] = 0.05
    """m, clearance kept beyond the footprint's radius"""
    comfort: Annotated[float, Bounds(0.0, 2.0, "m")] = 0.3
    """m: within this distance of obstacles, a metre costs more"""
    dislike: Annotated[float, Bounds(0.0, 100.0)] = 0.3
    """Additional cost of a metre next to an obstacle, over one far from any."""
    unknown_multiplier: Annotated[float, Bounds(1.0, 100.0)] = 1.2
    """Assumed cost of a metre through unknown ground, where no known path leads to the goal.
    The larger, the longer the search."""
    unknown_is_free: bool = False
    """Plan through unknown ground as if it were free. For open ground only."""
    escape: Annotated[float, Bounds(0.01, 2.0, "m")] = 0.5
    """m: how far the start may lie from the nearest place that fits the footprint"""
    slack: Annotated[float, Bounds(0.0, 2.0, "m")] = 0.1
    """m: how far a goal too close to an obstacle may be moved to a place that fits"""
    reverse: Annotated[float, Bounds(1.0, 100.0)] = 2.0
    """Cost of a metre backward, over one forward"""
    switch: Annotated[float, Bounds(0.0, 100.0, "m")] = 0.5
    """m that each change between forward and backward costs"""
    period: Annotated[Duration, Bounds(50.0, 5000.0)] = 250 * MILLISECOND
    """Period of checking the path against the map, and of searching while there is none."""
    explore: Annotated[Duration, Bounds(50.0, 60_000.0)] = 500 * MILLISECOND
    """Period of replanning while no known path leads to the goal."""
    patience: Annotated[Duration, Bounds(10.0, 600_000.0)] = 30 * SECOND
    """After this time without a path to a goal, or before an obstacle, the goal is given up: longer than a
    door is closed."""
    zones: dict[str, Zone] = field(default_factory=dict)
    """Zones of the map by name: keep_out and slow."""
    drive_timeout: Annotated[Duration, Bounds(10.0, 2000.0)] = 500 * MILLISECOND
    """Watchdog of Drive: not repeated within this time, it ends (a lost operator means stop)."""

    def __post_init__(self) -> None:
        check(self)
        if len(self.zones) > MOST_ZONES:
            raise Invalid(("zones", f"zones: there must be at most {MOST_ZONES}, not {len(self.zones)}"))


class Map(Protocol):
    """The part of the occupancy map that is needed here."""

    @property
    def version(self) -> int:
        """Incremented at each change."""
        ...

    @property
    def resolution(self) -> float:
        """m per cell"""
        ...

    def tile(self, row: int, column: int) -> npt.NDArray[Any] | None:
        """The values of a tile: above 0 occupied, below free, 0 unknown. None: nothing is known of it."""
        ...

    def changed(self, since: int) -> list[Tile]:
        """Tiles with a cell that became occupied, free or unknown after this version."""
        ...


class Costmap:
    """The levels of all tiles, up to date but for those that are `pending`. State is plain data."""

    def __init__(
        self,
        resolution: float,
        radius: float,
        settings: PlannerSettings,
        outer: float | None = None,
        fastest: float = 1.0,
    ) -> None:
        """`radius` [m] of the largest circle inside of the robot's outline, `outer` of one that contains it;
        None: the same; `fastest` [m/s]: its speed outside of slow zones."""
        self.resolution, self.radius, self.settings = resolution, radius, settings
        self.outer = outer = max(radius, outer or 0.0)
        self.wide = FREE + (outer > radius)
        """Level from which on every heading fits."""
        self._rings = rings = round(settings.comfort / resolution) if settings.dislike > 0.0 else 0
        self.top = self.wide + rings
        """Level of free cells far from obstacles."""
        self.outside = self.top if settings.unknown_is_free else UNKNOWN + self.top
        """Level of cells that no tile holds."""
        assert self.outside < EXIT, "brain.settings.MAX_REACH"
        self.multiplier = np.full(256, inf)
        """Cost factor by level, over known ground."""
        self.multiplier[NEAR] = NARROW * (1.0 + settings.dislike)
        self.multiplier[FREE] = TIGHT * (1.0 + settings.dislike)
        self.multiplier[self.wide : self.top] = [
            1.0 + settings.dislike * (1.0 - ring / rings) for ring in range(rings)
        ]
        self.multiplier[self.top] = 1.0
        if settings.unknown_is_free:
            self.multiplier[EXIT] = 1.0
        self.zones = Zones(settings.zones, resolution, outer, TILE, fastest)
        self.multiplier[SLOW : SLOW + len(self.zones.prices)] = self.zones.prices
        self._halo = ceil((outer + settings.margin) / resolution + 0.5) + rings
        """Cells around a tile in which obstacles matter to it"""
        self._reach = -(-self._halo // TILE)
        """The same in tiles"""
        self.tiles: dict[Tile, bytes] = {}
        self.pending: dict[Tile, int] = {}
        """Tiles to be drawn, and the map's version in which they had changed."""
        self.region: Region | None = None
        """That holds the tiles marked so far"""
        self._drawn: dict[Tile, int] = {}
        """The map's version that each tile was drawn from."""
        self._occupied: dict[Tile, bytes] = {}
        """Occupied cells, eight per byte, of tiles that have any."""
        self._version = 0
        """Of the map, up to which its changes are marked."""

    def update(self, grid: Map, here: Point, most: int) -> int:
        """Draw at most this many of the changed tiles, those about the robot first; return how many."""
        if grid.version != self._version:
            for tile in grid.changed(self._version):
                self._mark(tile, grid.version)
            self._version = grid.version
        side = TILE * self.resolution
        row, column = floor(here[1] / side), floor(here[0] / side)
        count = min(most, len(self.pending))
        for _ in range(count):
            about = ((row + up, column + right) for up, right in ABOUT)
            self.draw(grid, next((tile for tile in about if tile in self.pending), next(iter(self.pending))))
        return count

    def draw(self, grid: Map, tile: Tile) -> None:
        """Compute the levels of one tile from the obstacles in it and around it."""
        changed_at = self.pending.pop(tile, -1)
        values, window = grid.tile(*tile), self._window(grid, tile)
        self._mark_neighbours(tile, window, changed_at)
        if values is None and not window.any():
            self.tiles.pop(tile, None)
            self._drawn.pop(tile, None)
            return
        level = self._levels_of(window)
        if not self.settings.unknown_is_free:
            unseen = level >= NEAR
            if values is not None:
                unseen &= values == 0
            level |= unseen.view(np.uint8) << np.uint8(7)
        self.tiles[tile], self._drawn[tile] = level.tobytes(), self._version

    def _window(self, grid: Map, tile: Tile) -> Mask:
        """Return which cells are occupied, of a tile and those around it that matter to it."""
        halo, side = self._halo, TILE + 2 * self._halo
        window, reach = np.zeros((side, side), np.bool_), range(-self._reach, self._reach + 1)
        for up, right in product(reach, reach):
            values = grid.tile(tile[0] + up, tile[1] + right)
            if values is not None:
                bottom, left = up * TILE + halo, right * TILE + halo
                rows = slice(max(bottom, 0), min(bottom + TILE, side))
                columns = slice(max(left, 0), min(left + TILE, side))
                part = values[max(-bottom, 0) : side - bottom, max(-left, 0) : side - left]
                np.greater(part, 0, out=window[rows, columns])
        return window

    def _mark_neighbours(self, tile: Tile, window: Mask, changed_at: int) -> None:
        """Mark the tiles as pending to which a change of this one's obstacles matters, and that were drawn
        before it."""
        halo = self._halo
        own = np.packbits(window[halo : halo + TILE, halo : halo + TILE])
        before = self._occupied.get(tile, NOTHING)
        if (now := own.tobytes()) == before:
            return
        self._occupied[tile] = now
        if now == NOTHING:
            del self._occupied[tile]
        change = np.unpackbits(own ^ np.frombuffer(before, np.uint8)).reshape(TILE, TILE)
        rows, columns = (np.flatnonzero(change.any(axis=axis)) for axis in (1, 0))
        for up in range((int(rows[0]) - halo) // TILE, (int(rows[-1]) + halo) // TILE + 1):
            for right in range((int(columns[0]) - halo) // TILE, (int(columns[-1]) + halo) // TILE + 1):
                other = (tile[0] + up, tile[1] + right)
                if other != tile and self._drawn.get(other, -1) < changed_at:
                    self._mark(other, -1)

    def _mark(self, tile: Tile, version: int) -> None:
        """Mark a tile as pending."""
        self.pending[tile] = max(version, self.pending.get(tile, -1))
        if self.region is None or tile[0] not in self.region[0] or tile[1] not in self.region[1]:
            self.region = joined(self.region, tile)

    def _levels_of(self, window: Mask) -> Levels:
        """Return the levels of a tile, unknown cells not flagged, from the occupied cells around it.

        Masks are integers of one bit per cell of the window: a shift by a row moves all of them at once. What
        a shift carries over the window's edge stays within the halo."""
        occupied = int.from_bytes(np.packbits(window, bitorder="little").tobytes(), "little")
        if not occupied:
            return np.full((TILE, TILE), self.top, np.uint8)
        side, halo = TILE + 2 * self._halo, self._halo
        margin, small = self.settings.margin, self.radius
        reaches = [small, small + margin, *([self.outer + margin] if self.wide > FREE else [])]
        masks = [occupied, *(disc(occupied, side, reach / self.resolution) for reach in reaches)]
        near = masks[-1]
        for ring in range(self._rings):
            near = dilated(near, side, diagonal=ring % 2 == 1)
            masks.append(near)
        size, all_ = -(-side * side // 8), (1 << side * side) - 1
        packed = np.frombuffer(b"".join((mask & all_).to_bytes(size, "little") for mask in masks), np.uint8)
        bits = np.unpackbits(packed.reshape(len(masks), -1), axis=1, count=side * side, bitorder="little")
        inner = bits.reshape(-1, side, side)[:, halo : halo + TILE, halo : halo + TILE]
        level: Levels = np.uint8(self.top) - inner.sum(axis=0, dtype=np.uint8)
        return level

    # -- reading -------------------------------------------------------------------------------

    def levels(self, rows: Cells, columns: Cells) -> Levels:
        """Return the level of each of these cells, which are those along a line."""
        tile_rows, tile_columns = rows // TILE, columns // TILE
        starts = np.flatnonzero(np.diff(tile_rows) | np.diff(tile_columns)) + 1
        found = np.full(len(rows), self.outside, np.uint8)
        offsets = (rows % TILE) * TILE + columns % TILE
        for start, end in pairwise((0, *starts.tolist(), len(rows))):
            level = self.tiles.get((int(tile_rows[start]), int(tile_columns[start])))
            if level is not None:
                found[start:end] = np.frombuffer(level, np.uint8)[offsets[start:end]]
        return found

    def level_at(self, x: float, y: float) -> int:
        """Return the level at a position [m]."""
        row, column = floor(y / self.resolution), floor(x / self.resolution)
        level = self.tiles.get((row // TILE, column // TILE))
        return self.outside if level is None else level[row % TILE * TILE + column % TILE]

    def clearance(self, x: float, y: float) -> float:
        """Return the distance [m, whole cells] to the nearest blocked cell, as far as the levels resolve it.

        0 if the position is blocked or not drawn yet; infinite at the last level."""
        if (floor(y / self.resolution) // TILE, floor(x / self.resolution) // TILE) not in self.tiles:
            return 0.0
        level = self.level_at(x, y) % UNKNOWN
        if level < self.wide:
            return max(level - FREE + 1, 0) * self.resolution
        return (
            inf if level == self.top else self.outer - self.radius + (level - self.wide + 1) * self.resolution
        )


NOTHING = bytes(TILE * TILE // 8)
"""No occupied cell of a tile."""
ABOUT = sorted(((r, c) for r in range(-2, 3) for c in range(-2, 3)), key=lambda at: at[0] ** 2 + at[1] ** 2)
"""The tiles about one, the nearest first: those that are drawn before all others."""


def dilated(mask: int, side: int, *, diagonal: bool) -> int:
    """Return a mask of `side` cells per row, grown by one cell to its four neighbours, or to all eight."""
    across = mask | mask << 1 | mask >> 1
    return across | (across << side | across >> side if diagonal else mask << side | mask >> side)


def disc(mask: int, side: int, radius: float) -> int:
    """Return a mask of `side` cells per row, grown to the cells whose middle is closer than the radius
    [cells] to any part of a cell that is set.

    The disc is the union of its rows, the longest last: each is made of the one before."""
    grown, row, width = mask, mask, 0
    for up, half_width in _rows_of_disc(radius):
        while width < half_width:
            width += 1
            row |= mask << width | mask >> width
        if half_width >= 0:
            grown |= row << up * side | row >> up * side
    return grown


@cache
def _rows_of_disc(radius: float) -> list[tuple[int, int]]:
    """Return the rows of a disc [cells], the farthest first: how far up, and half their width."""
    near = np.maximum(np.arange(ceil(radius + 0.5) + 1) - 0.5, 0.0) ** 2
    half_widths = np.count_nonzero(near[:, None] + near[None, :] < radius * radius, axis=1) - 1
    return list(enumerate(half_widths.tolist()))[::-1]
