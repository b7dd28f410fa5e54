"""The costmap: what it costs to be in each cell of the map, and how it is built from the occupancy grid.

Rules. A costmap is a value: it is built once from the grid and never changes. A cell is blocked, unknown,
or free at one of a few levels, the lowest nearest to blocked cells; its multiplier (>= 1) is the cost of a
metre through the cell. Blocked means: the robot's centre must not be there, since its footprint circle would
touch an occupied cell (inflation). Distances are taken between the middles of cells, which is what the margin
beside the footprint's radius is for. A border of blocked cells surrounds the map, so that no search has to
check whether it has left it. Positions are in metres in the map's frame, cells are indices into `level`.
"""

from __future__ import annotations

from dataclasses import dataclass
from math import floor, hypot, inf
from typing import Protocol

import numpy as np
import numpy.typing as npt

from brain.checks import within
from brain.planning.polyline import Point
from protocols.messages import MILLISECOND, SECOND, Nanos

Mask = npt.NDArray[np.bool_]

BLOCKED = 0
UNKNOWN = 1
FREE = 2
"""The free level nearest to blocked cells; each level above it is one cell farther away."""


@dataclass(frozen=True, slots=True)
class PlannerSettings:
    """Parameters of planning and replanning, SI."""

    expansions_per_step: int = 1000
    """A* expansions per step of the brain: about 2 µs each."""
    margin: float = 0.05
    """m, clearance kept beyond the footprint's radius"""
    comfort: float = 0.4
    """m: within this distance of obstacles, a metre costs more"""
    dislike: float = 3.0
    """Additional cost of a metre next to an obstacle, over one far from any."""
    unknown_multiplier: float = 1.2
    """Assumed cost of a metre through unknown ground, where no known path leads to the goal.
    The larger, the longer the search."""
    unknown_is_free: bool = False
    """Plan through unknown ground as if it were free. For open ground only."""
    escape: float = 0.5
    """m: how far the start may lie from the nearest place that fits the footprint"""
    slack: float = 0.1
    """m: how far a goal too close to an obstacle may be moved to a place that fits"""
    period: Nanos = 250 * MILLISECOND
    """Period of checking the path against the map."""
    explore: Nanos = 500 * MILLISECOND
    """Period of replanning while no known path leads to the goal."""
    patience: Nanos = 8 * SECOND
    """After this time without any path to a goal, the goal is given up."""
    drive_timeout: Nanos = 500 * MILLISECOND
    """Watchdog of Drive: not repeated within this time, it ends (a lost operator means stop)."""

    def __post_init__(self) -> None:
        within(
            self,
            expansions_per_step=(1, 5000),
            margin=(0.0, 1.0, "m"),
            comfort=(0.0, 2.0, "m"),
            dislike=(0.0, 100.0),
            unknown_multiplier=(1.0, 100.0),
            escape=(0.01, 2.0, "m"),
            slack=(0.0, 2.0, "m"),
            period=(50.0, 5000.0),
            explore=(50.0, 60_000.0),
            patience=(10.0, 600_000.0),
            drive_timeout=(10.0, 2000.0),
        )


class Map(Protocol):
    """The part of the occupancy grid that is needed here."""

    version: int
    """Incremented at each change."""
    resolution: float
    """m per cell"""
    origin_x: float
    """m, of the lower left corner of cell (0, 0)"""
    origin_y: float

    @property
    def unknown(self) -> Mask:
        """Cells never observed: rows (y) × columns (x)."""
        ...

    def blocked(self, radius: float) -> Mask:
        """Cells with an occupied cell within the radius [m] of their middle."""
        ...


@dataclass(frozen=True, slots=True)
class Costmap:
    """The levels of all cells, and the cost of each level."""

    resolution: float
    """m per cell"""
    origin: Point
    """m, of the lower left corner of the first cell within the border"""
    stride: int
    """Cells per row, including the border's two."""
    level: bytes
    """One per cell, row by row, including the border."""
    multiplier: tuple[float, ...]
    """Cost factor by level, on known ground only: infinite for unknown and blocked."""
    unknown_multiplier: float
    """Assumed cost of a metre through unknown ground."""

    def index(self, x: float, y: float) -> int | None:
        """Return the cell at a position [m]; None outside the map."""
        column = (x - self.origin[0]) / self.resolution + 1.0
        row = (y - self.origin[1]) / self.resolution + 1.0
        if 1.0 <= column < self.stride - 1 and 1.0 <= row < len(self.level) // self.stride - 1:
            return floor(row) * self.stride + floor(column)
        return None

    def centre(self, cell: int) -> Point:
        """Return the middle of a cell [m]."""
        row, column = divmod(cell, self.stride)
        return (
            self.origin[0] + (column - 0.5) * self.resolution,
            self.origin[1] + (row - 0.5) * self.resolution,
        )

    def level_at(self, x: float, y: float) -> int:
        """Return the level at a position [m]; BLOCKED outside the map."""
        cell = self.index(x, y)
        return BLOCKED if cell is None else self.level[cell]

    def clearance(self, x: float, y: float) -> float:
        """Return the distance [m, whole cells] to the nearest blocked cell, as far as the levels resolve it.

        0 if the position is blocked or unknown; infinite beyond the last level."""
        level = self.level_at(x, y)
        if level < FREE:
            return 0.0
        return inf if level == len(self.multiplier) - 1 else (level - FREE + 1) * self.resolution

    def crossing(self, start: Point, end: Point) -> tuple[npt.NDArray[np.int64], npt.NDArray[np.float64]]:
        """Return the cells that a straight line crosses, and its length [m] in each; cell -1 is outside."""
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
        """Return the cost [m] of a straight line; infinite if it leaves known free ground."""
        cells, span = self.crossing(start, end)
        level = np.frombuffer(self.level, np.uint8)[cells]
        if bool(np.any((level < FREE) | (cells < 0))):
            return inf
        return float(np.asarray(self.multiplier)[level] @ span)

    def is_blocked(self, start: Point, end: Point) -> bool:
        """True if a straight line meets a blocked cell; unknown cells do not count."""
        cells, _ = self.crossing(start, end)
        level = np.frombuffer(self.level, np.uint8)[cells]
        return bool(np.any((level == BLOCKED) | (cells < 0)))


