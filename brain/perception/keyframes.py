"""The surroundings as the newest scans saw them, and the pose of a scan among them: point to line.

Rules. A keyframe is a scan's surfaces, each a point with the normal of its line, and what it takes to draw
the scan again, at the pose where it was taken. The newest few are one local map, a tree over x, y and the
direction that a surface faces: what faces otherwise is far away. Whatever was seen before plays no part, so a
building whose far end does not fit its beginning is none of its concern: `loops` closes them, by moving the
poses of the keyframes.
The pose of a scan is searched from the prediction by Gauss-Newton: of surfaces evenly spread along the
scan, each pulls to the line of the nearest one of the local map, less the farther it is off (Cauchy), and
the prediction holds as firmly as the motion since the last scan is known. Real odometry has heavy tails:
the farther the scan pulls away, the less the prediction counts. The search distance begins wide and shrinks
as the steps do. Sources: Censi 2008 (point to line); Zhang 1997 (robust weights).
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass
from typing import Annotated, Any, NamedTuple

import numpy as np
import numpy.typing as npt

from brain.belief import Floats, Pose
from brain.bodies.plane import seen_from, wrap
from brain.perception.body_scan import STEP_UP, BodyScan, Bools, PackedScan, rotated, to_world
from brain.perception.match import OPEN, inverted
from brain.perception.saved_keyframes import SavedKeyframe
from brain.perception.saved_map import SavedMap
from protocols.bounds import Bounds, check, ordered

Indices = npt.NDArray[np.int64]
Singles = npt.NDArray[np.float32]


@dataclass(frozen=True, slots=True)
class KeyframeSettings:
    """When a scan is kept, and how one is matched with those that were."""

    count: Annotated[int, Bounds(1, 100)] = 12
    """Keyframes that make the local map"""
    move: Annotated[float, Bounds(0.01, 10.0, "m")] = 0.35
    """m from the newest keyframe, beyond which a scan becomes the next one; a third of it on new ground"""
    turn: Annotated[float, Bounds(0.01, 3.0, "rad")] = 0.26
    """rad, the same"""
    farthest: Annotated[float, Bounds(0.5, 100.0, "m")] = 20.0
    """m: surfaces farther away are not used"""
    surfaces: Annotated[int, Bounds(20, 500)] = 140
    """Largest number of surfaces of a scan that are matched"""
    wide: Annotated[float, Bounds(0.05, 5.0, "m")] = 0.8
    """m: search distance at the first step,"""
    near: Annotated[float, Bounds(0.02, 5.0, "m")] = 0.15
    """and at the last"""
    steps: Annotated[int, Bounds(1, 30)] = 12
    """Gauss-Newton steps, at most"""
    sigma: Annotated[float, Bounds(1e-3, 1.0, "m")] = 0.02
    """m: standard deviation of one surface's distance, at least"""
    floor: Annotated[float, Bounds(1e-5, 1.0, "m")] = 0.002
    """m: error of a match that no number of surfaces averages out"""
    floor_yaw: Annotated[float, Bounds(1e-5, 1.0, "rad")] = 0.0008

    def __post_init__(self) -> None:
        check(self)
        ordered(self, "near", "wide")


FACING = 0.25
"""m for which a surface that faces 1 rad otherwise counts in the search for the nearest"""
ROBUST = 0.04
"""m off its line at which a surface counts half (Cauchy)"""
TAIL = 9.0
"""Squared Mahalanobis distance from the prediction at which that counts half"""
ON_LINE = 0.08
"""m: a surface this near to its line lies on it"""
LEAST = 20
"""Least number of surfaces of a scan that is matched or kept"""
NEW_GROUND = 0.75
"""Share of a scan on the local map, below which it shows new ground"""
SPACING = 0.04
"""m between the points of a keyframe, along its surfaces"""
BAD, BETTER = 0.55, 0.1
"""Share of a scan on the local map, below which other headings are tried, and by how much one must have
more"""
HEADINGS, LOOSE = (-0.2, 0.2, -0.1, 0.1, -0.4, 0.4), 0.05
"""rad: by which those are off, and the weight of the prediction then"""
GAP, GRAZING, LONGEST = (0.06, 3.5), 0.12, 0.3
"""m, and times the beams' spacing: hits farther apart are of two surfaces; cosine between normal and beam
below which a normal is none; m that two surfaces may be apart along the scan, at most"""
CLEAR = 5.0
"""Times the noise of a range, that two hits must be apart to show how a surface lies"""
HOLD = 0.02
"""Share of the surfaces by which a direction is held, below which it is open: the scatter of their own
directions would pass for it, as in a bare corridor"""
TINY = 1e-6 * np.eye(3)
NEIGHBOURHOOD, BESIDE, NEIGHBOURS = 1.0, 0.3, 0.6
"""m about a surface in which others are to be compared; m to one that it lies on; share of a scan that must
be so, to count fully"""
WITNESSES, BEHIND = 4, 0.3
"""Newest scans that are asked what was seen behind a point, and m by which that is farther: walls are seen
along, and edges passed"""
GROWTH = 256
"""Poses by which their memory grows, at first"""


