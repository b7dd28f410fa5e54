"""Loops: a place seen again, and what follows for all poses since.

Rules. Every second keyframe, and each while a loop waits for others, asks whether it sees a place from long
ago: the candidate is an old keyframe within the doubt, which grows with the shortest path to it in the
graph. Where that is small, the keyframe is matched with those about the old one. Else the newest few are
laid over them, first on a coarse grid of poses as far as the doubt reaches, then by matching from the best
of these; it is a loop only if most lie there, if no other place is as good, and if several loops in a row
agree with each other: a single one may be the next corridor. The graph is solved again, and the poses of all
keyframes move with their groups. A loop that speaks against the others then is taken out (`graph`). Each
call does one slice of this, bounded by counts.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import Annotated, NamedTuple

import numpy as np
import numpy.typing as npt

from brain.belief import Floats
from brain.bodies.plane import wrap
from brain.perception.body_scan import rotated
from brain.perception.graph import Edge, Graph, Solution, after, between, in_axes, inverse
from brain.perception.keyframes import FACING, Keyframes, KeyframeSettings, Surfaces, fit
from brain.perception.saved_keyframes import SavedKeyframes
from protocols.bounds import Bounds, check


@dataclass(frozen=True, slots=True)
class LoopSettings:
    """Whether loops are closed, and the work for it."""

    close: bool = True
    """If not, the pose drifts as matching from scan to scan does"""
    slices: Annotated[int, Bounds(1, 20)] = 5
    """Of this work, after each scan"""
    away: Annotated[float, Bounds(1.0, 1000.0, "m")] = 12.0
    """m travelled since a place was seen, from which on it closes a loop"""
    share: Annotated[float, Bounds(0.1, 1.0)] = 0.7
    """Of what is compared, that must lie on what was seen there"""
    margin: Annotated[float, Bounds(0.0, 1.0)] = 0.08
    """By which that must exceed the share at any other place"""
    keyframes: Annotated[int, Bounds(100, 20_000)] = 3000
    """That are kept at most, of about 8 KB each; of those at one place the older ones are forgotten"""
    agree: Annotated[int, Bounds(1, 20)] = 3
    """Loops that must agree with one another before any counts, where the doubt is large"""

    def __post_init__(self) -> None:
        check(self)


GROUP = 5
"""Keyframes of one group"""
LEAST_KEYFRAMES = 20
"""Before there is a loop"""
DRIFT, DRIFT_YAW = (0.3, 0.03, 5.0), (0.09, 0.012, 0.5)
"""m, per m of the shortest path in the graph, m at most: how far off a place may lie; so for its yaw, rad"""
AMONG = 1.5
"""m beyond that, within which an old keyframe shows the place"""
SURE = 0.75
"""m: where the doubt is smaller, one match is enough"""
AROUND, BEFORE = 8, 7
"""Keyframes to each side that make an old place; before the newest that are laid over it"""
FRESH = 0.7
"""Of `away`: keyframes of less travel ago are none of the old place's"""
SPACING_OLD, SPACING_NEW, MOST, LEAST_POINTS = 0.05, 0.1, 220, 40
"""m between points of the old and the new surfaces; number of the new ones"""
WIDE = 0.4
"""m: the first search distance of a match"""
BEYOND = 1.2
"""Times the doubt by which a match may be off"""
OTHER, OTHER_YAW = 0.6, 0.25
"""m, rad: farther apart are different places"""
UNSURE, UNSURE_YAW = 0.03, 0.006
"""m, rad: standard deviation of a loop, at least"""
FEW, MUCH, MUCH_YAW = 3, 0.1, 0.02
"""Loops where the doubt is small, after so many of which, or from which error [m, rad] on, it is solved"""
RECENT = 30
"""Keyframes for which a loop waits for others that agree"""
CELL, STEP, COARSE_YAW = 0.2, 2, 0.05
"""m, cells, rad: of the coarse search"""
PEAKS, PER_HEADING, COARSE = 6, 8, 110
"""Places that are matched, and those of each heading among which they are; points"""
APART, APART_YAW = 0.7, 0.2
"""m, rad between those places"""
TORN = np.diag([1.0, 1.0, 0.25])
"""Covariance of where a robot is from where it was, if it was carried"""


