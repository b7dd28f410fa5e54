"""A scan in the robot's frame, freed from its motion during the sweep, with the surfaces that it shows.

Rules. All is expressed in the robot's frame at the scan's end, about the place where the lidar is then. A
range below range_min, zero, or not finite is no reading: nothing is known along that beam. Beams without a
hit end at the largest range that is used. The surface at a hit is the line through the hits beside it, fitted
where they are straight (least squares across): it is finer than a single range, and belongs to the scan, not
to a pose, so that drawing and matching share it. How noisy ranges are the scan shows itself: on a wall each
hit lies on the line through the two beside it. The noisier, the longer the surface that is fitted.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from brain.belief import Floats, Pose
from brain.perception.mount import Mount
from protocols.messages import LaserScan

Bools = npt.NDArray[np.bool_]


@dataclass(frozen=True, slots=True)
class BodyScan:
    """Where each beam starts and ends, and whether it hit something."""

    origin: tuple[float, float]
    """m, position of the lidar"""
    bearings: Floats
    """rad, n, increasing: directions of the ends about the origin"""
    ranges: Floats
    """m, n, from the origin to the ends; 0 where the beam gave no reading"""
    hit: Bools
    """n; False also where the beam reached the largest range without a hit"""
    ends: Floats
    """n × 2, m; equal to the origin where the beam gave no reading"""
    straight: Bools
    """n: a hit whose neighbours form a line with it"""
    middles: Floats
    """n × 2, m: mean of those neighbours, a point on the line; undefined where not straight"""
    normals: Floats
    """n × 2: unit normal of that line, towards the lidar; undefined where not straight"""
    noise: float
    """m: standard deviation of a range beyond what is usual, as the scan itself shows it; 0 if too few hits
    do"""

    def place(self, pose: Pose) -> tuple[float, float]:
        """Return where the lidar is, with the robot at a pose."""
        (x, y), c, s = self.origin, math.cos(pose.yaw), math.sin(pose.yaw)
        return pose.x + c * x - s * y, pose.y + s * x + c * y


STEP, FARTHEST = 0.002, 130.0
"""m: of packed ranges, and their largest"""


@dataclass(frozen=True, slots=True)
class PackedScan:
    """A scan as it is kept for later: in 8 bytes a beam instead of 66."""

    origin: tuple[float, float]
    bearings: npt.NDArray[np.float32]
    ranges: npt.NDArray[np.uint16]
    """STEP"""
    hit: npt.NDArray[np.uint8]
    """Eight beams a byte"""

    @classmethod
    def of(cls, scan: BodyScan, kept: Bools) -> PackedScan:
        """Pack a scan; of the beams that are not `kept`, no hit remains."""
        ranges = np.rint(np.minimum(scan.ranges, FARTHEST) / STEP).astype(np.uint16)
        return cls(scan.origin, scan.bearings.astype(np.float32), ranges, np.packbits(scan.hit & kept))

    def reaches(self, points: Floats, behind: float) -> Bools:
        """Return for each point, n × 2 in the robot's frame, whether a beam went on behind it for m."""
        x, y = (points - self.origin).T
        first = float(self.bearings[0])
        beam = np.searchsorted(self.bearings - first, (np.arctan2(y, x) - first) % (2.0 * math.pi))
        reached: Bools = np.append(self.ranges * STEP, 0.0)[beam] > np.hypot(x, y) + behind
        return reached

    def unpacked(self) -> BodyScan:
        """Return the scan again."""
        bearings = self.bearings.astype(np.float64)
        ranges = self.ranges.astype(np.float64) * STEP
        hit = np.unpackbits(self.hit, count=len(ranges)).astype(np.bool_)
        x = self.origin[0] + ranges * np.cos(bearings)
        ends = np.column_stack([x, self.origin[1] + ranges * np.sin(bearings)])
        return _with_surfaces(self.origin, bearings, ranges, hit, ends)


def to_body(
    scan: LaserScan, mount: Mount, farthest: float = math.inf, motion: Floats | None = None
) -> BodyScan:
    """Return the scan in the robot's frame, cut at `farthest` [m].

    `motion` (n × 3: m, m, rad): pose of the robot at each beam's time, in the robot's frame at the end."""
    ranges = np.asarray(scan.ranges, dtype=np.float64)
    end = min(scan.range_max, farthest)
    read = (ranges >= max(scan.range_min, 1e-9)) & (ranges < math.inf)
    hit = read & (ranges < end)
    lengths = np.where(read, np.minimum(ranges, end), 0.0)
    dx, dy = mount.beams(scan)
    origin = (mount.x, mount.y)
    if motion is None:
        scale = np.sqrt(dx * dx + dy * dy)  # of a tilted lidar, less than 1
        ends = np.column_stack([mount.x + lengths * dx, mount.y + lengths * dy])
        lengths *= scale
    else:
        c, s = np.cos(motion[:, 2]), np.sin(motion[:, 2])
        x, y = mount.x + lengths * dx, mount.y + lengths * dy
        ends = np.column_stack([motion[:, 0] + c * x - s * y, motion[:, 1] + s * x + c * y])
        ends[~read] = origin
        dx, dy = np.where(read, (ends - origin).T, (c * dx - s * dy, s * dx + c * dy))
        lengths = np.where(read, np.sqrt(dx * dx + dy * dy), 0.0)
    bearings = np.arctan2(dy, dx)
    turns = bearings[1:] - bearings[:-1]
    turns -= 2.0 * math.pi * np.rint(turns / (2.0 * math.pi))
    bearings[1:] = bearings[:1] + np.cumsum(turns)
    if (bearings[1:] < bearings[:-1]).any():
        order = np.argsort(bearings, kind="stable")
        bearings, lengths, hit, ends = bearings[order], lengths[order], hit[order], ends[order]
    return _with_surfaces(origin, bearings, lengths, hit, ends)


