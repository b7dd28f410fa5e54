"""An occupancy grid in the frame "odom", in log-odds, that lasts from scan to scan.

Rules of this file. A cell's value is the logarithm of its odds of being occupied: above 0 occupied,
below 0 free, and exactly 0 only if no beam ever told anything of it. Each scan changes a cell at most
once: cells in which a beam ended rise by `hit` (also if other beams passed through them), cells that
beams only passed through fall by `miss`; values stay within bounds, so that what has moved away is
forgotten after a known number of scans. A beam that met nothing clears as far as the lidar sees.
Neighbouring beams diverge: the gap between two of them, where it is no wider than `gap`, may tell an
unknown cell free, as far as the shorter of them went, but never clears one.
Beside its value an occupied cell keeps the mean of its first hits, finer than the cell, for matching.
Rows count y, columns x; the cell (0, 0) has its lower left corner at the origin.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, fields

import numpy as np
import numpy.typing as npt

from brain.belief import Floats, MapView, Pose
from brain.perception.mount import Bools, Sweep, place

Cells = npt.NDArray[np.int64]
"""n × 2: column, row"""
Indices = npt.NDArray[np.int64]
"""Flat indices of cells"""


@dataclass(frozen=True, slots=True)
class GridSettings:
    """Size of the map and how beams change it."""

    resolution: float = 0.05
    """m per cell"""
    width: float = 24.0
    """m along x"""
    height: float = 24.0
    """m along y"""
    center_x: float = 0.0
    """m: the middle of the map in the frame "odom" """
    center_y: float = 0.0
    hit: float = 0.85
    miss: float = 0.4
    low: float = -2.0
    """The most that a cell can be free"""
    high: float = 3.5
    """The most that a cell can be occupied: gone after high / miss scans"""
    farthest: float = 12.0
    """m: beams are believed up to here"""
    gap: float = 0.2
    """m between neighbouring beams, where nothing that matters can stand unseen"""

    def __post_init__(self) -> None:
        for field in fields(self):
            if not math.isfinite(getattr(self, field.name)):
                raise ValueError(f"{field.name} must be finite, not {getattr(self, field.name)!r}")
        for name in ("resolution", "width", "height", "hit", "miss", "high", "farthest"):
            if getattr(self, name) <= 0.0:
                raise ValueError(f"{name} must be above 0, not {getattr(self, name)!r}")
        if self.low >= 0.0 or self.gap < 0.0:
            raise ValueError(f"low must be below 0 and gap not negative, not {self.low!r} and {self.gap!r}")
        cells = self.width * self.height / self.resolution**2
        if cells > 16e6 or min(self.width, self.height) < self.resolution:
            raise ValueError(f"the map must have between 1 and 16 million cells, not {cells:.0f}")


class Grid:
    """The map. `add` scans; read values, masks and views."""

    def __init__(self, settings: GridSettings) -> None:
        self.settings = settings
        self.resolution = settings.resolution
        self.rows = round(settings.height / settings.resolution)
        self.columns = round(settings.width / settings.resolution)
        self.origin_x = settings.center_x - self.columns * settings.resolution / 2.0
        self.origin_y = settings.center_y - self.rows * settings.resolution / 2.0
        self.version = 0
        """Grows at each change."""
        self.log_odds = np.zeros((self.rows, self.columns), dtype=np.float32)
        """Must not be written to from outside."""
        self.outside = 0
        """How many beams ended outside the map so far."""
        self.hits = np.zeros(self.rows * self.columns, dtype=np.int32)
        """How many hits each cell's mean is made of, up to FIRST."""
        self.means = np.zeros((self.rows * self.columns, 2))
        """Each cell's mean of its first hits [m]; of no meaning where `hits` is 0."""
        self.facing = np.zeros((self.rows * self.columns, 2))
        """The mean of the unit vectors from those hits to the lidar: from which side it was seen."""
        self._view: MapView | None = None
        self._blocked: dict[float, Bools] = {}
        self._blocked_version = 0

    # -- places and cells ----------------------------------------------------------------------

    def cell(self, x: float, y: float) -> tuple[int, int]:
        """The cell (row, column) of a place [m]; it may lie outside the map."""
        return (
            math.floor((y - self.origin_y) / self.resolution),
            math.floor((x - self.origin_x) / self.resolution),
        )

    def center(self, row: int, column: int) -> tuple[float, float]:
        """The middle of a cell [m]."""
        return (
            self.origin_x + (column + 0.5) * self.resolution,
            self.origin_y + (row + 0.5) * self.resolution,
        )

    def inside(self, row: int, column: int) -> bool:
        """Whether the map has this cell."""
        return 0 <= row < self.rows and 0 <= column < self.columns

    def cells(self, points: Floats) -> Cells:
        """The cells (column, row) of points (n × 2)."""
        corner = np.array([self.origin_x, self.origin_y])
        cells: Cells = np.floor((points - corner) / self.resolution).astype(np.int64)
        return cells

    # -- reading -------------------------------------------------------------------------------

    @property
    def occupied(self) -> Bools:
        """rows × columns"""
        return self.log_odds > 0.0

    @property
    def free(self) -> Bools:
        """rows × columns"""
        return self.log_odds < 0.0

    @property
    def unknown(self) -> Bools:
        """rows × columns: no beam ever told anything of these. They are not free."""
        unknown: Bools = self.log_odds == 0.0
        return unknown

    def blocked(self, radius: float) -> Bools:
        """Where the middle of a round robot of this radius [m] must not be: cells whose middle is
        closer than that to any part of an occupied cell. Unknown cells are not in it: see `unknown`.

        rows × columns; kept until the map changes, must not be written to."""
        if self._blocked_version != self.version:
            self._blocked.clear()
            self._blocked_version = self.version
        if radius not in self._blocked:
            self._blocked[radius] = _inflated(self.occupied, radius / self.resolution)
            self._blocked[radius].flags.writeable = False
        return self._blocked[radius]

    def clearance(self, x: float, y: float) -> float:
        """From a place to the nearest part of an occupied cell [m]; infinite if there is none."""
        rows, columns = np.nonzero(self.occupied)
        if not len(rows):
            return math.inf
        half = self.resolution / 2.0
        dx = np.maximum(np.abs(self.origin_x + (columns + 0.5) * self.resolution - x) - half, 0.0)
        dy = np.maximum(np.abs(self.origin_y + (rows + 0.5) * self.resolution - y) - half, 0.0)
        return float(np.sqrt(np.min(dx * dx + dy * dy)))

    def view(self) -> MapView:
        """The map as a value: a copy that nobody can write to, the same until the map changes."""
        if self._view is None or self._view.version != self.version:
            copy = self.log_odds.copy()
            copy.flags.writeable = False
            self._view = MapView(self.version, self.resolution, self.origin_x, self.origin_y, copy)
        return self._view

    # -- writing -------------------------------------------------------------------------------

    def add(self, pose: Pose, sweep: Sweep) -> None:
        """Take in a scan that was taken with the robot at this pose."""
        origin = place(np.array([sweep.origin]), pose)
        ends = place(sweep.ends, pose)
        start, stops = self.cells(origin)[0], self.cells(ends)
        read = sweep.ranges > 0.0
        hit_beams = sweep.hit & self._within(stops)
        self.outside += int(np.count_nonzero(read & ~self._within(stops)))
        hit = np.zeros(self.rows * self.columns, dtype=np.bool_)
        hit[self._flat(stops[hit_beams])] = True
        passed = np.zeros_like(hit)
        passed[self._rays(start, stops[read])] = True
        self._fall(np.flatnonzero(passed & ~hit))
        self._rise(np.flatnonzero(hit))
        self._fill(origin[0], pose.yaw, sweep, ends)
        self._average(self._flat(stops[hit_beams]), ends[hit_beams], origin[0])
        self.version += 1

    def _fall(self, cells: Indices) -> None:
        values = self.log_odds.reshape(-1)
        fallen = np.maximum(values[cells] - np.float32(self.settings.miss), np.float32(self.settings.low))
        fallen[fallen == 0.0] = KNOWN
        values[cells] = fallen
        self.hits[cells[fallen < 0.0]] = 0

    def _rise(self, cells: Indices) -> None:
        values = self.log_odds.reshape(-1)
        risen = np.minimum(values[cells] + np.float32(self.settings.hit), np.float32(self.settings.high))
        risen[risen == 0.0] = KNOWN
        values[cells] = risen

    def _within(self, cells: Cells) -> Bools:
        inside: Bools = np.all((cells >= 0) & (cells < (self.columns, self.rows)), axis=1)
        return inside

    def _flat(self, cells: Cells) -> Indices:
        flat: Indices = cells[:, 1] * self.columns + cells[:, 0]
        return flat

    def _rays(self, start: npt.NDArray[np.int64], stops: Cells) -> Indices:
        """The cells on the lines from a cell to others, without the last: one per step of the longer
        side, the other coordinate rounded (Bresenham, 1965), all lines at once."""
        steps = stops - start
        lengths = np.max(np.abs(steps), axis=1)
        if not lengths.any():
            return np.zeros(0, dtype=np.int64)
        largest = max(lengths.max(), *np.abs(start))
        kind = np.int32 if largest < 2**15 else np.int64  # half the width divides in a third of the time
        step = np.arange(lengths.sum(), dtype=kind)
        step -= np.repeat((np.cumsum(lengths) - lengths).astype(kind), lengths)
        half = np.repeat(lengths.astype(kind), lengths)
        across, up = (np.repeat(side.astype(kind), lengths) for side in steps.T)
        columns = kind(start[0]) + (2 * step * across + half) // (2 * half)
        rows = kind(start[1]) + (2 * step * up + half) // (2 * half)
        inside = (columns >= 0) & (columns < self.columns) & (rows >= 0) & (rows < self.rows)
        flat: Indices = (rows * kind(self.columns) + columns)[inside].astype(np.int64)
        return flat

    def _fill(self, origin: Floats, yaw: float, sweep: Sweep, ends: Floats) -> None:
        """Tell unknown cells free that lie in the narrow gaps between neighbouring beams."""
        corners = np.minimum(ends.min(axis=0), origin), np.maximum(ends.max(axis=0), origin)
        low, high = self.cells(np.array(corners))
        left, bottom = np.maximum(low, 0)
        right, top = np.minimum(high + 1, (self.columns, self.rows))
        if left >= right or bottom >= top:
            return
        rows, columns = np.nonzero(self.log_odds[bottom:top, left:right] == 0.0)
        rows, columns = rows + bottom, columns + left
        dx = self.origin_x + (columns + 0.5) * self.resolution - origin[0]
        dy = self.origin_y + (rows + 0.5) * self.resolution - origin[1]
        reach = _reach(dx, dy, yaw, sweep)
        distance = np.sqrt(dx * dx + dy * dy)
        seen = (distance < reach - self.resolution) & (
            distance * abs(sweep.angle_increment) <= self.settings.gap
        )
        self.log_odds[rows[seen], columns[seen]] = -np.float32(self.settings.miss)

    def _average(self, cells: Indices, points: Floats, origin: Floats) -> None:
        """Take hits into the means of those cells that are occupied and have too few."""
        wanted = (self.hits[cells] < FIRST) & (self.log_odds.reshape(-1)[cells] > 0.0)
        cells, points = cells[wanted], points[wanted]
        touched, which = np.unique(cells, return_inverse=True)
        before = self.hits[touched]
        after = before + np.bincount(which, minlength=len(touched))
        towards = unit(origin - points)
        for means, values in ((self.means, points), (self.facing, towards)):
            for axis in (0, 1):
                new = np.bincount(which, weights=values[:, axis], minlength=len(touched))
                means[touched, axis] = (means[touched, axis] * before + new) / after
        self.hits[touched] = after


