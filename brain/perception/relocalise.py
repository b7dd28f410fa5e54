"""Relocalisation: the pose of a scan in the map, without a prior.

Rules. Correlative scan matching by branch and bound. The hits, thinned to one per `THIN`, are laid on the
map at all headings and positions; a pose scores +1 for each hit on an occupied cell (smeared by one cell),
-1 for each in a cell known to be free, 0 in unknown ground. First blocks of SIDE × SIDE cells, exhaustively,
on the maxima over windows of that size: an upper bound of every pose in the block, and one shifted addition
of arrays per point for all blocks at once. Then the cells of the blocks whose bound is high enough. The best
pose of each neighbourhood is refined by `match` and judged beam by beam, at the map's own resolution. A pose
is found only if the scan agrees with the map there, clearly more than at every pose elsewhere, if the match
constrains every direction, and if the robot stands in free ground. Of a very large map, the part about the
place that was looked at last is searched. The pose believed before plays no part: a
robot that was carried may be anywhere. Work is counted in operations; the state in between is plain data.
Sources: Olson 2009 (real-time correlative matching); Hess et al. 2016, section V-B (bounds by maxima).
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Annotated, TypeAlias

import numpy as np
import numpy.typing as npt

from brain.belief import Floats, Pose
from brain.bodies.plane import wrap
from brain.perception.body_scan import BodyScan, Bools, to_world
from brain.perception.lines import TILE
from brain.perception.map import Map
from brain.perception.match import MatchSettings, match
from brain.perception.tiles import Values
from brain.region import about, region_of
from protocols.bounds import Bounds, check


@dataclass(frozen=True, slots=True)
class RelocaliseSettings:
    """When a pose counts as found, and the work of a step."""

    agree: Annotated[float, Bounds(0.5, 1.0)] = 0.75
    """Least share of the scan that agrees with the map: see `agreement`"""
    margin: Annotated[float, Bounds(0.01, 1.0)] = 0.05
    """By how much that share must exceed what might agree elsewhere"""
    caution: Annotated[float, Bounds(0.0, 10.0)] = 0.3
    """By which part of what it lacks to GOOD it must exceed that even more"""
    sigma: Annotated[float, Bounds(0.01, 1.0, "m")] = 0.15
    """m: largest standard deviation of the position found, in any direction"""
    operations: Annotated[int, Bounds(100_000, 10_000_000)] = 600_000
    """Per step, each about 1 ns on a desktop"""

    def __post_init__(self) -> None:
        check(self)


@dataclass(frozen=True, slots=True)
class PoseFound:
    """The only pose that fits."""

    pose: Pose
    covariance: Floats
    """3 × 3, of the match and of the map there"""
    score: float
    """Share of the scan that agrees with the map"""
    runner_up: float
    """Largest share that might agree at a pose elsewhere; 0 if there is none"""


@dataclass(frozen=True, slots=True)
class Ambiguous:
    """Several poses fit."""

    reason: str
    poses: tuple[Pose, ...]
    """Best first"""


@dataclass(frozen=True, slots=True)
class NoPoseFits:
    """No pose fits."""

    reason: str


@dataclass(frozen=True, slots=True)
class PoseSearching:
    """No result yet."""


Result: TypeAlias = PoseFound | Ambiguous | NoPoseFits

CELL = 0.1
"""m: side of a cell of the search, as nearly as whole cells of the map allow"""
SIDE = 4
"""Cells along the side of a block"""
THIN = 0.2
"""m: at most one hit is used in each square of this side"""
POINTS = 20, 96
"""Least number of hits: fewer recognise no place. Largest number, evenly chosen: sums fit into 8 bits."""
FAR = 250
"""Cells from the robot within which hits are used: a step of the heading moves farther ones too much"""
HEADINGS = 180, 720
"""Least and largest number of headings"""
FLOOR = 0.4
"""Least score, over the number of points, of a pose that is examined"""
SPREAD = 0.25
"""Poses whose score is lower than the best one's by so much are not examined"""
BLOCKS, POSES = 8192, 24
"""Largest number of blocks whose cells are examined, and of poses that are refined"""
GOOD = 0.9
"""Share of the scan that agrees with a map in which hardly anything has changed"""
ELSEWHERE, ELSEWHERE_YAW = 0.5, 0.35
"""m, rad: poses farther apart are different places"""
CHUNK = 48
"""Points, or blocks, that are worked on between two looks at the count of operations"""
CALL = 1000
"""Operations that a call on arrays counts for, beside those for their elements"""