class Motion(NamedTuple):
    """How far the base has moved since the last scan."""

    distance: float
    """m"""
    turn: float
    """rad"""

    def noise(self) -> Floats:
        """Return the covariance (3 × 3) of what real odometry makes of it: wheels slip, floors give way,
        stamps are off: that of robots in three buildings."""
        far, turn = abs(self.distance), abs(self.turn)
        along = 0.006 + 0.12 * far + 0.03 * turn
        yaw = 0.006 + 0.15 * far + 0.2 * turn
        return np.diag([along * along, along * along, yaw * yaw])

    def if_none(self) -> Floats:
        """Return the covariance (3 × 3) of the motion if there was none: all of it is an error."""
        return np.diag([self.distance**2, self.distance**2, self.turn**2])


@dataclass(frozen=True, slots=True)
class Placed:
    """A scan among the keyframes."""

    pose: Pose
    noise: Floats
    """3 × 3 covariance of x, y, yaw about where the keyframes place the robot"""
    shared: Floats
    """3 × 3 covariance of the keyframes there"""
    share: float
    """Of the scan's surfaces: on the local map"""


@dataclass(frozen=True, slots=True)
class Keyframe:
    """What is kept of a scan."""

    way: float
    """m that the robot had travelled"""
    covariance: Floats
    """3 × 3, of the pose when it was kept"""
    points: Singles
    """m, n × 2, in the robot's frame; so is the next"""
    normals: Singles
    scan: PackedScan


# -- matching --------------------------------------------------------------------------------------------


class Surfaces:
    """Points with normals in one frame, and a tree over place and facing."""

    def __init__(self, points: Floats, normals: Floats) -> None:
        self.points, self.normals = points, normals
        self.tree = _tree(np.hstack([points, FACING * normals]))

    def share(self, points: Floats, normals: Floats, x: Floats) -> float:
        """Return the share of a scan's surfaces, from a pose x, y, yaw, that lie on these; of those that lie
        in their neighbourhood, but at least of NEIGHBOURS of all."""
        yaw = float(x[2])
        at = rotated(points, yaw) + x[:2]
        apart, nearest = self.tree.query(
            np.hstack([at, FACING * rotated(normals, yaw)]), distance_upper_bound=NEIGHBOURHOOD
        )
        near = apart < NEIGHBOURHOOD
        nearest = nearest[near]
        off = np.abs(((at[near] - self.points[nearest]) * self.normals[nearest]).sum(axis=1))
        on = int(np.count_nonzero((off < ON_LINE) & (apart[near] < BESIDE)))
        return on / max(float(np.count_nonzero(near)), NEIGHBOURS * len(points))


class Fit(NamedTuple):
    """Where surfaces fit others."""

    x: Floats
    """x, y, yaw"""
    information: Floats
    """3 × 3: what the surfaces say of it"""
    share: float
    """Of the surfaces: on the others"""
    nearest: Indices
    """Of those: the nearest ones, at the last step"""
    noise: Floats
    """3 × 3 covariance; a direction that hardly any surface holds is left open"""
    alone: Floats
    """x, y, yaw by the surfaces alone, where they hold it: without the pull of the prior"""


