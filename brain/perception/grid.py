"""The occupancy grid, in the frame "odom", in log-odds.

Rules. A cell's value is the log-odds of being occupied: above 0 occupied, below 0 free, and exactly 0 only
if it was never observed. Each scan changes a cell at most once: cells in which a beam ended are raised by
`hit` (also if other beams passed through them), cells that beams only passed through are lowered by `miss`;
values are clamped, so that an obstacle that has moved away is cleared after a known number of scans. A beam
without a hit clears up to the lidar's largest range. Neighbouring beams diverge: an unknown cell in the gap
between two of them becomes free, if the gap is at most `gap` wide there, up to the shorter of the two ranges;
an occupied cell is never cleared that way. Beside its value an occupied cell keeps the mean of its first
hits, finer than the cell, for scan matching. Rows are y, columns x; the cell (0, 0) has its lower left corner
at the origin.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from brain.belief import Floats, MapView, Pose
from brain.checks import within
from brain.perception.mount import BodyScan, Bools, to_world

Cells = npt.NDArray[np.int64]
"""n × 2: column, row"""
Indices = npt.NDArray[np.int64]
"""Flat indices of cells"""


@dataclass(frozen=True, slots=True)
class GridSettings:
    """Size of the map and the sensor model of beams."""

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
    """Lower bound of a cell's log-odds"""
    high: float = 3.5
    """Upper bound of a cell's log-odds: cleared after high / miss scans"""
    farthest: float = 12.0
    """m: largest range of beams that is used"""
    gap: float = 0.2
    """m between neighbouring beams, below which no relevant obstacle fits unseen between them"""

    def __post_init__(self) -> None:
        within(
            self,
            resolution=(0.01, 0.5, "m"),
            width=(1.0, 1000.0, "m"),
            height=(1.0, 1000.0, "m"),
            center_x=(-1e4, 1e4, "m"),
            center_y=(-1e4, 1e4, "m"),
            hit=(0.01, 10.0),
            miss=(0.01, 10.0),
            low=(-20.0, -0.01),
            high=(0.01, 20.0),
            farthest=(0.5, 100.0, "m"),
            gap=(0.0, 1.0, "m"),
        )
        cells = self.width * self.height / self.resolution**2
        if cells > MAX_CELLS:
            text = f"{self.width:g} m × {self.height:g} m at {self.resolution:g} m are {cells:.0f} cells"
            raise ValueError(f"width × height: {text}, and the map must have at most {MAX_CELLS}")


MAX_CELLS = 1_000_000
"""Of a map: 50 m × 50 m at 0.05 m. The costmap is made of all of them in one step."""


