"""What a path query works on: a snapshot of a region of the costmap; and straight lines over such ground."""

from __future__ import annotations

from math import floor, hypot, inf
from typing import Protocol

import numpy as np

from brain.planning.costmap import (
    EXIT,
    FREE,
    NEAR,
    SLOW,
    TILE,
    TILE_WORK,
    TOUCHING,
    UNKNOWN,
    Cells,
    Costmap,
    Floats,
    Levels,
    Map,
)
from brain.planning.polyline import Point
from brain.planning.zones import Marks, Zones
from brain.region import about, joined

COPY_WORK = 16
"""Copying a tile into a snapshot, in expansions of A*."""
LINE_WORK = 140
"""A straight line, in expansions of A*, beside its cells"""
CELLS_PER_WORK = 10
"""Cells of a straight line for one expansion"""
HALVED_PER_WORK = 60
"""Cells that are made part of larger ones"""
MAX_LINES = 500
"""Straight lines that one search of the nearest place, or one shortening of a path, compares."""


class Ground(Protocol):
    """Levels of cells: the live costmap, or a snapshot of it."""

    @property
    def resolution(self) -> float:
        """m per cell"""
        ...

    @property
    def multiplier(self) -> Floats:
        """Cost factor by level; infinite for blocked and unknown."""
        ...

    @property
    def wide(self) -> int:
        """Level from which on every heading of the robot fits"""
        ...

    def levels(self, rows: Cells, columns: Cells) -> Levels:
        """The level of each of these cells."""
        ...