def build_costmap(
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
    """Return the costmap for these masks (rows = y, columns = x).

    Free ground costs 1 per metre at `comfort` [m] or more from blocked cells, and 1 + `dislike` next to
    them, linearly in between. Distances are counted in cells, by octagonal rings.
    """
    rings = round(comfort / resolution) if dislike > 0.0 else 0
    height, width = blocked.shape
    level = np.full((height + 2, width + 2), BLOCKED, np.uint8)
    inner = level[1:-1, 1:-1]
    inner[:] = FREE + rings
    near = blocked
    for ring in range(rings):
        near = dilated(near, diagonal=ring % 2 == 1)
        inner -= near.view(np.uint8)
    if not unknown_is_free:
        inner[unknown] = UNKNOWN
    inner[blocked] = BLOCKED
    free = tuple(1.0 + dislike * (rings - ring) / rings for ring in range(rings))
    return Costmap(
        resolution, origin, width + 2, level.tobytes(), (inf, inf, *free, 1.0), max(1.0, unknown_multiplier)
    )


def planning_costmap(
    grid: Map,
    radius: float,
    settings: PlannerSettings,
    *,
    standing: Point,
    unreachable: tuple[Point, ...] = (),
) -> Costmap:
    """Return the costmap of the present grid for a footprint circle of this radius [m].

    Unknown ground under the robot at `standing` counts as free. Unknown ground about the places
    `unreachable`, which stayed unknown when seen from near, counts as blocked."""
    resolution, corner = grid.resolution, (grid.origin_x, grid.origin_y)
    blocked, unknown = grid.blocked(radius + settings.margin), grid.unknown.copy()
    window, square = _around(unknown.shape, corner, resolution, standing, radius)
    unknown[window] &= square > radius**2
    blocked = blocked.copy() if unreachable else blocked
    for place in unreachable:
        window, square = _around(unknown.shape, corner, resolution, place, radius)
        blocked[window] |= unknown[window] & (square <= radius**2)
    return build_costmap(
        blocked,
        unknown,
        resolution=resolution,
        origin=corner,
        comfort=settings.comfort,
        dislike=settings.dislike,
        unknown_multiplier=settings.unknown_multiplier,
        unknown_is_free=settings.unknown_is_free,
    )


def footprint_costmap(grid: Map, radius: float) -> Costmap:
    """Return a costmap with only the cells blocked for this radius [m]; unknown ground is free."""
    return build_costmap(
        grid.blocked(radius),
        grid.unknown,
        resolution=grid.resolution,
        origin=(grid.origin_x, grid.origin_y),
        unknown_is_free=True,
    )


def nearest_cell(
    costmap: Costmap, place: Point, within: float, lowest: int, visible_in: Costmap | None = None
) -> int | None:
    """Return the nearest cell within a distance [m] that has at least this level; None if there is none.

    With `visible_in`, only cells on a straight line that is not blocked in that costmap: the nearest
    `MAX_LINES` are tried."""
    level = np.frombuffer(costmap.level, np.uint8).reshape(-1, costmap.stride)[1:-1, 1:-1]
    window, square = _around(level.shape, costmap.origin, costmap.resolution, place, within)
    row, column = np.nonzero((level[window] >= lowest) & (square <= within**2))
    nearest = np.argsort(square[row, column], kind="stable")[:MAX_LINES]
    first = (window[0].start + 1) * costmap.stride + window[1].start + 1
    for cell in (first + row[nearest] * costmap.stride + column[nearest]).tolist():
        if visible_in is None or not visible_in.is_blocked(place, costmap.centre(cell)):
            return int(cell)
    return None


MAX_LINES = 500
"""Straight lines that one search of the nearest place, or one shortening of a path, compares."""


def dilated(mask: Mask, *, diagonal: bool) -> Mask:
    """Return the mask grown by one cell to its four neighbours, or to all eight."""
    grown = mask.copy()
    grown[1:] |= mask[:-1]
    grown[:-1] |= mask[1:]
    across = grown.copy() if diagonal else mask
    grown[:, 1:] |= across[:, :-1]
    grown[:, :-1] |= across[:, 1:]
    return grown


def _around(
    shape: tuple[int, ...], corner: Point, resolution: float, centre: Point, radius: float
) -> tuple[tuple[slice, slice], npt.NDArray[np.float64]]:
    """Return the rows and columns of a map that contain a circle, and the squared distance [m²] of the middle
    of each of these cells from the centre."""
    spans, squares = [], []
    for count, low, at in zip(shape, reversed(corner), reversed(centre), strict=True):
        first = min(max(floor((at - radius - low) / resolution), 0), count)
        last = min(max(floor((at + radius - low) / resolution) + 1, first), count)
        spans.append(slice(first, last))
        squares.append((low + (np.arange(first, last) + 0.5) * resolution - at) ** 2)
    return (spans[0], spans[1]), squares[1][None, :] + squares[0][:, None]
