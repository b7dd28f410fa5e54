"""What moves: the place and velocity of people and the like, from scans alone, without the map.

Rules. All is in the frame "map", as the pose is known when a scan comes; a leap of it begins anew. A scan
is cut where neighbouring ends lie apart; what is narrow, and in front of what is beside it, is a cluster (two
legs are one). A wall's end or a corner is not: it is wide, or it goes on behind something nearer. Clusters
are followed by a Kalman filter of constant velocity each, nearest neighbour within a gate (Bar-Shalom, Li,
Kirubarajan 2001, section 6.3). What is followed moves once its speed is certain and enough of it stands where
beams of half a second or a second ago passed: a side of a box that comes into view has been behind its front,
and never does. What stands there beside a wall, or as a part of anything wide, is a cluster of its own. Who
steps out from behind something is taken to be as wide as a person: the middle of the part that is seen moves
otherwise than he does.

Who has just come into what was free may go anywhere until the velocity is known: `moving` returns that, too,
if asked for doubts, with the velocity so far and its standard deviation.
"""

from __future__ import annotations

import math
from collections import deque
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from brain.belief import Floats, Pose
from brain.bodies.plane import moved
from brain.perception.body_scan import BodyScan, Bools, to_world
from protocols.messages import MILLISECOND, SECOND, Nanos, seconds

FARTHEST = 8.0
"""m: what is farther is not followed."""
LEAST_HITS, WIDEST, LEG = 3, 0.8, 0.35
"""Beams on a cluster; m, its largest width, and that of a leg, and between two of them"""
APART, STEPS = 0.1, 3
"""m, with 1.5 times the beams' spacing added: neighbouring ends farther apart are of two clusters; beams
without a reading that may lie between"""
SMALLEST, SOMEBODY, LARGEST = 0.08, 0.25, 0.4
"""m, radius: the least, that of who is seen in part, the most"""
MAX_CLUSTERS, MAX_TRACKS = 48, 32
GATE = 0.4
"""m between a cluster and where one that is followed should be, at most; and 3 standard deviations"""
NOISE, SHAKE = 0.04, 0.25
"""m, of a cluster's place; m²/s³, of its acceleration"""
FIRST_SPEED = 1.2
"""m/s: standard deviation of the velocity of what has just appeared"""
KNOWN, KEPT = 3, 600 * MILLISECOND
"""Scans that show it before it may count; time for which it is followed without being seen"""
MOVES, STANDS = 0.15, 0.08
"""m/s, from which on something moves, and below which it has come to stand"""
SURE, ENTERED, WAY = 1.2, 0.3, 0.1
"""Standard deviations of its speed; share of its points where nothing stood; m since it appeared"""
AGES: tuple[Nanos, ...] = (500 * MILLISECOND, SECOND)
"""Ages of the scans in which it was free there,"""
SPACING: Nanos = 90 * MILLISECOND
"""which are kept this far apart;"""
PARTLY = 0.8
"""Share of a cluster that must stand so, if something nearer hides a part of it"""
DOUBT = 0.5
"""Share, from which on something may move although it is not known to"""
FREE, FREE_SHARE = 0.1, 0.01
"""m, and share of the range, by which their beams went farther"""
MARGIN = 0.12
"""m about something that moves, within which a beam ends at it"""


class Moving(NamedTuple):
    """A disc that moves."""

    x: float
    """m"""
    y: float
    vx: float
    """m/s"""
    vy: float
    radius: float
    sigma: float
    """m/s: standard deviation of vx and vy"""


