"""The occupancy map, in the frame "map": log-odds of the cells of an unbounded plane.

Rules. Which cells are kept, and where: see `Tiles`. No cost of a scan depends on what was seen elsewhere.
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
from typing import Annotated

import numpy as np

from brain.belief import Floats, Pose
from brain.perception.body_scan import BodyScan, Bools, rotated, to_world
from brain.perception.lines import TILE
from brain.perception.saved_map import SavedMap
from brain.perception.tiles import BITS, UNIT, Indices, Tiles, Values
from protocols.bounds import Bounds, Invalid, check

MAX_RAY_CELLS = 150_000
"""Cells on the rays of one scan; with more, every second (third …) beam clears. Every hit still counts."""
FILLED = 2
"""One in so many of the gaps between neighbouring beams is filled at a scan, in turn"""
FRACTION = 16
"""Bits of a fraction of a cell"""


@dataclass(frozen=True, slots=True)
class MapSettings:
    """Size of the map and the sensor model of beams."""

    resolution: Annotated[float, Bounds(0.01, 0.5, "m")] = 0.05
    """m per cell"""
    tiles: Annotated[int, Bounds(16, 65_536)] = 4096
    """Of 64 × 64 cells, that are kept at most: 205 m × 205 m at 0.05 m, all of it observed. Each needs 4 to
    17 KB, and as much again in planning and views."""
    hit: Annotated[float, Bounds(0.05, 3.9)] = 0.84
    """Log-odds, as all of these rounded to steps of `UNIT`"""
    miss: Annotated[float, Bounds(0.05, 3.9)] = 0.41
    """Log-odds by which a cell that a beam passed through is lowered"""
    low: Annotated[float, Bounds(-3.9, -0.05)] = -2.0
    """Log-odds, the least of a cell"""
    high: Annotated[float, Bounds(0.05, 3.9)] = 3.5
    """Log-odds, the most of a cell"""
    farthest: Annotated[float, Bounds(0.5, 100.0, "m")] = 12.0
    """m: largest range of beams that is used"""
    gap: Annotated[float, Bounds(0.0, 1.0, "m")] = 0.2
    """m between neighbouring beams, below which no relevant obstacle fits unseen between them"""

    def __post_init__(self) -> None:
        check(self)
        least = self.across**2
        if self.tiles < least:
            text = f"{least} tiles lie about the robot where beams reach ({self.farthest:g} m)"
            raise Invalid(("tiles", f"tiles: {text}, and the map must have at least these, not {self.tiles}"))

    @property
    def across(self) -> int:
        """Tiles along the sides of a square in which lie the beams of a lidar that is a tile off its middle:
        a power of two."""
        return 1 << (math.ceil(2.0 * self.farthest / (TILE * self.resolution)) + 2).bit_length()


class Map(Tiles):
    """The map. Plain data: a deep copy continues exactly as the original."""

    def __init__(self, settings: MapSettings, saved: SavedMap | None = None) -> None:
        """`saved`: what is known of the ground from before."""
        super().__init__(settings.resolution, settings.across, settings.tiles)
        self.settings, self._saved = settings, saved
        names = ("hit", "miss", "low", "high")
        self._hit, self._miss, self._low, self._high = (
            np.int8(round(getattr(settings, name) / UNIT)) for name in names
        )
        self._lay()

    def anew(self) -> Map:
        """Return a map to be drawn again from keyframes: what was saved without them is in it."""
        drawn = self._saved is not None and self._saved.keyframes is not None
        return Map(self.settings, None if drawn else self._saved)

    def forget(self) -> None:
        """Forget all that was observed: what is known is what it began with."""
        super().forget()
        self._lay()

    def _lay(self) -> None:
        """Take what is known from before."""
        if (saved := self._saved) is None:
            return
        self.version += 1
        firsts = {tile: self.put(tile, values) for tile, values in saved.tiles()}
        walls = saved.walls
        tiles = np.column_stack([walls.rows >> BITS, walls.columns >> BITS])
        which, at = np.unique(tiles, axis=0, return_inverse=True)
        first = np.array([firsts[row, column] for row, column in which.tolist()], dtype=np.int64)
        _, within = self._parts(walls.columns, walls.rows)
        surfaces = walls.normals * walls.offsets[:, None]
        sure = np.diag([saved.variance, saved.variance, 0.0])
        if len(first):
            places = first[at.reshape(-1)] + within
            self.lines.draw(places, surfaces, walls.normals, Pose(0.0, 0.0, 0.0), sure)

    def add(self, pose: Pose, scan: BodyScan, covariance: Floats) -> None:
        """Add a scan that was taken with the robot at this pose, known to this covariance (3 × 3)."""
        origin = scan.place(pose)
        self.recenter(*origin)
        self.version += 1
        farthest, per = self.settings.farthest, 1.0 / self.resolution
        beams = rotated(scan.ends - scan.origin, pose.yaw)
        beams *= np.minimum(1.0, farthest / np.maximum(scan.ranges, 1e-9))[:, None]
        hit = scan.hit & (scan.ranges <= farthest)
        start, stops = np.array(origin) * per, (beams + origin) * per
        passed = self._rays(start, stops[scan.ranges > 0.0])
        columns, rows = np.floor(stops[hit].T).astype(np.int64)
        ends = self._placed(*self._parts(columns, rows))
        before = self._values[ends]
        cleared = self._lower(passed)
        del passed
        self._fill(start, beams * per, scan)
        self._raise(ends, before, self._agree(hit, before))
        cleared = cleared[self._values[cleared] < 0]
        self.lines.forget(cleared)
        drawn = scan.straight[hit] & (self._values[ends] > 0)
        if drawn.any():
            middles = to_world(scan.middles[hit][drawn], pose) * per
            normals = rotated(scan.normals[hit][drawn], pose.yaw)
            cells = np.column_stack([columns[drawn], rows[drawn]])
            self.lines.draw(ends[drawn], middles - cells - 0.5, normals, pose, covariance)

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
        self._write(cells, after, (before >= 0) & (after < 0))
        return cells[(before > 0) & (after < 0)]

    def _raise(self, cells: Indices, before: Values, agree: Bools) -> None:
        after = np.minimum(before, self._high - self._hit) + self._hit
        after -= after == 0
        self._values[cells] = after
        self._values[cells[agree]] = min(self._hit, self._high)
        after = self._values[cells]
        self._write(cells, after, (before <= 0) & (after > 0))

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
        self._write(cells, max(-self._miss, self._low), np.ones(len(cells), dtype=np.bool_))

    def _rays(self, start: Floats, stops: Floats) -> Indices:
        """Return the places of the cells on lines [cells], without the last one: one per step of the
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
        lines, lengths, half = lines[kept], lengths[kept], FRACTION + self._shift + BITS
        step = np.rint(lines * ((1 << FRACTION) / lengths)[:, None]).astype(np.int64)
        first = np.floor(start * (1 << FRACTION)).astype(np.int64)
        first = first[kept] if first.ndim == 2 else np.broadcast_to(first, step.shape)
        steps = (step[:, 1] << half) + step[:, 0]
        at = (first[:, 1] << half) + (first[:, 0] & ((1 << half) - 1))
        path = np.repeat(steps, lengths)
        path[0] = at[0]
        path[np.cumsum(lengths[:-1])] = at[1:] - (at + (lengths - 1) * steps)[:-1]
        np.cumsum(path, out=path)
        mask, row = self._across - 1, FRACTION + half
        tiles = (path >> (row + BITS - self._shift)) & (mask << self._shift)
        tiles |= (path >> (FRACTION + BITS)) & mask
        cells = (path >> (row - BITS)) & ((TILE - 1) << BITS)
        path >>= FRACTION
        path &= TILE - 1
        cells |= path
        del path
        return self._placed(tiles, cells)


GOLDEN = (math.sqrt(5.0) - 1.0) / 2.0
"""Its multiples, modulo 1, are spread evenly."""
