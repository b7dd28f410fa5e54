"""Whether wheels, gyro and scans show the same motion, without a map.

Rules. Each scan is compared with a reference scan of at most a second before (point to line, neighbours by
bearing): the motion that the two scans show is searched from the motion that wheels and gyro have integrated
between their times. Wheels and gyro are compared with each other as well. A reference is renewed once all
have agreed on a motion, and kept while they differ, so that a difference stays visible: a lidar that is
knocked out of its mount agrees with itself again one scan later. After `FORGET` it is renewed anyway. One
comparison that differs may be a glitch, `CONFIRM` of them in a row are not. A scan too bare to show a motion
is not compared. Of three sources that turn, the one without which the other two agree best is named.
What differs slowly is summed: the gyro's rate against the scans' (its bias is learnt here, independently of
the filter), and the scans' sideways motion against a base that cannot move sideways (the lidar's mounting).
Source: Censi 2008 (PLICP).
"""

from __future__ import annotations

import math
from bisect import bisect_left
from collections import deque
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np

from brain.belief import Floats
from brain.bodies.differential import Differential, sinc
from brain.perception.body_scan import BodyScan, _surfaces
from protocols.messages import MILLISECOND, SECOND, Nanos, seconds

KEPT: Nanos = 4 * SECOND
"""Integrated motion is kept for this time,"""
FORGET: Nanos = 3 * SECOND
"""and a reference at most for this time."""
GAP: Nanos = 250 * MILLISECOND
"""After so long without feedback a track begins anew: what comes then may be stamped late."""
AHEAD: Nanos = 60 * MILLISECOND
"""A track is extrapolated by at most this much, and a gyro's rate holds for at most this time."""
FASTEST = 1e3
"""rad/s: a rate beyond counts as this, since sums must stay finite."""
RENEW_TURNS: Nanos = 500 * MILLISECOND
"""Age from which on the turns of wheels and gyro are compared anew."""
PERIOD: Nanos = 50 * MILLISECOND
"""Wheels and gyro are compared this often."""
CONFIRM, CONFIRM_FOR = 3, 150 * MILLISECOND
"""Comparisons in a row that must differ, and for how long: of a burst that a host stamps late all may."""
RENEW_DISTANCE, RENEW_TURN, RENEW_AGE = 0.4, 0.35, 1500 * MILLISECOND
"""m, rad, and age from which on a reference is renewed once all agree."""
BEAMS = 120
"""Largest number of beams of a scan that are compared, evenly chosen."""
LEAST = 20
"""Least number of them on lines of the reference; fewer show no motion."""
ON_LINE = 0.1
"""m: a point this near to a line of the reference lies on it."""
NO_LINE = 1e9
"""m: distance from where the reference has no line."""
MOVING = 0.05
"""m: standard deviation of a point that may belong to what moves: in a corridor, few show its length."""
FIT = 0.5
"""Least share of the points that must lie on lines once the motion is found."""
TURN, DISTANCE = 0.05, 0.07
"""rad and m: differences below these are none (measured: at most 0.045 rad and 0.015 m),"""
TURN_SHARE, SLIP_SHARE = 0.15, 0.35
"""nor are those below this share of the motion (tyres, stamps), or of a way that the base lags behind."""
LIKELY_SLIP = 0.07
"""Share of the slip allowed for, by which wheels may be wrong where they decide between two others."""
PAST: Nanos = 5 * SECOND
"""A gyro's bias is compared over this time."""
BIAS, JUMP, SCALE = 0.08, 0.04, 0.05
"""rad/s: largest bias of a gyro, and largest change of it; share by which it may be wrong in turns."""
LEARN, LEARN_MOST = 60.0, 0.01
"""s, rad/s: its bias is a mean over this time; once known, what differs by more counts as this."""
FADE = 5.0
"""m: what was seen of a mounting fades with the way driven (and turned, at 1 m per rad), to 1/e."""
YAW, PLACE = math.radians(0.8), 0.05
"""rad, m: smaller errors of a mounting are not named,"""
DRIVABLE_YAW, DRIVABLE_PLACE = math.radians(10.0), 0.3
"""and larger ones than these not driven with."""
BENT, STEERED = (0.25, 0.02), (0.01, 0.0)
"""Shares of what is across a way, and of it, by which its shape may be wrong; and with a gyro's turns."""
ASIDE = 0.001
"""m: standard deviation of a comparison beside its noise."""
PRIOR = np.diag([1.0, 100.0, 100.0, 0.0])
"""Information on a mounting before any motion: 1 rad, 0.1 m."""
DAMPING = 1e-3 * np.eye(3)