@dataclass(slots=True)
class _Track:
    """A cluster that is followed."""

    x: float
    y: float
    radius: float
    t: Nanos
    """Of the state,"""
    seen: Nanos
    """and of the newest scan that shows it"""
    from_x: float
    from_y: float
    """m, where it appeared"""
    vx: float = 0.0
    vy: float = 0.0
    pp: float = NOISE**2
    """Variance of the place along each axis, its covariance with the velocity, and that one's variance"""
    pv: float = 0.0
    vv: float = FIRST_SPEED**2
    count: int = 1
    entered: float = 0.0
    """Share of its points where nothing stood, a mean over some scans"""
    fresh: float = 0.0
    """The same of `_Cluster.fresh`, in the first scans also of what is unseen"""
    moving: bool = False

    def predict(self, t: Nanos) -> None:
        """Move on to a time."""
        dt = max(seconds(t - self.t), 0.0)
        self.x, self.y, self.t = self.x + dt * self.vx, self.y + dt * self.vy, max(t, self.t)
        self.pp += dt * (2.0 * self.pv + dt * (self.vv + SHAKE * dt / 3.0))
        self.pv += dt * (self.vv + 0.5 * SHAKE * dt)
        self.vv += SHAKE * dt

    def shift(self, by: Pose) -> None:
        """Turn and shift the frame that it is in."""
        here, there = moved(by, Pose(self.x, self.y, 0.0)), moved(by, Pose(self.from_x, self.from_y, 0.0))
        self.x, self.y, self.from_x, self.from_y = here.x, here.y, there.x, there.y
        c, s = math.cos(by.yaw), math.sin(by.yaw)
        self.vx, self.vy = c * self.vx - s * self.vy, s * self.vx + c * self.vy

    def update(self, cluster: _Cluster) -> None:
        """Correct by a cluster at the time of the state."""
        gain, rate = self.pp / (self.pp + NOISE**2), self.pv / (self.pp + NOISE**2)
        dx, dy = cluster.x - self.x, cluster.y - self.y
        self.x, self.y = self.x + gain * dx, self.y + gain * dy
        self.vx, self.vy = self.vx + rate * dx, self.vy + rate * dy
        self.vv -= rate * self.pv
        self.pp, self.pv = self.pp * (1.0 - gain), self.pv * (1.0 - gain)
        self.radius += (0.5 if cluster.radius > self.radius else 0.1) * (cluster.radius - self.radius)
        self.entered += 0.5 * (cluster.entered - self.entered)
        fresh = 1.0 if cluster.unseen and self.count < KNOWN else cluster.fresh
        self.fresh += 0.5 * (fresh - self.fresh)
        self.count, self.seen = self.count + 1, self.t
        speed, far = math.hypot(self.vx, self.vy), math.dist((self.x, self.y), (self.from_x, self.from_y))
        if self.moving:
            self.moving = speed > STANDS
        elif speed > max(MOVES, SURE * math.sqrt(self.vv)) and self.count >= KNOWN:
            self.moving = self.entered > ENTERED and far > WAY


class _Cluster(NamedTuple):
    """Neighbouring ends in front of what is beside them: m, s after the scan's first beam."""

    x: float
    y: float
    radius: float
    entered: float
    fresh: float
    """The same, all of it if enough has come from behind something"""
    unseen: bool
    """It has come from behind something to where nothing was seen"""
    share: float
    """Of the scan's duration, after which it was seen"""


class _Past(NamedTuple):
    """A scan of a while ago: as much of it as tells what was free."""

    t: Nanos
    at: Pose
    origin: tuple[float, float]
    bearings: Floats
    ranges: Floats


class Movers:
    """Follows what moves. Plain data."""

    def __init__(self) -> None:
        self._tracks: list[_Track] = []
        self._past: dict[str, deque[_Past]] = {}

    def moving(self, t: Nanos, here: Pose, there: Pose, *, doubts: bool = False) -> tuple[Moving, ...]:
        """Return what moves, as it is at a time, in another frame: `here` is the robot in the frame "map"
        then, `there` in the other one. `doubts`: also what may move."""
        found = []
        turn = there.yaw - here.yaw
        c, s = math.cos(turn), math.sin(turn)
        for one in self._tracks:
            if one.moving or (doubts and one.fresh > DOUBT):
                dt = max(seconds(t - one.t), 0.0)
                x, y = one.x + dt * one.vx - here.x, one.y + dt * one.vy - here.y
                at = there.x + c * x - s * y, there.y + s * x + c * y
                velocity = c * one.vx - s * one.vy, s * one.vx + c * one.vy
                found.append(Moving(*at, *velocity, one.radius, math.sqrt(one.vv)))
        return tuple(found)

    def shift(self, by: Pose) -> None:
        """Turn and shift the frame "map"."""
        for one in self._tracks:
            one.shift(by)
        for name, past in self._past.items():
            kept = [one._replace(at=moved(by, one.at)) for one in past]
            self._past[name] = deque(kept, maxlen=past.maxlen)

    def observe(self, name: str, t: Nanos, duration: Nanos, here: Pose, scan: BodyScan) -> Bools:
        """Follow what a scan shows that ended at a time, with the robot there; return which of its beams end
        at what moves."""
        past = self._past.setdefault(name, deque(maxlen=len(AGES) * 8))
        clusters = _clusters(scan, here, [one for age in AGES for one in _aged(past, t, age)])
        self._follow(t, duration, clusters)
        if not past or t - past[-1].t >= SPACING:
            past.append(_Past(t, here, scan.origin, scan.bearings, scan.ranges))
        ends = np.zeros(len(scan.hit), dtype=np.bool_)
        moving = [one for one in self._tracks if one.moving]
        if moving:
            x, y = to_world(scan.ends, here).T
            for one in moving:
                dx, dy = x - one.x, y - one.y
                reach = one.radius + MARGIN + seconds(abs(duration)) * math.hypot(one.vx, one.vy)
                ends |= dx * dx + dy * dy < reach * reach
        return ends & scan.hit

    def _follow(self, t: Nanos, duration: Nanos, clusters: list[_Cluster]) -> None:
        """Assign the clusters to what is followed, nearest first."""
        for track in self._tracks:
            track.predict(t)
        pairs = []
        for i, cluster in enumerate(clusters):
            late = _late(duration, cluster)
            for j, track in enumerate(self._tracks):
                far = math.hypot(cluster.x - track.x + late * track.vx, cluster.y - track.y + late * track.vy)
                if far < min(GATE, 0.1 + 3.0 * math.sqrt(track.pp + NOISE**2)):
                    pairs.append((far, i, j))
        seen, known = set(), set()
        for _, i, j in sorted(pairs):
            if i not in known and j not in seen:
                known.add(i)
                seen.add(j)
                late, track = _late(duration, clusters[i]), self._tracks[j]
                x, y = clusters[i].x + late * track.vx, clusters[i].y + late * track.vy
                track.update(clusters[i]._replace(x=x, y=y))
        self._tracks = [one for one in self._tracks if t - one.seen < KEPT]
        for i, new in enumerate(clusters):
            if i not in known and len(self._tracks) < MAX_TRACKS:
                fresh = 1.0 if new.unseen else new.fresh
                place = new.x, new.y
                self._tracks.append(
                    _Track(*place, new.radius, t, t, *place, entered=new.entered, fresh=fresh)
                )