class Loop(NamedTuple):
    """A place seen again."""

    old: int
    """Keyframes"""
    new: int
    pose: Floats
    """Of the new one, in the frame of the old one"""
    information: Floats


class _Cells(NamedTuple):
    """Where old surfaces are, coarsely."""

    low: Floats
    """m: corner of the first cell"""
    values: npt.NDArray[np.uint8]
    """2 on them, 1 beside, by column (x) and row (y)"""


@dataclass(slots=True)
class _Inquiry:
    """Whether a keyframe sees an old place."""

    new: int
    old: int
    guess: Floats
    """Pose of the new one in the frame of the old one, as it is believed"""
    reach: float
    """m, rad: by which that may be off"""
    reach_yaw: float
    near: bool
    """That is little"""
    points: Floats
    """What is compared, in the frame of the new one"""
    normals: Floats
    old_points: Floats
    """In the frame of the old one"""
    old_normals: Floats
    local: Surfaces | None = None
    cells: _Cells | None = None
    headings: list[float] = field(default_factory=list)
    """Left to be tried"""
    coarse: list[tuple[int, float, float, float]] = field(default_factory=list)
    """Points on the grid's cells, at x, y, yaw"""
    starts: list[Floats] = field(default_factory=list)
    """Poses left to be matched from"""
    found: list[tuple[float, Floats, Floats]] = field(default_factory=list)
    """Share, pose, information"""

    def advance(self, matching: KeyframeSettings) -> bool:
        """Do one part of the search; return whether it is done."""
        if self.local is None:
            self.local = Surfaces(self.old_points, self.old_normals)
            if self.near:
                self.starts = [self.guess]
            else:
                self.cells = _cells(self.old_points)
                count = max(1, math.ceil(self.reach_yaw / COARSE_YAW))
                self.headings = [self.reach_yaw * k / count for k in range(-count, count + 1)]
            return False
        if self.headings and self.cells is not None:
            self.coarse += _laid(self, self.cells, self.headings.pop(0))
            if not self.headings:
                self.starts = _peaks(self.coarse)
            return False
        if self.starts:
            firm = 1.0 if self.near else 0.01
            prior = firm * np.diag([self.reach**-2, self.reach**-2, self.reach_yaw**-2])
            place = fit(self.local, self.points, self.normals, self.starts.pop(0), prior, matching, WIDE)
            if place is not None:
                share = self.local.share(self.points, self.normals, place.x)
                self.found.append((share, place.x, place.information))
        return not self.starts


