"""Whether wheels, gyro and scans show the same motion, without a map.

Rules. Each scan is compared with a reference scan of at most a second before (point to line, neighbours by
bearing): the motion that the two scans show is searched from the motion that wheels and gyro have integrated
between their times. Wheels and gyro are compared with each other as well. A reference is renewed once all
have agreed on a motion, and kept while they differ, so that a difference stays visible: a lidar that is
knocked out of its mount agrees with itself again one scan later. After `FORGET` it is renewed anyway. One
comparison that differs may be a glitch, `CONFIRM` of them in a row are not. A scan too bare to show a motion
is not compared. Source: Censi 2008 (PLICP).
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from brain.belief import Floats
from brain.bodies.differential import Differential, sinc
from brain.perception.grid import Indices
from brain.perception.mount import BodyScan, Bools
from protocols.messages import MILLISECOND, SECOND, Nanos, seconds

KEPT: Nanos = 4 * SECOND
"""Integrated motion is kept for this time,"""
FORGET: Nanos = 3 * SECOND
"""and a reference at most for this time."""
AHEAD: Nanos = 60 * MILLISECOND
"""A track is extrapolated by at most this much, and a gyro's rate holds for at most this time."""
FASTEST = 1e3
"""rad/s: a rate beyond counts as this, since sums must stay finite."""
PERIOD: Nanos = 50 * MILLISECOND
"""Wheels and gyro are compared this often."""
CONFIRM = 3
"""Comparisons in a row that must differ."""
RENEW_DISTANCE, RENEW_TURN, RENEW_AGE = 0.2, 0.35, 1 * SECOND
"""m, rad, and age from which on a reference is renewed once all agree."""
BEAMS = 120
"""Largest number of beams of a scan that are compared, evenly chosen."""
LEAST = 20
"""Least number of them on lines of the reference; fewer show no motion."""
ON_LINE = 0.1
"""m: a point this near to a line of the reference lies on it."""
FIT = 0.6
"""Least share of the points that must lie on lines once the motion is found."""
TURN, DISTANCE = 0.05, 0.07
"""rad and m: differences below these are none (measured: at most 0.045 rad and 0.015 m),"""
TURN_SHARE, SLIP_SHARE = 0.15, 0.35
"""nor are those below this share of the motion (tyres, stamps), or of a way that the base lags behind."""
PAST: Nanos = 10 * SECOND
"""What differs slowly is summed over this time:"""
LEAST_WAY, STRAIGHT = 1.0, 0.1
"""m: a lidar's direction shows from a way of this length on, where comparisons turn by less (rad)."""
PAST_SHARE = 0.05
"""there, and of turns that neither the wheels' slip nor their distance spoils, this share is allowed."""


@dataclass(frozen=True, slots=True)
class Motion:
    """Motion between two times."""

    x: float
    """m, in the frame of the first"""
    y: float
    turn: float
    """rad, not wrapped"""
    uncertain: float = 0.0
    """rad by which the turn may be wrong by slip or bias"""


_Row = tuple[Nanos, float, float, float, float]
"""Time, then x, y, turn and uncertainty since the beginning of the track."""


class Track:
    """What one source has integrated. Plain data."""

    def __init__(self) -> None:
        self._rows: deque[_Row] = deque()

    def add(self, since: Nanos, t: Nanos, distance: float, turn: float, uncertain: float) -> None:
        """Add an arc [m, rad] between two times; after a gap the track begins anew."""
        if self._rows and self._rows[-1][0] != since:
            self._rows.clear()
        _, x, y, yaw, total = self._rows[-1] if self._rows else (since, 0.0, 0.0, 0.0, 0.0)
        if not self._rows:
            self._rows.append((since, x, y, yaw, total))
        if distance:
            chord, heading = distance * sinc(turn / 2.0), yaw + turn / 2.0
            x, y = x + chord * math.cos(heading), y + chord * math.sin(heading)
        self._rows.append((t, x, y, yaw + turn, total + uncertain))
        while self._rows[0][0] < t - KEPT:
            self._rows.popleft()

    def clear(self) -> None:
        """Forget everything: a motion was lost."""
        self._rows.clear()

    def between(self, since: Nanos, t: Nanos) -> Motion | None:
        """Return the motion between two times; None if the track does not reach that far."""
        start, end = self._at(since), self._at(t)
        if start is None or end is None:
            return None
        c, s = math.cos(start[3]), math.sin(start[3])
        dx, dy = end[1] - start[1], end[2] - start[2]
        return Motion(c * dx + s * dy, c * dy - s * dx, end[3] - start[3], end[4] - start[4])

    def _at(self, t: Nanos) -> _Row | None:
        rows = self._rows
        if len(rows) < 2 or not rows[0][0] <= t <= rows[-1][0] + AHEAD:
            return None
        after = len(rows) - 1
        while after > 1 and rows[after - 1][0] > t:
            after -= 1
        a, b = rows[after - 1], rows[after]
        part = (t - a[0]) / max(b[0] - a[0], 1)
        x, y, yaw, total = (p + part * (q - p) for p, q in zip(a[1:], b[1:], strict=True))
        return t, x, y, yaw, total