class Motion(NamedTuple):
    """Motion between two times."""

    x: float
    """m, in the frame of the first"""
    y: float
    heading: float
    """rad that the way has turned by, not wrapped"""
    turn: float
    """rad that the source shows"""
    uncertain: float = 0.0
    """rad by which that may be wrong by slip or bias"""

    def ahead(self) -> tuple[float, float]:
        """Return the way [m] along and across the mean heading: of an arc, none is across."""
        c, s = math.cos(self.heading / 2.0), math.sin(self.heading / 2.0)
        return c * self.x + s * self.y, c * self.y - s * self.x

    def then(self, other: Motion, turn: float) -> Motion:
        """Return this motion and another one after it, that turns by this angle."""
        c, s = math.cos(self.turn), math.sin(self.turn)
        x, y, turn = self.x + c * other.x - s * other.y, self.y + s * other.x + c * other.y, self.turn + turn
        return Motion(x, y, turn, turn)


STILL = Motion(0.0, 0.0, 0.0, 0.0)


class Shown(NamedTuple):
    """What two scans show."""

    motion: Motion
    fit: float
    """Share of the rays' ends on lines, of those that meet one"""
    inverse: Floats
    """3 × 3: covariance of x, y, turn, for points with a variance of 1;"""
    variance: float
    """m², and theirs"""

    def spread(self) -> tuple[float, float]:
        """Return the standard deviations along and across the mean heading, for points with one of 1."""
        c, s = math.cos(self.motion.turn / 2.0), math.sin(self.motion.turn / 2.0)
        (xx, xy, _), (_, yy, _), _ = self.inverse.tolist()
        cross = 2.0 * c * s * xy
        return math.sqrt(c * c * xx + s * s * yy + cross), math.sqrt(s * s * xx + c * c * yy - cross)


_Row = tuple[Nanos, float, float, float, float, float]
"""Time, then x, y, heading, turn and uncertainty since the beginning of the track."""


class Track:
    """What one source has integrated. Plain data."""

    def __init__(self) -> None:
        self._rows: list[_Row] = [(0, 0.0, 0.0, 0.0, 0.0, 0.0)]

    def add(
        self, since: Nanos, t: Nanos, distance: float, heading: float, turn: float, uncertain: float
    ) -> None:
        """Add an arc [m, rad] between two times, and what the source shows of its turn; after a gap the track
        begins anew."""
        rows = self._rows
        last, x, y, yaw, turned, total = rows[-1]
        if last != since or t - since > GAP:
            rows[:] = [(since if t - since <= GAP else t, x, y, yaw, turned, total)]
            if t - since > GAP:
                return
        if distance:
            chord, middle = distance * sinc(heading / 2.0), yaw + heading / 2.0
            x, y = x + chord * math.cos(middle), y + chord * math.sin(middle)
        rows.append((t, x, y, yaw + heading, turned + turn, total + uncertain))
        half = len(rows) // 2
        if rows[half][0] < t - KEPT:
            del rows[:half]

    def clear(self) -> None:
        """Forget everything: a motion was lost."""
        del self._rows[:-1]

    def between(self, since: Nanos, t: Nanos) -> Motion | None:
        """Return the motion between two times; None if the track does not reach that far."""
        a, b = self.at(since), self.at(t)
        if a is None or b is None:
            return None
        c, s = math.cos(a[3]), math.sin(a[3])
        dx, dy = b[1] - a[1], b[2] - a[2]
        return Motion(c * dx + s * dy, c * dy - s * dx, b[3] - a[3], b[4] - a[4], b[5] - a[5])

    def at(self, t: Nanos) -> _Row | None:
        """Return the sums at a time."""
        rows = self._rows
        if len(rows) < 2 or not rows[0][0] <= t <= rows[-1][0] + AHEAD:
            return None
        after = len(rows) - 1
        if t < rows[after - 1][0]:
            after = max(bisect_left(rows, (t,)), 1)
        (t0, x0, y0, yaw0, turn0, sum0), (t1, x1, y1, yaw1, turn1, sum1) = rows[after - 1], rows[after]
        p = (t - t0) / max(t1 - t0, 1)
        x, y, yaw = x0 + p * (x1 - x0), y0 + p * (y1 - y0), yaw0 + p * (yaw1 - yaw0)
        return t, x, y, yaw, turn0 + p * (turn1 - turn0), sum0 + p * (sum1 - sum0)


