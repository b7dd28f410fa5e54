"""Relocalisation: the pose of a scan in the map, without a prior.

Rules. Correlative scan matching by branch and bound. The scan's hits, thinned to one per 0.2 m, are laid on the
map at all headings and positions; a pose scores +1 for each hit on an occupied cell (smeared by one cell), -1 for
each in a cell known to be free, 0 in unknown ground, over their number. Two levels: blocks of 4 × 4 cells of 0.1 m
on the maxima over windows of that size, an upper bound of every pose inside, exhaustively (a point is one shifted
addition of arrays, for all blocks at once); then the positions within those blocks whose bound is high enough. What
is best in each neighbourhood, a mode, is refined by `match` and judged beam by beam at the map's own resolution.
A pose is found only if enough beams agree with the map, clearly more than at every pose elsewhere, if the match
constrains every direction, and if the robot then stands in free ground. No pose is nearer to the truth than another
because it is nearer to the one believed before: a robot that was carried may be anywhere.
All work is counted; the state in between is plain data.
Sources: Olson 2009 (real-time correlative scan matching); Hess et al. 2016, section V-B (bounds by maxima).
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TypeAlias

import numpy as np
import numpy.typing as npt

from brain.belief import Floats, Pose
from brain.bodies.differential import wrap
from brain.checks import within
from brain.perception.map import TILE, Map
from brain.perception.mount import BodyScan, to_world
from brain.perception.scan_match import MatchSettings, match

Bytes = npt.NDArray[np.int8]
Indices = npt.NDArray[np.int64]


@dataclass(frozen=True, slots=True)
class RelocaliseSettings:
    """When a pose counts as found."""

    operations: int = 600_000
    """Per step, each about 1 ns on a desktop: see `Search.advance`"""
    points: int = 96
    """Largest number of hits of the scan that are laid on the map, evenly chosen"""
    least: int = 20
    """Least number of them: a scan with fewer recognises no place"""
    floor: float = 0.4
    """Least score of a pose that is looked at more closely"""
    agree: float = 0.72
    """Least share of the scan that agrees with the map: see `agreement`"""
    margin: float = 0.05
    """By how much that share must exceed the one at every pose elsewhere"""
    elsewhere: float = 0.5
    """m: poses that are farther apart than this, or than `elsewhere_yaw`, are different places"""
    elsewhere_yaw: float = 0.35
    """rad"""
    sigma: float = 0.15
    """m: largest standard deviation of the pose found, in any direction"""

    def __post_init__(self) -> None:
        within(
            self,
            operations=(10_000, 1e9),
            points=(20, 120),
            least=(5, 120),
            floor=(0.05, 1.0),
            agree=(0.1, 1.0),
            margin=(0.01, 1.0),
            elsewhere=(0.05, 10.0, "m"),
            elsewhere_yaw=(0.01, 3.2, "rad"),
            sigma=(0.01, 10.0, "m"),
        )


@dataclass(frozen=True, slots=True)
class Found:
    """The only pose that fits."""

    pose: Pose
    covariance: Floats
    """3 × 3, of the match and of the map there"""
    score: float
    """Share of the scan that agrees with the map"""
    runner_up: float
    """The same of the best pose elsewhere; 0 if there is none"""


@dataclass(frozen=True, slots=True)
class Ambiguous:
    """Several poses fit."""

    reason: str
    poses: tuple[Pose, ...]
    """Best first"""


@dataclass(frozen=True, slots=True)
class NotFound:
    """No pose fits."""

    reason: str


@dataclass(frozen=True, slots=True)
class Searching:
    """The search needs further steps."""


Result: TypeAlias = Found | Ambiguous | NotFound


@dataclass(frozen=True, slots=True)
class Mode:
    """A pose that scores best in its neighbourhood, refined."""

    pose: Pose
    covariance: Floats | None
    """None if no match refined it"""
    agree: float


SIDE = 4
"""Cells of the search along a block's side"""
CELL = 0.1
"""m: side of a cell of the search, as nearly as the map's own cells allow"""
THIN = 0.2
"""m: at most one hit is used in each square of this side"""
FAR = 250
"""Cells from the robot within which hits are used: a step of the heading moves farther ones too much"""
HEADINGS = (180, 720)
CANDIDATES = 8192
"""Blocks kept for the second level"""
SPREAD = 0.25
"""Poses that score by so much less than the best one need no closer look"""
MODES = 10
CHUNK = 48
"""Blocks of the second level, and beams of the first, that are worked on at once"""
CALL = 1000
"""Operations that count for a call on arrays, beside their elements"""