class Grid:
    """The map."""

    def __init__(self, settings: GridSettings) -> None:
        self.settings = settings
        self.resolution = settings.resolution
        self.rows = round(settings.height / settings.resolution)
        self.columns = round(settings.width / settings.resolution)
        self.origin_x = settings.center_x - self.columns * settings.resolution / 2.0
        self.origin_y = settings.center_y - self.rows * settings.resolution / 2.0
        self.version = 0
        """Incremented at each change."""
        self.log_odds = np.zeros((self.rows, self.columns), dtype=np.float32)
        """Must not be written to from outside."""
        self.hits = np.zeros(self.rows * self.columns, dtype=np.int32)
        """Number of hits in each cell's mean, up to MAX_MEAN_HITS."""
        self.means = np.zeros((self.rows * self.columns, 2))
        """Mean of each cell's first hits [m]; undefined where `hits` is 0."""
        self.facing = np.zeros((self.rows * self.columns, 2))
        """Mean of the unit vectors from those hits to the lidar: the side from which the cell was seen."""
        self._view: MapView | None = None
        self._blocked: dict[float, Bools] = {}
        self._blocked_version = 0

    # -- positions and cells -------------------------------------------------------------------

    def cell(self, x: float, y: float) -> tuple[int, int]:
        """Return the cell (row, column) of a position [m]; it may lie outside the map."""
        return (
            math.floor((y - self.origin_y) / self.resolution),
            math.floor((x - self.origin_x) / self.resolution),
        )

    def center(self, row: int, column: int) -> tuple[float, float]:
        """Return the middle of a cell [m]."""
        return (
            self.origin_x + (column + 0.5) * self.resolution,
            self.origin_y + (row + 0.5) * self.resolution,
        )

    def corners(self) -> tuple[tuple[float, float], tuple[float, float]]:
        """Return the lower left and the upper right corner of the map [m]."""
        left, bottom = self.origin_x, self.origin_y
        return (left, bottom), (left + self.columns * self.resolution, bottom + self.rows * self.resolution)

    def cells(self, points: Floats) -> Cells:
        """Return the cells (column, row) of points (n × 2) [m]."""
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
        """rows × columns: never observed. They are not free."""
        unknown: Bools = self.log_odds == 0.0
        return unknown

    def blocked(self, radius: float) -> Bools:
        """Return the occupied cells inflated by a radius [m]: cells whose middle is closer than that to any
        part of an occupied cell, where the middle of a round robot must not be. Unknown cells are not
        included: see `unknown`.

        rows × columns; cached until the map changes, must not be written to."""
        if self._blocked_version != self.version:
            self._blocked.clear()
            self._blocked_version = self.version
        if radius not in self._blocked:
            self._blocked[radius] = _inflated(self.occupied, radius / self.resolution)
            self._blocked[radius].flags.writeable = False
        return self._blocked[radius]

    def view(self) -> MapView:
        """Return the map as a value: a read-only copy, the same object until the map changes."""
        if self._view is None or self._view.version != self.version:
            copy = self.log_odds.copy()
            copy.flags.writeable = False
            self._view = MapView(
                self.version, self.resolution, {(0, 0): copy}, corner=(self.origin_x, self.origin_y)
            )
        return self._view

    # -- writing -------------------------------------------------------------------------------

    def add(self, pose: Pose, scan: BodyScan) -> None:
        """Add a scan that was taken with the robot at this pose."""
        origin = to_world(np.array([scan.origin]), pose)
        ends = to_world(scan.ends, pose)
        start, stops = self.cells(origin)[0], self.cells(ends)
        read = scan.ranges > 0.0
        hit_beams = scan.hit & self._within(stops)
        hit = np.zeros(self.rows * self.columns, dtype=np.bool_)
        hit[self._flat(stops[hit_beams])] = True
        passed = np.zeros_like(hit)
        passed[self._rays(start, stops[read])] = True
        self._lower(np.flatnonzero(passed & ~hit))
        self._raise(np.flatnonzero(hit))
        self._fill_gaps(origin[0], pose.yaw, scan, ends)
        self._update_means(self._flat(stops[hit_beams]), ends[hit_beams], origin[0])
        self.version += 1

    def _lower(self, cells: Indices) -> None:
        values = self.log_odds.reshape(-1)
        lowered = np.maximum(values[cells] - np.float32(self.settings.miss), np.float32(self.settings.low))
        lowered[lowered == 0.0] = OBSERVED_FREE
        values[cells] = lowered
        self.hits[cells[lowered < 0.0]] = 0

    def _raise(self, cells: Indices) -> None:
        values = self.log_odds.reshape(-1)
        raised = np.minimum(values[cells] + np.float32(self.settings.hit), np.float32(self.settings.high))
        raised[raised == 0.0] = OBSERVED_FREE
        values[cells] = raised

    def _within(self, cells: Cells) -> Bools:
        inside: Bools = np.all((cells >= 0) & (cells < (self.columns, self.rows)), axis=1)
        return inside

    def _flat(self, cells: Cells) -> Indices:
        flat: Indices = cells[:, 1] * self.columns + cells[:, 0]
        return flat

    def _rays(self, start: npt.NDArray[np.int64], stops: Cells) -> Indices:
        """Return the cells on the lines from a cell to others, without the last: one per step of the longer
        side, the other coordinate rounded (Bresenham, 1965), all lines at once; of too many, evenly chosen
        ones."""
        steps = stops - start
        lengths = np.max(np.abs(steps), axis=1)
        every = math.ceil(len(steps) * int(lengths.max(initial=0)) / MAX_RAY_CELLS)
        steps, lengths = steps[:: every or 1], lengths[:: every or 1]
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

    def _fill_gaps(self, origin: Floats, yaw: float, scan: BodyScan, ends: Floats) -> None:
        """Mark unknown cells in the narrow gaps between neighbouring beams as free, up to `MAX_GAP_REACH`."""
        corners = np.minimum(ends.min(axis=0), origin), np.maximum(ends.max(axis=0), origin)
        far = MAX_GAP_REACH * self.resolution
        low, high = self.cells(np.clip(np.array(corners), origin - far, origin + far))
        left, bottom = np.maximum(low, 0)
        right, top = np.minimum(high + 1, (self.columns, self.rows))
        if left >= right or bottom >= top:
            return
        rows, columns = np.nonzero(self.log_odds[bottom:top, left:right] == 0.0)
        rows, columns = rows + bottom, columns + left
        dx = self.origin_x + (columns + 0.5) * self.resolution - origin[0]
        dy = self.origin_y + (rows + 0.5) * self.resolution - origin[1]
        reach = _gap_range(dx, dy, yaw, scan)
        distance = np.sqrt(dx * dx + dy * dy)
        seen = (distance < reach - self.resolution) & (
            distance * abs(scan.angle_increment) <= self.settings.gap
        )
        self.log_odds[rows[seen], columns[seen]] = -np.float32(self.settings.miss)

    def _update_means(self, cells: Indices, points: Floats, origin: Floats) -> None:
        """Add hits to the means of those cells that are occupied and have too few."""
        wanted = (self.hits[cells] < MAX_MEAN_HITS) & (self.log_odds.reshape(-1)[cells] > 0.0)
        cells, points = cells[wanted], points[wanted]
        touched, which = np.unique(cells, return_inverse=True)
        before = self.hits[touched]
        after = before + np.bincount(which, minlength=len(touched))
        towards = normalised(origin - points)
        for means, values in ((self.means, points), (self.facing, towards)):
            for axis in (0, 1):
                new = np.bincount(which, weights=values[:, axis], minlength=len(touched))
                means[touched, axis] = (means[touched, axis] * before + new) / after
        self.hits[touched] = after