@dataclass(frozen=True, slots=True)
class Contradiction:
    """What cannot all be true, in words."""

    reason: str
    confirmed: bool = True
    drivable: bool = False
    """The base may go on slowly for as long as it lasts."""


class Reference:
    """A scan's surfaces. Plain data."""

    def __init__(self, t: Nanos, scan: BodyScan) -> None:
        self.t, self._origin = t, scan.origin
        self.last: tuple[Nanos, Motion] = (t, STILL)
        """Time of the newest scan compared with it, and the motion until then."""
        bearings, count = scan.bearings, len(scan.bearings)
        self._first = float(bearings[0])
        last = float(bearings[-1]) - self._first
        half = last / max(count - 1, 1) / 2.0
        self._edges = np.empty(count + 1)
        """rad after the first bearing, at which the next beam is nearer; behind the last none is, until the
        first is again."""
        self._edges[:-2] = (bearings[1:] + bearings[:-1]) / 2.0 - self._first
        self._edges[-2:] = last + half, max(last + half, 2.0 * math.pi - half)
        self._lines = np.zeros((3, count + 2))
        """Of each beam's surface: its normal, and the normal's product with a point of it."""
        self._lines[2] = NO_LINE
        line, normals = scan.straight, scan.normals[scan.straight]
        self._lines[0, :count][line], self._lines[1, :count][line] = normals.T
        self._lines[2, :count][line] = np.einsum("ij,ij->i", normals, scan.middles[line])
        self._lines[:, -1] = self._lines[:, 0]

    def motion(self, points: Floats, guess: Motion) -> Shown | None:
        """Return the motion since the reference that a scan's points (2 × n: its rays' ends, also of those
        without a return, that pass the lines) show, searched from a guess; None if too few of them meet a
        line."""
        x, y, turn = guess.x, guess.y, guess.turn
        px, py = points
        J = np.empty((4, len(px)))
        for gate in (0.8, 0.4, 0.3, 0.3, 0.3):
            c, s = math.cos(turn), math.sin(turn)
            arm_x, arm_y = c * px - s * py, s * px + c * py
            bearing = np.arctan2(arm_y + (y - self._origin[1]), arm_x + (x - self._origin[0]))
            beam = self._edges.searchsorted((bearing - self._first) % (2.0 * math.pi))
            J[0], J[1], past = self._lines.take(beam, axis=1)
            nx, ny = J[0], J[1]
            np.subtract(ny * arm_x, nx * arm_y, out=J[2])
            off = np.add(nx * (arm_x + x), ny * (arm_y + y), out=J[3])
            off -= past
            size = np.abs(off)
            lined = int(np.count_nonzero(size < NO_LINE / 2.0))
            if lined < LEAST:
                return None
            weight = (size < gate) / (1.0 + 400.0 * (off * off))
            M = (J * weight) @ J.T
            inverse: Floats = np.linalg.inv(M[:3, :3] + DAMPING)
            dx, dy, dturn = (inverse @ M[:3, 3]).tolist()
            x, y, turn = x - dx, y - dy, turn - dturn
            if max(abs(dx), abs(dy), abs(dturn)) < 2e-3:
                break
        variance = float(M[3, 3]) / max(float(weight.sum()), 1.0)
        fit = float(np.count_nonzero(size < ON_LINE)) / lined
        return Shown(Motion(x, y, turn, turn), fit, inverse, variance)