def fit(
    local: Surfaces,
    points: Floats,
    normals: Floats,
    start: Floats,
    prior: Floats,
    settings: KeyframeSettings,
    wide: float = 0.0,
    sigma: float = 0.0,
) -> Fit | None:
    """Return where surfaces fit a local map, searched from a pose; `prior`: its information, 3 × 3; `wide`:
    m, the first search distance, if another than the settings'; `sigma`: m, standard deviation of a surface's
    distance, if it is known to be more. None if too few lie near the map's."""
    x, reach, least = start, wide or settings.wide, max(settings.sigma, sigma)
    for number in range(settings.steps):
        yaw = float(x[2])
        c, s = math.cos(yaw), math.sin(yaw)
        turn = np.array([[c, s], [-s, c]])
        arm = points @ turn
        at = np.concatenate((arm + x[:2], normals @ (FACING * turn)), axis=1)
        distances, nearest = local.tree.query(at, distance_upper_bound=reach)
        found = np.flatnonzero(distances < reach)
        if len(found) < LEAST // 2:
            return None
        nearest, arm = nearest[found], arm[found]
        J = np.empty((3, len(found)))
        lines = local.normals[nearest].T
        J[:2] = lines
        np.subtract(lines[1] * arm[:, 0], lines[0] * arm[:, 1], out=J[2])
        off = ((at[found, :2] - local.points[nearest]).T * lines).sum(axis=0)
        size = np.abs(off)
        weight = 1.0 / (1.0 + (off / max(ROBUST, 0.25 * reach)) ** 2)
        variance = max(least, float(size.sum()) / len(size)) ** 2
        weighted = J * (weight / variance)
        information = weighted @ J.T
        apart = x - start
        firm = prior / (1.0 + float(apart @ prior @ apart) / TAIL)
        step = np.linalg.solve(information + firm + TINY, -(weighted @ off + firm @ apart))
        x = x + step
        dx, dy, turned = np.abs(step).tolist()
        largest = max(dx, dy, 3.0 * turned)
        if reach <= settings.near and largest < 0.002:
            break
        if largest < 0.03:
            reach = max(settings.near, 0.5 * reach)
        elif number > 2:
            reach = max(settings.near, 0.7 * reach)
    length = max(math.sqrt(float(np.vdot(arm, arm)) / len(arm)), 0.1)
    held, left_open = inverted(information, length, HOLD * float(weight.sum()) / variance)
    share = float(np.count_nonzero(size < ON_LINE)) / len(points)
    alone = x + held @ (firm @ (x - start))
    return Fit(x, information, share, nearest, held + OPEN * left_open, alone)


# -- keyframes -------------------------------------------------------------------------------------------


