"""The occupancy map in the frame "odom": log-odds of cells of an unbounded plane, of which an extent is kept.

Rules. The cell (row, column) of a position is (floor(y / resolution), floor(x / resolution)): global
integers, without an origin. What is kept is an extent about the robot, at least as large as asked; its sides
are a power of two of tiles, so that a cell's place in memory is its indices without their upper bits. It
moves by whole tiles when the robot is more than a tile off its middle; what falls out of it is forgotten. No
cost of a scan depends on the extent.
A cell's value is the log-odds of being occupied, in steps of `UNIT`: above 0 occupied, below 0 free, and
exactly 0 only if it was never observed. Each scan changes a cell at most once: cells where a beam ended are
raised by `hit` (also if other beams passed through them), those that beams only passed through are lowered
by `miss`. Values are clamped: what has gone is cleared after high / miss scans that pass. What appears is
occupied at once, however free its cells were: where two neighbouring beams both end in free cells, these are
raised from 0. A single such end is as likely to be noise, and has to outweigh what was seen before.
Neighbouring beams diverge: in turn, some unknown cells between two of them become free as well. Beside its
value an occupied cell has the line of its surface, for matching (see `Lines`).
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from brain.belief import Floats, MapView, Pose
from brain.checks import within
from brain.perception.body_scan import BodyScan, Bools, rotated, to_world
from brain.perception.lines import Lines

Cells = npt.NDArray[np.int64]
"""n × 2: column, row"""
Indices = npt.NDArray[np.int64]
"""Places of cells in memory"""
Values = npt.NDArray[np.int8]
"""Log-odds in steps of `UNIT`"""

TILE = 64
"""Cells along a tile's sides"""
UNIT = 1.0 / 32.0
"""Log-odds"""
MAX_CELLS = 2**24
"""Of the extent: 204.8 m × 204.8 m at 0.05 m"""
MAX_RAY_CELLS = 150_000
"""Cells on the rays of one scan; with more, every second (third …) beam clears. Every hit still counts."""
FILLED = 2
"""One in so many of the gaps between neighbouring beams is filled at a scan, in turn"""
FRACTION = 16
"""Bits of a fraction of a cell"""


@dataclass(frozen=True, slots=True)
class MapSettings:
    """Extent of the map and the sensor model of beams."""

    resolution: float = 0.05
    """m per cell"""
    width: float = 60.0
    """m along x, at least"""
    height: float = 60.0
    """m along y, at least"""
    hit: float = 0.84
    """Log-odds, as all of these rounded to steps of `UNIT`"""
    miss: float = 0.41
    low: float = -2.0
    high: float = 3.5
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
            hit=(0.05, 3.9),
            miss=(0.05, 3.9),
            low=(-3.9, -0.05),
            high=(0.05, 3.9),
            farthest=(0.5, 100.0, "m"),
            gap=(0.0, 1.0, "m"),
        )
        cells = self.side(self.width) * self.side(self.height)
        if cells > MAX_CELLS:
            text = f"{self.width:g} m × {self.height:g} m at {self.resolution:g} m need {cells} cells"
            raise ValueError(f"width × height: {text}, and the map must have at most {MAX_CELLS}")

    def side(self, length: float) -> int:
        """Return the cells along a side of the extent: the beams of a robot off its middle lie within it."""
        tile = TILE * self.resolution
        tiles = math.ceil(max(length, 2.0 * self.farthest + 3.0 * tile) / tile)
        return TILE << (tiles - 1).bit_length()