@dataclass(frozen=True, slots=True)
class Contradiction:
    """What cannot all be true, in words."""

    reason: str
    confirmed: bool = True


@dataclass(frozen=True, slots=True)
class _Agreed:
    """A comparison, at a time."""

    t: Nanos
    shown: Motion
    fit: float
    wheels: Motion
    gyro: Motion | None


class Reference:
    """A scan and the lines through its neighbouring hits. Plain data."""

    def __init__(self, t: Nanos, scan: BodyScan) -> None:
        self.t, self._scan = t, scan
        apart = max(1, round(0.05 / scan.angle_increment))
        before, after = np.roll(scan.ends, apart, axis=0), np.roll(scan.ends, -apart, axis=0)
        along = after - before
        length = np.maximum(np.sqrt(np.sum(along * along, axis=1)), 1e-9)
        self._normals = np.column_stack([-along[:, 1], along[:, 0]]) / length[:, None]
        self._centers = (before + scan.ends + after) / 3.0
        bend = np.abs(np.sum(self._normals * (scan.ends - (before + after) / 2.0), axis=1))
        hit = scan.hit & np.roll(scan.hit, apart) & np.roll(scan.hit, -apart)
        self._line = hit & (length < 0.1 + 0.5 * scan.ranges) & (bend < ON_LINE / 2.0)

    def motion(self, scan: BodyScan, wheels: Motion, turn: float) -> tuple[Motion, float] | None:
        """Return the motion since the reference that a scan shows, searched from that of the wheels with this
        turn, and the share of its rays' ends that then lie on the reference's lines (rays without a return
        pass them); None if too few of them meet a line."""
        read = np.flatnonzero(scan.ranges > 0.0)
        points = scan.ends[read[:: max(1, math.ceil(len(read) / BEAMS))]]
        x, y = wheels.x, wheels.y
        for gate in (0.8, 0.4, 0.3, 0.3, 0.3):
            moved, beam, lined, distance = self._distances(points, x, y, turn)
            near = lined & (np.abs(distance) < gate)
            if np.count_nonzero(lined) < LEAST:
                return None
            normals, off = self._normals[beam[near]], distance[near]
            arm = moved[near] - (x, y)
            J = np.column_stack([normals, normals[:, 1] * arm[:, 0] - normals[:, 0] * arm[:, 1]])
            weighted = J / (1.0 + (off / 0.05) ** 2)[:, None]
            step = -np.linalg.solve(weighted.T @ J + 1e-3 * np.eye(3), weighted.T @ off)
            x, y, turn = x + float(step[0]), y + float(step[1]), turn + float(step[2])
            if np.abs(step).max() < 2e-3:
                break
        on_line = lined & (np.abs(distance) < ON_LINE)
        return Motion(x, y, turn), float(np.sum(on_line) / max(1.0, float(np.sum(lined))))

    def _distances(
        self, points: Floats, x: float, y: float, turn: float
    ) -> tuple[Floats, Indices, Bools, Floats]:
        """Return for points moved by (x, y, turn): where they are, the beam of the reference in whose
        direction, whether it is part of a line, and the distance from that [m]."""
        scan = self._scan
        c, s = math.cos(turn), math.sin(turn)
        moved = points @ np.array([[c, s], [-s, c]]) + (x, y)
        local = (moved - scan.origin) @ scan.axes
        bearing = np.mod(np.arctan2(local[:, 1], local[:, 0]) - scan.angle_min, 2.0 * math.pi)
        beam = np.rint(bearing / scan.angle_increment).astype(np.int64)
        beam[np.abs(beam * scan.angle_increment - 2.0 * math.pi) < scan.angle_increment / 2.0] = 0
        inside = beam < len(scan.ranges)
        beam[~inside] = 0
        distance = np.sum(self._normals[beam] * (moved - self._centers[beam]), axis=1)
        return moved, beam, inside & self._line[beam], distance