class Snapshot:
    """The levels of a region as one flat array, assembled over several steps, then immutable.

    The region is what is known of the map, of a very large one the part about the robot, and its place.
    Around it lie one row and column of unknown ground, of level `EXIT` on the sides that face a goal beyond,
    and one of blocked cells, so that no search has to check whether it has left it. Unknown ground under the
    robot counts as free. Unknown ground about the places `unreachable`, which stayed unknown when seen from
    near, counts as blocked."""

    def __init__(self, costmap: Costmap, here: Point, goal: Point, unreachable: tuple[Point, ...]) -> None:
        self.resolution, self.radius, self.wide = costmap.resolution, costmap.outer, costmap.wide
        self.multiplier, self.outside = costmap.multiplier, costmap.outside
        self.standing, self.unreachable = here, unreachable
        self._leaves = costmap.zones.holding(here)
        """Keep-out zones in which the robot stands."""
        row, column = floor(here[1] / self.resolution) // TILE, floor(here[0] / self.resolution) // TILE
        self._rows, self._columns = about((row, column), joined(costmap.region, (row, column)))
        self.corner = (self._rows.start * TILE - 2, self._columns.start * TILE - 2)
        """Row and column, in the map, of the first cell."""
        self.stride = len(self._columns) * TILE + 4
        """Cells per row."""
        self.height = len(self._rows) * TILE + 4
        self.level: Levels = np.zeros(self.height * self.stride, np.uint8)
        """One per cell, row by row."""
        self.complete = False
        self._filled = 0
        """Rows of tiles so far."""
        self.goal = (
            floor(goal[1] / self.resolution) - self.corner[0],
            floor(goal[0] / self.resolution) - self.corner[1],
        )
        """Row and column of the goal in this snapshot; it may lie beyond the region."""

    def assemble(self, costmap: Costmap, grid: Map, work: int) -> int:
        """Add rows of tiles for about this much work; return the rest of it."""
        blank = bytes((self.outside,)) * TILE**2
        while work > 0 and not self.complete:
            tiles = [(self._rows[self._filled], column) for column in self._columns]
            pending = [tile for tile in tiles if tile in costmap.pending]
            if pending:
                costmap.draw(grid, pending[0])
                work -= TILE_WORK
                continue
            joined = b"".join(costmap.tiles.get(tile, blank) for tile in tiles)
            block = np.frombuffer(joined, np.uint8).reshape(-1, TILE, TILE).swapaxes(0, 1)
            first = 2 + self._filled * TILE
            rows = self._plane()[first : first + TILE, 2:-2]
            rows[:] = block.reshape(TILE, -1)
            for tile, (_, column) in enumerate(tiles):
                marks = costmap.zones.marks((self._rows[self._filled], column))
                if marks is not None:
                    work -= TILE_WORK
                    self._add_zones(rows[:, tile * TILE : (tile + 1) * TILE], marks, costmap.zones)
            self._filled += 1
            work -= len(tiles) * COPY_WORK
            if self._filled == len(self._rows):
                self._add_edges()
                self._judge_places()
                self.complete = True
        return work

    def _add_zones(self, part: Levels, marks: Marks, zones: Zones) -> None:
        """Set the levels of a tile's cells in zones: blocked; dear, if the robot is to leave the zone; slow,
        where that is dearer than what the cell costs already. Unknown ground in slow zones stays unknown."""
        for number, price in enumerate(zones.prices):
            cells = marks == number + 1
            if price < inf:
                cells &= (part >= self.wide) & (part < UNKNOWN) & (self.multiplier[part] < price)
                part[cells] = SLOW + number
            else:
                highest = np.uint8(NEAR if number in self._leaves else TOUCHING)
                part[cells] = np.minimum(part[cells], highest)

    def _plane(self) -> Levels:
        """Return the levels by row and column."""
        return self.level.reshape(self.height, self.stride)

    def _add_edges(self) -> None:
        """Set the levels of the unknown ground around the region."""
        plane, (row, column) = self._plane()[1:-1, 1:-1], self.goal
        plane[[0, -1], :] = plane[:, [0, -1]] = self.outside
        for side, beyond in (
            (plane[0], row < 2),
            (plane[-1], row >= self.height - 2),
            (plane[:, 0], column < 2),
            (plane[:, -1], column >= self.stride - 2),
        ):
            if beyond:
                side[:] = EXIT

    def _judge_places(self) -> None:
        """Set the levels of unknown ground under the robot and about the unreachable places."""
        for place in (self.standing, *self.unreachable):
            window, square = self.around(place, self.radius)
            part = self._plane()[window]
            unknown = (part >= UNKNOWN) & (square <= self.radius**2)
            if place is self.standing:
                part[unknown & (part != EXIT)] %= UNKNOWN
            else:
                part[unknown] = TOUCHING

    def around(self, centre: Point, radius: float) -> tuple[tuple[slice, slice], Floats]:
        """Return the rows and columns of this snapshot that contain a circle, and the squared distance [m²]
        of the middle of each of these cells from the centre."""
        spans, squares = [], []
        for count, low, at in zip((self.height, self.stride), self.corner, reversed(centre), strict=True):
            first = min(max(floor((at - radius) / self.resolution) - low, 0), count)
            last = min(max(floor((at + radius) / self.resolution) - low + 1, first), count)
            spans.append(slice(first, last))
            squares.append(((low + np.arange(first, last) + 0.5) * self.resolution - at) ** 2)
        return (spans[0], spans[1]), squares[1][None, :] + squares[0][:, None]

    def index(self, x: float, y: float) -> int | None:
        """Return the cell at a position [m]; None beyond the region."""
        row = floor(y / self.resolution) - self.corner[0]
        column = floor(x / self.resolution) - self.corner[1]
        inside = 2 <= row < self.height - 2 and 2 <= column < self.stride - 2
        return row * self.stride + column if inside else None

    def centre(self, cell: int) -> Point:
        """Return the middle of a cell [m]."""
        row, column = divmod(cell, self.stride)
        return (
            (self.corner[1] + column + 0.5) * self.resolution,
            (self.corner[0] + row + 0.5) * self.resolution,
        )

    def levels(self, rows: Cells, columns: Cells) -> Levels:
        """Return the level of each of these cells of the map."""
        row, column = rows - self.corner[0], columns - self.corner[1]
        inside = (row > 0) & (row < self.height - 1) & (column > 0) & (column < self.stride - 1)
        level = self.level[np.where(inside, row * self.stride + column, 0)]
        return np.where(inside, level, np.uint8(self.outside))

    def nearest(self, place: Point, within: float, *, known: bool) -> list[int]:
        """Return the cells within a distance [m] that are free, or unknown unless `known`; nearest first."""
        window, square = self.around(place, within)
        level = self._plane()[window]
        free = (level % UNKNOWN >= FREE) & (level < UNKNOWN if known else level != EXIT)
        row, column = np.nonzero(free & (square <= within**2))
        nearest = np.argsort(square[row, column], kind="stable")[:MAX_LINES]
        first = window[0].start * self.stride + window[1].start
        cells: list[int] = (first + row[nearest] * self.stride + column[nearest]).tolist()
        return cells


