"""Stop zone: the share of a wanted twist from which the base stops before what its lidars see.

Rules. Raw ranges in the robot's own frame, before filter and map: only the mounts, and the wheels' dead
reckoning since each beam was measured. The points of the last two scans of every lidar count. A beam that
ends alone, with no neighbouring beam near, counts once the previous scan has something at the same place.

A twist moves the footprint along an arc. The time until the footprint, grown by `gap`, meets the first point
on that arc is exact: seen from the robot a point moves on a circle about the centre of the turn, which is
intersected with the edges that lead. The share of the twist is such that reaction and braking on this arc end
before. If a point is within the gap already, no motion that brings any point nearer than that one is allowed.
The base brakes along the arc that it is on, which was found free, until the wanted one is slow enough.
A base that an obstacle makes stand may turn on the spot, slowly and up to `turn_gap`, so that it can leave.

Not seen, and therefore not protected: what no lidar's plane meets (glass, table tops), what is nearer than a
lidar's `range_min`, and everything on a robot without a lidar, which is not slowed either. Driving where no
lidar looks, as backward with one of 180°, is limited to `blind_speed`; turning is not.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from math import copysign, cos, hypot, inf, isfinite, pi, sin, sqrt

import numpy as np
import numpy.typing as npt

from brain.belief import Floats, Pose
from brain.bodies.differential import Differential, wrap
from brain.checks import ordered, within
from brain.perception.mount import Bools, Mount
from protocols.messages import MILLISECOND, Event, LaserScan, Nanos, seconds

Ints = npt.NDArray[np.int64]
Velocity = tuple[float, float]
"""Twist: m/s forward, rad/s to the left."""


@dataclass(frozen=True, slots=True)
class StopSettings:
    """How far from an obstacle, and how soon, the base stops."""

    gap: float = 0.05
    """m between the footprint and any point on its way"""
    turn_gap: float = 0.01
    """m, the same for a slow turn on the spot of a base that an obstacle makes stand"""
    latency: Nanos = 100 * MILLISECOND
    """From a command to the motion that it causes, with the age of the wheels' feedback"""
    blind_speed: float = 0.1
    """m/s: largest speed towards where no lidar looks, and of the footprint's corners in such a slow turn"""
    self_seen: float = 0.0
    """m about the footprint, within which a beam ends at the robot's own body and is ignored"""

    def __post_init__(self) -> None:
        within(
            self,
            gap=(0.0, 2.0, "m"),
            turn_gap=(0.0, 2.0, "m"),
            latency=(0.0, 2000.0),
            blind_speed=(0.0, 20.0, "m/s"),
            self_seen=(0.0, 1.0, "m"),
        )
        ordered(self, "turn_gap", "gap")


MAX_BEAMS, MAX_POINTS = 10_000, 360
"""Beams of a scan that is processed; points kept of it, the nearest of each group of neighbouring beams."""
NEIGHBOUR = 0.1
"""m, with the distance of neighbouring beams added: two beams within this support each other"""
MAX_ISOLATED = 64
"""Of more beams that end alone in one scan, all count at once."""
HISTORY = 512
"""Poses of dead reckoning that are kept, to place the beams of a scan."""
AHEAD = cos(0.35)
"""A beam within 20° of the direction of travel looks there;"""
SEEING = 0.25
"""a lidar does if this share of those beams has a reading."""
HORIZON = 1.0
"""s of driving at the largest speed, for which points beyond the stopping distance are kept"""
CLEAR_AFTER = 0.3
"""s without an obstacle, after which none is reported"""
SLOWEST = 0.01
"""m/s: less is standing"""
TOUCH = 1e-6
"""m: what is nearer than the gap counts as this far from the footprint's edge."""
STRAIGHT = 1e-6
"""rad/m: least curvature computed with"""


