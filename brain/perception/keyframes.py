"""The surroundings as the newest scans saw them, and the pose of a scan among them: point to line.

Rules. A keyframe is a scan's surfaces, each a point with the normal of its line, at the pose where it was
taken. The newest few are one local map, a tree over x, y and the direction that a surface faces: what faces
otherwise is far away. Whatever else was once drawn plays no part, so a building whose far end does not fit
its beginning is none of its concern.
The pose of a scan is searched from the prediction by Gauss-Newton: of surfaces evenly spread along the
scan, each pulls to the line of the nearest one of the local map, less the farther it is off (Cauchy), and
the prediction holds as firmly as the motion since the last scan is known. Real odometry has heavy tails:
the farther the scan pulls away, the less the prediction counts. The search distance begins wide and shrinks
as the steps do. Sources: Censi 2008 (point to line); Zhang 1997 (robust weights).
"""

from __future__ import annotations

import math
from collections import deque
from dataclasses import dataclass
from typing import Annotated, Any, NamedTuple

import numpy as np
import numpy.typing as npt

from brain.belief import Floats, Pose
from brain.bodies.plane import wrap
from brain.perception.body_scan import BodyScan, Bools, rotated, to_world
from protocols.bounds import Bounds, check, ordered

Indices = npt.NDArray[np.int64]


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
HEADINGS, LOOSE = (-0.2, 0.2, -0.1, 0.1), 0.05
"""rad: by which those are off, and the weight of the prediction then"""
GAP, GRAZING, LONGEST = (0.06, 3.5), 0.12, 0.3
"""m, and times the beams' spacing: hits farther apart are of two surfaces; cosine between normal and beam
below which a normal is none; m that two surfaces may be apart along the scan, at most"""
TINY = 1e-6 * np.eye(3)


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
class _Keyframe:
    pose: Pose
    covariance: Floats
    points: Floats
    """m, n × 2, in the map; so is the next"""
    normals: Floats