class Halved(Snapshot):
    """A complete snapshot in cells twice as large, each as good as the best of the four in it: for estimates
    of what a way costs at least."""

    def __init__(self, ground: Snapshot) -> None:
        self.resolution, self.radius, self.wide = 2.0 * ground.resolution, ground.radius, ground.wide
        self.multiplier, self.outside = ground.multiplier, ground.outside
        self.corner = (ground.corner[0] // 2 - 1, ground.corner[1] // 2 - 1)
        self.height, self.stride = ground.height // 2 + 2, ground.stride // 2 + 2
        self.level = np.zeros(self.height * self.stride, np.uint8)
        self.complete, self._filled, self._of = False, 0, ground
        self._by_price = np.argsort(ground.multiplier, kind="stable").astype(np.uint8)
        """Levels, the best first"""

    def halve(self, work: int) -> int:
        """Add rows for about this much work; return the rest of it."""
        rank = np.argsort(self._by_price).astype(np.uint8)
        while work > 0 and not self.complete:
            rows = slice(2 * self._filled, 2 * self._filled + TILE)
            four = rank[self._of._plane()[rows]]  # noqa: SLF001 -- its own kind
            two = np.minimum(four[::2], four[1::2])
            best = self._by_price[np.minimum(two[:, ::2], two[:, 1::2])]
            self._plane()[1 + self._filled :][: len(best), 1:-1] = best
            self._filled += len(best)
            work -= self._of.stride * TILE // HALVED_PER_WORK
            self.complete = 2 * self._filled == self._of.height
        return work


class Part(Snapshot):
    """Some rows and columns of a complete snapshot, with blocked cells around them."""

    def __init__(self, ground: Snapshot, rows: range, columns: range) -> None:
        self.resolution, self.radius, self.wide = ground.resolution, ground.radius, ground.wide
        self.multiplier, self.outside = ground.multiplier, ground.outside
        self.corner = (ground.corner[0] + rows.start - 1, ground.corner[1] + columns.start - 1)
        self.height, self.stride = len(rows) + 2, len(columns) + 2
        self.level = np.zeros(self.height * self.stride, np.uint8)
        there = ground._plane()[rows.start : rows.stop, columns.start : columns.stop]  # noqa: SLF001 -- its own kind
        self._plane()[1:-1, 1:-1] = there
        self.complete = True


def cells_in(ground: Snapshot, cells: Cells, other: Snapshot) -> Cells:
    """Return cells of a snapshot as those of another."""
    rows, columns = np.divmod(cells, ground.stride)
    up, right = (a - b for a, b in zip(ground.corner, other.corner, strict=True))
    found: Cells = (rows + up) * other.stride + columns + right
    return found


def crossing(resolution: float, start: Point, end: Point) -> tuple[Cells, Cells, Floats]:
    """Return row and column of the cells that a straight line crosses, and its length [m] in each."""
    a = (start[0] / resolution, start[1] / resolution)
    d = (end[0] / resolution - a[0], end[1] / resolution - a[1])
    cuts = [np.array((0.0, 1.0))]
    for p, v in zip(a, d, strict=True):
        if v != 0.0:
            low, high = sorted((p, p + v))
            cuts.append((np.arange(floor(low) + 1, floor(high) + 1) - p) / v)
    t = np.sort(np.clip(np.concatenate(cuts), 0.0, 1.0))
    middle, span = (t[1:] + t[:-1]) / 2, np.diff(t) * hypot(d[0], d[1]) * resolution
    columns = np.floor(a[0] + middle * d[0]).astype(np.int64)
    rows = np.floor(a[1] + middle * d[1]).astype(np.int64)
    return rows, columns, span


def line_cost(ground: Ground, start: Point, end: Point) -> float:
    """Return the cost [m] of a straight line; infinite if it leaves known free ground."""
    rows, columns, span = crossing(ground.resolution, start, end)
    factor = ground.multiplier[ground.levels(rows, columns)]
    return inf if factor.max() == inf else float(factor @ span)


def is_blocked(ground: Ground, start: Point, end: Point, lowest: int) -> bool:
    """True if a straight line meets a cell below this level."""
    rows, columns, _ = crossing(ground.resolution, start, end)
    return bool(np.any(ground.levels(rows, columns) < lowest))