class Outline:
    """The footprint as a convex polygon, and when it meets a point. Constant."""

    def __init__(self, body: Differential) -> None:
        self.corners = np.array(body.outline)
        edges = np.roll(self.corners, -1, axis=0) - self.corners
        self.normals = np.stack([edges[:, 1], -edges[:, 0]], axis=1) / np.linalg.norm(edges, axis=1)[:, None]
        self.offsets: Floats = (self.normals * self.corners).sum(axis=1)
        before = np.roll(self.normals, 1, axis=0)
        opening = 1.0 + (before * self.normals).sum(axis=1)
        self.mitres: Floats = (before + self.normals) / np.maximum(opening, 0.1)[:, None]
        """Motion of the corners per metre by which all edges are moved outward."""
        self.radius = float(np.linalg.norm(self.corners, axis=1).max())
        self.inner = float(self.offsets.min())

    def distances(self, points: Floats) -> Floats:
        """Return how far the edges must be moved outward until they meet each point (n × 2) [m]."""
        most: Floats = (points @ self.normals.T - self.offsets).max(axis=1)
        return most

    def contact(self, points: Floats, twist: Velocity, gap: float) -> tuple[float, float]:
        """Return the time [s] at this twist until the footprint, grown by the gap, meets a point (n × 2), and
        that gap [m]: less than `gap` if a point is nearer already."""
        distances = self.distances(points)
        outside = distances > -0.5 * self.inner
        if not outside.all():
            points, distances = points[outside], distances[outside]
        if not len(points):
            return inf, gap
        grown = min(gap, float(distances.min()) - TOUCH)
        v, w = twist
        w = copysign(max(abs(w), STRAIGHT * abs(v)), w)
        corners = self.corners + grown * self.mitres
        following = np.roll(corners, -1, axis=0)
        ahead = v * self.normals[:, 0]  # outward speed of the edges' ends
        turning = w * np.stack([-corners[:, 1], corners[:, 0], -following[:, 1], following[:, 0]])
        begin = ahead + turning[0] * self.normals[:, 0] + turning[1] * self.normals[:, 1]
        end = ahead + turning[2] * self.normals[:, 0] + turning[3] * self.normals[:, 1]
        leading = np.maximum(begin, end) > 1e-5 * (abs(v) + abs(w) * self.radius)
        center = np.array([0.0, v / w])
        a, d = (corners - center)[leading], (following - corners)[leading]
        points = points - center
        aa, ad, dd = (a * a).sum(axis=1), (a * d).sum(axis=1), (d * d).sum(axis=1)
        nearest = np.clip(-ad / dd, 0.0, 1.0)
        radii = (points * points).sum(axis=1)
        swept = (radii <= max(aa.max(), (aa + 2.0 * ad + dd).max())) & (
            radii >= (aa + nearest * (2.0 * ad + nearest * dd)).min()
        )
        if not swept.any():
            return inf, grown
        points, radii = points[swept, None], radii[swept, None]
        inside = ad * ad - dd * (aa - radii)
        root = np.sqrt(np.maximum(inside, 0.0))
        along = np.stack([-ad - root, -ad + root]) / dd
        hit_x, hit_y = a[:, 0] + along * d[:, 0], a[:, 1] + along * d[:, 1]
        x, y = points[..., 0], points[..., 1]
        turn = np.arctan2(x * hit_y - y * hit_x, x * hit_x + y * hit_y)
        turn = np.mod(-copysign(1.0, w) * turn, 2.0 * pi)
        turn[(inside < 0.0) | (along < 0.0) | (along > 1.0)] = inf
        return float(turn.min()) / abs(w), grown


@dataclass(slots=True)
class _Beams:
    """Directions of a lidar's beams, as long as its scans keep their shape."""

    shape: tuple[float, float, int]
    directions: Floats
    """n × 2, in the robot's frame; shorter than 1 if the lidar is tilted"""
    ways: tuple[Bools, Bools]
    """n: which beams look ahead, and behind"""


@dataclass(slots=True)
class _View:
    """What one lidar saw last, in the frame of dead reckoning."""

    t: Nanos
    ends: Floats
    """n × 2, m: of every beam near enough"""
    kept: Floats
    """Those that count: of this scan,"""
    before: Floats
    """and of the one before."""
    sees: tuple[bool, bool]
    """Ahead, behind"""