class MotionCheck:
    """Compares the sources' motions. Plain data."""

    def __init__(self, body: Differential, turn_slip: float) -> None:
        self._body, self._slip = body, turn_slip
        self._wheels, self._gyro = Track(), Track()
        self._gyro_name, self._gyro_t = "", 0
        self._turned: Nanos = 0
        """Since when the turns of wheels and gyro are compared,"""
        self._turned_at: Nanos = 0
        """and when they last were."""
        self._references: dict[str, Reference] = {}
        self._past: dict[str, deque[_Agreed]] = {}
        """By lidar: the comparisons after which its reference was renewed."""
        self._differ: dict[str, tuple[int, str]] = {}
        """By lidar ("": wheels and gyro): comparisons in a row that differed, and how."""

    def contradictions(self) -> list[Contradiction]:
        """Return what differs now."""
        return [Contradiction(reason, count >= CONFIRM) for count, reason in self._differ.values()]

    def on_wheels(self, since: Nanos, t: Nanos, left: float, right: float) -> None:
        """Add the wheels' rotation [rad] between two times."""
        distance, turn = self._body.forward(left, right)
        way = self._body.wheel_radius * math.hypot(left, right)
        self._wheels.add(since, t, distance, turn, 3.0 * self._slip * way / self._body.wheel_separation)
        if t - self._turned_at >= PERIOD:
            self._turned_at = t
            self._compare_turns(t)

    def on_jump(self, motor: str, moving: bool) -> None:
        """Forget the wheels' motion, since a position jumped: of a moving base that is a contradiction."""
        self._wheels.clear()
        if moving:
            self._differ[""] = CONFIRM, f"{motor}: its position jumped"
            self._turned = self._turned_at

    def on_gyro(self, name: str, t: Nanos, rate: float, sigma: float) -> None:
        """Add a rate without its bias, whose standard deviation is sigma [rad/s]."""
        if self._gyro_name == name and self._gyro_t < t <= self._gyro_t + AHEAD:
            dt, rate = seconds(t - self._gyro_t), min(max(rate, -FASTEST), FASTEST)
            self._gyro.add(self._gyro_t, t, 0.0, rate * dt, 3.0 * sigma * dt)
        self._gyro_name, self._gyro_t = name, max(t, self._gyro_t)

    def on_scan(self, name: str, t: Nanos, scan: BodyScan) -> None:
        """Compare a scan with its reference, and renew that if it is time."""
        reference = self._references.get(name)
        since = t if reference is None else reference.t
        wheels, gyro = self._wheels.between(since, t), self._gyro.between(since, t)
        if reference is None or wheels is None or t - since > FORGET or self._is_far(name, wheels):
            self._references[name] = Reference(t, scan)
            self._past[name] = deque()
            self._differ.pop(name, None)
            return
        found = reference.motion(scan, wheels, wheels.turn if gyro is None else gyro.turn)
        if found is not None and found[1] < FIT and gyro is not None:
            found = max(found, reference.motion(scan, wheels, wheels.turn) or found, key=lambda f: f[1])
        reason = "" if found is None else self._difference(name, *found, wheels, gyro)
        if found is not None and not reason:
            now = _Agreed(t, *found, wheels, gyro)
            reason = self._drift(name, now)
            moved = math.hypot(wheels.x, wheels.y) > RENEW_DISTANCE or abs(found[0].turn) > RENEW_TURN
            if not reason and (moved or t - since > RENEW_AGE) and not self._confirmed(name):
                self._past[name].append(now)
                self._references[name] = Reference(t, scan)
        elif found is None and not self._confirmed(name):
            self._references[name] = Reference(t, scan)
        self._count(name, reason)

    def _is_far(self, name: str, wheels: Motion) -> bool:
        """True if a gap of the scans leaves too little in common with the reference."""
        far = math.hypot(wheels.x, wheels.y) > 3.0 * RENEW_DISTANCE or abs(wheels.turn) > 3.0 * RENEW_TURN
        return far and name not in self._differ

    def _compare_turns(self, t: Nanos) -> None:
        since = self._turned
        wheels, gyro = self._wheels.between(since, t), self._gyro.between(since, t)
        if t - since > FORGET or (wheels is None and not self._confirmed("")):
            self._turned = t
            self._differ.pop("", None)
        elif wheels is not None and gyro is not None:
            name, reason = self._gyro_name, ""
            if _turns_differ(wheels, gyro):
                reason = f"wheels or {name}: turned by {_deg(wheels)} by the wheels, {_deg(gyro)} by {name}"
            self._count("", reason)
            if not reason and t - since > RENEW_AGE // 2 and not self._confirmed(""):
                self._turned = t

    def _difference(self, name: str, shown: Motion, fit: float, wheels: Motion, gyro: Motion | None) -> str:
        """Return in what the motions differ, beginning with the likely culprit; "" if they agree."""
        if fit < FIT:
            return f"{name}: {100 * fit:.0f} % of its rays agree with the scan before: has it moved?"
        if _turns_differ(shown, wheels) or (gyro is not None and _turns_differ(shown, gyro, PAST_SHARE)):
            culprit = f"{name} or wheels"
            other = ""
            if gyro is not None:
                apart = {
                    self._gyro_name: abs(shown.turn - wheels.turn),
                    "wheels": abs(shown.turn - gyro.turn),
                    name: abs(gyro.turn - wheels.turn),
                }
                culprit = min(apart, key=lambda one: apart[one])
                other = f", {self._gyro_name} {_deg(gyro)}"
            return f"{culprit}: turned by {_deg(wheels)} by the wheels{other}, {name} {_deg(shown)}"
        way = math.hypot(wheels.x, wheels.y)
        slips = math.hypot(shown.x, shown.y) < way
        allowed = DISTANCE + (SLIP_SHARE if slips else TURN_SHARE) * way
        if math.hypot(shown.x - wheels.x, shown.y - wheels.y) > allowed:
            return _moved(name, wheels, shown)
        return ""

    def _drift(self, name: str, now: _Agreed) -> str:
        """Return in what the motions differ over `PAST`, although they agreed between each two scans."""
        past = self._past[name]
        while past and past[0].t < now.t - PAST:
            past.popleft()
        rows = [*past, now]
        gyros = [one for one in rows if one.gyro is not None]
        off = sum(one.shown.turn - one.gyro.turn for one in gyros if one.gyro)
        allowed = 2.0 * TURN + sum(PAST_SHARE * abs(o.shown.turn) + o.gyro.uncertain for o in gyros if o.gyro)
        if abs(off) > allowed:
            return f"{self._gyro_name}: differs from {name} by {math.degrees(off):.0f}° within {_span(rows)}"
        straight = [one for one in rows if abs(one.wheels.turn) < STRAIGHT]
        aside = sum(one.shown.y - one.wheels.y for one in straight)
        along = sum(math.hypot(one.wheels.x, one.wheels.y) for one in straight)
        if along > LEAST_WAY and abs(aside) > 0.1 + PAST_SHARE * along:
            return f"{name}: moves {aside:.2f} m aside in {along:.2f} m: is it mounted as stated?"
        return ""

    def _confirmed(self, name: str) -> bool:
        return self._differ.get(name, (0, ""))[0] >= CONFIRM

    def _count(self, name: str, reason: str) -> None:
        """Count a comparison. What is confirmed stays until the reference is renewed."""
        if reason:
            self._differ[name] = (self._differ.get(name, (0, ""))[0] + 1, reason)
        elif not self._confirmed(name):
            self._differ.pop(name, None)


def _span(rows: Sequence[_Agreed]) -> str:
    return f"{seconds(rows[-1].t - rows[0].t):.1f} s"


def _moved(name: str, wheels: Motion, shown: Motion) -> str:
    by = f"moved by {wheels.x:.2f}, {wheels.y:.2f} m by the wheels, {shown.x:.2f}, {shown.y:.2f} m by {name}"
    return f"wheels or {name}: {by}"


def _turns_differ(a: Motion, b: Motion, share: float = TURN_SHARE) -> bool:
    allowed = TURN + share * max(abs(a.turn), abs(b.turn)) + a.uncertain + b.uncertain
    return abs(a.turn - b.turn) > allowed


def _deg(motion: Motion) -> str:
    return f"{math.degrees(motion.turn):.0f}°"
