"""Stop zone: the part of a wanted twist from which the base stops before what its lidars see.

Rules. Raw ranges in the robot's own frame, before filter and map: only the mounts, and the wheels' dead
reckoning since each beam was measured. The points of the last two scans of every lidar count. A beam that
ends alone, with no neighbouring beam near, counts once the previous scan has something at the same place.

A twist moves the footprint along an arc until it is within `gap` of a point (`brain.planning.outline`).
The next motion is the wanted one, or of those between that and braking the nearest to it, from which reaction
and braking along this arc end before. Braking is limited in acceleration and jerk, from the acceleration that
the base has: so the stop begins earlier, by what the ramps of its deceleration take (`Base.max_linear_jerk`).
If a point is within the gap already, no motion that brings any point nearer than that one is allowed. The
base brakes along the arc that it is on, which was found free, until the wanted one is slow enough. A base
that an obstacle makes stand may turn on the spot, slowly and up to `turn_gap`, so that it can leave.

What moves, or may (`moving`: discs with velocities), counts along its predicted way, too, until the base
stands: the share is such that the disc does not come within the gap while a corner is faster than `STANDS`.
The disc grows by `doubt` standard deviations of the velocity, at most by `walk`. Where an edge hides who
might step out ahead, at `walk`, the same holds down to `hidden_speed`: it makes the base slower, never stand.

Not seen, and therefore not protected: what no lidar's plane meets (glass, table tops), what is nearer than a
lidar's `range_min`, and everything on a robot without a lidar, which is not slowed either. Driving where no
lidar looks, as backward with one of 180°, is limited to `blind_speed`; turning is not. What appears nearer
than the base can stop is braked for by the same rule; a body with a `stop_deceleration` brakes for that at
once, and so hard.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from math import cos, hypot, inf, isfinite, pi, sin, sqrt
from typing import Annotated, NamedTuple, Protocol

import numpy as np
import numpy.typing as npt

from brain.belief import Floats, Pose
from brain.bodies.base_profile import along, approach, braked
from brain.bodies.body import Base
from brain.bodies.joint_profile import JointState, stopping
from brain.bodies.plane import Commanded, Twist, wrap
from brain.perception.body_scan import Bools
from brain.perception.mount import Mount
from brain.planning.outline import Outline
from protocols.bounds import Bounds, Duration, check, ordered
from protocols.messages import MILLISECOND, Event, LaserScan, Nanos, seconds

Ints = npt.NDArray[np.int64]


@dataclass(frozen=True, slots=True)
class StopSettings:
    """How far from an obstacle, and how soon, the base stops."""

    gap: Annotated[float, Bounds(0.0, 2.0, "m")] = 0.05
    """m between the footprint and any point on its way"""
    turn_gap: Annotated[float, Bounds(0.0, 2.0, "m")] = 0.015
    """m, the same for a slow turn on the spot of a base that an obstacle makes stand"""
    latency: Annotated[Duration, Bounds(0.0, 2000.0)] = 100 * MILLISECOND
    """From a command to the motion that it causes, with the age of the wheels' feedback"""
    blind_speed: Annotated[float, Bounds(0.0, 20.0, "m/s")] = 0.1
    """m/s: largest speed towards where no lidar looks, and of the footprint's corners in such a slow turn"""
    walk: Annotated[float, Bounds(0.0, 5.0, "m/s")] = 1.2
    """m/s: how fast what has just appeared may come,"""
    doubt: Annotated[float, Bounds(0.0, 5.0)] = 1.0
    """and by how many standard deviations of its velocity what moves is taken to be nearer"""
    hidden_speed: Annotated[float, Bounds(0.05, 20.0, "m/s")] = 20.0
    """m/s, down to which an edge ahead that may hide a person slows the base; by default none does"""
    self_seen: Annotated[float, Bounds(0.0, 1.0, "m")] = 0.0
    """m about the footprint, within which a beam ends at the robot's own body and is ignored"""

    def __post_init__(self) -> None:
        check(self)
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
BEGIN = 0.03
"""m/s of a corner, with which a base that begins to move is judged"""
TOUCHING = 1e-3
"""m: less nearer is no nearer"""
STANDS = 0.035
"""m/s of a corner, up to which a base may move wherever people walk; from 0.05 on a contact is its own"""
MAX_MOVING, MOMENTS, LONGEST = 8, 10, 3.0
"""Moving obstacles that count, the nearest; moments looked at until the base stands; s of them"""
HIDES = 0.8
"""m by which neighbouring beams differ if a person fits behind the nearer one"""
MOST_SHARE, NEARLY = 2.0, 0.995
"""Share of braking that counts at most where there is room without end; share of what is between braking and
the desired motion, for which there must be room"""
SHARES = np.array([1.0, 0.8, 0.6, 0.45, 0.3, 0.2, 0.1, 0.0])
"""Shares of a twist that are tried"""