class StopZone:
    """Points about the base, and the twist that they allow. State is plain data."""

    def __init__(self, body: Differential, mounts: Mapping[str, Mount], settings: StopSettings) -> None:
        self.body, self.settings = body, settings
        self.reason = ""
        """Why the base is slower than wanted: "obstacle 0.31 m ahead: slow"; "" if it is not."""
        self.standing = 0.0
        """s for which an obstacle has made the base stand"""
        self._notes: list[str] = []
        self._mounts = dict(mounts)
        self._outline = Outline(body)
        self._beams: dict[str, _Beams] = {}
        self._views: dict[str, _View] = {}
        self._points: Floats = np.empty((0, 2))
        self._here = Pose(0.0, 0.0, 0.0)
        self._track: deque[tuple[Nanos, Pose]] = deque(maxlen=HISTORY)
        self._own_seen: set[str] = set()
        self._clear = 0.0
        self._fresh = False
        """A scan has come since the last check."""

    def observe(self, t: Nanos, here: Pose, events: Sequence[Event]) -> None:
        """Process the scans since the last call; `here`: dead reckoning by the wheels at time t."""
        self._here = here
        if not self._track or t > self._track[-1][0]:
            self._track.append((t, here))
        scans = [e for e in events if isinstance(e, LaserScan) and e.sensor in self._mounts]
        for scan in scans:
            if _is_usable(scan) and (scan.sensor not in self._views or scan.t > self._views[scan.sensor].t):
                self._on_scan(scan)
        if scans:
            self._points = np.concatenate([p for v in self._views.values() for p in (v.kept, v.before)])

    def is_too_fast(self, twist: Velocity) -> bool:
        """Return whether a scan since the last call shows that this twist is too fast."""
        fresh, self._fresh = self._fresh, False
        return fresh and self._share(twist, self._near(twist), self.settings.gap)[0] < 1.0

    def allowed(self, previous: Velocity, desired: Velocity, wanted: Velocity, dt: float) -> Velocity:
        """Return the next twist, dt [s] after the previous: the desired one (within the accelerations, on its
        way to the wanted one), or what can be stopped in time."""
        points = self._near(desired)
        share, away = self._share(desired, points, self.settings.gap)
        result = desired
        if share < 1.0:
            result = desired[0] * share, desired[1] * share
            braked = self._braked(previous, dt)
            if abs(result[0]) < abs(braked[0]) or abs(result[1]) < abs(braked[1]):
                result = braked
            if abs(result[0]) < SLOWEST and abs(previous[0]) < SLOWEST:
                result = max(
                    result, self._turned(previous, wanted, dt, points), key=lambda twist: abs(twist[1])
                )
        self._report(wanted, result, share, away, dt)
        return result

    def take_notes(self) -> list[str]:
        """Return the notes for the operator since the last call."""
        notes, self._notes = self._notes, []
        return notes

    # -- scans --------------------------------------------------------------------------------

    def _on_scan(self, scan: LaserScan) -> None:
        beams, mount, count = self._shaped(scan), self._mounts[scan.sensor], len(scan.ranges)
        ranges = np.asarray(scan.ranges, dtype=np.float64)
        read = np.isfinite(ranges) & (ranges >= max(scan.range_min, 1e-9))
        farthest = min(scan.range_max, self._reach() + hypot(mount.x, mount.y))
        index = np.flatnonzero(read & (ranges < farthest))
        points = ranges[index, None] * beams.directions[index] + (mount.x, mount.y)
        index, points = self._without_own(scan.sensor, index, points)
        after: Floats = index * np.float64(scan.duration / max(count - 1, 1))
        ends = self._placed(points, scan.t, after)
        last = self._views.get(scan.sensor)
        spacing = NEIGHBOUR + scan.angle_increment * ranges[index]
        counts = _supported(ends, index, spacing, count)
        if last is not None:
            counts = _confirmed(ends, counts, last.ends)
        kept = _thinned(ends[counts], self._here)
        ahead, behind = (bool(read[way].sum() > SEEING * way.sum()) for way in beams.ways)
        before = last.kept if last else ends[:0]
        self._views[scan.sensor] = _View(scan.t, _thinned(ends, self._here), kept, before, (ahead, behind))
        self._fresh = True

    def _shaped(self, scan: LaserScan) -> _Beams:
        shape = scan.angle_min, scan.angle_increment, len(scan.ranges)
        known = self._beams.get(scan.sensor)
        if known is not None and known.shape == shape:
            return known
        angles = scan.angle_min + scan.angle_increment * np.arange(shape[2])
        axes = np.array([row[:2] for row in self._mounts[scan.sensor].rotation()[:2]])
        directions = np.stack([np.cos(angles), np.sin(angles)], axis=1) @ axes.T
        ways = directions[:, 0] > AHEAD, directions[:, 0] < -AHEAD
        self._beams[scan.sensor] = _Beams(shape, directions, ways)
        return self._beams[scan.sensor]

    def _reach(self) -> float:
        """Return how far from the origin a point may matter until the next scans [m]."""
        body, settings = self.body, self.settings
        stopping = body.max_linear**2 / (2.0 * body.max_linear_acceleration)
        driven = body.max_linear * (seconds(settings.latency) + HORIZON)
        return self._outline.radius + settings.gap + stopping + driven

    def _without_own(self, name: str, index: Ints, points: Floats) -> tuple[Ints, Floats]:
        own = self._outline.distances(points) < self.settings.self_seen
        count = int(own.sum())
        if not count:
            return index, points
        if count > 2 and name not in self._own_seen:
            self._own_seen.add(name)
            self._notes.append(
                f"{name}: {count} beams end within the footprint, at its own body, and are ignored"
            )
        return index[~own], points[~own]

    def _placed(self, points: Floats, t: Nanos, after: Floats) -> Floats:
        """Return points of the robot's frame, each measured `after` [ns] t, in that of dead reckoning."""
        rows: list[tuple[float, float, float, float]] = []
        for at, pose in reversed(self._track):
            rows.append((at - t, pose.x, pose.y, wrap(pose.yaw - self._here.yaw)))
            if at <= t:
                break
        times, x, y, yaw = (np.array(column[::-1], dtype=np.float64) for column in zip(*rows, strict=True))
        heading = np.interp(after, times, yaw) + self._here.yaw
        c, s = np.cos(heading), np.sin(heading)
        placed = np.empty_like(points)
        placed[:, 0] = np.interp(after, times, x) + c * points[:, 0] - s * points[:, 1]
        placed[:, 1] = np.interp(after, times, y) + s * points[:, 0] + c * points[:, 1]
        return placed

    # -- twist --------------------------------------------------------------------------------

    def _near(self, twist: Velocity) -> Floats:
        """Return the points (n × 2) in the robot's frame that the footprint can reach while it stops."""
        time = seconds(self.settings.latency) + self._to_rest(twist, 1.0)
        reach = self._outline.radius * 1.5 + self.settings.gap + abs(twist[0]) * time
        x, y = self._points[:, 0] - self._here.x, self._points[:, 1] - self._here.y
        near = x * x + y * y < reach * reach
        x, y = x[near], y[near]
        c, s = cos(self._here.yaw), sin(self._here.yaw)
        return np.stack([c * x + s * y, c * y - s * x], axis=1)

    def _share(self, twist: Velocity, points: Floats, gap: float) -> tuple[float, float]:
        """Return the share of a twist from which the base can stop, and how far away [m] along its arc the
        point is for which it must; inf if it is another reason.

        Reaction and braking: r·share + T·share²/2 <= time, with T the time in which all of it is braked."""
        if twist == (0.0, 0.0):
            return 1.0, inf
        share, away = 1.0, inf
        time, grown = self._outline.contact(points, twist, gap) if len(points) else (inf, gap)
        if isfinite(time):
            reaction, braking = seconds(self.settings.latency), self._to_rest(twist, 1.0)
            share = (sqrt(reaction**2 + 2.0 * braking * time) - reaction) / braking
            away = grown + abs(twist[0]) * time
        blind = self._views and not any(view.sees[twist[0] < 0.0] for view in self._views.values())
        if blind and self.settings.blind_speed < min(share, 1.0) * abs(twist[0]):
            return self.settings.blind_speed / abs(twist[0]), inf
        return min(share, 1.0), away

    def _to_rest(self, twist: Velocity, harder: float) -> float:
        """Return the time [s] to brake a twist along its arc."""
        body = self.body
        return max(
            abs(twist[0]) / (harder * body.max_linear_acceleration),
            abs(twist[1]) / (harder * body.max_angular_acceleration),
        )

    def _braked(self, twist: Velocity, dt: float) -> Velocity:
        """Return a twist after braking for dt [s] along its arc, as hard as the body may."""
        body = self.body
        harder = (body.stop_deceleration or body.max_linear_acceleration) / body.max_linear_acceleration
        left = 1.0 - dt / max(self._to_rest(twist, harder), dt, 1e-9)
        return twist[0] * left, twist[1] * left

    def _turned(self, previous: Velocity, wanted: Velocity, dt: float, points: Floats) -> Velocity:
        """Return a slow turn on the spot towards the wanted side, as far as there is room for it."""
        slow = self.settings.blind_speed / self._outline.radius
        target = max(min(wanted[1], slow), -slow)
        step = self.body.max_angular_acceleration * dt
        turn = max(min(target, previous[1] + step), previous[1] - step)
        share, _ = self._share((0.0, turn), points, self.settings.turn_gap)
        return 0.0, turn * share

    def _report(self, wanted: Velocity, result: Velocity, share: float, away: float, dt: float) -> None:
        """Set the reason, with hysteresis: noise of the ranges must not make it flicker."""
        speed, free = self._speed(result), share >= 1.0 or self._speed(result) >= 0.9 * self._speed(wanted)
        self._clear = self._clear + dt if free else 0.0
        if self._clear >= CLEAR_AFTER or wanted == (0.0, 0.0):
            self.reason, self.standing = "", 0.0
        if free:
            return
        stands = speed < (5.0 * SLOWEST if self.standing else SLOWEST)
        self.standing = self.standing + dt if stands else 0.0
        how = "standing" if stands else "slow"
        way = "ahead" if wanted[0] > 0.0 else "behind" if wanted[0] < 0.0 else "beside"
        near = f"obstacle {max(away, 0.0):.2f} m {way}" if isfinite(away) else f"no lidar looks {way}"
        self.reason = f"{near}: {how}"

    def _speed(self, twist: Velocity) -> float:
        """Return the largest speed of a point of the footprint, at most [m/s]."""
        return abs(twist[0]) + self._outline.radius * abs(twist[1])


