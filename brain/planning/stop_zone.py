"""Stop zone: the part of a wanted twist from which the base stops before what its lidars see.

Rules. Raw ranges in the robot's own frame, before filter and map: only the mounts, and the wheels' dead
reckoning since each beam was measured. The points of the last two scans of every lidar count. A beam that
ends alone, with no neighbouring beam near, counts once the previous scan has something at the same place.

A twist moves the footprint along an arc until it is within `gap` of a point (`brain.planning.outline`).
The share of the twist is such that reaction and braking along this arc end before. If a point is within the
gap already, no motion that brings any point nearer than that one is allowed. The base brakes along the arc
that it is on, which was found free, until the wanted one is slow enough. A base that an obstacle makes stand
may turn on the spot, slowly and up to `turn_gap`, so that it can leave.

Not seen, and therefore not protected: what no lidar's plane meets (glass, table tops), what is nearer than a
lidar's `range_min`, and everything on a robot without a lidar, which is not slowed either. Driving where no
lidar looks, as backward with one of 180°, is limited to `blind_speed`; turning is not. Nothing is predicted:
an obstacle that moves counts where it was seen last.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from math import cos, hypot, inf, isfinite, sin, sqrt

import numpy as np
import numpy.typing as npt

from brain.belief import Floats, Pose
from brain.bodies.differential import Differential, wrap
from brain.checks import ordered, within
from brain.perception.body_scan import Bools
from brain.perception.mount import Mount
from brain.planning.outline import Outline
from protocols.messages import MILLISECOND, Event, LaserScan, Nanos, seconds

Ints = npt.NDArray[np.int64]
Velocity = tuple[float, float]
"""Twist: m/s forward, rad/s to the left."""


@dataclass(frozen=True, slots=True)
class StopSettings:
    """How far from an obstacle, and how soon, the base stops."""

    gap: float = 0.05
    """m between the footprint and any point on its way"""
    turn_gap: float = 0.015
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


MAX_BEAMS, MAX_POINTS, MAX_ISOLATED = 10_000, 180, 64
"""Beams of a scan that is processed; points kept of it, the nearest of each group of neighbouring beams;
beams that end alone: if there are more, all count at once"""
NEIGHBOUR = 0.1
"""m, with the distance of neighbouring beams added: two beams within this support each other"""
HISTORY = 512
"""Poses of dead reckoning that are kept, to place the beams of a scan"""
AHEAD, SEEING = cos(0.35), 0.25
"""A beam within 20° of the direction of travel looks there; a lidar does if this share of them reads."""
HORIZON = 1.0
"""s of driving at the largest speed, for which points beyond the stopping distance are kept"""
CLEAR_AFTER = 0.3
"""s without an obstacle, after which none is reported"""
SLOWEST = 0.01
"""m/s: less is standing"""


@dataclass(slots=True)
class _View:
    """What one lidar saw last, in the frame of dead reckoning: points, 2 × n [m]."""

    t: Nanos
    ends: Floats
    """Of every beam that ends near enough"""
    kept: Floats
    """Those that count: of this scan,"""
    before: Floats
    """and of the one before"""
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
        self._mounts, self._outline = mounts, Outline(body)  # the mounts may be corrected
        self._views: dict[str, _View] = {}
        self._points: Floats = np.empty((2, 0))
        self._track: deque[tuple[Nanos, Pose]] = deque(maxlen=HISTORY)
        self._here = Pose(0.0, 0.0, 0.0)
        self._fresh = False
        """A scan has come since the last check."""
        self._clear = 0.0
        """s without an obstacle"""
        self._own_seen: set[str] = set()
        """Lidars that see the robot's own body."""
        self._notes: list[str] = []

    def observe(self, t: Nanos, here: Pose, events: Sequence[Event]) -> None:
        """Process the scans since the last call; `here`: dead reckoning by the wheels at time t."""
        self._here = here
        if not self._track or t > self._track[-1][0]:
            self._track.append((t, here))
        for scan in events:
            if isinstance(scan, LaserScan) and scan.sensor in self._mounts and _is_usable(scan):
                last = self._views.get(scan.sensor)
                if last is None or scan.t > last.t:
                    self._views[scan.sensor] = self._view(scan, last)
                    self._fresh = True
        if self._fresh:
            self._points = np.hstack([p for view in self._views.values() for p in (view.kept, view.before)])

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
            result, braked = _scaled(desired, share), self._braked(previous, dt)
            if abs(result[0]) < abs(braked[0]) or abs(result[1]) < abs(braked[1]):
                result = braked
            if max(abs(result[0]), abs(previous[0])) < SLOWEST:
                turned = self._turned(previous, wanted, dt, points)
                result = turned if abs(turned[1]) > abs(result[1]) else result
        self._report(wanted, result, share, away, dt)
        return result

    def take_notes(self) -> list[str]:
        """Return the notes for the operator since the last call."""
        notes, self._notes = self._notes, []
        return notes

    # -- scans --------------------------------------------------------------------------------

    def _view(self, scan: LaserScan, last: _View | None) -> _View:
        mount, count = self._mounts[scan.sensor], len(scan.ranges)
        ranges = np.asarray(scan.ranges, dtype=np.float64)
        beams = mount.beams(scan)
        read = np.isfinite(ranges) & (ranges >= max(scan.range_min, 1e-9))
        ways = beams[0] > AHEAD, beams[0] < -AHEAD
        sees = [np.count_nonzero(read & way) > SEEING * np.count_nonzero(way) for way in ways]
        farthest = min(scan.range_max, self._reach() + hypot(mount.x, mount.y))
        index = np.flatnonzero(read & (ranges < farthest))
        points = ranges[index] * beams[:, index] + [[mount.x], [mount.y]]
        own = self._outline.distances(points) < self.settings.self_seen
        if own.any():
            self._note_own(scan.sensor, int(own.sum()))
            index, points = index[~own], points[:, ~own]
        ends = self._placed(points, scan.t, index * np.float64(scan.duration / max(count - 1, 1)))
        spacing = NEIGHBOUR + scan.angle_increment * ranges[index]
        counts = _supported(ends, index, spacing, count)
        if last is not None:
            counts = _confirmed(ends, counts, last.ends)
        before = last.kept if last else ends[:, :0]
        kept = _thinned(ends[:, counts], self._here)
        return _View(scan.t, _thinned(ends, self._here), kept, before, (bool(sees[0]), bool(sees[1])))

    def _reach(self) -> float:
        """Return how far from the origin a point may matter until the next scans [m]."""
        body, settings = self.body, self.settings
        stopping = body.max_linear**2 / (2.0 * body.max_linear_acceleration)
        driven = body.max_linear * (seconds(settings.latency) + HORIZON)
        return self._outline.radius + self._outline.longest * settings.gap + stopping + driven

    def _note_own(self, name: str, count: int) -> None:
        if count > 2 and name not in self._own_seen:
            self._own_seen.add(name)
            text = "they are ignored; its own body, or something that touches it"
            self._notes.append(f"{name}: {count} beams end within the footprint: {text}")

    def _placed(self, points: Floats, t: Nanos, after: Floats) -> Floats:
        """Return points of the robot's frame, each measured `after` [ns] t, in that of dead reckoning."""
        rows: list[tuple[float, float, float, float]] = []
        for at, pose in reversed(self._track):
            rows.append((at - t, pose.x, pose.y, wrap(pose.yaw - self._here.yaw)))
            if at <= t:
                break
        times, *track = np.array(rows[::-1], dtype=np.float64).T
        x, y, yaw = (np.interp(after, times, values) for values in track)
        c, s = np.cos(yaw + self._here.yaw), np.sin(yaw + self._here.yaw)
        return np.array([x + c * points[0] - s * points[1], y + s * points[0] + c * points[1]])

    # -- twist --------------------------------------------------------------------------------

    def _near(self, twist: Velocity) -> Floats:
        """Return the points (2 × n) in the robot's frame that the footprint can reach while it stops."""
        time = seconds(self.settings.latency) + self._to_rest(twist)
        outline, driven = self._outline, abs(twist[0]) * time
        reach = outline.radius + outline.longest * self.settings.gap + driven
        x, y = self._points[0] - self._here.x, self._points[1] - self._here.y
        near = x * x + y * y < reach * reach
        x, y = x[near], y[near]
        c, s = cos(self._here.yaw), sin(self._here.yaw)
        return np.array([c * x + s * y, c * y - s * x])

    def _share(self, twist: Velocity, points: Floats, gap: float) -> tuple[float, float]:
        """Return the share of a twist from which the base can stop, and how far away along its arc the point
        is for which it must [m]; inf if it is another reason.

        Reaction and braking: r·share + T·share²/2 <= time, with T the time in which all of it is braked."""
        share, away = 1.0, inf
        time, grown = self._outline.contact(points, *twist, gap) if any(twist) and points.size else (inf, gap)
        if isfinite(time):
            reaction, braking = seconds(self.settings.latency), self._to_rest(twist)
            share = min((sqrt(reaction**2 + 2.0 * braking * time) - reaction) / braking, 1.0)
            away = grown + abs(twist[0]) * time
        blind = self._views and not any(view.sees[int(twist[0] < 0.0)] for view in self._views.values())
        if blind and self.settings.blind_speed < share * abs(twist[0]):
            return self.settings.blind_speed / abs(twist[0]), inf
        return share, away

    def _to_rest(self, twist: Velocity) -> float:
        """Return the time [s] to brake a twist along its arc, within both accelerations."""
        linear, angular = abs(twist[0]), abs(twist[1])
        return max(linear / self.body.max_linear_acceleration, angular / self.body.max_angular_acceleration)

    def _braked(self, twist: Velocity, dt: float) -> Velocity:
        """Return a twist after braking for dt [s] along its arc, as hard as the body may."""
        body = self.body
        harder = (body.stop_deceleration or body.max_linear_acceleration) / body.max_linear_acceleration
        return _scaled(twist, 1.0 - dt * harder / max(self._to_rest(twist), dt * harder, 1e-9))

    def _turned(self, previous: Velocity, wanted: Velocity, dt: float, points: Floats) -> Velocity:
        """Return a slow turn on the spot towards the wanted side, as far as there is room for it."""
        slow, step = self.settings.blind_speed / self._outline.radius, self.body.max_angular_acceleration * dt
        target = max(min(wanted[1], slow), -slow)
        turn = 0.0, max(min(target, previous[1] + step), previous[1] - step)
        return _scaled(turn, self._share(turn, points, self.settings.turn_gap)[0])

    def _report(self, wanted: Velocity, result: Velocity, share: float, away: float, dt: float) -> None:
        """Set the reason, with hysteresis: noise of the ranges must not make it flicker."""
        radius = self._outline.radius
        fast, speed = (abs(linear) + radius * abs(angular) for linear, angular in (wanted, result))
        free = share >= 1.0 or speed >= 0.9 * fast
        self._clear = self._clear + dt if free else 0.0
        if self._clear >= CLEAR_AFTER or fast == 0.0:
            self.reason, self.standing = "", 0.0
        if free:
            return
        stands = speed < (0.25 * fast if self.standing else SLOWEST)
        self.standing = self.standing + dt if stands else 0.0
        way = "ahead" if wanted[0] > 0.0 else "behind" if wanted[0] < 0.0 else "beside"
        near = f"obstacle {max(away, 0.0):.2f} m {way}" if isfinite(away) else f"no lidar looks {way}"
        self.reason = f"{near}: {'standing' if stands else 'slow'}"