class Keyframes:
    """All keyframes, numbered as they came, their poses, and the local map of the newest. Plain data: a deep
    copy continues exactly as the original."""

    def __init__(self, settings: KeyframeSettings, saved: SavedMap | None = None) -> None:
        """`saved`: its keyframes come first, as of a robot that was carried since. If it has none, those of
        its walls that are about the robot are always in the local map."""
        before = None if saved is None else saved.keyframes
        self.settings, self._saved = settings, None if before is not None else saved
        self.kept: dict[int, Keyframe] = {}
        self.count = 0
        """That there have been"""
        self._poses: Floats = np.zeros((GROWTH, 3))
        if before is not None:
            self.kept = {number: self._remade(one) for number, one in before.kept.items()}
            self.count = len(before.poses)
            self._poses = np.concatenate([before.poses, self._poses])
        self._first = self.count
        """Number of the oldest that may be in the local map"""
        self._local = Surfaces(np.zeros((0, 2)), np.zeros((0, 2)))
        self._owners: Indices = np.zeros(0, dtype=np.int64)
        """Keyframe of each of its surfaces; `count`: the saved map"""

    def _remade(self, one: SavedKeyframe) -> Keyframe:
        """Return a keyframe as it was when it was kept, but for what packing its scan has rounded."""
        scan = one.scan.unpacked()
        points, normals = _surfaces(scan, scan.ranges < self.settings.farthest, spacing=SPACING)
        return Keyframe(
            one.way, one.covariance, points.astype(np.float32), normals.astype(np.float32), one.scan
        )

    def __len__(self) -> int:
        return self.count - self._first

    @property
    def poses(self) -> Floats:
        """Pose of every keyframe in the map: n × 3."""
        return self._poses[: self.count]

    def pose(self, number: int) -> Pose:
        """Return where a keyframe was taken, as it is known now."""
        x, y, yaw = self._poses[number].tolist()
        return Pose(x, y, wrap(yaw))

    def forget_local(self) -> None:
        """The robot is elsewhere: what comes next has nothing in common with the newest ones."""
        self._first = self.count
        self._build()

    def wants(self, pose: Pose, share: float) -> bool:
        """Return whether a scan at this pose is to be the next one; `share`: of it on the local map."""
        if not len(self):
            return True
        x, y, yaw = self._poses[self.count - 1].tolist()
        far = math.dist((x, y), (pose.x, pose.y)) / self.settings.move
        far = max(far, abs(wrap(pose.yaw - yaw)) / self.settings.turn)
        return far >= (1.0 if share > NEW_GROUND else 1.0 / 3.0)

    def add(self, pose: Pose, covariance: Floats, scan: BodyScan, static: Bools, way: float) -> bool:
        """Keep a scan; `static`: the beams that may be kept, `way`: m travelled. False if it shows too
        little."""
        points, normals = _surfaces(scan, static & (scan.ranges < self.settings.farthest), spacing=SPACING)
        if len(points) < LEAST:
            return False
        if self.count == len(self._poses):
            self._poses = np.concatenate([self._poses, np.zeros_like(self._poses)])
        self._poses[self.count] = pose.x, pose.y, pose.yaw
        packed = PackedScan.of(scan, static)
        single = points.astype(np.float32), normals.astype(np.float32)
        self.kept[self.count] = Keyframe(way, covariance, *single, packed)
        self.count += 1
        self._build()
        return True

    def move(self, poses: Floats) -> None:
        """Set the poses of all keyframes."""
        self._poses[: self.count] = poses
        self._build()

    def gathered(self, numbers: Iterable[int], base: Floats | None = None) -> tuple[Floats, Floats]:
        """Return points and normals of keyframes that are there, in the map, or in the frame of a pose."""
        points, normals = [np.zeros((0, 2))], [np.zeros((0, 2))]
        for number in numbers:
            one = self.kept.get(number)
            if one is None:
                continue
            pose = self.pose(number)
            if base is not None:
                pose = seen_from(Pose(*base.tolist()), pose)
            points.append(to_world(one.points.astype(np.float64), pose))
            normals.append(rotated(one.normals.astype(np.float64), pose.yaw))
        return np.concatenate(points), np.concatenate(normals)

    def seen_through(self, points: Floats) -> Bools:
        """Return for each point, n × 2 in the map, whether one of the newest few scans saw what is behind it:
        nothing was there."""
        through = np.zeros(len(points), dtype=np.bool_)
        for number in self._newest()[-WITNESSES:]:
            one = self.kept.get(number)
            if one is not None:
                x, y, yaw = self._poses[number].tolist()
                through |= one.scan.reaches(rotated(points - (x, y), -yaw), BEHIND)
        return through

    def _newest(self) -> range:
        return range(max(self._first, self.count - self.settings.count), self.count)

    def _build(self) -> None:
        newest = [number for number in self._newest() if number in self.kept]
        points, normals = self.gathered(newest)
        sizes = [len(self.kept[number].points) for number in newest]
        if self._saved is not None and newest:
            here = self.pose(newest[-1])
            walls = self._saved.near(here.x, here.y, self.settings.farthest)
            points, normals = np.concatenate([points, walls[0]]), np.concatenate([normals, walls[1]])
            newest, sizes = [*newest, self.count], [*sizes, len(walls[0])]
        self._local = Surfaces(points, normals)
        self._owners = np.repeat(np.array(newest, dtype=np.int64), np.array(sizes, dtype=np.int64))

    def place(self, scan: BodyScan, predicted: Pose, noise: Floats) -> Placed | None:
        """Return the pose of a scan, searched from a prediction with this covariance (3 × 3), and, if
        little of the scan lies on the keyframes there, from other headings; None if there are no keyframes,
        or too few of its surfaces lie near theirs."""
        settings = self.settings
        points, normals = _surfaces(scan, scan.ranges < settings.farthest, most=settings.surfaces)
        if not len(self) or len(points) < LEAST:
            return None
        start = np.array([predicted.x, predicted.y, predicted.yaw])
        prior: Floats = np.asarray(np.linalg.inv(noise), dtype=np.float64)
        hits = max(int(np.count_nonzero(scan.hit)), len(points))
        sigma = scan.noise * math.sqrt(len(points) / hits)  # lines through several hits share their errors
        best = fit(self._local, points, normals, start, prior, settings, sigma=sigma)
        if best is None or best.share < BAD:
            for turn in HEADINGS:
                turned = start + np.array([0.0, 0.0, turn])
                other = fit(self._local, points, normals, turned, LOOSE * prior, settings, sigma=sigma)
                if other is not None and (best is None or other.share > best.share + BETTER):
                    best = other
        if best is None:
            return None
        x, y, yaw = best.alone.tolist()  # the filter has its own prior: one must not count twice
        pose = Pose(x, y, wrap(yaw))
        floor = np.diag([settings.floor**2, settings.floor**2, settings.floor_yaw**2])
        return Placed(pose, best.noise + floor, self._shared(best.nearest, pose), best.share)

    def _shared(self, nearest: Indices, pose: Pose) -> Floats:
        """Return the covariance of the keyframes to which these surfaces belong, moved to a pose; that of a
        saved map's walls turns with no lever."""
        first = self._newest().start
        counts = np.bincount(self._owners[nearest] - first) / len(nearest)
        total = np.zeros((3, 3))
        for number, part in enumerate(counts.tolist(), first):
            if part and number == self.count and self._saved is not None:
                total += part * self._saved.variance * np.diag([1.0, 1.0, 0.0])
            elif part:
                x, y, _ = self._poses[number].tolist()
                turn = np.eye(3)
                turn[0, 2], turn[1, 2] = y - pose.y, pose.x - x
                total += part * (turn @ self.kept[number].covariance @ turn.T)
        return total