FIRST = 10
"""How many hits make a cell's mean: the first, from when the pose was best known."""
KNOWN = np.float32(-1e-3)
"""What a cell is set to whose hits and misses happen to cancel: known, and free by a hair."""


def unit(vectors: Floats) -> Floats:
    """Vectors (n × 2) of length 1; those of length 0 stay."""
    lengths = np.sqrt(np.sum(vectors * vectors, axis=1))
    units: Floats = vectors / np.maximum(lengths, 1e-12)[:, None]
    return units


def _reach(dx: Floats, dy: Floats, yaw: float, sweep: Sweep) -> Floats:
    """For places relative to the lidar, in the world's axes: the shorter range [m] of the two beams
    that each place lies between; 0 where there is no such pair."""
    c, s = math.cos(yaw), math.sin(yaw)
    bx, by = c * dx + s * dy, c * dy - s * dx
    (xx, xy), (yx, yy) = sweep.axes
    bearing = np.arctan2(xy * bx + yy * by, xx * bx + yx * by)
    beam = np.floor(np.mod(bearing - sweep.angle_min, 2.0 * math.pi) / sweep.angle_increment).astype(np.int64)
    count = len(sweep.ranges)
    after = np.roll(sweep.ranges, -1)
    if count * sweep.angle_increment < 2.0 * math.pi - sweep.angle_increment / 2.0:
        after[-1] = 0.0
    shorter = np.minimum(sweep.ranges, after)
    reach: Floats = np.where(beam < count, shorter[np.minimum(beam, count - 1)], 0.0)
    return reach


def _inflated(occupied: Bools, radius: float) -> Bools:
    """Cells whose middle is closer than the radius [cells] to any part of a cell that is set."""
    reach = max(math.ceil(radius + 0.5), 0)
    span = np.arange(-reach, reach + 1)
    near = np.maximum(np.abs(span) - 0.5, 0.0)
    inside = near[:, None] ** 2 + near[None, :] ** 2 < radius * radius
    inside[reach, reach] = True
    rows, columns = occupied.shape
    wide = np.zeros((rows + 2 * reach, columns + 2 * reach), dtype=np.bool_)
    disc = np.argwhere(inside)
    offsets = disc[:, 0] * wide.shape[1] + disc[:, 1]
    at_row, at_column = np.nonzero(occupied)
    flat = wide.reshape(-1)
    flat[((at_row * wide.shape[1] + at_column)[:, None] + offsets[None, :]).reshape(-1)] = True
    return wide[reach : reach + rows, reach : reach + columns].copy()
