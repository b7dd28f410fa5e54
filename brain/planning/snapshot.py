"""What a path query works on: a snapshot of a region of the costmap; and straight lines over such ground."""

from __future__ import annotations

from math import floor, hypot, inf
from typing import Protocol

import numpy as np

from brain.planning.costmap import (
    EXIT,
    FREE,
    NEAR,
    TILE,
    TILE_WORK,
    UNKNOWN,
    Cells,
    Costmap,
    Floats,
    Levels,
    Map,
    tiles_of,
)
from brain.planning.polyline import Point

COPY_WORK = 1
"""Copying a tile into a snapshot, in expansions of A*."""
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

    def levels(self, rows: Cells, columns: Cells) -> Levels:
        """The level of each of these cells."""
        ...


class Snapshot:
    """The levels of a region as one flat sequence, assembled over several steps, then immutable.

    The region is what is known of the map, and the robot's place. Around it lie one row and column of unknown
    ground, of level `EXIT` on the sides that face a goal beyond, and one of blocked cells, so that no search
    has to check whether it has left it. Unknown ground under the robot counts as free. Unknown ground about
    the places `unreachable`, which stayed unknown when seen from near, counts as blocked."""

    def __init__(
        self, costmap: Costmap, grid: Map, here: Point, goal: Point, unreachable: tuple[Point, ...]
    ) -> None:
        self.resolution, self.multiplier, self.outside = (
            costmap.resolution,
            costmap.multiplier,
            costmap.outside,
        )
        self.standing, self.unreachable, self.radius = here, unreachable, costmap.radius
        row, column = floor(here[1] / self.resolution) // TILE, floor(here[0] / self.resolution) // TILE
        box, (rows, columns) = costmap.box or (row, column, row, column), tiles_of(grid.extent())
        self._rows = range(min(row, max(box[0], rows.start)), max(row + 1, min(box[2], rows.stop)))
        self._columns = range(
            min(column, max(box[1], columns.start)), max(column + 1, min(box[3], columns.stop))
        )
        self.corner = (self._rows.start * TILE - 2, self._columns.start * TILE - 2)
        """Row and column, in the map, of the first cell."""
        self.stride = len(self._columns) * TILE + 4
        """Cells per row."""
        self.height = len(self._rows) * TILE + 4
        self.level = bytearray()
        """One per cell, row by row."""
        self.goal = (
            floor(goal[1] / self.resolution) - self.corner[0],
            floor(goal[0] / self.resolution) - self.corner[1],
        )
        """Row and column of the goal in this snapshot; it may lie beyond the region."""
        up, right_ = self.goal
        self._sides = [
            EXIT if beyond else self.outside
            for beyond in (up < 2, up >= self.height - 2, right_ < 2, right_ >= self.stride - 2)
        ]

    @property
    def complete(self) -> bool:
        """True once every cell has its level."""
        return len(self.level) == self.height * self.stride

    def assemble(self, costmap: Costmap, grid: Map, work: int) -> int:
        """Add rows of tiles for about this much work; return the rest of it."""
        below, above, left, right = self._sides
        if not self.level:
            self.level += self._edge(0) + self._edge(below)
        while work > 0 and not self.complete:
            row = self._rows[len(self.level) // self.stride // TILE]
            tiles = [(row, column) for column in self._columns]
            while pending := [tile for tile in tiles if tile in costmap.pending]:
                if work <= 0:
                    return work
                costmap.draw(grid, pending[0])
                work -= TILE_WORK
            blank = bytes((self.outside,)) * TILE**2
            joined = b"".join(costmap.tiles.get(tile, blank) for tile in tiles)
            block = np.zeros((TILE, self.stride), np.uint8)
            inner = np.frombuffer(joined, np.uint8).reshape(-1, TILE, TILE).swapaxes(0, 1)
            block[:, 1], block[:, 2:-2], block[:, -2] = left, inner.reshape(TILE, -1), right
            self.level += block.tobytes()
            work -= len(tiles) * COPY_WORK
            if row == self._rows[-1]:
                self.level += self._edge(above) + self._edge(0)
                self._judge_places()
        return work

    def _edge(self, level: int) -> bytes:
        """Return one row of cells at the edge, between its two blocked ends."""
        return bytes((0, *(level,) * (self.stride - 2), 0))

    def _judge_places(self) -> None:
        """Set the levels of unknown ground under the robot and about the unreachable places."""
        level = np.frombuffer(self.level, np.uint8).reshape(-1, self.stride)
        for place in (self.standing, *self.unreachable):
            window, square = self.around(place, self.radius)
            part = level[window]
            unknown = (part >= UNKNOWN) & (square <= self.radius**2)
            if place is self.standing:
                part[unknown & (part != EXIT)] %= UNKNOWN
            else:
                part[unknown] = NEAR

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
        level = np.frombuffer(self.level, np.uint8)
        return np.where(
            inside, level[np.where(inside, row * self.stride + column, 0)], np.uint8(self.outside)
        )

    def nearest(self, place: Point, within: float, *, known: bool) -> list[int]:
        """Return the cells within a distance [m] that are free, or unknown unless `known`; nearest first."""
        window, square = self.around(place, within)
        level = np.frombuffer(self.level, np.uint8).reshape(-1, self.stride)[window]
        free = (level >= FREE) & (level < UNKNOWN if known else level != EXIT)
        row, column = np.nonzero(free & (square <= within**2))
        nearest = np.argsort(square[row, column], kind="stable")[:MAX_LINES]
        first = window[0].start * self.stride + window[1].start
        cells: list[int] = (first + row[nearest] * self.stride + column[nearest]).tolist()
        return cells


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