def _scaled(twist: Velocity, share: float) -> Velocity:
    return twist[0] * share, twist[1] * share


def _is_usable(scan: LaserScan) -> bool:
    """Return whether a scan is of bounded work, and its numbers are finite."""
    numbers = scan.angle_min, scan.angle_increment, scan.range_min, scan.range_max
    return 0 < len(scan.ranges) <= MAX_BEAMS and all(abs(number) < 1e6 for number in numbers)


def _supported(ends: Floats, index: Ints, spacing: Floats, count: int) -> Bools:
    """Return which beams end within `spacing` of the next reading, or of the one before, among neighbours."""
    step = (np.concatenate((index[1:], index[:1])) - index) % count
    x, y = np.concatenate((ends[:, 1:], ends[:, :1]), axis=1) - ends
    pair = (step > 0) & (step <= 2) & (x * x + y * y <= spacing * spacing)
    found: Bools = pair | np.concatenate((pair[-1:], pair[:-1]))
    return found


def _confirmed(ends: Floats, counts: Bools, before: Floats) -> Bools:
    """Return which points count if those do as well that the previous scan has at the same place."""
    alone = np.flatnonzero(~counts)
    if len(alone) > MAX_ISOLATED:
        return np.ones_like(counts)
    x, y = ends[:, alone, None] - before[:, None]
    counts[alone] = (x * x + y * y <= NEIGHBOUR**2).any(axis=1)
    return counts


def _thinned(points: Floats, here: Pose) -> Floats:
    """Return at most MAX_POINTS: of each group of neighbours the nearest."""
    count = points.shape[1]
    group = -(-count // MAX_POINTS)
    if group <= 1:
        return points
    rows = -(-count // group)
    distance = np.full(rows * group, inf)
    distance[:count] = np.hypot(points[0] - here.x, points[1] - here.y)
    thinned: Floats = points[:, distance.reshape(rows, group).argmin(axis=1) + group * np.arange(rows)]
    return thinned