@dataclass(slots=True)
class _View:
    """What one lidar saw last, in the frame of dead reckoning: points, 2 × n [m]."""

    t: Nanos
    ends: Floats
    """Of every beam that ends near enough"""
    kept: Floats
    """Those of this scan that count"""
    before: Floats
    """Those of the scan before that count"""
    looks: Floats
    """Directions of all its beams in the robot's frame, unit vectors"""
    read: Bools
    """Which of these beams gave a reading"""
    edges: Floats
    """Nearest ends beside which a beam goes much farther"""


class Mover(Protocol):
    """Something that moves: m, m/s."""

    @property
    def x(self) -> float: ...  # noqa: D102
    @property
    def y(self) -> float: ...  # noqa: D102
    @property
    def vx(self) -> float: ...  # noqa: D102
    @property
    def vy(self) -> float: ...  # noqa: D102


class SizedMover(Mover, Protocol):
    """One with its size, and how uncertain it is: m."""

    @property
    def radius(self) -> float: ...  # noqa: D102
    @property
    def sigma(self) -> float: ...  # noqa: D102


class Hindrance(NamedTuple):
    """What an obstacle makes of the motion wanted."""

    standing: float
    """s for which it has made the base stand"""
    reason: str
    """Why the base is slower than wanted; "" if it is not"""