class Mounting:
    """What the scans show of a lidar's true mounting against the robot file's. Plain data.

    A base on two wheels moves along its mean heading. A lidar that stands by (yaw, x, y) otherwise than
    stated shows, over a way d and a turn w, aside = -yaw d + 2 sin(w/2) x, and along = d - 2 sin(w/2) y:
    weighted least squares."""

    def __init__(self) -> None:
        self.sums = PRIOR.copy()
        """Of the equations' outer products, 4 × 4: yaw, x, y, right side;"""
        self.number = 0.0
        """and how many they are. Both fade with the way."""
        self._named = False

    def with_one(self, wheels: Motion, shown: Shown) -> tuple[Floats, float]:
        """Return the sums with the motion that scans show, beside that of the wheels, whose way need be no
        arc."""
        turn = shown.motion.turn
        (way, across), (along, aside) = wheels.ahead(), shown.motion.ahead()
        lever, noise = 2.0 * math.sin(turn / 2.0), math.sqrt(shown.variance)
        bent, slip = BENT if wheels.heading == wheels.turn else STEERED
        bent = bent * (abs(turn * along) + 4.0 * abs(across)) + slip * abs(along)
        forward, sideways = shown.spread()
        forward = math.hypot(ASIDE, noise * forward, SLIP_SHARE * way)
        sideways = math.hypot(ASIDE, noise * sideways, bent)
        rows = np.array(
            [
                [-along / sideways, lever / sideways, 0.0, (aside - across) / sideways],
                [0.0, 0.0, -lever / forward, (along - way) / forward],
            ]
        )
        kept = math.exp(-(abs(way) + abs(turn)) / FADE)
        return PRIOR + kept * (self.sums - PRIOR) + rows.T @ rows, kept * self.number + 1.0

    def flaw(self, name: str, sums: Floats, number: float) -> Contradiction | None:
        """Return how the mounting differs, by these sums, if that is certain (3 sigma)."""
        inverse = np.linalg.inv(sums[:3, :3])
        found = inverse @ sums[:3, 3]
        left = float(sums[3, 3] - found @ sums[:3, 3])
        inverse *= max((left + 3.0) / (number + 2.0), 1.0)  # larger if the equations disagree
        (yaw, x, y), sigma = found.tolist(), np.sqrt(np.diag(inverse)).tolist()
        certain = 0.0 if self._named else 3.0
        clear = [
            spread < least < abs(value) - certain * spread
            for value, spread, least in zip((yaw, x, y), sigma, (YAW, PLACE, PLACE), strict=True)
        ]
        self._named = any(clear)
        if not self._named:
            return None
        by = f"{math.degrees(yaw):+.1f}° (±{math.degrees(2.0 * sigma[0]):.1f}°)"
        bad = abs(yaw) > DRIVABLE_YAW + 3.0 * sigma[0]
        if not clear[0]:
            by = (
                f"{x:+.2f} m (±{2.0 * sigma[1]:.2f}) ahead and {y:+.2f} m (±{2.0 * sigma[2]:.2f}) to the left"
            )
            bad = math.hypot(x, y) > DRIVABLE_PLACE + 3.0 * max(sigma[1:])
        return Contradiction(f"{name}: mounted {by} off what the robot file states", bad, drivable=not bad)


class _Turns(NamedTuple):
    """Turns over one comparison [rad]."""

    t: Nanos
    dt: float
    shown: float
    wheels: float
    slip: float
    gyro: float
    """with its bias"""