def _is_usable(scan: LaserScan) -> bool:
    numbers = scan.angle_min, scan.angle_increment, scan.range_min, scan.range_max
    return 0 < len(scan.ranges) <= MAX_BEAMS and all(abs(number) < 1e6 for number in numbers)


def _supported(ends: Floats, index: Ints, spacing: Floats, count: int) -> Bools:
    """Return which beams end within `spacing` of the next reading, or of the one before, among neighbours."""
    step = (np.roll(index, -1) - index) % count
    away = np.roll(ends, -1, axis=0) - ends
    pair = (step > 0) & (step <= 2) & ((away * away).sum(axis=1) <= spacing * spacing)
    found: Bools = pair | np.roll(pair, 1)
    return found


def _confirmed(ends: Floats, counts: Bools, before: Floats) -> Bools:
    """Return which points count if those do as well that the previous scan has at the same place."""
    alone = np.flatnonzero(~counts)
    if not len(alone) or not len(before):
        return counts
    if len(alone) > MAX_ISOLATED:
        return np.ones_like(counts)
    away = ends[alone, None] - before
    counts[alone] = ((away * away).sum(axis=2) <= NEIGHBOUR**2).any(axis=1)
    return counts


def _thinned(points: Floats, here: Pose) -> Floats:
    """Return at most MAX_POINTS: of each group of neighbours the nearest."""
    group = -(-len(points) // MAX_POINTS)
    if group <= 1:
        return points
    rows = -(-len(points) // group)
    distance = np.full(rows * group, inf)
    distance[: len(points)] = np.hypot(points[:, 0] - here.x, points[:, 1] - here.y)
    thinned: Floats = points[distance.reshape(rows, group).argmin(axis=1) + group * np.arange(rows)]
    return thinned
