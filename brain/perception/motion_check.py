"""Whether wheels, gyro and scans show the same motion, without a map.

Rules. Each scan is compared with a reference scan of at most 1.5 s before (point to line, neighbours by
bearing): the motion that the two scans show is searched from the motion that wheels and gyro have integrated
between their times. Wheels and gyro are compared with each other as well. A reference is renewed once all
have agreed on a motion, and kept while they differ, so that a difference stays visible: a lidar that is
knocked out of its mount agrees with itself again one scan later. After `FORGET` it is renewed anyway. One
comparison that differs may be a glitch, `CONFIRM` of them in a row are not. A scan too bare to show a motion
is not compared, nor is one hidden by what has appeared: most of its rays end before the reference's lines;
`CONFIRM` of those in a row renew the reference. Of three sources that turn, the one without which the other
two agree best is named. What differs slowly is summed: the gyro's rate against the scans' (its bias is learnt
here, independently of the filter), and the direction of the scans' motion against that of the base (the
lidar's mounting).
Source: Censi 2008 (PLICP).
"""

from __future__ import annotations

import math
from collections import deque
from dataclasses import dataclass

from brain.bodies.body import Base
from brain.perception.body_scan import BodyScan
from brain.perception.explain import DELAYS, Explanation
from brain.perception.mounting import Mounting
from brain.perception.scan_motion import ReferenceScan, Shown
from brain.perception.track import AHEAD, SLIP_SHARE, Motion, SourceTrack
from protocols.messages import MILLISECOND, SECOND, Nanos, seconds

FORGET: Nanos = 3 * SECOND
"""A reference is kept at most for this time."""
FASTEST = 1e3
"""rad/s: a rate beyond counts as this, since sums must stay finite."""
PERIOD: Nanos = 50 * MILLISECOND
"""Wheels and gyro are compared this often,"""
RENEW_TURNS: Nanos = 500 * MILLISECOND
"""since a time that is renewed this often."""
REST_AGE: Nanos = 250 * MILLISECOND
"""Age from which on a reference is renewed at rest, to learn the gyro's bias,"""
RENEW_DISTANCE, RENEW_TURN, RENEW_AGE = 0.4, 0.35, 1500 * MILLISECOND
"""and m, rad, and age from which on it is once all agree; after a gap, at three times."""
CONFIRM, CONFIRM_FOR = 3, 150 * MILLISECOND
"""Comparisons in a row that must differ, and for how long: of a burst that a host stamps late all may."""
MOVING = 0.05
"""m: standard deviation of a point that may belong to what moves: in a corridor, few show its length."""
RESTING = 0.01
"""rad: wheels whose turn is less uncertain are at rest."""
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


_Turns = tuple[Nanos, float, float, float, float, float]
"""Time of a comparison, its span [s], and turns over it [rad]: as shown, of the wheels, their possible slip,
and of the gyro with its bias."""