def _aged(past: deque[_Past], t: Nanos, age: Nanos) -> list[_Past]:
    """Return the newest scan that is at least so old, if there is one."""
    for one in reversed(past):
        if t - one.t >= age - SPACING // 2:
            return [one] if t - one.t < 2 * age else []
    return []


def _clusters(scan: BodyScan, here: Pose, past: list[_Past]) -> list[_Cluster]:
    """Return what may move, in the frame of `here`, the nearest first."""
    at = np.flatnonzero(scan.hit & (scan.ranges < FARTHEST))
    count = len(scan.hit)
    if len(at) < LEAST_HITS:
        return []
    ranges, ends = scan.ranges[at], scan.ends[at]
    step = np.diff(at, append=at[0] + count)  # to the next hit; of the last one, around
    width = (scan.bearings[-1] - scan.bearings[0]) / max(count - 1, 1)
    following = np.concatenate((ends[1:], ends[:1]))
    apart = np.hypot(*(following - ends).T)
    joined = (step <= STEPS) & (apart < APART + 1.5 * width * step * ranges)
    around = _is_full(scan.bearings)
    joined[-1] &= around
    breaks = np.flatnonzero(~joined)
    if not len(breaks):
        return []
    order = np.roll(np.arange(len(at)), -(int(breaks[0]) + 1))  # begins behind a break
    lasts = (breaks - int(breaks[0]) - 1) % len(at)
    lasts.sort()
    firsts = np.concatenate(([0], lasts[:-1] + 1))
    beside = np.arange(1, STEPS + 1)
    lengths = np.where(scan.ranges > 0.0, scan.ranges, math.inf)
    entered, unseen = _entered(to_world(ends, here), past)
    found: list[tuple[int, int]] = []
    for first, last in zip(firsts.tolist(), lasts.tolist(), strict=True):
        if last - first + 1 < LEAST_HITS:
            continue
        a, b = int(order[first]), int(order[last])
        part = order[first : last + 1]
        new = entered[part]
        if math.dist(ends[a], ends[b]) <= WIDEST:
            if not around and not STEPS <= at[a] <= at[b] < count - STEPS:
                continue  # it may go on where nothing looks
            before = lengths[(int(at[a]) - beside) % count].min() - ranges[a]
            behind = lengths[(int(at[b]) + beside) % count].min() - ranges[b]
            nearer, farther = sorted((before, behind))
            steps_out = nearer < -APART and (new.sum() >= LEAST_HITS or unseen[part].mean() > PARTLY)
            if (farther > 0.0 and (nearer > 0.0 or steps_out)) or new.mean() > PARTLY:
                found.append((first, last))
                continue
        if new.sum() >= LEAST_HITS:
            found += [(first + i, first + j) for i, j in _runs(new) if j - i + 1 >= LEAST_HITS]
    clusters = []
    for first, last in _joined_legs(found, ends[order]):
        part = order[first : last + 1]
        part = part[ranges[part] < ranges[part].min() + WIDEST]  # not what is seen between two legs
        sides = lengths[(at[part[0]] - beside) % count], lengths[(at[part[-1]] + beside) % count]
        hidden = [side.min() < ranges[end] - APART for side, end in zip(sides, part[[0, -1]], strict=True)]
        partly = hidden[0] != hidden[1]
        x, y, radius = _disc(ends[part], scan, here, partly=partly)
        new, share = entered[part], float(at[part].mean() / count)
        mean = float(new.mean())
        fresh = 1.0 if partly and new.sum() >= LEAST_HITS else mean
        unknown = partly and bool(unseen[part].mean() > PARTLY)
        disc = _Cluster(x, y, radius, mean, fresh, unknown, share)
        clusters.append((float(ranges[part].min()), disc))
    clusters.sort(key=lambda one: one[0])
    return [cluster for _, cluster in clusters[:MAX_CLUSTERS]]