class Map:
    """The map. Plain data: a deep copy continues exactly as the original."""

    def __init__(self, settings: MapSettings) -> None:
        self.settings = settings
        self.resolution = settings.resolution
        self.version = 0
        """Incremented at each change."""
        rows, columns = settings.side(settings.height), settings.side(settings.width)
        self._row0, self._column0 = -rows // 2, -columns // 2
        self._shift = columns.bit_length() - 1
        self._values: Values = np.zeros(rows * columns, dtype=np.int8)
        self._stamps = np.zeros((rows // TILE, columns // TILE), dtype=np.int64)
        """Version at which a class of a tile's cells last changed; 0 if none was ever observed."""
        self._touched = np.zeros_like(self._stamps)
        """Version at which any value in a tile last changed"""
        self._copies: dict[tuple[int, int], Values] = {}
        """Tiles as the last view shows them"""
        self._view: MapView | None = None
        self._rows, self._columns = rows, columns
        self.lines = Lines(rows, columns)
        names = ("hit", "miss", "low", "high")
        self._hit, self._miss, self._low, self._high = (
            np.int8(round(getattr(settings, name) / UNIT)) for name in names
        )

    # -- reading -------------------------------------------------------------------------------

    def cells(self, points: Floats) -> Cells:
        """Return the cells (column, row) of points (n × 2) [m]."""
        cells: Cells = np.floor(points * (1.0 / self.resolution)).astype(np.int64)
        return cells

    def extent(self) -> tuple[int, int, int, int]:
        """Return the cells that are kept: first row, first column, and those after the last."""
        return self._row0, self._column0, self._row0 + self._rows, self._column0 + self._columns

    def values(self, columns: Indices, rows: Indices) -> Values:
        """Return the values of cells; 0 outside of the extent."""
        values = self._values.take(self._places(columns, rows))
        values *= self.inside(columns, rows)
        return values

    def inside(self, columns: Indices, rows: Indices) -> Bools:
        """Return which cells are within the extent."""
        # Modulo 2^64, what lies before the first is far beyond the last: one comparison for both.
        across = (columns - self._column0).view(np.uint64) < self._columns
        up = (rows - self._row0).view(np.uint64) < self._rows
        inside: Bools = across & up
        return inside

    def tile(self, row: int, column: int) -> Values | None:
        """Return the values of a tile (its indices: those of its cells // TILE), None if never observed.

        64 × 64, read-only, shared with the map: it changes with it."""
        first_row, first_column = self._row0 // TILE, self._column0 // TILE
        rows, columns = self._stamps.shape
        if not (0 <= row - first_row < rows and 0 <= column - first_column < columns):
            return None
        row, column = row % rows, column % columns
        if not self._stamps[row, column]:
            return None
        grid = self._values.reshape(self._rows, self._columns)
        tile = grid[row * TILE : (row + 1) * TILE, column * TILE : (column + 1) * TILE]
        tile.flags.writeable = False
        return tile

    def changed(self, since: int) -> list[tuple[int, int]]:
        """Return the tiles (row, column) in which a cell's class changed after a version."""
        return self._after(self._stamps, since)

    def _after(self, stamps: npt.NDArray[np.int64], since: int) -> list[tuple[int, int]]:
        rows, columns = np.nonzero(stamps > since)
        first_row, first_column = self._row0 // TILE, self._column0 // TILE
        rows = first_row + (rows - first_row) % stamps.shape[0]
        columns = first_column + (columns - first_column) % stamps.shape[1]
        return list(zip(rows.tolist(), columns.tolist(), strict=True))

    def view(self) -> MapView:
        """Return the map as a value, the same object until it changes: only changed tiles are copied."""
        before = self._view
        if before is None or before.version != self.version:
            for tile in self._after(self._touched, before.version if before else 0):
                values = self.tile(*tile)
                if values is not None:
                    self._copies[tile] = values.copy()
                    self._copies[tile].flags.writeable = False
            tiles = dict(self._copies) or {(0, 0): np.zeros((TILE, TILE), dtype=np.int8)}
            self._view = before = MapView(self.version, self.resolution, tiles, UNIT)
        return before

    def _places(self, columns: Indices, rows: Indices) -> Indices:
        return ((rows & (self._rows - 1)) << self._shift) | (columns & (self._columns - 1))

    # -- writing -------------------------------------------------------------------------------

    def forget(self) -> None:
        """Forget all that was observed: its tiles change to unknown."""
        observed = self._touched > 0
        self._drop(slice(None), slice(None))
        self._stamps[observed] = self._touched[observed] = self.version

    def recenter(self, x: float, y: float) -> None:
        """Move the extent if a position [m] is more than a tile off its middle."""
        for axis, at in enumerate((y, x)):
            first, side = (self._row0, self._rows) if axis == 0 else (self._column0, self._columns)
            off = math.floor(at / self.resolution) - (first + side // 2)
            if abs(off) <= TILE:
                continue
            moved = round(off / TILE)
            start = first // TILE if moved > 0 else first // TILE + moved
            for tile in range(start, start + min(abs(moved), side // TILE)):
                slot = slice(tile % (side // TILE), tile % (side // TILE) + 1)
                self._drop(*((slot, slice(None)) if axis == 0 else (slice(None), slot)))
            if axis == 0:
                self._row0 += moved * TILE
            else:
                self._column0 += moved * TILE
            self._copies = {at: tile for at, tile in self._copies.items() if self.tile(*at) is not None}

    def _drop(self, rows: slice, columns: slice) -> None:
        """Forget tiles, by where they are in memory."""
        self.version += 1
        observed = np.zeros_like(self._touched)
        observed[rows, columns] = self._touched[rows, columns]
        grid = self._values.reshape(self._stamps.shape[0], TILE, self._stamps.shape[1], TILE)
        for row, column in np.argwhere(observed).tolist():  # memory never written to is not there yet
            grid[row, :, column] = 0
            self._stamps[row, column] = self._touched[row, column] = 0
        self.lines.drop(rows, columns, TILE)

    def add(self, pose: Pose, scan: BodyScan, covariance: Floats) -> None:
        """Add a scan that was taken with the robot at this pose, known to this covariance (3 × 3)."""
        origin = to_world(np.array([scan.origin]), pose)[0]
        self.recenter(float(origin[0]), float(origin[1]))
        self.version += 1
        farthest, per = self.settings.farthest, 1.0 / self.resolution
        beams = rotated(scan.ends - scan.origin, pose.yaw)
        beams *= np.minimum(1.0, farthest / np.maximum(scan.ranges, 1e-9))[:, None]
        hit = scan.hit & (scan.ranges <= farthest)
        start, stops = origin * per, (beams + origin) * per
        passed = self._rays(start, stops[scan.ranges > 0.0])
        columns, rows = np.floor(stops[hit].T).astype(np.int64)
        ends = self._places(columns, rows)
        before = self._values[ends]
        cleared = self._lower(passed)
        self._fill(start, beams * per, scan)
        self._raise(ends, before, self._agree(hit, before))
        cleared = cleared[self._values[cleared] < 0]
        self.lines.forget(cleared, cleared >> self._shift)
        drawn = scan.straight[hit] & (self._values[ends] > 0)
        if drawn.any():
            middles = to_world(scan.middles[hit][drawn], pose) * per
            normals = rotated(scan.normals[hit][drawn], pose.yaw)
            self.lines.draw(columns[drawn], rows[drawn], middles, normals, pose, covariance)

    def _agree(self, hit: Bools, before: Values) -> Bools:
        """Return which hits end in free cells together with a neighbour."""
        denied = np.zeros(len(hit) + 2, dtype=np.bool_)
        denied[1:-1][hit] = before < 0
        both: Bools = denied[1:-1] & (denied[:-2] | denied[2:])
        return both[hit]

    def _lower(self, cells: Indices) -> Indices:
        """Lower cells; return those of them that were occupied before and are not now."""
        before = self._values.take(cells)
        after = np.maximum(before, self._low + self._miss) - self._miss
        after -= after == 0  # observed, and barely free
        lowered = np.flatnonzero(after != before)
        cells, before, after = cells[lowered], before[lowered], after[lowered]
        self._values[cells] = after
        self._mark(cells, (before >= 0) & (after < 0))
        return cells[(before > 0) & (after < 0)]

    def _raise(self, cells: Indices, before: Values, agree: Bools) -> None:
        after = np.minimum(before, self._high - self._hit) + self._hit
        after -= after == 0
        self._values[cells] = after
        self._values[cells[agree]] = min(self._hit, self._high)
        self._mark(cells, (before <= 0) & (self._values[cells] > 0))

    def _mark(self, cells: Indices, otherwise: Bools) -> None:
        """Note that values of these cells have changed, and of some also the class."""
        columns = (cells & (self._columns - 1)) // TILE
        tiles = (cells >> self._shift) // TILE * self._touched.shape[1] + columns
        self._touched.put(tiles, self.version)
        self._stamps.put(tiles[otherwise], self.version)

    def _fill(self, start: Floats, beams: Floats, scan: BodyScan) -> None:
        """Mark unknown cells between neighbouring beams as free, as far as the shorter one reaches and they
        are at most `gap` apart: at each scan along one ray in some of the gaps."""
        first = np.arange(self.version % FILLED, len(beams) - 1, FILLED)
        apart = np.maximum(scan.bearings[first + 1] - scan.bearings[first], 1e-6)
        shorter = np.minimum(scan.ranges[first], scan.ranges[first + 1])
        far = np.minimum(shorter - self.resolution, self.settings.gap / apart) / self.resolution
        near = 1.0 / apart  # nearer, neighbouring beams pass through neighbouring cells
        wide = far > near
        first, near, far = first[wide], near[wide, None], far[wide, None]
        part = self.version // FILLED * GOLDEN % 1.0
        between = beams[first] * ((1.0 - part) / np.maximum(scan.ranges[first], 1e-9))[:, None]
        between += beams[first + 1] * (part / np.maximum(scan.ranges[first + 1], 1e-9))[:, None]
        between *= self.resolution
        cells = self._rays(start + between * near, start + between * far)
        cells = cells[self._values.take(cells) == 0]
        self._values[cells] = max(-self._miss, self._low)
        self._mark(cells, np.ones(len(cells), dtype=np.bool_))

    def _rays(self, start: Floats, stops: Floats) -> Indices:
        """Return where the cells on lines [cells] are in memory, without the last one: one per step of the
        longer side, all lines at once; of too many, evenly chosen ones.

        Column and row are in one integer, each with the bits of its fraction below it, so that one cumulative
        sum makes both; what wraps from the column into the row's fraction is below its rounding."""
        lines = stops - start
        sides = np.abs(lines).T
        lengths = np.ceil(np.maximum(sides[0], sides[1])).astype(np.int64)
        every = math.ceil(int(lengths.sum()) / MAX_RAY_CELLS)
        kept = np.flatnonzero(lengths)[self.version % max(every, 1) :: max(every, 1)]
        if not len(kept):
            return np.zeros(0, dtype=np.int64)
        lines, lengths, half = lines[kept], lengths[kept], FRACTION + self._shift
        step = np.rint(lines * ((1 << FRACTION) / lengths)[:, None]).astype(np.int64)
        first = np.floor(start * (1 << FRACTION)).astype(np.int64)
        first = first[kept] if first.ndim == 2 else np.broadcast_to(first, step.shape)
        steps = (step[:, 1] << half) + step[:, 0]
        at = (first[:, 1] << half) + (first[:, 0] & ((1 << half) - 1))
        path = np.repeat(steps, lengths)
        path[0] = at[0]
        path[np.cumsum(lengths[:-1])] = at[1:] - (at + (lengths - 1) * steps)[:-1]
        np.cumsum(path, out=path)
        rows = path >> (2 * FRACTION)
        rows &= (self._rows - 1) << self._shift
        path >>= FRACTION
        path &= self._columns - 1
        path |= rows
        return path


GOLDEN = (math.sqrt(5.0) - 1.0) / 2.0
"""Its multiples, modulo 1, are spread evenly."""
