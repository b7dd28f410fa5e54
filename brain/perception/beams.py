"""Whether all beams of a lidar measure: some may be frozen, blind or covered, while the others are well.

Rules. Between two scans the wheels tell how the lidar has moved. That tells a defect from a place:

    frozen    not one bit of a range changes in `CONFIRM` scans that should have, by `FROZEN` in sum: the
              surface at a beam's end, from the beams beside it, tells by how much (along a wall not at all)
    hanging   a range below `NEAR` stays within `SPREAD` though the lidar has gone `GONE` or turned `TURNED`,
              and what it showed first is not there any more, where another beam looks: a cable or dirt in
              view. Whoever goes along so near, and so steadily, looks the same. What ends within the
              footprint, or `self_seen` about it, is the robot's own body
    blind     a sector of more than `SECTOR`, all of which had a return, has none in the next scans: a place
              opens beam by beam, and what passes by uncovers another part in each scan

A finding lasts until the beams measure again. Beams that never had a return show nothing: open ground looks
the same. State is plain data.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np

from brain.belief import Floats, Pose
from brain.bodies.body import Corners
from brain.bodies.plane import moved, wrap
from brain.perception.body_scan import Bools
from brain.perception.mount import Mount
from protocols.messages import SECOND, LaserScan, Nanos

FROZEN, STEPS = 0.15, 3.0
"""m, and at least so many of the lidar's own steps"""
NEAR, SPREAD, BEYOND = 0.6, 0.05, 0.2
"""m; farther than what was there, by the last, another beam ends"""
GONE, TURNED = 0.4, 0.8
"""m, rad"""
ABOUT, ON_THE_SPOT = 0.1, 0.5
"""rad to each side of a place, within which all beams must go on beyond; more by what the wheels say that it
has turned since, for they may slip; of a turn on the spot by this share"""
PER_SIDE = 6
"""Beams that are looked at to each side"""
WIDE, NARROW, FEW = 0.17, 0.1, 5
"""rad: least share of the view that is frozen, or hanging; and beams"""
SECTOR = 0.7
"""rad"""
SURELY = 0.8
"""Share of the largest range, below which a return is not lost by noise."""
CONFIRM = 3
"""Scans in a row in which a range is as before, or a sector is blind"""
BESIDE = 0.035
"""rad to each side of a beam: from there comes the slope of the surface,"""
STEEP = 3.0
"""which at most is this multiple of the range per rad: more is a gap between two surfaces."""
LONGEST: Nanos = SECOND // 2
"""Scans farther apart are not compared."""


@dataclass(frozen=True, slots=True)
class _Seen:
    """A scan, and what is known of each beam."""

    t: Nanos
    place: Pose
    """Of the lidar, by dead reckoning; its yaw is the robot's"""
    ranges: Floats
    read: Bools
    equal: Floats
    """Number of scans since a range last changed,"""
    due: Floats
    """and m by which it should have"""
    first: Floats
    """m, the range with which a near one is compared,"""
    where: Floats
    """and 5 × n: the end of that beam, then the place of the lidar, by dead reckoning"""
    hangs: Bools
    blind: Bools
    """The beams of a sector that has lost its returns,"""
    scans: int = 0
    """and for how many scans."""


class Beams:
    """The beams of one lidar.

    Args:
        outline: corners [m] of the footprint, convex, counter-clockwise.
        self_seen: m about it, within which a beam ends at the robot's own body.
    """

    def __init__(self, outline: Corners, self_seen: float) -> None:
        corners = np.array(outline)
        edges = np.roll(corners, -1, axis=0) - corners
        self._normals = np.column_stack((edges[:, 1], -edges[:, 0])) / np.hypot(*edges.T)[:, None]
        self._offsets = (self._normals * corners).sum(axis=1) + self_seen
        self._seen: _Seen | None = None

    def observe(self, scan: LaserScan, ranges: Floats, mount: Mount, here: Pose) -> str:
        """Return what some beams do in place of measuring, in words; "" if nothing shows that.

        `here`: the robot, by dead reckoning; its yaw is not wrapped."""
        place = replace(moved(here, Pose(mount.x, mount.y, 0.0)), yaw=here.yaw)
        beams, count = mount.beams(scan), len(ranges)
        read = (ranges >= max(scan.range_min, 1e-9)) & (ranges < scan.range_max)
        nothing, far = np.zeros(count, dtype=np.bool_), ranges >= scan.range_max
        ranges = np.where(read, ranges, 0.0)
        before, where = self._seen, _where(place, beams, ranges)
        zeros = np.zeros(count)
        now = _Seen(scan.t, place, ranges, read, zeros, zeros, ranges, where, nothing, nothing)
        if count < 2 or before is None or len(before.ranges) != count or scan.t - before.t > LONGEST:
            self._seen = now
            return ""
        same = read & (ranges == before.ranges)
        expected = _expected(before, place, beams, scan.angle_increment)
        equal, due = np.where(same, before.equal + 1.0, 0.0), np.where(same, before.due + expected, 0.0)
        least = max(FROZEN, STEPS * _step(ranges))
        frozen = (equal >= CONFIRM) & (np.abs(due) > least)
        now = self._with_hanging(before, now, scan, mount, np.where(far, np.inf, ranges))
        turn = abs(wrap(place.yaw - before.place.yaw))
        blind, scans = _blind(before, now, SECTOR + turn, scan)
        self._seen = now = replace(now, equal=equal, due=due, blind=blind, scans=scans)
        for bad, least, what in (
            (frozen, WIDE, "repeat their readings while the base moves"),
            (now.hangs, NARROW, "see something near that moves with the lidar"),
            (now.blind & (now.scans >= CONFIRM), SECTOR, "have lost their returns, all at once"),
        ):
            found = int(np.count_nonzero(bad))
            if found >= max(FEW, least / scan.angle_increment):
                x, y = beams[:, bad].sum(axis=1)
                about = round(math.degrees(math.atan2(y, x)))
                return f"{found} of {count} beams, about {about}° from ahead, {what}"
        return ""

    def _with_hanging(
        self, before: _Seen, now: _Seen, scan: LaserScan, mount: Mount, ranges: Floats
    ) -> _Seen:
        """Return a scan with its near beams that stay; `ranges`: inf where a beam goes on beyond."""
        beams = mount.beams(scan)
        stays = now.read & (now.ranges < NEAR) & (np.abs(now.ranges - before.first) < SPREAD)
        if not stays.any():
            return now
        first, where = np.where(stays, before.first, now.ranges), np.where(stays, before.where, now.where)
        x, y, from_x, from_y, from_yaw = where
        place = now.place
        went = np.hypot(place.x - from_x, place.y - from_y) > GONE
        turned = np.abs(place.yaw - from_yaw)
        gone = (went | (turned > TURNED)) & stays & self._outside(mount, beams, now.ranges)
        about = (ABOUT + turned * np.where(went, 1.0, ON_THE_SPOT))[gone]
        x, y = x[gone] - place.x, y[gone] - place.y
        gone[gone] = _seen_beyond(x, y, place.yaw, about, beams, scan, ranges)
        return replace(now, first=first, where=where, hangs=stays & (before.hangs | gone))

    def _outside(self, mount: Mount, beams: Floats, ranges: Floats) -> Bools:
        """Return which beams end outside the footprint."""
        ends = ranges * beams + [[mount.x], [mount.y]]
        outside: Bools = (self._normals @ ends > self._offsets[:, None]).any(axis=0)
        return outside