class StopZone:
    """Points about the base, and the twist that they allow. State is plain data."""

    def __init__(self, body: Base, mounts: Mapping[str, Mount], settings: StopSettings) -> None:
        self.body, self.settings = body, settings
        self.reason = ""
        """Why the base is slower than wanted: "obstacle 0.31 m ahead: slow"; "" if it is not."""
        self.standing = 0.0
        """s for which an obstacle has made the base stand"""
        self._mounts, self._outline = mounts, Outline(body)  # the mounts may be corrected
        self._views: dict[str, _View] = {}
        self._points: Floats = np.empty((2, 0))
        self._moving: Floats = np.empty((6, 0))
        """x, y [m], their rates [m/s], radius [m], standard deviation of the rates [m/s]"""
        self._edges: Floats = np.empty((2, 0))
        self._track: deque[tuple[Nanos, Pose]] = deque(maxlen=HISTORY)
        self._here = Pose(0.0, 0.0, 0.0)
        self._fresh = False
        """A scan has come since the last check."""
        self._clear = 0.0
        """s without an obstacle"""
        self._own_seen: set[str] = set()
        """Lidars that see the robot's own body."""
        self._notes: list[str] = []

    def hindrance(self) -> Hindrance:
        """Return what was in the way at the last step."""
        return Hindrance(self.standing, self.reason)

    def adopt(self, body: Base, settings: StopSettings) -> None:
        """Continue with other settings."""
        self.body, self.settings = body, settings

    def observe(
        self, t: Nanos, here: Pose, events: Sequence[Event], moving: Sequence[SizedMover] = ()
    ) -> None:
        """Process the scans since the last call; `here`: dead reckoning by the wheels at time t.

        `moving`: what moves, as it is at t, in the frame of dead reckoning."""
        rows = [(m.x, m.y, m.vx, m.vy, m.radius, m.sigma) for m in moving]
        self._moving = np.array(rows).reshape(-1, 6).T
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
            self._edges = np.hstack([view.edges for view in self._views.values()])

    def is_too_fast(self, now: Commanded) -> bool:
        """Return whether a scan since the last call shows that this motion is too fast."""
        fresh, self._fresh = self._fresh, False
        return fresh and self._share(now, self._near(now.twist), self.settings.gap)[0] < 1.0

    def allowed(self, before: Commanded, desired: Commanded, wanted: Twist, dt: float) -> Commanded:
        """Return the next motion, dt [s] after the one before: the desired one, on its way to the wanted
        twist, or one that can be stopped in time; all of them within accelerations and jerks."""
        aim, share, away = self._seen(before, desired, dt)
        points = self._near(aim.twist, before.twist)
        result, before_points, near = self._slowed(before, aim, wanted, points, self.settings.gap, dt)
        if before_points < 1.0:
            share, away = before_points, near
            begins = self._share(self._beginning(wanted), points, self.settings.gap)[0] >= 1.0
            if max(result.twist.speed, before.twist.speed) < SLOWEST and not begins:
                turned = self._turned(before, wanted, points, dt)
                result = turned if abs(turned.twist.angular) > abs(result.twist.angular) else result
        self._report(wanted, result.twist, share, away, dt)
        return result

    def _seen(self, before: Commanded, desired: Commanded, dt: float) -> tuple[Commanded, float, float]:
        """Return the desired motion, or a slower one towards where no lidar looks, which share of it that is,
        and how far away the reason is [m]: nowhere."""
        twist, most = self._peak(desired)[0], self.settings.blind_speed
        if twist.speed <= most or not self._is_blind(twist):
            return desired, inf, inf
        share = most / twist.speed
        return approach(before, twist.scaled(share), dt, self.body), share, inf

    def _slowed(
        self, before: Commanded, desired: Commanded, wanted: Twist, points: Floats, gap: float, dt: float
    ) -> tuple[Commanded, float, float]:
        """Return the motion nearest to the desired one, and not slower than braking, from which the base can
        stop; the share of the desired one from which it could, and how far away the reason is [m]."""
        tried = self._tried(desired, wanted)
        share, away = self._share(tried, points, gap)
        if share >= 1.0:
            return desired, share, away
        stop = braked(before, dt, self.body)
        least = min(self._share(stop, points, gap)[0], MOST_SHARE)
        if least < 1.0:
            return stop if self.body.stop_deceleration is None else self._hard(before.twist, dt), share, away
        if tried is not desired:
            slow = self._fast(desired.twist) <= share * self._fast(tried.twist)
            return desired if slow else stop, share, away
        mixed = _between(stop, desired, (least - 1.0) / (least - share))
        free = self._share(mixed, points, gap)[0] >= NEARLY
        return mixed if free else stop, share, away

    def _fast(self, twist: Twist) -> float:
        """Return the most that a corner of the footprint may move [m/s]."""
        return twist.speed + self._outline.radius * abs(twist.angular)

    def _tried(self, desired: Commanded, wanted: Twist) -> Commanded:
        """Return the motion to judge: of a base that only begins to move a little more than the desired one,
        which hardly moves yet and so would always be free."""
        if self._fast(self._peak(desired)[0]) >= BEGIN or not any(wanted):
            return desired
        return self._beginning(wanted)

    def _beginning(self, wanted: Twist) -> Commanded:
        """Return the wanted twist as it is when a base begins to move."""
        return Commanded(wanted.scaled(min(1.0, BEGIN / max(self._fast(wanted), 1e-9))))

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
        edges = self._nearest(ends[:, _hiding(ranges, index, scan.range_max)], MAX_MOVING)
        return _View(scan.t, _thinned(ends, self._here), kept, before, beams, read, edges)

    def _nearest(self, points: Floats, most: int) -> Floats:
        """Return the points (2 × n, or more rows) nearest to the base, at most so many."""
        away = np.hypot(points[0] - self._here.x, points[1] - self._here.y)
        nearest: Floats = points[:, np.argsort(away, kind="stable")[:most]]
        return nearest

    def _reach(self) -> float:
        """Return how far from the origin a point may matter until the next scans [m]."""
        body, settings = self.body, self.settings
        fastest = Twist(body.max_linear)
        braking = body.max_linear * stopping(JointState(0.0, 1.0), along(fastest, body)).goal
        driven = body.max_linear * (seconds(settings.latency) + HORIZON)
        return self._outline.radius + self._outline.longest * settings.gap + braking + driven

    def _note_own(self, name: str, count: int) -> None:
        if count > 2 and name not in self._own_seen:
            self._own_seen.add(name)
            text = "they are ignored; its own body, or something that touches it"
            self._notes.append(f"{name}: {count} beams end within the footprint: {text}")

    def _placed(self, points: Floats, t: Nanos, after: Floats) -> Floats:
        """Return points of the robot's frame, each measured `after` [ns] t, in that of dead reckoning."""
        first = t + round(after.min(initial=0.0))
        rows: list[tuple[float, float, float, float]] = []
        for at, pose in reversed(self._track):
            rows.append((at - t, pose.x, pose.y, wrap(pose.yaw - self._here.yaw)))
            if at <= first:
                break
        times, *track = np.array(rows[::-1], dtype=np.float64).T
        x, y, yaw = (np.interp(after, times, values) for values in track)
        c, s = np.cos(yaw + self._here.yaw), np.sin(yaw + self._here.yaw)
        return np.array([x + c * points[0] - s * points[1], y + s * points[0] + c * points[1]])

    # -- twist --------------------------------------------------------------------------------

    def _near(self, *twists: Twist) -> Floats:
        """Return the points (2 × n) in the robot's frame that the footprint can reach while it stops from any
        of these twists."""
        outline, driven = self._outline, 0.0
        for twist in twists:
            accelerating = 1.0 / (along(twist, self.body).jerk * max(self._to_rest(twist), 1e-9))
            time = seconds(self.settings.latency) + self._to_rest(twist) + 2.0 * accelerating
            driven = max(driven, twist.speed * time)
        reach = outline.radius + outline.longest * self.settings.gap + driven
        x, y = self._points[0] - self._here.x, self._points[1] - self._here.y
        near = x * x + y * y < reach * reach
        x, y = x[near], y[near]
        c, s = cos(self._here.yaw), sin(self._here.yaw)
        return np.array([c * x + s * y, c * y - s * x])

    def _peak(self, motion: Commanded) -> tuple[Twist, float, float]:
        """Return the fastest twist that a motion still comes to when it is braked, the time [s] at that
        before it seems to brake at once, reaction included, and the time in which all of it is braked."""
        limits, grows, ramp = along(motion.twist, self.body), motion.growth, 0.0
        twist = motion.twist
        if grows > 0.0:
            ramp = grows / limits.jerk
            twist = twist.scaled(1.0 + grows * ramp / 2.0)
            limits, grows = along(twist, self.body), 0.0
        whole = self._to_rest(twist)
        stop = stopping(JointState(0.0, 1.0, max(grows, -limits.acceleration)), limits)
        return twist, seconds(self.settings.latency) + ramp + stop.goal - whole / 2.0, whole

    def _share(self, motion: Commanded, points: Floats, gap: float) -> tuple[float, float]:
        """Return the share of a motion from which the base can stop (more than 1: there is room left), and
        how far away along its arc the point is for which it must [m]; inf if it is another reason.

        Reaction and braking: r·share + T·share²/2 <= time, with T the time in which all of it is braked."""
        twist, reaction, whole = self._peak(motion)
        share, away = inf, inf
        time, grown = self._outline.contact(points, twist, gap) if any(twist) and points.size else (inf, gap)
        if isfinite(time):
            share = (sqrt(reaction**2 + 2.0 * whole * time) - reaction) / whole
            away = grown + twist.speed * time
        if self._moving.size and self._fast(twist) > STANDS:
            before_moving, near = self._before_moving(twist, gap, self._moving, reaction, whole)
            if before_moving < min(share, 1.0):
                share, away = before_moving, near
        least = self.settings.hidden_speed / max(twist.speed, 1e-9)
        if self._edges.size and least < min(share, 1.0) and (edges := self._ahead(twist)).size:
            hidden, near = self._before_moving(twist, gap, edges, reaction, whole)
            if max(hidden, least) < min(share, 1.0):
                share, away = max(hidden, least), near
        return share, away

    def _is_blind(self, twist: Twist) -> bool:
        """Return whether no lidar looks where the base would go."""
        way = np.array([twist.linear, twist.lateral]) / twist.speed
        for view in self._views.values():
            there = way @ view.looks > AHEAD
            if np.count_nonzero(view.read & there) > SEEING * np.count_nonzero(there):
                return False
        return bool(self._views)

    def _ahead(self, twist: Twist) -> Floats:
        """Return the edges ahead of the footprint, as discs of which the velocity is not known."""
        c, s = cos(self._here.yaw), sin(self._here.yaw)
        way = np.array([c * twist.linear - s * twist.lateral, s * twist.linear + c * twist.lateral])
        off = self._edges - [[self._here.x], [self._here.y]]
        edges = self._edges[:, way @ off > self._outline.radius * twist.speed]
        return np.vstack([edges, np.zeros((3, edges.shape[1])), np.full((1, edges.shape[1]), 1e6)])

    def _before_moving(
        self, twist: Twist, gap: float, discs: Floats, reaction: float, whole: float
    ) -> tuple[float, float]:
        """Return the largest share of a twist with which the base stands before something that moves comes
        within the gap, and how far away that is [m]."""
        x, y, vx, vy, radius, sigma = self._nearest(discs, MAX_MOVING)
        away = np.hypot(x - self._here.x, y - self._here.y)
        grows = np.minimum(self.settings.doubt * sigma, self.settings.walk)
        # from a share of the twist no corner is faster than STANDS after this time
        fast = self._fast(twist)
        until = reaction + whole * np.maximum(SHARES - STANDS / fast, 0.0)
        t = np.minimum(until, LONGEST)[:, None] * np.linspace(0.0, 1.0, MOMENTS)
        late = np.maximum(t - reaction, 0.0)
        gone = SHARES[:, None] * t - np.minimum(late * late / (2.0 * max(whole, 1e-9)), SHARES[:, None] * t)
        yaw = self._here.yaw + twist.angular * gone
        half = self._here.yaw + twist.angular * gone / 2.0
        chord = np.sinc(twist.angular * gone / (2.0 * pi)) * gone
        hx = self._here.x + chord * (twist.linear * np.cos(half) - twist.lateral * np.sin(half))
        hy = self._here.y + chord * (twist.linear * np.sin(half) + twist.lateral * np.cos(half))
        dx = x[:, None, None] + vx[:, None, None] * t - hx
        dy = y[:, None, None] + vy[:, None, None] * t - hy
        c, s = np.cos(yaw), np.sin(yaw)
        seen = np.stack([c * dx + s * dy, c * dy - s * dx]).reshape(2, -1)
        off = self._outline.distances(seen).reshape(dx.shape) - radius[:, None, None]
        off -= grows[:, None, None] * t
        # what is within the gap already may stay there, if it comes no nearer; what touches may not
        least = np.clip(off[:, :, :1], 0.0, gap) - TOUCHING
        met = ((off < least).any(axis=2)).any(axis=0) & (SHARES * fast > STANDS)
        free = np.flatnonzero(~met)
        return float(SHARES[free[0]]), float(away.min() - self._outline.radius)

    def _to_rest(self, twist: Twist) -> float:
        """Return the time [s] to brake a twist along its arc, within both accelerations."""
        return self.body.to_rest(twist)

    def _hard(self, twist: Twist, dt: float) -> Commanded:
        """Return the motion after braking for dt [s] along its arc at once, as hard as the body may before
        what is too near for the ordinary stop."""
        body, whole = self.body, max(self._to_rest(twist), 1e-9)
        harder = (body.stop_deceleration or body.max_linear_acceleration) / body.max_linear_acceleration
        share = max(1.0 - dt * harder / whole, 0.0)
        return Commanded(twist.scaled(share), twist.scaled(-1.0 / whole) if share else Twist())

    def _turned(self, before: Commanded, wanted: Twist, points: Floats, dt: float) -> Commanded:
        """Return a slow turn on the spot towards the wanted side, as far as there is room for it."""
        slow = self.settings.blind_speed / self._outline.radius
        turn = Twist(0.0, max(min(wanted.angular, slow), -slow))
        desired = approach(before, turn, dt, self.body)
        return self._slowed(before, desired, turn, points, self.settings.turn_gap, dt)[0]

    def _report(self, wanted: Twist, result: Twist, share: float, away: float, dt: float) -> None:
        """Set the reason, with hysteresis: noise of the ranges must not make it flicker."""
        fast, speed = self._fast(wanted), self._fast(result)
        free = share >= 1.0 or speed >= 0.9 * fast
        self._clear = self._clear + dt if free else 0.0
        if self._clear >= CLEAR_AFTER or fast == 0.0:
            self.reason, self.standing = "", 0.0
        if free:
            return
        stands = speed < (0.25 * fast if self.standing else SLOWEST)
        self.standing = self.standing + dt if stands else 0.0
        way = _way(wanted)
        near = f"obstacle {max(away, 0.0):.2f} m {way}" if isfinite(away) else f"no lidar looks {way}"
        self.reason = f"{near}: {'standing' if stands else 'slow'}"


def _between(stop: Commanded, desired: Commanded, part: float) -> Commanded:
    """Return a motion this part of the way from one to the other."""
    twist, rate = (
        Twist(*(a + part * (b - a) for a, b in zip(*pair, strict=True)))
        for pair in zip(stop, desired, strict=True)
    )
    return Commanded(twist, rate)


def _way(twist: Twist) -> str:
    """Return where a twist leads, in a word."""
    if abs(twist.lateral) > abs(twist.linear):
        return "to the left" if twist.lateral > 0.0 else "to the right"
    return "ahead" if twist.linear > 0.0 else "behind" if twist.linear < 0.0 else "beside"


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


def _hiding(ranges: Floats, index: Ints, range_max: float) -> Bools:
    """Return which beams (by their index) have a neighbour that goes much farther."""
    far = np.where(np.isnan(ranges) | (ranges <= 0.0), 0.0, np.minimum(ranges, range_max))
    beyond = np.maximum(far[(index + 1) % len(far)], far[index - 1])
    hides: Bools = beyond > far[index] + HIDES
    return hides


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