class Loops:
    """The search for loops, and the graph. Plain data: a deep copy continues exactly as the original."""

    def __init__(self, settings: LoopSettings, saved: SavedKeyframes | None = None) -> None:
        """`saved`: keyframes from before, with the graph of which it begins."""
        self.settings = settings
        self.graph = Graph() if saved is None else Graph(saved.groups, saved.joins, saved.ties)
        self.closed = len(self.graph.ties)
        """Loops that count"""
        self._drift: Floats = np.zeros((3, 3))
        """Covariance since the newest group began"""
        self._asks = False
        """The newest keyframe is to ask"""
        self._inquiry: _Inquiry | None = None
        self._waiting: list[Loop] = []
        """Loops that wait for others that agree"""
        self._due = 0
        """Loops since the graph was solved"""
        self._solution: Solution | None = None

    def forget_search(self) -> None:
        """Drop what is under way: the robot is elsewhere."""
        self._asks, self._inquiry, self._solution = False, None, None
        self._waiting = []

    @property
    def busy(self) -> bool:
        """Whether there is something left to do."""
        return self._asks or self._inquiry is not None or self._solution is not None

    def ties_to_before(self, number: int) -> bool:
        """Return whether a loop ties a keyframe from before this one to one since then."""
        return any(one.first * GROUP < number <= one.second * GROUP for one in self.graph.ties)

    def added(self, keyframes: Keyframes, covariance: Floats) -> None:
        """The newest keyframe was kept: 3 × 3 covariance of its pose from the one before, in its axes."""
        new = keyframes.count - 1
        if new:
            self._drift = self._drift + covariance
        if new and new % GROUP == 0:
            first = new - GROUP
            pose = between(keyframes.poses[first], keyframes.poses[new])
            information: Floats = np.asarray(np.linalg.inv(self._drift), dtype=np.float64)
            self.graph.join(Edge(first // GROUP, new // GROUP, pose, information))
            self._drift = np.zeros((3, 3))
            if len(keyframes.kept) > self.settings.keyframes and not self.busy:
                self._merge(keyframes)
        due = new % 2 == 0 or bool(self._waiting)
        if self.settings.close and due and new > LEAST_KEYFRAMES and not self.busy:
            self._asks = True

    def advance(self, keyframes: Keyframes) -> Floats | None:
        """Do one slice; return the poses of all keyframes, if they are known better now."""
        if self._asks:
            self._asks = False
            self._inquiry = self._candidate(keyframes)
        elif self._inquiry is not None:
            if self._inquiry.advance(keyframes.settings):
                inquiry, self._inquiry = self._inquiry, None
                self._conclude(keyframes, inquiry)
        elif self._solution is not None and self._solution.advance():
            solution, self._solution = self._solution, None
            refused = solution.refused()
            if refused is not None:
                self.graph.take_out(refused)
                self._solve(keyframes)
                return None
            self.closed = len(self.graph.ties)
            return self._moved(keyframes, solution.poses)
        return None

    def _merge(self, keyframes: Keyframes) -> None:
        """Of the two groups that are nearest to each other, forget the older one."""
        groups = np.array(self.graph.groups[1 : -2 * BEFORE])
        if len(groups) < 2:
            return
        x, y, yaw = keyframes.poses[groups * GROUP].T
        facing = np.column_stack([np.cos(yaw), np.sin(yaw)]) / FACING
        tree = Surfaces(np.column_stack([x, y]), facing).tree
        apart, nearest = tree.query(tree.data, k=2)
        one = int(apart[:, 1].argmin())
        group = int(groups[min(one, int(nearest[one, 1]))])
        self.graph.remove(group)
        for number in range(group * GROUP, (group + 1) * GROUP):
            keyframes.kept.pop(number, None)

    # -- is it a place from long ago? ----------------------------------------------------------------------

    def _candidate(self, keyframes: Keyframes) -> _Inquiry | None:
        """Choose the old place that the newest keyframe may see; None if there is none."""
        new, numbers = keyframes.count - 1, np.array(list(keyframes.kept))
        ways = np.array([keyframes.kept[number].way for number in numbers.tolist()])
        groups = np.array(self.graph.groups)
        firsts = np.searchsorted(numbers, groups * GROUP)
        lengths = self.graph.lengths(ways[firsts])[np.searchsorted(groups, numbers // GROUP)]
        poses = keyframes.poses[numbers]
        travel = ways[-1] - ways
        reach = np.minimum(DRIFT[0] + DRIFT[1] * lengths, DRIFT[2])
        off = np.hypot(*(poses[:, :2] - poses[-1, :2]).T)
        can = np.flatnonzero((travel > self.settings.away) & (off < AMONG + reach))
        if not len(can):
            return None
        at = int(can[np.argmin(off[can] + 0.05 * np.minimum(lengths[can], 20.0))])
        about = np.arange(max(0, at - AROUND), min(len(numbers), at + AROUND + 1))
        about = about[travel[about] > FRESH * self.settings.away]
        base, near = poses[at], bool(reach[at] < SURE)
        old = _thinned(*keyframes.gathered(numbers[about].tolist(), base), SPACING_OLD)
        newest = [new] if near else range(max(0, new - BEFORE), new + 1)
        points, normals = _thinned(*keyframes.gathered(newest, poses[-1]), SPACING_NEW)
        if len(points) > MOST:
            some = np.linspace(0, len(points) - 1, MOST).astype(np.int64)
            points, normals = points[some], normals[some]
        if len(points) < LEAST_POINTS or len(old[0]) < LEAST_POINTS:
            return None
        reach_yaw = min(DRIFT_YAW[0] + DRIFT_YAW[1] * float(lengths[at]), DRIFT_YAW[2])
        guess = between(base, poses[-1])
        return _Inquiry(
            new, int(numbers[at]), guess, float(reach[at]), reach_yaw, near, points, normals, *old
        )

    def _conclude(self, keyframes: Keyframes, one: _Inquiry) -> None:
        """Keep the loop that was found, if it is one; solve the graph, if it is worth it."""
        one.found.sort(key=lambda found: -found[0])
        if not one.found or one.found[0][0] < self.settings.share:
            return
        share, x, information = one.found[0]
        off = between(one.guess, x)
        far, turn = math.hypot(off[0], off[1]), abs(float(off[2]))
        if far > BEYOND * one.reach or turn > BEYOND * one.reach_yaw:
            return
        others = [other for other, pose, _ in one.found[1:] if _elsewhere(pose, x)]
        if any(other > share - self.settings.margin for other in others):
            return
        known = in_axes(information, float(x[2])) + np.diag([1.0, 1.0, 10.0])
        spread = np.linalg.inv(known) + np.diag([UNSURE**2, UNSURE**2, UNSURE_YAW**2])
        loop = Loop(one.old, one.new, x, np.linalg.inv(spread))
        if one.near:
            self._tie(keyframes, loop)
            self._due += 1
            if self._due >= FEW or far > MUCH or turn > MUCH_YAW:
                self._solve(keyframes)
            return
        self._waiting = [other for other in self._waiting if one.new - other.new < RECENT] + [loop]
        same = [other for other in self._waiting if _agree(keyframes, other, loop)]
        if len(same) >= self.settings.agree:
            for other in same:
                self._tie(keyframes, other)
            kept = {id(other) for other in same}
            self._waiting = [other for other in self._waiting if id(other) not in kept]
            self._solve(keyframes)

    # -- the graph -----------------------------------------------------------------------------------------

    def _tie(self, keyframes: Keyframes, loop: Loop) -> None:
        """Keep a loop between keyframes, as one between their groups."""
        first, second = loop.old // GROUP, loop.new // GROUP
        poses = keyframes.poses
        a = between(poses[first * GROUP], poses[loop.old])
        b = between(poses[second * GROUP], poses[loop.new])
        pose = after(after(a, loop.pose), inverse(b))
        c, s = math.cos(b[2]), math.sin(b[2])
        turn = np.array([[c, s, s * b[0] - c * b[1]], [-s, c, c * b[0] + s * b[1]], [0.0, 0.0, 1.0]])
        self.graph.ties.append(Edge(first, second, pose, turn.T @ loop.information @ turn))
        self.closed = len(self.graph.ties)

    def _solve(self, keyframes: Keyframes) -> None:
        self._due = 0
        self._solution = Solution(self.graph, keyframes.poses[np.array(self.graph.groups) * GROUP])

    def _moved(self, keyframes: Keyframes, groups: Floats) -> Floats:
        """Return the poses of all keyframes, each moved with its group; later ones with the last."""
        poses, numbers = keyframes.poses, np.array(self.graph.groups[: len(groups)])
        group = np.searchsorted(numbers, np.arange(len(poses)) // GROUP, side="right") - 1
        return after(groups[group], between(poses[numbers[group] * GROUP], poses))


def _agree(keyframes: Keyframes, a: Loop, b: Loop) -> bool:
    """Return whether two loops put the newer part in the same place, relative to the older one."""
    if not {a.old, a.new, b.old, b.new} <= keyframes.kept.keys():
        return False
    pose = keyframes.poses
    by_a = after(after(pose[a.old], a.pose), between(pose[a.new], pose[b.new]))
    off = between(by_a, after(pose[b.old], b.pose))
    way = [keyframes.kept[number].way for number in (*a[:2], *b[:2])]
    apart = abs(way[1] - way[3]) + abs(way[0] - way[2])
    return math.hypot(off[0], off[1]) < 0.2 + 0.02 * apart and abs(off[2]) < 0.04 + 0.003 * apart


def _elsewhere(one: Floats, other: Floats) -> bool:
    off = between(one, other)
    return math.hypot(off[0], off[1]) > OTHER or abs(float(off[2])) > OTHER_YAW


def _thinned(points: Floats, normals: Floats, cell: float) -> tuple[Floats, Floats]:
    """Return one point, with its normal, per square and facing."""
    at = np.floor(points / cell).astype(np.int64)
    facing = np.floor((np.arctan2(normals[:, 1], normals[:, 0]) + math.pi) / (math.pi / 4.0)).astype(np.int64)
    key = (at[:, 0] * 100_003 + at[:, 1]) * 16 + facing
    some = np.sort(np.unique(key, return_index=True)[1])
    return points[some], normals[some]


def _cells(points: Floats) -> _Cells:
    """Return the cells of old surfaces."""
    low = points.min(axis=0) - 1.0
    size = np.ceil((points.max(axis=0) + 1.0 - low) / CELL).astype(np.int64) + 1
    column, row = ((points - low) / CELL).astype(np.int64).T
    grid = np.zeros(size, dtype=np.uint8)
    for dx in (-1, 0, 1):
        for dy in (-1, 0, 1):
            grid[column + dx, row + dy] = 1
    grid[column, row] = 2
    return _Cells(low, grid)


def _laid(one: _Inquiry, cells: _Cells, turn: float) -> list[tuple[int, float, float, float]]:
    """Return the best places at one heading: points on cells of the old surfaces, x, y, yaw."""
    yaw, (high, wide) = float(one.guess[2]) + turn, cells.values.shape
    some = one.points[:: math.ceil(len(one.points) / COARSE)]
    columns, rows = np.floor((rotated(some, yaw) + one.guess[:2] - cells.low) / CELL).astype(np.int64).T
    count = math.ceil(one.reach / (STEP * CELL))
    shifts = np.arange(-count, count + 1)
    columns, rows = columns + STEP * shifts[:, None], rows + STEP * shifts[:, None]
    inside = (columns >= 0) & (columns < high), (rows >= 0) & (rows < wide)
    columns, rows = np.where(inside[0], columns * wide, 0), np.where(inside[1], rows, 0)
    values = cells.values.ravel()[columns[:, None] + rows] * (inside[0][:, None] & inside[1])
    score = values.sum(axis=2, dtype=np.int64).ravel()
    best = np.argsort(-score, kind="stable")[:PER_HEADING].tolist()
    places = one.guess[:2] + STEP * CELL * np.column_stack(
        [shifts[np.array(best) // len(shifts)], shifts[np.array(best) % len(shifts)]]
    )
    return [(int(score[i]), x, y, yaw) for i, (x, y) in zip(best, places.tolist(), strict=True)]


def _peaks(coarse: list[tuple[int, float, float, float]]) -> list[Floats]:
    """Return the best places that are apart from each other."""
    peaks: list[Floats] = []
    for _, x, y, yaw in sorted(coarse, key=lambda one: -one[0]):
        place = np.array([x, y, yaw])
        if not any(
            math.dist(place[:2], peak[:2]) < APART and abs(wrap(yaw - float(peak[2]))) < APART_YAW
            for peak in peaks
        ):
            peaks.append(place)
        if len(peaks) >= PEAKS:
            break
    return peaks