class PoseSearch:
    """One search, for one scan taken while standing."""

    def __init__(
        self, chart: Map, scan: BodyScan, settings: RelocaliseSettings, matching: MatchSettings
    ) -> None:
        self._map, self._scan, self._settings, self._matching = chart, scan, settings, matching
        self._fine = 2 ** max(0, min(4, round(math.log2(CELL / chart.resolution))))
        """Cells of the map along the side of one of the search"""
        self._cell = self._fine * chart.resolution
        self._points = _thinned(scan.ends[scan.hit], FAR * self._cell)
        known = chart.known()
        region = about(chart.middle, region_of(known)) if known else (range(0), range(0))
        self._tiles = [(row, column) for row, column in known if row in region[0] and column in region[1]]
        self.result: Result | None = None
        if len(self._points) < POINTS[0] or not self._tiles:
            self.result = NoPoseFits(
                f"{len(self._points)} separate hits, {len(self._tiles)} tiles of the map"
            )
            return
        ranges = np.hypot(*self._points.T) / self._cell
        headings = math.ceil(2.0 * math.pi * float(np.quantile(ranges, 0.8)))
        self._turn = 2.0 * math.pi / min(max(headings, HEADINGS[0]), HEADINGS[1])
        self._headings = round(2.0 * math.pi / self._turn)
        self._corner = np.array([region[0].start, region[1].start])
        """Tile (row, column) at the corner of the search"""
        rows, columns = (len(span) * (TILE // self._fine) for span in region)
        self._border = (math.ceil(float(ranges.max())) // SIDE + 2) * SIDE
        """Unknown cells about the map: no point of a pose inside lies outside"""
        high, wide = rows + 2 * self._border, columns + 2 * self._border
        self._cells: Values = np.zeros((high, wide), dtype=np.int8)
        self._maxima = np.zeros((high // SIDE, SIDE, SIDE, wide // SIDE), dtype=np.int8)
        """Over the window of SIDE × SIDE cells that begins at a cell: block's row, phases, block's column"""
        self._free = np.zeros((rows // SIDE, columns // SIDE), dtype=np.bool_)
        """Blocks in which a cell of the map is free"""
        self._sum: Values = np.zeros(self._free.shape, dtype=np.int8)
        self._offsets = np.zeros((len(self._points), self._headings), dtype=np.int32)
        """From the robot's cell to each point's, in the flat array of cells"""
        self._band = self._heading = self._point = self._examined = 0
        """How far each part of the work is"""
        self._blocks = np.zeros((0, 3), dtype=np.int64)
        """Bound, heading, flat index"""
        self._missed = self._best = 0
        """Highest bound, or score, of what was dropped; highest score so far"""
        self._scores = np.zeros((0, 4), dtype=np.int64)
        """Score, heading, row, column"""
        self._left: list[Pose] | None = None
        """Poses to be refined"""
        self._refined: list[tuple[float, float, Pose, Floats | None]] = []
        """Agreement, least and most; pose; covariance if there is a match"""

    def advance(self, operations: int) -> Result | PoseSearching:
        """Work on for about so many operations, at least one part, or until there is a result."""
        while self.result is None and operations > 0:
            if self._tiles:
                operations -= self._add_tile(*self._tiles.pop())
            elif self._band < len(self._maxima):
                operations -= self._add_band()
            elif self._heading < self._headings:
                operations -= self._add_points()
            elif self._left is None:
                operations -= self._examine()
            elif self._left:
                operations -= self._refine(self._left.pop(0))
            else:
                self.result = self._decide()
        return self.result or PoseSearching()

    # -- cells and maxima ------------------------------------------------------------------------

    def _add_tile(self, row: int, column: int) -> int:
        values = np.zeros((TILE + 2, TILE + 2), dtype=np.int8)
        for down, (to_rows, from_rows) in EDGES.items():
            for right, (to_columns, from_columns) in EDGES.items():
                tile = self._map.tile(row + down, column + right)
                if tile is not None:
                    values[to_rows, to_columns] = tile[from_rows, from_columns]
        occupied = values > 0
        occupied = occupied[1:-1] | occupied[:-2] | occupied[2:]
        occupied = occupied[:, 1:-1] | occupied[:, :-2] | occupied[:, 2:]
        free = values[1:-1, 1:-1] < 0
        cells = _merged(occupied.astype(np.int8) - (free & ~occupied), self._fine)
        top, left = (np.array([row, column]) - self._corner) * len(cells)
        self._cells[self._border :, self._border :][top : top + len(cells), left : left + len(cells)] = cells
        blocks = _merged(free, self._fine * SIDE)
        top, left = top // SIDE, left // SIDE
        self._free[top : top + len(blocks), left : left + len(blocks)] = blocks
        return 40 * CALL + 8 * TILE * TILE

    def _add_band(self) -> int:
        """Take the maxima for one row of blocks: over windows of 1, 2, 4 … cells."""
        rows = self._cells[self._band * SIDE : (self._band + 2) * SIDE]
        high, wide = rows.shape
        window = np.zeros((2 * SIDE, wide + SIDE), dtype=np.int8)
        window[:high, :wide] = rows
        step = 1
        while step < SIDE:
            window[:-step] = np.maximum(window[:-step], window[step:])
            window[:, :-step] = np.maximum(window[:, :-step], window[:, step:])
            step *= 2
        by_block = window[:SIDE, :wide].reshape(SIDE, wide // SIDE, SIDE)
        self._maxima[self._band] = by_block.transpose(0, 2, 1)
        self._band += 1
        return 10 * CALL + 8 * window.size

    # -- blocks ------------------------------------------------------------------------------------

    def _add_points(self) -> int:
        """Add some points at the present heading to all blocks' sums; after the last, keep blocks."""
        half = 0.5 * self._cell
        some = slice(self._point, self._point + CHUNK)
        turned = to_world(self._points[some], Pose(half, half, self._heading * self._turn))
        columns, rows = np.floor(turned / self._cell).astype(np.int64).T + self._border
        self._offsets[some, self._heading] = rows * self._cells.shape[1] + columns
        parts = (rows % SIDE, columns % SIDE, rows // SIDE, columns // SIDE)
        high, wide = self._sum.shape
        for down, right, row, column in zip(*(part.tolist() for part in parts), strict=True):
            self._sum += self._maxima[row : row + high, down, right, column : column + wide]
        self._point += CHUNK
        if self._point >= len(self._points):
            bounds = self._sum.reshape(-1)
            blocks = np.flatnonzero((bounds >= FLOOR * len(self._points)) & self._free.reshape(-1))
            new = np.column_stack([bounds[blocks], np.full(len(blocks), self._heading), blocks])
            self._blocks = np.concatenate([self._blocks, new])
            if len(self._blocks) > 2 * BLOCKS:
                self._sort()
            self._sum[:] = 0
            self._heading, self._point = self._heading + 1, 0
        return len(rows) * (CALL + self._sum.size // 16) + 20 * CALL

    def _sort(self) -> None:
        """Keep the blocks with the highest bounds."""
        order = np.argsort(-self._blocks[:, 0], kind="stable")
        self._missed = max(self._missed, int(self._blocks[order[BLOCKS:], 0].max(initial=0)))
        self._blocks = self._blocks[order[:BLOCKS]]

    # -- poses -------------------------------------------------------------------------------------

    def _examine(self) -> int:
        """Score all cells of some blocks, those with the highest bounds first."""
        if self._examined == 0:
            self._sort()
        some = self._blocks[self._examined : self._examined + CHUNK]
        some = some[some[:, 0] >= self._best - SPREAD * len(self._points)]
        if not len(some):
            self._left = self._separate()
            return 1000 * CALL
        self._examined += CHUNK
        wide = self._cells.shape[1]
        rows, columns = (SIDE * part for part in np.divmod(some[:, 2], self._sum.shape[1]))
        inside = (np.arange(SIDE)[:, None] * wide + np.arange(SIDE)).reshape(-1)
        index = self._offsets[:, some[:, 1], None] + ((rows * wide + columns)[:, None] + inside)
        scores = self._cells.reshape(-1)[index].sum(axis=0, dtype=np.int8)
        cell = np.argmax(scores, axis=1)
        score = scores[np.arange(len(some)), cell]
        new = np.column_stack([score, some[:, 1], rows + cell // SIDE, columns + cell % SIDE])
        self._scores = np.concatenate([self._scores, new])
        self._best = max(self._best, int(score.max()))
        return 20 * CALL + 3 * int(index.size)

    def _separate(self) -> list[Pose]:
        """Return the best pose of each neighbourhood, best first."""
        least = max(FLOOR * len(self._points), self._best - SPREAD * len(self._points))
        order = np.argsort(-self._scores[:, 0], kind="stable")
        scores = self._scores[order][self._scores[order, 0] >= least]
        y, x = ((scores[:, 2:] + self._corner * (TILE // self._fine) + 0.5) * self._cell).T
        yaw = scores[:, 1] * self._turn
        poses: list[Pose] = []
        left = np.ones(len(scores), dtype=np.bool_)
        while left.any() and len(poses) < POSES:
            first = int(np.argmax(left))
            poses.append(Pose(float(x[first]), float(y[first]), wrap(float(yaw[first]))))
            turn = np.abs(np.mod(yaw - yaw[first] + math.pi, 2.0 * math.pi) - math.pi)
            left &= (np.hypot(x - x[first], y - y[first]) > ELSEWHERE) | (turn > ELSEWHERE_YAW)
        self._missed = max(self._missed, int(scores[left, 0].max(initial=0)))
        return poses

    def _refine(self, pose: Pose) -> int:
        """Refine a pose by a match, unless much less agrees then; drop it if it is not in free ground."""
        least, most, _ = agreement(self._map, self._scan, pose)
        found, covariance = match(self._map, self._scan, pose, self._cell, self._matching), None
        if found is not None:
            refined = agreement(self._map, self._scan, found.pose)
            most = max(most, refined[1])
            if refined[0] > least - self._settings.margin:
                least, pose, covariance = refined[0], found.pose, found.noise + found.shared
        columns, rows = (self._map.cells(np.array([[pose.x, pose.y]])) + AROUND).T
        if (self._map.values(columns, rows) < 0).any():
            self._refined.append((least, most, pose, covariance))
        return 1000 * CALL

    def _decide(self) -> Result:
        if not self._refined:
            return NoPoseFits("no pose in free ground lets the scan fit the map")
        score, _, pose, covariance = max(self._refined, key=lambda one: one[0])
        settings = self._settings
        if score < settings.agree:
            return NoPoseFits(f"at the best pose only {score:.0%} of the scan agrees with the map")
        if covariance is None:
            return NoPoseFits("the best pose has no match on the map's lines")
        margin = settings.margin + settings.caution * max(GOOD - score, 0.0)
        elsewhere = [(most, other) for _, most, other, _ in self._refined if _elsewhere(other, pose)]
        runner_up = max((most for most, _ in elsewhere), default=0.0)
        alike = (pose, *(other for most, other in elsewhere if most > score - margin))
        if len(alike) > 1:
            text = f"{len(alike)} places look alike: {score:.0%} and up to {runner_up:.0%} of the scan agree"
            return Ambiguous(text, alike)
        if self._missed > self._best - margin * len(self._points):
            return Ambiguous("more poses fit than can be examined", alike)
        if np.linalg.eigvalsh(covariance[:2, :2])[-1] > settings.sigma**2:
            return Ambiguous("a direction is open, as along a corridor", alike)
        return PoseFound(pose, covariance, score, runner_up)


EDGES = {
    -1: (slice(0, 1), slice(TILE - 1, TILE)),
    0: (slice(1, TILE + 1), slice(None)),
    1: (slice(TILE + 1, TILE + 2), slice(0, 1)),
}
"""A tile with one cell of its neighbours about it: where they go, and which they are of the neighbour's"""
AROUND = np.array([(column, row) for column in (-1, 0, 1) for row in (-1, 0, 1)])
BESIDE = np.array([(0, 0), (-1, 0), (1, 0), (0, -1), (0, 1)])


def _elsewhere(one: Pose, other: Pose) -> bool:
    apart = math.dist((one.x, one.y), (other.x, other.y))
    return apart > ELSEWHERE or abs(wrap(one.yaw - other.yaw)) > ELSEWHERE_YAW


def _thinned(points: Floats, far: float) -> Floats:
    """Return at most one point (n × 2) per square of THIN, within a distance [m], and not too many."""
    points = points[np.hypot(points[:, 0], points[:, 1]) < far]
    squares = np.floor(points / THIN).astype(np.int64)
    first = np.sort(np.unique(squares[:, 0] * 2**20 + squares[:, 1], return_index=True)[1])
    most = min(len(first), POINTS[1])
    thinned: Floats = points[first[np.arange(most) * len(first) // max(most, 1)]]
    return thinned


def _merged(cells: npt.NDArray[np.generic], side: int) -> npt.NDArray[np.generic]:
    """Return the largest value in each square of side × side cells; the side is a power of 2."""
    while side > 1:
        cells = np.maximum(cells[::2], cells[1::2])
        cells = np.maximum(cells[:, ::2], cells[:, 1::2])
        side //= 2
    return cells


BEAMS, SAMPLES = 180, 24
"""Largest number of beams that are judged, and of places along each"""
CLEAR = 0.3
"""m before a beam's end in which what it passes is not judged"""


def agreement(chart: Map, scan: BodyScan, pose: Pose) -> tuple[float, float, float]:
    """Return the share of the scan, taken at this pose, that agrees with the map, at least and at most, and
    the share of its beams that pass through occupied cells.

    A beam agrees if it ends on an occupied cell or beside one; it contradicts the map if it ends in a free
    cell or passes through an occupied one. At least: a hit in unknown ground counts half against the map; at
    most: it does not count, where at least half of the hits lie in known ground. Each beam weighs as much as
    its range: so long is the piece of wall that it stands for. What stands before a wall shortens beams; that
    they pass through walls as well shows a wrong pose."""
    read = np.flatnonzero(scan.ranges > 0.0)
    read = read[:: math.ceil(len(read) / BEAMS) or 1]
    if not len(read):
        return 0.0, 0.0, 0.0
    ranges, hit, ends = scan.ranges[read], scan.hit[read], to_world(scan.ends[read], pose)
    origin = scan.place(pose)
    chart.recenter(*origin)
    columns, rows = (chart.cells(ends)[:, None] + BESIDE).reshape(-1, 2).T
    beside = chart.values(columns, rows).reshape(-1, len(BESIDE))
    share = (np.arange(SAMPLES) + 0.5) / SAMPLES * np.maximum(1.0 - CLEAR / ranges, 0.0)[:, None]
    passed = origin + share[:, :, None] * (ends - origin)[:, None, :]
    columns, rows = chart.cells(passed.reshape(-1, 2)).T
    pierced: Bools = np.any((chart.values(columns, rows) > 0).reshape(share.shape), axis=1)
    on = hit & (beside > 0).any(axis=1)
    agrees = float(ranges[on & ~pierced].sum())
    denies = float(ranges[(hit & ~on & (beside[:, 0] < 0)) | pierced].sum())
    unknown = float(ranges[hit & ~on & ~pierced & (beside[:, 0] == 0)].sum())
    known = max(agrees + denies, 1e-9)
    least = agrees / (known + unknown / 2.0)
    return least, agrees / known if known > unknown else least, float(np.mean(pierced))