class MotionCheck:
    """Compares the sources' motions. Plain data."""

    def __init__(self, body: Differential, turn_slip: float = 0.0) -> None:  # noqa: ARG002 - until perception omits it
        self._body = body
        self._wheels, self._gyro = Track(), Track()
        self._gyro_name, self._gyro_t = "", 0
        self._headed: float | None = None
        """Turn of the gyro when the wheels last reported: it shows the shape of their way best."""
        self._bias, self._learnt = 0.0, 0.0
        """rad/s, of the gyro, and over which time [s] that is the mean"""
        self._turned: Nanos = 0
        """Since when the turns of wheels and gyro are compared,"""
        self._turned_at: Nanos = 0
        """and when they last were."""
        self._references: dict[str, Reference] = {}
        self._past: dict[str, deque[_Turns]] = {}
        """By lidar ("": at rest by the wheels): the comparisons after which its reference was renewed."""
        self._mountings: dict[str, Mounting] = {}
        self._flaws: dict[str, Contradiction] = {}
        self._differ: dict[str, tuple[int, Nanos, str]] = {}
        """By lidar ("": wheels and gyro): comparisons in a row that differed, since when, and how."""

    def contradictions(self) -> list[Contradiction]:
        """Return what differs now."""
        three_first = sorted(self._differ, key=lambda name: not name)
        differ = [Contradiction(self._differ[name][2], self._confirmed(name)) for name in three_first]
        return differ + list(self._flaws.values())

    def on_wheels(self, since: Nanos, t: Nanos, left: float, right: float) -> None:
        """Add the wheels' rotation [rad] between two times."""
        body = self._body
        distance, turn = body.forward(left, right)
        slip = SLIP_SHARE * body.wheel_radius * math.hypot(left, right) / body.wheel_separation
        heading, gyro = turn, self._gyro.at(t)
        if gyro is not None:
            if self._headed is not None:
                heading = gyro[4] - self._headed - self._bias * seconds(t - since)
            self._headed = gyro[4]
        else:
            self._headed = None
        self._wheels.add(since, t, distance, heading, turn, slip)
        if t - self._turned_at >= PERIOD:
            self._turned_at = t
            self._compare_turns(t)

    def on_jump(self, motor: str, moving: bool) -> None:
        """Forget the wheels' motion, since a position jumped: of a moving base that is a contradiction."""
        self._wheels.clear()
        if moving:
            self._differ[""] = CONFIRM, 0, f"{motor}: its position jumped"
            self._turned = self._turned_at

    def on_gyro(self, name: str, t: Nanos, rate: float, sigma: float = 0.0) -> None:  # noqa: ARG002 - likewise
        """Add a rate [rad/s], its bias included."""
        if self._gyro_name == name and self._gyro_t < t <= self._gyro_t + AHEAD:
            rate = min(max(rate, -FASTEST), FASTEST)
            self._gyro.add(self._gyro_t, t, 0.0, 0.0, rate * seconds(t - self._gyro_t), 0.0)
        self._gyro_name, self._gyro_t = name, max(t, self._gyro_t)

    def on_scan(self, name: str, t: Nanos, scan: BodyScan) -> None:
        """Compare a scan with its reference, and renew that if it is time."""
        scan = _with_surfaces(scan)
        reference = self._references.get(name)
        since = t if reference is None else reference.t
        wheels, gyro = self._wheels.between(since, t), self._turn_of_gyro(since, t)
        if reference is None or wheels is None or t - since > FORGET or self._is_far(name, wheels):
            self._references[name] = Reference(t, scan)
            self._past[name] = deque()
            self._differ.pop(name, None)
            return
        read = np.flatnonzero(scan.ranges)
        points = scan.ends[read[:: max(1, math.ceil(len(read) / BEAMS))]].T
        shown = self._shown(reference, t, points, wheels, gyro)
        if shown is None:
            if not self._confirmed(name):
                self._references[name] = Reference(t, scan)
                self._differ.pop(name, None)
            return
        reason = self._difference(name, shown, wheels, gyro)
        if not reason:
            reason = self._compare_slowly(name, t, since, scan, shown, wheels)
        self._count(name, t, reason)

    def _shown(
        self, reference: Reference, t: Nanos, points: Floats, wheels: Motion, gyro: Motion | None
    ) -> Shown | None:
        """Return what is found from the motion until the scan before; if it does not fit, from none."""
        last, before = reference.last
        since, turned = self._wheels.between(last, t), self._gyro.between(last, t)
        shown = None
        if since is not None:
            turn = since.turn if turned is None else turned.turn - self._bias * seconds(t - last)
            shown = reference.motion(points, before.then(since, turn))
        if shown is None or shown.fit < FIT:
            guesses = [wheels] if gyro is None else [STILL.then(wheels, gyro.turn), wheels]
            others = [shown, *(reference.motion(points, guess) for guess in guesses)]
            shown = max(filter(None, others), key=lambda one: one.fit, default=None)
        if shown is not None and shown.fit >= FIT:
            reference.last = t, shown.motion
        return shown

    def _compare_slowly(
        self, name: str, t: Nanos, since: Nanos, scan: BodyScan, shown: Shown, wheels: Motion
    ) -> str:
        """Return what differs over some time, though it agreed between these two scans; renew the reference
        if it is time."""
        way, turn = wheels.ahead()[0], shown.motion.turn
        mounting = self._mountings.setdefault(name, Mounting())
        with_this = mounting.with_one(wheels, shown)
        flaw = mounting.flaw(name, *with_this)
        if flaw is None:
            self._flaws.pop(name, None)
        else:
            self._flaws[name] = flaw
        dt, reason = seconds(t - since), ""
        turned = self._gyro.between(since, t)
        now = None if turned is None else _Turns(t, dt, turn, wheels.turn, wheels.uncertain, turned.turn)
        past = self._past[name]
        if now is not None:
            reason = self._drift(name, past, now)
        moved = abs(way) > RENEW_DISTANCE or abs(turn) > RENEW_TURN
        if not reason and (moved or t - since > RENEW_AGE) and not self._confirmed(name):
            mounting.sums, mounting.number = with_this
            if now is not None:
                self._learn(past, now)
            self._references[name] = Reference(t, scan)
        return reason

    def _turn_of_gyro(self, since: Nanos, t: Nanos) -> Motion | None:
        """Return the gyro's motion without its bias."""
        turned, dt = self._gyro.between(since, t), seconds(t - since)
        if turned is None:
            return None
        turn = turned.turn - self._bias * dt
        return Motion(0.0, 0.0, turn, turn, self._unknown_bias() * dt)

    def _unknown_bias(self) -> float:
        """Return by how much the bias may be wrong [rad/s]: less, the longer it has been learnt."""
        return 0.01 + BIAS / (1.0 + self._learnt)

    def _is_far(self, name: str, wheels: Motion) -> bool:
        """True if a gap of the scans leaves too little in common with the reference."""
        far = math.hypot(wheels.x, wheels.y) > 3.0 * RENEW_DISTANCE or abs(wheels.heading) > 3.0 * RENEW_TURN
        return far and name not in self._differ

    def _compare_turns(self, t: Nanos) -> None:
        since = self._turned
        wheels, gyro = self._wheels.between(since, t), self._turn_of_gyro(since, t)
        if t - since > FORGET or (wheels is None and not self._confirmed("")):
            self._turned = t
            self._differ.pop("", None)
        elif wheels is not None and gyro is not None:
            name, reason = self._gyro_name, ""
            if _turns_differ(wheels, gyro):
                turns = f"turned by {_deg(wheels.turn)} by the wheels, {_deg(gyro.turn)} by {name}"
                reason = f"wheels or {name}: {turns}"
            elif not self._references and wheels.uncertain < TURN / 5.0:
                dt = seconds(t - since)
                now = _Turns(t, dt, wheels.turn, wheels.turn, 0.0, gyro.turn + self._bias * dt)
                past = self._past.setdefault("", deque())
                reason = self._drift("wheels", past, now)
                if not reason and t - since > RENEW_TURNS:
                    self._learn(past, now)
            self._count("", t, reason)
            if not reason and t - since > RENEW_TURNS and not self._confirmed(""):
                self._turned = t

    def _difference(self, name: str, shown: Shown, wheels: Motion, gyro: Motion | None) -> str:
        """Return in what the motions differ, beginning with the likely culprit; "" if they agree."""
        motion, fit = shown.motion, shown.fit
        if fit < FIT:
            return f"{name}: {100 * fit:.0f} % of its rays agree with the scan before: has it moved?"
        if _turns_differ(motion, wheels) or (gyro is not None and _turns_differ(motion, gyro, SCALE)):
            culprit, other = f"{name} or wheels", ""
            if gyro is not None:
                culprit = self._culprit(name, motion.turn, wheels.turn, wheels.uncertain, gyro.turn)
                other = f", {self._gyro_name} {_deg(gyro.turn)}"
            return (
                f"{culprit}: turned by {_deg(wheels.turn)} by the wheels{other}, {name} {_deg(motion.turn)}"
            )
        along, aside = motion.ahead()
        way, across = wheels.ahead()
        allowed = DISTANCE + (SLIP_SHARE if abs(along) < abs(way) else TURN_SHARE) * abs(way)
        forward, sideways = (3.0 * MOVING * spread for spread in shown.spread())
        if max(abs(along - way) - forward, abs(aside - across) - sideways) > allowed:
            by = f"moved by {along:.2f} m along, {aside:.2f} m aside by {name}, {way:.2f} m by the wheels"
            return f"wheels or {name}: {by}"
        return ""

    def _culprit(self, name: str, shown: float, wheels: float, slip: float, gyro: float) -> str:
        """Return the source without which the other two agree best; two of them if wheels that slip cannot
        decide."""
        apart = {self._gyro_name: abs(shown - wheels), "wheels": abs(shown - gyro), name: abs(gyro - wheels)}
        best, second = sorted(apart, key=lambda one: apart[one])[:2]
        undecided = apart[second] - apart[best] < LIKELY_SLIP * slip
        return f"{best} or {second}" if undecided else best

    def _drift(self, name: str, past: deque[_Turns], now: _Turns) -> str:
        """Return how the gyro's rate has differed over `PAST`, from its mean or from any that is right."""
        while past and past[0].t < now.t - PAST:
            past.popleft()
        span, shown, wheels, slip, gyro = (float(sum(c)) for c in list(zip(*past, now, strict=True))[1:])
        off, noise = gyro - shown, TURN + SCALE * abs(shown)
        changed = off - self._bias * span
        if abs(changed) > noise + (JUMP + self._unknown_bias()) * span:
            culprit = self._culprit(name, shown, wheels, slip, gyro - self._bias * span)
            off = changed
        elif abs(off) > noise + BIAS * span:
            culprit = self._gyro_name
        else:
            return ""
        return (
            f"{culprit}: {self._gyro_name} is off by {off / span:.2f} rad/s against {name}, over {span:.1f} s"
        )

    def _learn(self, past: deque[_Turns], now: _Turns) -> None:
        past.append(now)
        self._learnt = min(self._learnt + now.dt, LEARN)
        most = LEARN_MOST * now.dt * (1.0 + LEARN / self._learnt**2)
        self._bias += min(max(now.gyro - now.shown - self._bias * now.dt, -most), most) / self._learnt

    def _confirmed(self, name: str) -> bool:
        return self._differ.get(name, (0, 0, ""))[0] >= CONFIRM

    def _count(self, name: str, t: Nanos, reason: str) -> None:
        """Count a comparison. What is confirmed stays until the reference is renewed."""
        if reason:
            count, since, _ = self._differ.get(name, (0, t, ""))
            early = count + 1 == CONFIRM and t - since < CONFIRM_FOR
            self._differ[name] = count + (not early), since, reason
        elif not self._confirmed(name):
            self._differ.pop(name, None)


def _with_surfaces(scan: Any) -> BodyScan:  # noqa: ANN401 - of the earlier kind, too
    """Return the scan with its surfaces, if perception does not pass them yet."""
    if isinstance(scan, BodyScan):
        return scan
    turned = math.atan2(scan.axes[1, 0], scan.axes[0, 0])
    bearings = turned + scan.angle_min + scan.angle_increment * np.arange(len(scan.ranges))
    of = scan.origin, bearings, scan.ranges, scan.hit, scan.ends
    return BodyScan(*of, *_surfaces(*of))


def _turns_differ(a: Motion, b: Motion, share: float = TURN_SHARE) -> bool:
    allowed = TURN + share * max(abs(a.turn), abs(b.turn)) + a.uncertain + b.uncertain
    return abs(a.turn - b.turn) > allowed


def _deg(turn: float) -> str:
    return f"{math.degrees(turn):.0f}°"