def to_world(points: Floats, pose: Pose) -> Floats:
    """Return points (n × 2) of the robot's frame in the world, for the robot at this pose."""
    world = rotated(points, pose.yaw)
    world += (pose.x, pose.y)
    return world


def rotated(vectors: Floats, angle: float) -> Floats:
    """Return vectors (n × 2) turned by an angle."""
    c, s = math.cos(angle), math.sin(angle)
    turned: Floats = vectors @ np.array([[c, s], [-s, c]])
    return turned


SPAN, SPAN_NOISE = 0.2, 10.0
"""m to each side of a hit: the surface that is fitted, at least one hit to each side; and at least so many
times the noise of a range"""
STRAIGHT = 0.02
"""Hits form a line if their variance across it is below this share of the variance along it"""
STEEP = 0.2
"""Cosine between a surface's normal and the beam below which it rather is the gap between two surfaces"""
STEP_UP = (0.05, 6.0)
"""m, and times the noise of a range, by which neighbouring ranges of one surface may differ besides"""
FEWEST, LOW, OF_LOW, USUAL_NOISE, MOST_NOISE = 50, 25.0, 2.05, 0.03, 0.3
"""Least number of hits that show the noise, since too many of few are beside corners; percentile of how far
they are off the line through the two beside them; the standard deviation of a range, in those, if a fifth
is beside corners and edges; m, for which all lengths here are made, and m, at most"""


def _with_surfaces(
    origin: tuple[float, float], bearings: Floats, ranges: Floats, hit: Bools, ends: Floats
) -> BodyScan:
    noise = _noise(bearings, ranges, hit)
    surfaces = _surfaces(origin, bearings, ranges, hit, ends, noise)
    return BodyScan(origin, bearings, ranges, hit, ends, *surfaces, noise)


def _noise(bearings: Floats, ranges: Floats, hit: Bools) -> float:
    """Return by how much the standard deviation of a range is more than usual [m]: on a wall each lies on the
    line through the two beside it, however the wall lies."""
    middle = np.flatnonzero(hit[1:-1] & hit[:-2] & hit[2:]) + 1
    if len(middle) < FEWEST:
        return 0.0
    before, after = ranges[middle - 1], ranges[middle + 1]
    came, goes = bearings[middle] - bearings[middle - 1], bearings[middle + 1] - bearings[middle]
    across = before * np.sin(came) + after * np.sin(goes)
    off = np.abs(ranges[middle] - before * after * np.sin(came + goes) / np.maximum(across, 1e-9))
    found = min(OF_LOW * float(np.percentile(off, LOW)), MOST_NOISE)
    return math.sqrt(max(found * found - USUAL_NOISE * USUAL_NOISE, 0.0))


def _surfaces(
    origin: tuple[float, float], bearings: Floats, ranges: Floats, hit: Bools, ends: Floats, noise: float
) -> tuple[Bools, Floats, Floats]:
    """Return where the hits lie on a straight surface, a point on it, and its normal."""
    count = len(ranges)
    if count < 3:
        return np.zeros(count, dtype=np.bool_), np.zeros((count, 2)), np.zeros((count, 2))
    spacing = ranges * ((bearings[-1] - bearings[0]) / (count - 1))
    span = max(SPAN, SPAN_NOISE * noise)
    half = np.minimum(np.maximum(span / np.maximum(spacing, 1e-6), 1.0), count / 8 + 1).astype(np.intp)
    index = np.arange(count)
    first, last = np.maximum(index - half, 0), np.minimum(index + half + 1, count)
    sums = np.zeros((7, count + 1))
    number, x, y, xx, yy, xy, jump = sums[:, 1:]
    number[:] = hit
    np.multiply((ends - origin).T, hit, out=sums[1:3, 1:])
    np.multiply(x, x, out=xx)
    np.multiply(y, y, out=yy)
    np.multiply(x, y, out=xy)
    before = np.maximum.accumulate(np.where(hit, index, 0))[:-1]  # a beam without a reading is no jump
    away = np.abs(ranges[1:] - ranges[before]) > max(STEP_UP[0], STEP_UP[1] * noise) + (
        spacing[1:] * (index[1:] - before) / STEEP
    )
    jump[:-1] = hit[1:] & hit[before] & away
    np.cumsum(sums, axis=1, out=sums)
    number, x, y, xx, yy, xy, _ = sums.take(last, axis=1) - sums.take(first, axis=1)
    jumps = sums[6].take(last - 1) - sums[6].take(first)
    share = 1.0 / np.maximum(number, 1.0)
    x, y = x * share, y * share
    xx, yy, xy = xx * share - x * x, yy * share - y * y, xy * share - x * y
    middle, difference = 0.5 * (xx + yy), 0.5 * (xx - yy)
    root = np.sqrt(difference * difference + xy * xy)
    scatter = noise * noise * np.maximum(1.0 - 2.0 * share, 0.0)
    straight = hit & (number >= 3.0) & (jumps == 0.0)
    straight &= middle - root < STRAIGHT * (middle + root) + scatter
    across = 0.5 * np.arctan2(xy, difference) + 0.5 * math.pi
    nx, ny = np.cos(across), np.sin(across)
    towards = -(nx * x + ny * y)
    straight &= np.abs(towards) > STEEP * np.sqrt(x * x + y * y)
    sign = np.where(towards < 0.0, -1.0, 1.0)
    middles = np.column_stack([x + origin[0], y + origin[1]])
    return straight, middles, np.column_stack([nx * sign, ny * sign])