class Keyframes:
    """The newest keyframes. Plain data: a deep copy continues exactly as the original."""

    def __init__(self, settings: KeyframeSettings) -> None:
        self.settings = settings
        self._kept: deque[_Keyframe] = deque(maxlen=settings.count)
        self._points: Floats = np.zeros((0, 2))
        self._normals: Floats = np.zeros((0, 2))
        self._owners: Indices = np.zeros(0, dtype=np.int64)
        self._tree = _tree(np.zeros((0, 4)))

    def __len__(self) -> int:
        return len(self._kept)

    def forget(self) -> None:
        """Forget all of them: the robot is elsewhere."""
        self._kept.clear()
        self._build()

    def add(self, pose: Pose, covariance: Floats, scan: BodyScan, static: Bools, share: float) -> None:
        """Keep a scan if it was taken far enough from the newest keyframe; `static`: the beams that may be
        kept, `share`: of it on the local map."""
        settings = self.settings
        if self._kept:
            last = self._kept[-1].pose
            far = math.dist((last.x, last.y), (pose.x, pose.y)) / settings.move
            far = max(far, abs(wrap(pose.yaw - last.yaw)) / settings.turn)
            if far < (1.0 if share > NEW_GROUND else 1.0 / 3.0):
                return
        points, normals = _surfaces(scan, static & (scan.ranges < settings.farthest), spacing=SPACING)
        if len(points) < LEAST:
            return
        points, normals = to_world(points, pose), rotated(normals, pose.yaw)
        self._kept.append(_Keyframe(pose, covariance, points, normals))
        self._build()

    def _build(self) -> None:
        self._points = np.concatenate([np.zeros((0, 2)), *(one.points for one in self._kept)])
        self._normals = np.concatenate([np.zeros((0, 2)), *(one.normals for one in self._kept)])
        sizes = [len(one.points) for one in self._kept]
        self._owners = np.repeat(np.arange(len(sizes)), np.array(sizes, dtype=np.int64))
        self._tree = _tree(np.hstack([self._points, FACING * self._normals]))

    def place(self, scan: BodyScan, predicted: Pose, noise: Floats) -> Placed | None:
        """Return the pose of a scan, searched from a prediction with this covariance (3 × 3), and, if
        little of the scan lies on the keyframes there, from other headings; None if there are no keyframes,
        or too few of its surfaces lie near theirs."""
        settings = self.settings
        points, normals = _surfaces(scan, scan.ranges < settings.farthest, most=settings.surfaces)
        if not self._kept or len(points) < LEAST:
            return None
        start = np.array([predicted.x, predicted.y, predicted.yaw])
        prior: Floats = np.asarray(np.linalg.inv(noise), dtype=np.float64)
        best = self._search(points, normals, start, prior)
        if best is None or best.share < BAD:
            for turn in HEADINGS:
                other = self._search(points, normals, start + np.array([0.0, 0.0, turn]), LOOSE * prior)
                if other is not None and (best is None or other.share > best.share + BETTER):
                    best = other
        return best

    def _search(self, points: Floats, normals: Floats, start: Floats, prior: Floats) -> Placed | None:
        """Search from one pose; `prior`: its information, 3 × 3."""
        settings, x = self.settings, start
        reach = settings.wide
        for number in range(settings.steps):
            arm = rotated(points, float(x[2]))
            at = np.hstack([arm + x[:2], FACING * rotated(normals, float(x[2]))])
            distances, nearest = self._tree.query(at, distance_upper_bound=reach)
            found = np.flatnonzero(distances < reach)
            if len(found) < LEAST // 2:
                return None
            nearest, arm = nearest[found], arm[found]
            lines = self._normals[nearest]
            off = ((at[found, :2] - self._points[nearest]) * lines).sum(axis=1)
            weight = 1.0 / (1.0 + (off / max(ROBUST, 0.25 * reach)) ** 2)
            J = np.column_stack([lines, lines[:, 1] * arm[:, 0] - lines[:, 0] * arm[:, 1]])
            weighted = J * (weight / max(settings.sigma, float(np.abs(off).mean())) ** 2)[:, None]
            information = weighted.T @ J
            apart = x - start
            firm = prior / (1.0 + float(apart @ prior @ apart) / TAIL)
            step = np.linalg.solve(information + firm + TINY, -(weighted.T @ off + firm @ apart))
            x = x + step
            largest = max(abs(step[0]), abs(step[1]), 3.0 * abs(step[2]))
            if reach <= settings.near and largest < 0.002:
                break
            if largest < 0.03:
                reach = max(settings.near, 0.5 * reach)
            elif number > 2:
                reach = max(settings.near, 0.7 * reach)
        floor = np.diag([settings.floor**2, settings.floor**2, settings.floor_yaw**2])
        pose = Pose(float(x[0]), float(x[1]), wrap(float(x[2])))
        share = float(np.count_nonzero(np.abs(off) < ON_LINE)) / len(points)
        return Placed(pose, np.linalg.inv(information + TINY) + floor, self._shared(nearest, pose), share)

    def _shared(self, nearest: Indices, pose: Pose) -> Floats:
        """Return the covariance of the keyframes to which these surfaces belong, moved to a pose."""
        counts = np.bincount(self._owners[nearest], minlength=len(self._kept)) / len(nearest)
        total = np.zeros((3, 3))
        for part, one in zip(counts.tolist(), self._kept, strict=True):
            if part:
                turn = np.eye(3)
                turn[0, 2], turn[1, 2] = one.pose.y - pose.y, pose.x - one.pose.x
                total += part * (turn @ one.covariance @ turn.T)
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
    apart = GAP[0] + GAP[1] * abs(scan.bearings[-1] - scan.bearings[0]) / max(count - 1, 1) * scan.ranges
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
    known = (came | goes_on) & (length > 0.0) & (np.abs(away) > GRAZING * scan.ranges)
    return scan.ends.copy(), normals, known