MAX_RAY_CELLS = 400_000
"""Cells on the rays of one scan; with more, every second (third …) beam clears. Every hit still counts."""
MAX_GAP_REACH = 256
"""Cells from the lidar within which gaps between beams are filled."""
MAX_MEAN_HITS = 10
"""Hits in a cell's mean: the first ones, from when the pose was best known."""
OBSERVED_FREE = np.float32(-1e-3)
"""Value of a cell whose hits and misses happen to cancel: observed, and barely free."""


def normalised(vectors: Floats) -> Floats:
    """Return vectors (n × 2) scaled to length 1; those of length 0 stay."""
    lengths = np.sqrt(np.sum(vectors * vectors, axis=1))
    units: Floats = vectors / np.maximum(lengths, 1e-12)[:, None]
    return units


def _gap_range(dx: Floats, dy: Floats, yaw: float, scan: BodyScan) -> Floats:
    """Return for each position relative to the lidar, in the world's axes, the shorter range [m] of the two
    beams that it lies between; 0 where there is no such pair."""
    c, s = math.cos(yaw), math.sin(yaw)
    bx, by = c * dx + s * dy, c * dy - s * dx
    (xx, xy), (yx, yy) = scan.axes
    bearing = np.arctan2(xy * bx + yy * by, xx * bx + yx * by)
    beam = np.floor(np.mod(bearing - scan.angle_min, 2.0 * math.pi) / scan.angle_increment).astype(np.int64)
    count = len(scan.ranges)
    after = np.roll(scan.ranges, -1)
    if count * scan.angle_increment < 2.0 * math.pi - scan.angle_increment / 2.0:
        after[-1] = 0.0
    shorter = np.minimum(scan.ranges, after)
    reach: Floats = np.where(beam < count, shorter[np.minimum(beam, count - 1)], 0.0)
    return reach


def _inflated(occupied: Bools, radius: float) -> Bools:
    """Return the cells whose middle is closer than the radius [cells] to any part of a cell that is set.

    The disc is the union of its rows, the longest last: each is made of the one before, so that the work is
    four passes over the map per cell of the radius, however much of it is occupied."""
    rows = len(occupied)
    near = np.maximum(np.arange(math.ceil(radius + 0.5) + 1) - 0.5, 0.0) ** 2
    half_widths = np.count_nonzero(near[:, None] + near[None, :] < radius * radius, axis=1) - 1
    inflated, row, width = occupied.copy(), occupied.copy(), 0
    for up in reversed(range(min(len(near), rows))):
        while width < half_widths[up]:
            width += 1
            row[:, width:] |= occupied[:, :-width]
            row[:, :-width] |= occupied[:, width:]
        if half_widths[up] >= 0:
            inflated[up:] |= row[: rows - up]
            inflated[: rows - up] |= row[up:]
    return inflated