def _step(ranges: Floats) -> float:
    """Return the resolution [m] that the ranges of a scan show."""
    steps = np.diff(np.sort(ranges))
    return float(steps.min(where=steps > 1e-9, initial=1.0))


def _where(place: Pose, beams: Floats, ranges: Floats) -> Floats:
    """Return where each beam ends, and the lidar's place: 5 × n."""
    c, s = math.cos(place.yaw), math.sin(place.yaw)
    x, y = ranges * beams
    ends = place.x + c * x - s * y, place.y + s * x + c * y
    return np.stack([*ends, *(np.full(len(x), each) for each in (place.x, place.y, place.yaw))])


def _seen_beyond(
    dx: Floats, dy: Floats, yaw: float, about: Floats, beams: Floats, scan: LaserScan, ranges: Floats
) -> Bools:
    """Return at which points, from the lidar, beams pass and go on beyond, all within an angle `about` each
    [rad]; `yaw`: of the robot."""
    first, count = math.atan2(beams[1, 0], beams[0, 0]), len(ranges)
    beside = np.linspace(-1.0, 1.0, 2 * PER_SIDE + 1) * about[:, None]
    angles = _sense(beams) * (np.arctan2(dy, dx) - yaw - first)[:, None] + beside
    numbers = np.rint(angles % math.tau / scan.angle_increment).astype(np.intp)
    looked = numbers < count
    beyond = ranges[np.where(looked, numbers, 0)] > np.hypot(dx, dy)[:, None] + BEYOND
    return np.asarray((looked & beyond).all(axis=1))


def _sense(beams: Floats) -> float:
    """Return 1 if the beams go counter-clockwise, -1 if the lidar is mounted upside down."""
    (x, after_x), (y, after_y) = beams[:, :2]
    return 1.0 if x * after_y >= y * after_x else -1.0


def _blind(before: _Seen, now: _Seen, least: float, scan: LaserScan) -> tuple[Bools, int]:
    """Return the beams of the sector that is blind, or has become so, and for how many scans."""
    if 2 * np.count_nonzero(now.read[before.blind]) < np.count_nonzero(before.blind):
        return before.blind, before.scans + 1
    gone = before.read & ~now.read & (before.ranges < SURELY * scan.range_max)
    blind = _longest(~now.read, gone)
    if np.count_nonzero(blind) * scan.angle_increment <= least:
        return np.zeros_like(gone), 0
    return blind, 1


def _expected(before: _Seen, place: Pose, beams: Floats, increment: float) -> Floats:
    """Return by how much each range should have changed by the lidar's motion; 0 where it is not known."""
    c, s = math.cos(before.place.yaw), math.sin(before.place.yaw)
    dx, dy = place.x - before.place.x, place.y - before.place.y
    dx, dy, turn = c * dx + s * dy, c * dy - s * dx, wrap(place.yaw - before.place.yaw)
    ranges, step = before.ranges, max(1, round(BESIDE / increment))
    ahead, behind = np.roll(ranges, -step), np.roll(ranges, step)
    known = before.read & np.roll(before.read, -step) & np.roll(before.read, step)
    x, y = beams
    slope = _sense(beams) * (ahead - behind) / (2.0 * step * increment)
    known &= np.abs(slope) < STEEP * ranges
    known[:step] = known[-step:] = False
    aside = turn + (x * dy - y * dx) / np.where(known, ranges, 1.0)
    change: Floats = np.where(known, slope * aside - (x * dx + y * dy), 0.0)
    return change


def _longest(bad: Bools, gone: Bools) -> Bools:
    """Return the beams that are gone in the run of bad ones, around the circle, that has most of them."""
    starts = np.flatnonzero(bad & ~np.roll(bad, 1))
    if not len(starts):
        return gone
    run = (np.cumsum(bad & ~np.roll(bad, 1)) - 1) % len(starts)
    counts = np.bincount(run[gone], minlength=len(starts))
    most: Bools = gone & (run == counts.argmax())
    return most
