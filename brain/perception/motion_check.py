"""Whether wheels, gyro and scans show the same motion, without a map.

Rules. Each scan is compared with a reference scan of at most 1.5 s before (point to line, neighbours by
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
from collections import deque
from dataclasses import dataclass
from typing import NamedTuple

from brain.bodies.differential import Differential
from brain.perception.body_scan import BodyScan
from brain.perception.mounting import Mounting
from brain.perception.scan_motion import Reference, Shown
from brain.perception.track import AHEAD, SLIP_SHARE, STILL, Motion, Track
from protocols.messages import MILLISECOND, SECOND, Nanos, seconds

FORGET: Nanos = 3 * SECOND
"""A reference is kept at most for this time."""
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
MOVING = 0.05
"""m: standard deviation of a point that may belong to what moves: in a corridor, few show its length."""
FIT = 0.5
"""Least share of the points that must lie on lines once the motion is found."""
TURN, GYRO_TURN, DISTANCE = 0.05, 0.035, 0.07
"""rad, rad between gyro and scans, m: differences below these are none,"""
TURN_SHARE = 0.15
"""nor are those below this share of the motion (tyres, stamps), and of a way that the base lags behind below
`SLIP_SHARE`."""
LIKELY_SLIP = 0.07
"""Share of the slip allowed for, by which wheels may be wrong where they decide between two others."""
PAST: Nanos = 5 * SECOND
"""A gyro's bias is compared over this time."""
BIAS, JUMP, SCALE = 0.08, 0.04, 0.05
"""rad/s: largest bias of a gyro, and largest change of it; share by which it may be wrong in turns."""
LEARN, LEARN_MOST = 60.0, 0.01
"""s, rad/s: its bias is a mean over this time; once known, what differs by more counts as this."""


@dataclass(frozen=True, slots=True)
class Contradiction:
    """What cannot all be true, in words."""

    reason: str
    confirmed: bool = True
    flawed: str = ""
    """The sensor with which the base may go on slowly for as long as it lasts; "" if it may not."""


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

    def __init__(self, body: Differential) -> None:
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

    def on_gyro(self, name: str, t: Nanos, rate: float) -> None:
        """Add a rate [rad/s], its bias included."""
        if self._gyro_name == name and self._gyro_t < t <= self._gyro_t + AHEAD:
            rate = min(max(rate, -FASTEST), FASTEST)
            self._gyro.add(self._gyro_t, t, 0.0, 0.0, rate * seconds(t - self._gyro_t), 0.0)
        self._gyro_name, self._gyro_t = name, max(t, self._gyro_t)

    def on_scan(self, name: str, t: Nanos, scan: BodyScan) -> None:
        """Compare a scan that ended at this time with its reference, and renew that if it is time."""
        reference = self._references.get(name)
        since = t if reference is None else reference.t
        wheels, gyro = self._wheels.between(since, t), self._turn_of_gyro(since, t)
        if reference is None or wheels is None or t - since > FORGET or self._is_far(name, wheels):
            self._references[name] = Reference(t, scan)
            self._past[name] = deque()
            self._differ.pop(name, None)
            return
        shown = self._shown(reference, t, scan, wheels, gyro)
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
        self, reference: Reference, t: Nanos, scan: BodyScan, wheels: Motion, gyro: Motion | None
    ) -> Shown | None:
        """Return what is found from the motion until the scan before; if it does not fit, from none."""
        last, before = reference.last
        since, turned = self._wheels.between(last, t), self._gyro.between(last, t)
        shown = None
        if since is not None:
            turn = since.turn if turned is None else turned.turn - self._bias * seconds(t - last)
            shown = reference.motion(scan, before.then(since, turn))
        if shown is None or shown.fit < FIT:
            guesses = [wheels] if gyro is None else [STILL.then(wheels, gyro.turn), wheels]
            others = [shown, *(reference.motion(scan, guess) for guess in guesses)]
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
        flaw = mounting.flaw(*with_this)
        if flaw is None:
            self._flaws.pop(name, None)
        else:
            text, drivable = flaw
            self._flaws[name] = Contradiction(f"{name}: {text}", not drivable, name if drivable else "")
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
        if _turns_differ(motion, wheels) or (
            gyro is not None and _turns_differ(motion, gyro, SCALE, GYRO_TURN)
        ):
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


def _turns_differ(a: Motion, b: Motion, share: float = TURN_SHARE, least: float = TURN) -> bool:
    allowed = least + share * max(abs(a.turn), abs(b.turn)) + a.uncertain + b.uncertain
    return abs(a.turn - b.turn) > allowed


def _deg(turn: float) -> str:
    return f"{math.degrees(turn):.0f}°"
