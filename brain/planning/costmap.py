"""What it costs to stand on each cell of the map: the planner's whole picture of the world.

Rules. A costmap is a value: it is built once from the grid and never changes. A cell is blocked, unknown,
or free at one of a few levels, the lowest nearest to what is blocked; its multiplier (>= 1) is what a
metre through the cell costs. Blocked means: the robot's centre must not be there, since its footprint
circle would touch what is occupied. A border of blocked cells stands around the map, so that no search has
to ask whether it has left it. Positions are in metres in the map's frame, cells are indices into `level`.
"""

from __future__ import annotations

from dataclasses import dataclass
from math import floor, hypot, inf
from typing import Protocol

import numpy as np
import numpy.typing as npt

from brain.planning.line import Point

Mask = npt.NDArray[np.bool_]

BLOCKED = 0
UNKNOWN = 1
FREE = 2
"""The free level nearest to what is blocked; each level above it is one cell farther away."""


class Map(Protocol):
    """What of the occupancy grid is needed here."""

    version: int
    """Grows at each change."""
    resolution: float
    """m per cell"""
    origin_x: float
    """m, of the lower left corner of cell (0, 0)"""
    origin_y: float

    @property
    def unknown(self) -> Mask:
        """Rows (y) × columns (x): nothing was ever told of these."""
        ...

    def blocked(self, radius: float) -> Mask:
        """Whether anything occupied lies within the radius [m] of the cell's middle."""
        ...


def origin(grid: Map) -> Point:
    """m, of the lower left corner of cell (0, 0)."""
    return grid.origin_x, grid.origin_y


@dataclass(frozen=True, slots=True)
class Costmap:
    """The levels of all cells, and what they cost."""

    resolution: float
    """m per cell"""
    origin: Point
    """m, of the lower left corner of the cell in the first row and column within the border"""
    stride: int
    """Cells per row, the border's two included."""
    level: bytes
    """One per cell, row by row, the border included."""
    multiplier: tuple[float, ...]
    """By level, for what must keep to known ground: infinite where it must not go."""
    unknown_multiplier: float
    """What a metre through unknown ground is guessed to cost."""

    def index(self, x: float, y: float) -> int | None:
        """The cell at a position; None outside of the map."""
        column = floor((x - self.origin[0]) / self.resolution) + 1
        row = floor((y - self.origin[1]) / self.resolution) + 1
        if 0 < column < self.stride - 1 and 0 < row < len(self.level) // self.stride - 1:
            return row * self.stride + column
        return None

    def centre(self, cell: int) -> Point:
        """The middle of a cell [m]."""
        row, column = divmod(cell, self.stride)
        return (
            self.origin[0] + (column - 0.5) * self.resolution,
            self.origin[1] + (row - 0.5) * self.resolution,
        )

    def level_at(self, x: float, y: float) -> int:
        """The level at a position; outside of the map all is blocked."""
        cell = self.index(x, y)
        return BLOCKED if cell is None else self.level[cell]

    def clearance(self, x: float, y: float) -> float:
        """How far [m, in cells] what is blocked lies from a position, as far as the levels tell.

        0 where it is blocked or unknown; infinite where nothing is near."""
        level = self.level_at(x, y)
        if level < FREE:
            return 0.0
        return inf if level == len(self.multiplier) - 1 else (level - FREE + 1) * self.resolution

    def crossing(self, start: Point, end: Point) -> tuple[npt.NDArray[np.int64], npt.NDArray[np.float64]]:
        """The cells that a straight line crosses, and the length [m] within each; -1 is outside."""
        a = ((start[0] - self.origin[0]) / self.resolution, (start[1] - self.origin[1]) / self.resolution)
        d = ((end[0] - start[0]) / self.resolution, (end[1] - start[1]) / self.resolution)
        cuts = [np.array((0.0, 1.0))]
        for p, v in zip(a, d, strict=True):
            if v != 0.0:
                low, high = sorted((p, p + v))
                cuts.append((np.arange(floor(low) + 1, floor(high) + 1) - p) / v)
        t = np.sort(np.clip(np.concatenate(cuts), 0.0, 1.0))
        middle, span = (t[1:] + t[:-1]) / 2, np.diff(t) * hypot(d[0], d[1]) * self.resolution
        column = np.floor(a[0] + middle * d[0]).astype(np.int64) + 1
        row = np.floor(a[1] + middle * d[1]).astype(np.int64) + 1
        rows = len(self.level) // self.stride
        inside = (column > 0) & (column < self.stride - 1) & (row > 0) & (row < rows - 1)
        return np.where(inside, row * self.stride + column, -1), span

    def line_cost(self, start: Point, end: Point) -> float:
        """What a straight line over known ground costs [m]; infinite if it meets anything else."""
        cells, span = self.crossing(start, end)
        level = np.frombuffer(self.level, np.uint8)[cells]
        if bool(np.any((level < FREE) | (cells < 0))):
            return inf
        return float(np.asarray(self.multiplier)[level] @ span)

    def is_blocked(self, start: Point, end: Point) -> bool:
        """Whether a straight line meets anything blocked; unknown ground does not count."""
        cells, _ = self.crossing(start, end)
        level = np.frombuffer(self.level, np.uint8)[cells]
        return bool(np.any((level == BLOCKED) | (cells < 0)))


def build(
    blocked: Mask,
    unknown: Mask,
    *,
    resolution: float,
    origin: Point,
    comfort: float = 0.0,
    dislike: float = 0.0,
    unknown_multiplier: float = 1.0,
    unknown_is_free: bool = False,
) -> Costmap:
    """The costmap of a grid (rows = y, columns = x).

    Free ground costs 1 a metre at `comfort` [m] and more from what is blocked, and 1 + `dislike` next
    to it, linearly between. Distances are counted in cells with octagonal rings.
    """
    rings = round(comfort / resolution) if dislike > 0.0 else 0
    height, width = blocked.shape
    level = np.full((height + 2, width + 2), BLOCKED, np.uint8)
    inner = level[1:-1, 1:-1]
    inner[:] = FREE + rings
    near = blocked
    shells = []
    for ring in range(rings):
        near = dilated(near, diagonal=ring % 2 == 1)
        shells.append(near)
    for ring in reversed(range(rings)):
        inner[shells[ring]] = FREE + ring
    if not unknown_is_free:
        inner[unknown] = UNKNOWN
    inner[blocked] = BLOCKED
    free = tuple(1.0 + dislike * (rings - ring) / rings for ring in range(rings))
    return Costmap(
        resolution, origin, width + 2, level.tobytes(), (inf, inf, *free, 1.0), max(1.0, unknown_multiplier)
    )


def dilated(mask: Mask, *, diagonal: bool) -> Mask:
    """The mask grown by one cell to four sides, or to all eight."""
    grown = mask.copy()
    grown[1:] |= mask[:-1]
    grown[:-1] |= mask[1:]
    across = grown.copy() if diagonal else mask
    grown[:, 1:] |= across[:, :-1]
    grown[:, :-1] |= across[:, 1:]
    return grown