class Search:
    """One search, for one scan taken while standing. `advance` until it returns a result."""

    def __init__(
        self, map_: Map, scan: BodyScan, settings: RelocaliseSettings, matching: MatchSettings
    ) -> None:
        self._map, self._scan, self._settings, self._matching = map_, scan, settings, matching
        self._fine = 2 ** max(0, min(4, round(math.log2(CELL / map_.resolution))))
        """Cells of the map along a side of one of the search"""
        self._cell = self._fine * map_.resolution
        self._points = _thinned(scan.ends[scan.hit], self._cell, settings.points)
        self._tiles = map_.observed()
        self.result: Result | None = None
        if len(self._points) < settings.least:
            self.result = NotFound(f"the scan has only {len(self._points)} separate hits")
            return
        if not self._tiles:
            self.result = NotFound("the map is empty")
            return
        self._lay_out()

    def _lay_out(self) -> None:
        ranges = np.hypot(*self._points.T) / self._cell
        count = math.ceil(2.0 * math.pi * float(np.quantile(ranges, 0.8)))
        self._headings = min(max(count, HEADINGS[0]), HEADINGS[1])
        tiles = np.array(self._tiles)
        (row0, column0), (row1, column1) = tiles.min(axis=0), tiles.max(axis=0) + 1
        self._corner = int(row0), int(column0)
        """Tile in the corner of the search"""
        side = TILE // self._fine
        rows, columns = int(row1 - row0) * side, int(column1 - column0) * side
        self._border = (math.ceil(float(ranges.max())) // SIDE + 2) * SIDE
        """Unknown cells about the map, so that no point of a pose inside lies outside"""
        shape = rows + 2 * self._border, columns + 2 * self._border
        self._cells: Bytes = np.zeros(shape, dtype=np.int8)
        self._blocks = np.zeros((SIDE, SIDE, shape[0] // SIDE, shape[1] // SIDE), dtype=np.int8)
        """Largest value in the window of SIDE × SIDE cells that begins at a cell, by phase and block"""
        self._standing = np.zeros((rows // SIDE, columns // SIDE), dtype=np.bool_)
        """Blocks in which some of the map's cells are free"""
        self._band = 0
        self._offsets = np.zeros((len(self._points), self._headings), dtype=np.int32)
        """Of each point at each heading, from the robot's cell, in the flat array of cells"""
        self._heading = self._point = 0
        self._shifts: list[tuple[int, int, int, int]] = []
        self._sum: Bytes = np.zeros_like(self._standing, dtype=np.int8)
        self._candidates = np.zeros((0, 3), dtype=np.int64)
        """Bound, heading, flat block"""
        self._missed = 0
        """Largest bound of those that were dropped"""
        self._examined = 0
        self._leaves = np.zeros((0, 4), dtype=np.int64)
        """Score, heading, row, column"""
        self._best = 0
        self._seeds: list[Pose] | None = None
        self._modes: list[Mode] = []

    def advance(self, operations: int) -> Result | Searching:
        """Work on for about so many operations, at least one part; return the result once there is one."""
        while self.result is None and operations > 0:
            operations -= self._work()
        return self.result or Searching()

    def _work(self) -> int:
        if self._tiles:
            return self._add_tile(*self._tiles.pop())
        if self._band < self._blocks.shape[2]:
            return self._add_band()
        if self._heading < self._headings:
            return self._bound()
        if self._seeds is None:
            return self._descend()
        if self._seeds:
            return self._refine(self._seeds.pop(0))
        self.result = self._decide()
        return 0

    # -- what the search is made on --------------------------------------------------------------

    def _add_tile(self, row: int, column: int) -> int:
        values = np.zeros((TILE + 2, TILE + 2), dtype=np.float32)
        for down, (to_rows, from_rows) in EDGES.items():
            for right, (to_columns, from_columns) in EDGES.items():
                tile = self._map.tile(row + down, column + right)
                if tile is not None:
                    values[to_rows, to_columns] = tile[from_rows, from_columns]
        occupied = values > 0.0
        occupied = occupied[1:-1] | occupied[:-2] | occupied[2:]
        occupied = occupied[:, 1:-1] | occupied[:, :-2] | occupied[:, 2:]
        free = values[1:-1, 1:-1] < 0.0
        cells = occupied.astype(np.int8)
        cells[free & ~occupied] = -1
        cells = _merged(cells, self._fine)
        top, left = (row - self._corner[0]) * len(cells), (column - self._corner[1]) * len(cells)
        down, right = top + self._border, left + self._border
        self._cells[down : down + len(cells), right : right + len(cells)] = cells
        standing = _merged(free, self._fine * SIDE)
        top, left = top // SIDE, left // SIDE
        self._standing[top : top + len(standing), left : left + len(standing)] = standing
        return 40 * CALL + 8 * TILE * TILE

    def _add_band(self) -> int:
        """Take the maxima over windows for one row of blocks: of windows of 1, 2, 4 … cells."""
        top = self._band * SIDE
        rows = self._cells[top : top + 2 * SIDE]
        width = rows.shape[1]
        window = np.zeros((2 * SIDE, width + SIDE), dtype=np.int8)
        window[: len(rows), :width] = rows
        step = 1
        while step < SIDE:
            window[:-step] = np.maximum(window[:-step], window[step:])
            window[:, :-step] = np.maximum(window[:, :-step], window[:, step:])
            step *= 2
        phases = window[:SIDE, :width].reshape(SIDE, width // SIDE, SIDE)
        self._blocks[:, :, self._band] = phases.transpose(0, 2, 1)
        self._band += 1
        return 10 * CALL + 8 * window.size

    # -- first level: blocks -----------------------------------------------------------------------

    def _bound(self) -> int:
        """Add up some points for all blocks at this heading; after the last, keep the blocks worth a look."""
        if self._point == 0:
            turned = to_world(
                self._points, Pose(0.5 * self._cell, 0.5 * self._cell, self._yaw(self._heading))
            )
            columns, rows = np.floor(turned / self._cell).astype(np.int64).T + self._border
            self._offsets[:, self._heading] = rows * self._cells.shape[1] + columns
            places = (rows % SIDE, columns % SIDE, rows // SIDE, columns // SIDE)
            self._shifts = list(zip(*(place.tolist() for place in places), strict=True))
            self._sum[:] = 0
        high, wide = self._sum.shape
        some = self._shifts[self._point : self._point + CHUNK]
        for phase_row, phase_column, row, column in some:
            self._sum += self._blocks[phase_row, phase_column, row : row + high, column : column + wide]
        self._point += len(some)
        if self._point == len(self._shifts):
            self._keep()
            self._point = 0
            self._heading += 1
        return len(some) * (CALL + self._sum.size // 16) + 20 * CALL

    def _keep(self) -> None:
        least = math.ceil(self._settings.floor * len(self._points))
        blocks = np.flatnonzero((self._sum >= least) & self._standing)
        if not len(blocks):
            return
        bounds = self._sum.reshape(-1)[blocks].astype(np.int64)
        new = np.column_stack([bounds, np.full(len(blocks), self._heading), blocks])
        self._candidates = np.concatenate([self._candidates, new])
        if len(self._candidates) > 2 * CANDIDATES:
            self._sort_candidates()

    def _sort_candidates(self) -> None:
        order = np.argsort(-self._candidates[:, 0], kind="stable")
        dropped = self._candidates[order[CANDIDATES:], 0]
        self._missed = max(self._missed, int(dropped.max(initial=0)))
        self._candidates = self._candidates[order[:CANDIDATES]]

    def _yaw(self, heading: int) -> float:
        return wrap(2.0 * math.pi * heading / self._headings)

    # -- second level: cells in blocks ---------------------------------------------------------------

    def _descend(self) -> int:
        """Score all cells of some blocks, those with the highest bounds first."""
        if self._examined == 0:
            self._sort_candidates()
        some = self._candidates[self._examined : self._examined + CHUNK]
        some = some[some[:, 0] >= self._best - SPREAD * len(self._points)]
        if not len(some):
            self._seeds = self._separate()
            return 1000 * CALL
        self._examined += CHUNK
        width = self._cells.shape[1]
        rows, columns = (SIDE * place for place in np.divmod(some[:, 2], self._sum.shape[1]))
        inside = (np.arange(SIDE)[:, None] * width + np.arange(SIDE)).reshape(-1)
        places = (rows * width + columns)[:, None] + inside
        index = self._offsets[:, some[:, 1]][:, :, None] + places
        scores = self._cells.reshape(-1)[index].sum(axis=0, dtype=np.int8)
        best = np.argmax(scores, axis=1)
        score = scores[np.arange(len(some)), best].astype(np.int64)
        leaves = np.column_stack([score, some[:, 1], rows + best // SIDE, columns + best % SIDE])
        self._leaves = np.concatenate([self._leaves, leaves])
        self._best = max(self._best, int(score.max()))
        return 20 * CALL + 3 * index.size

    def _separate(self) -> list[Pose]:
        """Return the best pose of each neighbourhood, best first."""
        least = max(self._settings.floor, self._best / len(self._points) - SPREAD) * len(self._points)
        leaves = self._leaves[self._leaves[:, 0] >= least]
        leaves = leaves[np.argsort(-leaves[:, 0], kind="stable")]
        side = TILE // self._fine
        y, x = ((leaves[:, 2:] + np.array(self._corner) * side + 0.5) * self._cell).T
        yaw = leaves[:, 1] * (2.0 * math.pi / self._headings)
        seeds: list[Pose] = []
        left = np.ones(len(leaves), dtype=np.bool_)
        while left.any() and len(seeds) < MODES:
            first = int(np.argmax(left))
            seeds.append(Pose(float(x[first]), float(y[first]), wrap(float(yaw[first]))))
            turn = np.abs(np.mod(yaw - yaw[first] + math.pi, 2.0 * math.pi) - math.pi)
            far = np.hypot(x - x[first], y - y[first]) > self._settings.elsewhere
            left &= far | (turn > self._settings.elsewhere_yaw)
        return seeds

    # -- modes -------------------------------------------------------------------------------------

    def _refine(self, seed: Pose) -> int:
        """Refine a pose by a match; it counts as one only if the robot then stands in free ground."""
        found = match(self._map, self._scan, seed, self._cell, self._matching)
        pose, covariance = (seed, None) if found is None else (found.pose, found.noise + found.shared)
        columns, rows = (self._map.cells(np.array([[pose.x, pose.y]])) + AROUND).T
        if (self._map.values(columns, rows) < 0.0).any():
            self._modes.append(Mode(pose, covariance, agreement(self._map, self._scan, pose)))
        return 1000 * CALL

    def _decide(self) -> Result:
        settings = self._settings
        modes = sorted(self._modes, key=lambda mode: -mode.agree)
        if not modes:
            return NotFound("no pose in free ground lets the scan fit the map")
        best = modes[0]
        if best.agree < settings.agree:
            return NotFound(f"at the best pose only {best.agree:.0%} of the scan agrees with the map")
        rivals = [mode for mode in modes[1:] if self._elsewhere(mode.pose, best.pose)]
        runner_up = rivals[0].agree if rivals else 0.0
        alike = [best.pose, *(r.pose for r in rivals if r.agree > best.agree - settings.margin)]
        if len(alike) > 1:
            reason = f"{len(alike)} poses fit alike: {best.agree:.0%} and {runner_up:.0%} of the scan agree with the map"
            return Ambiguous(reason, tuple(alike))
        if self._missed > self._best - settings.margin * len(self._points):
            return Ambiguous("too many poses fit to examine them all", (best.pose,))
        if best.covariance is None:
            return NotFound("the best pose has no match on the map's lines")
        if math.sqrt(float(np.linalg.eigvalsh(best.covariance[:2, :2])[-1])) > settings.sigma:
            return Ambiguous("a direction is open, as along a corridor", (best.pose,))
        return Found(best.pose, best.covariance, best.agree, runner_up)

    def _elsewhere(self, one: Pose, other: Pose) -> bool:
        apart = math.hypot(one.x - other.x, one.y - other.y)
        return (
            apart > self._settings.elsewhere or abs(wrap(one.yaw - other.yaw)) > self._settings.elsewhere_yaw
        )


AROUND = np.array([(column, row) for column in (-1, 0, 1) for row in (-1, 0, 1)])
EDGES = {
    -1: (slice(0, 1), slice(TILE - 1, TILE)),
    0: (slice(1, TILE + 1), slice(None)),
    1: (slice(TILE + 1, TILE + 2), slice(0, 1)),
}
"""A tile with one cell of each neighbour about it: where the cells go, and where they come from"""


def _thinned(points: Floats, cell: float, most: int) -> Floats:
    """Return at most one point (n × 2) per square of THIN, within FAR cells, and at most so many of them."""
    points = points[np.hypot(points[:, 0], points[:, 1]) < FAR * cell]
    squares = np.floor(points / THIN).astype(np.int64)
    _, first = np.unique(squares[:, 0] * 2**20 + squares[:, 1], return_index=True)
    first.sort()
    if len(first) > most:
        first = first[np.arange(most) * len(first) // most]
    return points[first]


def _merged(cells: npt.NDArray[np.generic], side: int) -> npt.NDArray[np.generic]:
    """Return the largest value in each square of side × side cells, a power of 2."""
    while side > 1:
        cells = np.maximum(cells[::2], cells[1::2])
        cells = np.maximum(cells[:, ::2], cells[:, 1::2])
        side //= 2
    return cells


BEAMS = 180
SAMPLES = 24
"""Places along a beam at which the map is looked up"""
CLEAR = 0.3
"""m before a beam's end in which what it passes is not judged"""


def agreement(map_: Map, scan: BodyScan, pose: Pose) -> float:
    """Return the share of the scan that agrees with the map, taken at this pose: 0 to 1.

    A beam agrees if it ends on an occupied cell or beside one; it contradicts the map if it ends in a free cell, or
    if it passes through an occupied one; in unknown ground a hit counts half against the map. Each beam weighs as
    much as its range: so long is the piece of wall that it stands for."""
    read = np.flatnonzero(scan.ranges > 0.0)
    read = read[:: max(1, math.ceil(len(read) / BEAMS))]
    ranges, hit, ends = scan.ranges[read], scan.hit[read], to_world(scan.ends[read], pose)
    columns, rows = map_.cells(ends).T
    end = map_.values(columns, rows)
    beside = [map_.values(columns + i, rows + j) for i, j in ((-1, 0), (1, 0), (0, -1), (0, 1))]
    origin = to_world(np.array([scan.origin]), pose)[0]
    share = (np.arange(SAMPLES) + 0.5) / SAMPLES * np.maximum(1.0 - CLEAR / ranges, 0.0)[:, None]
    passed = origin + share[:, :, None] * (ends - origin)[:, None, :]
    columns, rows = map_.cells(passed.reshape(-1, 2)).T
    pierced = (map_.values(columns, rows) > 0.0).reshape(share.shape).any(axis=1)
    on = hit & (np.max([end, *beside], axis=0) > 0.0)
    agrees = float(ranges[on & ~pierced].sum())
    denies = float(ranges[(hit & ~on & (end < 0.0)) | pierced].sum())
    unknown = float(ranges[hit & ~on & ~pierced & (end == 0.0)].sum())
    return agrees / max(agrees + denies + unknown / 2.0, 1e-9)