class MotionCheck:
    """Compares the sources' motions. Plain data."""

    def __init__(self, body: Base) -> None:
        self._any_way, self._slip = body.moves_sideways, SLIP_SHARE + 2.0 * body.turn_slip
        self._wheels, self._gyro = SourceTrack(), SourceTrack()
        self._gyro_name, self._gyro_t = "", 0
        self._headed: float | None = None
        """Turn of the gyro when the wheels last reported: it shows the shape of their way best."""
        self._bias, self._learnt = 0.0, 0.0
        """rad/s, of the gyro, and over which time [s] that is the mean"""
        self._turned: Nanos = 0
        """Since when the turns of wheels and gyro are compared,"""
        self._turned_at: Nanos = 0
        """and when they last were."""
        self._references: dict[str, ReferenceScan] = {}
        self._past: dict[str, deque[_Turns]] = {}
        """By lidar ("": wheels at rest): the comparisons that renewed its reference."""
        self._mountings: dict[str, Mounting] = {}
        self._differ: dict[str, tuple[int, Nanos, str]] = {}
        """By lidar ("": wheels and gyro): comparisons in a row that differed, since when, and how."""

        self.explanations: dict[str, Explanation] = {}
        """By lidar: what would make all agree"""
        self._news: list[str] = []

        self._hidden: dict[str, int] = {}
        """By lidar: scans in a row of which most was hidden by what has appeared."""

    def contradictions(self) -> list[Contradiction]:
        """Return what differs now."""
        three_first = sorted(self._differ, key=lambda name: not name)
        differ = [Contradiction(self._differ[name][2], self._confirmed(name)) for name in three_first]
        return differ + [
            Contradiction(f"{name}: {one.flaw}", not one.drivable, name if one.drivable else "")
            for name, one in self._mountings.items()
            if one.flaw
        ]

    def take_news(self) -> list[str]:
        """Return what was explained since the last call."""
        news, self._news = self._news, []
        return news

    def on_wheels(
        self, since: Nanos, t: Nanos, distance: float, turn: float, sideways: float, slid: float
    ) -> None:
        """Add the motion that the joints show between two times [m, rad, m to the left], and the turn [rad]
        that a slip of 1 of all of them would have added."""
        gyro = self._gyro.at(t)
        before, self._headed = self._headed, None if gyro is None else gyro[4]
        heading = turn
        if before is not None and self._headed is not None:
            heading = self._headed - before - self._bias * seconds(t - since)
        self._wheels.add(since, t, distance, heading, turn, self._slip * slid, sideways)
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

    def on_scan(self, name: str, t: Nanos, scan: BodyScan) -> float:
        """Compare a scan that ended at this time with its reference, and renew that if it is time. Return the
        yaw [rad] by which the mounting of this lidar's next scans is to be corrected: mostly 0."""
        reference = self._references.get(name)
        since = t if reference is None else reference.t
        wheels, gyro = self._wheels.between(since, t), self._turn_of_gyro(since, t)
        shown = None
        if reference is not None and wheels is not None and t - since <= FORGET:
            far = max(math.hypot(wheels.x, wheels.y) / RENEW_DISTANCE, abs(wheels.heading) / RENEW_TURN)
            if name in self._differ or far < 3.0:
                shown = _shown(reference, scan, wheels, gyro)
                if shown is None and self._confirmed(name):
                    return 0.0
        hidden = shown is not None and shown.fit < FIT < shown.fit + shown.hidden
        self._hidden[name] = self._hidden.get(name, 0) + 1 if hidden else 0
        if hidden and self._hidden[name] < CONFIRM:
            return 0.0  # one that is wrong may look like this; the next are not to be compared with it
        if shown is None or wheels is None or hidden:
            self._differ.pop(name, None)
            self._past[name] = deque()
            self._refer(name, t, scan)
            return 0.0
        turn = shown.motion.turn
        now = gyro and self._turns(since, t, turn, wheels, gyro)
        reason = self._difference(name, shown, wheels, gyro) or self._drift(name, self._past[name], now)
        self._count(name, t, reason)
        if reason:
            self._explain(name, since, t, shown, wheels, gyro, keep=False)
            return 0.0
        way, resting = self._way(wheels), wheels.uncertain < RESTING
        old = t - since > (REST_AGE if resting and now else RENEW_AGE)
        renewed = (old or way > RENEW_DISTANCE or abs(turn) > RENEW_TURN) and not self._confirmed(name)
        mounting = self._mountings.setdefault(name, Mounting(self._any_way))
        correction = 0.0 if resting else mounting.add(wheels, shown, keep=renewed)
        if renewed:
            self._explain(name, since, t, shown, wheels, gyro, keep=True)
            self._learn(self._past[name], now)
            self._refer(name, t, scan)
        if correction:
            del self._references[name]
        return correction

    def _refer(self, name: str, t: Nanos, scan: BodyScan) -> None:
        """Compare the next scans with this one."""
        self._references[name] = ReferenceScan(t, scan)
        if name in self.explanations:
            self.explanations[name].begin()

    def _explain(
        self,
        name: str,
        since: Nanos,
        t: Nanos,
        shown: Shown,
        wheels: Motion,
        gyro: Motion | None,
        *,
        keep: bool,
    ) -> None:
        """Look for what would make a comparison agree with the others."""
        moved = [self._wheels.between(since - delay, t - delay) for delay in DELAYS]
        earlier = tuple(math.nan if one is None else one.turn for one in moved)
        explanation = self.explanations.setdefault(name, Explanation(name))
        if told := explanation.add(wheels, shown, gyro, seconds(t - since), earlier, keep=keep):
            self._news.append(told)

    def _compare_turns(self, t: Nanos) -> None:
        since = self._turned
        wheels, gyro = self._wheels.between(since, t), self._turn_of_gyro(since, t)
        if t - since > FORGET or (wheels is None and not self._confirmed("")):
            self._turned = t
            self._differ.pop("", None)
        elif wheels is not None and gyro is not None:
            reason, now = "", None
            if _turns_differ(wheels, gyro):
                turns = f"turned by {_deg(wheels.turn)} by the wheels, {_deg(gyro.turn)} by {self._gyro_name}"
                reason = f"wheels or {self._gyro_name}: {turns}"
            elif not self._references and wheels.uncertain < RESTING:
                now = self._turns(since, t, wheels.turn, wheels, gyro)
                reason = self._drift("wheels", self._past.setdefault("", deque()), now)
            self._count("", t, reason)
            if not reason and t - since > RENEW_TURNS and not self._confirmed(""):
                self._learn(self._past.get("", deque()), now)
                self._turned = t

    def _turns(self, since: Nanos, t: Nanos, shown: float, wheels: Motion, gyro: Motion) -> _Turns:
        dt = seconds(t - since)
        return t, dt, shown, wheels.turn, wheels.uncertain, gyro.turn + self._bias * dt

    def _turn_of_gyro(self, since: Nanos, t: Nanos) -> Motion | None:
        """Return the gyro's motion without its bias."""
        turned, dt = self._gyro.between(since, t), seconds(t - since)
        if turned is None:
            return None
        turn = turned.turn - self._bias * dt
        return Motion(0.0, 0.0, turn, turn, self._unknown_bias() * dt)

    def _unknown_bias(self) -> float:
        """Return by how much the bias may be wrong [rad/s]: less, the longer it has been learnt."""
        return 0.01 + BIAS / (1.0 + 4.0 * self._learnt**2)

    def _difference(self, name: str, shown: Shown, wheels: Motion, gyro: Motion | None) -> str:
        """Return in what the motions differ, beginning with the likely culprit; "" if they agree."""
        motion = shown.motion
        if shown.fit < FIT:
            return f"{name}: {100 * shown.fit:.0f} % of its rays agree with the scan before: has it moved?"
        gyro_differs = gyro is not None and _turns_differ(motion, gyro, SCALE, GYRO_TURN)
        if gyro_differs or _turns_differ(motion, wheels):
            culprit, other = f"{name} or wheels", ""
            if gyro is not None:
                culprit = self._culprit(name, motion.turn, wheels.turn, wheels.uncertain, gyro.turn)
                other = f", {self._gyro_name} {_deg(gyro.turn)}"
            turns = f"{_deg(wheels.turn)} by the wheels{other}, {name} {_deg(motion.turn)}"
            return f"{culprit}: turned by {turns}"
        along, aside = motion.ahead()
        way, across = wheels.ahead()
        far = self._way(wheels)
        lags = (abs(along) if not self._any_way else math.hypot(along, aside)) < far
        allowed = DISTANCE + (SLIP_SHARE if lags else TURN_SHARE) * far
        forward, sideways = (3.0 * MOVING * spread for spread in shown.spread())
        if max(abs(along - way) - forward, abs(aside - across) - sideways) > allowed:
            wheel = f"{way:.2f} m along, {across:.2f} m aside" if self._any_way else f"{way:.2f} m"
            by = f"moved by {along:.2f} m along, {aside:.2f} m aside by {name}, {wheel} by the wheels"
            return f"wheels or {name}: {by}"
        return ""

    def _way(self, wheels: Motion) -> float:
        """Return the way [m]; of a base that cannot move sideways, what is along it."""
        along, across = wheels.ahead()
        return math.hypot(along, across) if self._any_way else abs(along)

    def _culprit(self, name: str, shown: float, wheels: float, slip: float, gyro: float) -> str:
        """Return the source without which the other two agree best; two of them if wheels that slip cannot
        decide."""
        apart = {self._gyro_name: abs(shown - wheels), "wheels": abs(shown - gyro), name: abs(gyro - wheels)}
        best, second = sorted(apart, key=lambda one: apart[one])[:2]
        undecided = apart[second] - apart[best] < LIKELY_SLIP * slip
        return f"{best} or {second}" if undecided else best

    def _drift(self, name: str, past: deque[_Turns], now: _Turns | None) -> str:
        """Return how the gyro's rate has differed over `PAST`, from its mean or from any that is right."""
        if now is None:
            return ""
        while past and past[0][0] < now[0] - PAST:
            past.popleft()
        span, shown, wheels, slip, gyro = (math.fsum(c) for c in list(zip(*past, now, strict=True))[1:])
        off, noise = gyro - shown, TURN + SCALE * abs(shown)
        changed, culprit = off - self._bias * span, self._gyro_name
        if abs(changed) > noise + (JUMP + self._unknown_bias()) * span:
            culprit, off = self._culprit(name, shown, wheels, slip, gyro - self._bias * span), changed
        elif abs(off) <= noise + BIAS * span:
            return ""
        rate = f"{off / span:.2f} rad/s against {name}, over {span:.1f} s"
        return f"{culprit}: {self._gyro_name} is off by {rate}"

    def _learn(self, past: deque[_Turns], now: _Turns | None) -> None:
        """Learn the gyro's bias from a comparison in which nothing differed."""
        if now is None:
            return
        past.append(now)
        _, dt, shown, _, _, gyro = now
        self._learnt = min(self._learnt + dt, LEARN)
        most = dt * (LEARN_MOST + self._unknown_bias())
        self._bias += min(max(gyro - shown - self._bias * dt, -most), most) / self._learnt

    def _confirmed(self, name: str) -> bool:
        return self._differ.get(name, (0, 0, ""))[0] >= CONFIRM

    def _count(self, name: str, t: Nanos, reason: str) -> None:
        """Count a comparison. What is confirmed stays until the reference is renewed."""
        if reason:
            count, since, first = self._differ.get(name, (0, t, ""))
            early = count + 1 == CONFIRM and t - since < CONFIRM_FOR
            # The longer it lasts, the more wheels may have slipped: the first reason names the culprit best.
            self._differ[name] = count + (not early), since, first or reason
        elif not self._confirmed(name):
            self._differ.pop(name, None)


def _shown(reference: ReferenceScan, scan: BodyScan, wheels: Motion, gyro: Motion | None) -> Shown | None:
    """Return the motion found from that of wheels and gyro; if it does not fit, from others as well."""
    turn = wheels.turn if gyro is None else gyro.turn
    x, y, by = reference.apart
    best: Shown | None = None
    for guess in (
        wheels._replace(turn=turn),
        wheels._replace(x=wheels.x + x, y=wheels.y + y, turn=turn + by),
        wheels,
    ):
        one = reference.motion(scan, guess)
        best = one if best is None or (one is not None and one.fit > best.fit) else best
        if best is not None and best.fit >= FIT:
            reference.keep(best.motion, wheels._replace(turn=turn))
            break
    return best


def _turns_differ(a: Motion, b: Motion, share: float = TURN_SHARE, least: float = TURN) -> bool:
    allowed = least + share * max(abs(a.turn), abs(b.turn)) + a.uncertain + b.uncertain
    return abs(a.turn - b.turn) > allowed


def _deg(turn: float) -> str:
    return f"{math.degrees(turn):.0f}°"