def _tree(places: Floats) -> Any:  # noqa: ANN401 -- it has no types
    from scipy.spatial import cKDTree  # here, because it takes half a second to import

    return cKDTree(places, leafsize=24, balanced_tree=False, compact_nodes=False)


def _surfaces(scan: BodyScan, usable: Bools, *, most: int = 0, spacing: float = 0.0) -> tuple[Floats, Floats]:
    """Return points and normals of a scan's surfaces, in its frame, evenly along them: this many at most,
    or so far apart [m]. Where the hits about one form no line, as in clutter, its neighbours tell how the
    surface lies."""
    points, normals, known = _rough(scan)
    points[scan.straight], normals[scan.straight] = scan.middles[scan.straight], scan.normals[scan.straight]
    found = np.flatnonzero((known | scan.straight) & usable)
    if len(found) > 2:
        step = np.diff(points[found], axis=0)
        way = np.concatenate(([0.0], np.minimum(np.hypot(*step.T), LONGEST).cumsum()))
        number = np.floor(way / (spacing or max(float(way[-1]) / most, 1e-6)))
        found = found[np.concatenate(([True], number[1:] != number[:-1]))]
    return points[found], normals[found]


def _rough(scan: BodyScan) -> tuple[Floats, Floats, Bools]:
    """Return each hit, the normal by up to two hits to each side on the same surface, and whether there is
    one."""
    count = len(scan.ranges)
    here = np.arange(count)
    left, right = np.maximum(here - 1, 0), np.minimum(here + 1, count - 1)
    apart = (
        max(GAP[0], STEP_UP[1] * scan.noise)
        + GAP[1] * abs(scan.bearings[-1] - scan.bearings[0]) / max(count - 1, 1) * scan.ranges
    )
    after = np.hypot(*(scan.ends[right] - scan.ends).T)
    goes_on = scan.hit & scan.hit[right] & (after < apart) & (right > here)
    came = np.concatenate(([False], goes_on[:-1]))
    first, last = np.where(came, left, here), np.where(goes_on, right, here)
    first = np.where(came & came[first], np.maximum(first - 1, 0), first)
    last = np.where(goes_on & goes_on[last], np.minimum(last + 1, count - 1), last)
    along = scan.ends[last] - scan.ends[first]
    length = np.hypot(*along.T)
    normals = np.column_stack([along[:, 1], -along[:, 0]]) / np.maximum(length, 1e-9)[:, None]
    beams = scan.ends - scan.origin
    away = (normals * beams).sum(axis=1)
    normals *= np.where(away > 0.0, -1.0, 1.0)[:, None]
    known = (came | goes_on) & (length > CLEAR * scan.noise) & (np.abs(away) > GRAZING * scan.ranges)
    return scan.ends.copy(), normals, known