def _late(duration: Nanos, cluster: _Cluster) -> float:
    """Return how long before the scan's newest beam it was seen [s]."""
    return seconds(duration) * (1.0 - cluster.share) if duration > 0 else -seconds(duration) * cluster.share


def _runs(chosen: Bools) -> list[tuple[int, int]]:
    """Return the first and the last index of each row of neighbours that are chosen."""
    change = np.flatnonzero(np.diff(np.concatenate(([False], chosen, [False]))))
    return [(int(a), int(b) - 1) for a, b in change.reshape(-1, 2)]


def _is_full(bearings: Floats) -> bool:
    """Return whether a scan looks all around."""
    span, count = float(bearings[-1] - bearings[0]), len(bearings)
    return span > 2.0 * math.pi * (1.0 - 2.0 / count)


def _joined_legs(found: list[tuple[int, int]], ends: Floats) -> list[tuple[int, int]]:
    """Return the clusters, two neighbouring legs as one."""
    joined: list[tuple[int, int]] = []
    for first, last in found:
        if joined:
            begin, end = joined[-1]
            near = math.dist(ends[end], ends[first]) < LEG and math.dist(ends[begin], ends[last]) < WIDEST
            if near and math.dist(ends[begin], ends[end]) < LEG and math.dist(ends[first], ends[last]) < LEG:
                joined[-1] = begin, last
                continue
        joined.append((first, last))
    return joined


def _disc(ends: Floats, scan: BodyScan, here: Pose, *, partly: bool) -> tuple[float, float, float]:
    """Return place and radius of the disc behind ends: as wide as they are, behind the nearest, at their
    middle bearing; if something nearer hides the rest (`partly`), as wide as a person, through both ends."""
    x, y = (ends - scan.origin).T
    chord = math.dist(ends[0], ends[-1])
    if partly and 0.0 < chord < 2.0 * SOMEBODY:
        radius, behind = SOMEBODY, math.sqrt(SOMEBODY**2 - 0.25 * chord**2) / chord
        middle, along = 0.5 * (ends[0] + ends[-1]), ends[-1] - ends[0]
        place = float(middle[0] + behind * along[1]), float(middle[1] - behind * along[0])
    else:
        radius = min(max(0.5 * chord, SMALLEST), LARGEST)
        bearing = math.atan2(y[0] + y[-1], x[0] + x[-1])
        far = float(np.hypot(x, y).min()) + radius
        place = scan.origin[0] + far * math.cos(bearing), scan.origin[1] + far * math.sin(bearing)
    world = moved(here, Pose(*place, 0.0))
    return world.x, world.y, radius


def _entered(points: Floats, past: list[_Past]) -> tuple[Bools, Bools]:
    """Return which points are where beams of a scan of a while ago passed, and its neighbours; and which are
    where none of them ended."""
    found = np.zeros(len(points), dtype=np.bool_)
    unseen = np.full(len(points), bool(past))
    for one in past:
        c, s = math.cos(one.at.yaw), math.sin(one.at.yaw)
        dx, dy = points[:, 0] - one.at.x, points[:, 1] - one.at.y
        x, y = c * dx + s * dy - one.origin[0], c * dy - s * dx - one.origin[1]
        first, count = float(one.bearings[0]), len(one.bearings)
        bearing = (np.arctan2(y, x) - first) % (2.0 * math.pi) + first
        beam = np.searchsorted(one.bearings, bearing)
        seen = _is_full(one.bearings) or (beam >= 2) & (beam <= count - 2)
        near = np.stack([one.ranges[(beam + k) % count] for k in (-2, -1, 0, 1)])
        length = np.hypot(x, y)
        found |= seen & (near.min(axis=0) > length * (1.0 + FREE_SHARE) + FREE)
        unseen &= seen & (np.abs(near - length) > APART).all(axis=0)
    return found, unseen
