"""The state of the filter, and what one input makes of it.

Rules. A state is a value: `after` returns the one that follows from an input, with the decisions that were
made then. Its methods write to it only while it is made; then it never changes.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from operator import sub
from typing import Any, NamedTuple

import numpy as np

from brain.belief import Floats, Pose
from brain.bodies.body import Base
from brain.bodies.plane import wrap
from brain.perception.engine import (
    AT,
    BIAS,
    ENGINES,
    SCALE,
    TURN,
    YAW,
    Engine,
    MoveErrors,
    Packed,
    Vector,
    X,
    Y,
    cross_zeroed,
    pack,
    relative,
    unpacked,
)  # fmt: skip
from brain.perception.filter_inputs import (
    GateResult,
    GyroRate,
    Input,
    Judged,
    PoseFix,
    Relocated,
    ScanEnd,
    WheelAngle,
)  # fmt: skip
from brain.perception.filter_settings import CHI_SQUARE, FilterSettings
from brain.perception.wheel_odometry import (
    Point,
    Rolling,
    Samples,
    added,
    angle_at,
    arc_end,
    arc_slopes,
    jumped,
)  # fmt: skip
from protocols.messages import MILLISECOND, SECOND, Nanos

NEVER: Nanos = -(1 << 62)
GYRO_GAP: Nanos = 250 * MILLISECOND
"""A gyro silent for longer has lost its angle."""
STILL_FOR: Nanos = 300 * MILLISECOND
"""Wheels that have not turned for this time rest."""
GYRO_HOLD = 1.5
"""Intervals for which a gyro's last rate holds."""
MAX_INPUTS = 600
MAX_WAITING = 16
"""Most inputs that are run again, and poses that wait for the wheels."""
NOISE_RATE, MOST_SQUARE, MOST_NOISE = 0.02, 25.0, 400.0
"""Share of one innovation in the noise, its largest square, and the largest factor"""
MAX_INFLATION = 1e6
"""Largest factor on a variance."""
POSE = (X, Y, YAW)


@dataclass(frozen=True, slots=True)
class FilterModel:
    """What all states of a filter have in common."""

    body: Base
    settings: FilterSettings
    engine: Engine
    rolling: Rolling
    number: Mapping[str, int]
    """Of each joint, in the body's order"""
    fastest: tuple[float, ...]
    """rad/s, of each joint"""

    @classmethod
    def of(cls, body: Base, settings: FilterSettings) -> FilterModel:
        """Return the model of a body."""
        number = {motor: number for number, motor in enumerate(body.joints)}
        rolling = Rolling(body, settings.turn_slip)
        return cls(body, settings, ENGINES[settings.engine](), rolling, number, body.top_speeds)


class Gyro(NamedTuple):
    """The gyro in use, integrated."""

    source: str
    sigma: float
    interval: Nanos
    """Between the newest two samples"""
    samples: tuple[tuple[Nanos, float, float], ...]
    """Time, rate, angle: the last one at or before the base, and those since"""
    zero: float | None
    """Angle of the gyro less that of the wheels at which TURN is 0; None: not compared yet"""
    used: Nanos
    """Time of the newest sample that has corrected the state"""


@dataclass(slots=True)
class FilterState:
    """All that is known after an input."""

    model: FilterModel
    x: Vector
    P: Packed
    smooth: Point
    """Pose by wheels and gyro alone: without the leaps that corrections make"""
    raw: Point
    """Pose by the wheels alone"""
    t: Nanos = NEVER
    """Time up to which the wheels have moved the pose"""
    samples: tuple[Samples, ...] = ()
    """By joint"""
    at: tuple[float, ...] = ()
    """Angles of the joints [rad] at t; () before the start, and after a jump"""
    travelled: tuple[float, float, float] = (0.0, 0.0, 0.0)
    """Sums since the start, without jumps: m forward and to the left in the moving frame, and rad that a slip
    of 1 of all joints would have turned the base by"""
    gyro: Gyro | None = None
    waiting: tuple[PoseFix | Relocated | ScanEnd, ...] = ()
    """Poses newer than t, oldest first"""
    rejected: tuple[tuple[str, Nanos], ...] = ()
    """Sources that the gate rejects, and since when"""
    noise: tuple[float, float, float] = (1.0, 1.0, 0.0)
    """Factors on the variances of the gyro and of slip, found from innovations at rest and in motion, and the
    newest innovation over its standard deviation"""
    turning: float = 0.0
    """Yaw rate by the wheels [rad/s], over the last travel"""
    stood: tuple[Nanos, tuple[float, ...]] = (NEVER, ())
    """Since when the wheels have been at these angles, to a count"""
    doubt: bool = False
    """The gyro contradicted the wheels for long: its bias is not learnt from the wheels until it is known
    """
    judged: tuple[Judged, ...] = ()
    """The decisions that the last input brought"""

    @property
    def resting(self) -> bool:
        """Whether the wheels have not turned for a while."""
        return self.t - self.stood[0] >= STILL_FOR

    @classmethod
    def first(cls, model: FilterModel) -> FilterState:
        """Return the state before any input."""
        settings = model.settings
        start = settings.start_x, settings.start_y, settings.start_yaw
        sigmas = (
            *(settings.start_sigma,) * 2,
            settings.start_yaw_sigma,
            settings.bias_sigma,
            settings.scale_sigma,
            settings.turn_slip,
            settings.turn_slip,
            0.0,
        )
        P = pack(np.diag(np.square(sigmas)))
        return cls(
            model, (*start, 0.0, 0.0, 0.0, 0.0, 0.0), P, start, start, samples=((),) * len(model.fastest)
        )

    def after(self, item: Input) -> FilterState:
        """Return the state after an input."""
        new = FilterState(
            self.model, self.x, self.P, self.smooth, self.raw, self.t, self.samples, self.at, self.travelled,
            self.gyro, self.waiting, self.rejected, self.noise, self.turning, self.stood, self.doubt,
        )  # fmt: skip
        new._apply(item)
        return new

    def __deepcopy__(self, memo: dict[int, Any]) -> FilterState:
        return self  # never changed again

    def _apply(self, item: Input) -> None:
        if isinstance(item, GyroRate):
            self._on_gyro(item)
        elif isinstance(item, WheelAngle):
            self._on_wheel(item)
        elif self.t == item.t:
            self._on_pose(item)
        elif self.at and self.t < item.t <= min([each[-1][0] for each in self.samples]):
            self.travel(item.t)
            self._on_pose(item)
        else:
            if len(self.waiting) >= MAX_WAITING:
                if not isinstance(self.waiting[0], ScanEnd):
                    self._report(source_of(self.waiting[0]), self.waiting[0].t, GateResult.LATE)
                self.waiting = self.waiting[1:]
            self.waiting = (*self.waiting, item)

    def _report(
        self, source: str, t: Nanos, result: GateResult, distance: float = 0.0, freedom: int = 0
    ) -> None:
        self.judged = (*self.judged, Judged(source, t, result, distance, freedom))

    # -- wheels --------------------------------------------------------------------------------------------

    def _on_wheel(self, item: WheelAngle) -> None:
        number = self.model.number[item.motor]
        new = item.t, item.angle
        samples = self.samples[number]
        settings = self.model.settings
        if samples:
            if item.t <= samples[-1][0]:
                self._report(item.motor, item.t, GateResult.CONFLICT)
                return
            most = self.model.fastest[number]
            if jumped(most, samples[-1], new, settings.jump_margin, settings.resolution):
                self._report(item.motor, item.t, GateResult.JUMPED)
                self.samples, self.at, samples = ((),) * len(self.samples), (), ()
        each = list(self.samples)
        each[number] = added(samples, new, self.t)
        self.samples = tuple(each)
        if not all(self.samples):
            return
        t = min([each[-1][0] for each in self.samples])
        if not self.at:  # the start, or a new zero
            if t < max(each[0][0] for each in self.samples):
                return
            self._start(t)
        while self.waiting and self.waiting[0].t <= t:
            pose = self.waiting[0]
            self.waiting = self.waiting[1:]
            if pose.t > self.t:
                self.travel(pose.t)
            self._on_pose(pose)
        if t - self.t >= settings.shortest:
            self.travel(t)

    def _start(self, t: Nanos) -> None:
        """Take the joints' angles at a time as those of the present pose."""
        self.t = t
        self.at = tuple([angle_at(samples, t) for samples in self.samples])
        self.stood = t, self.at

    def travel(self, t: Nanos) -> None:
        """Move by what the joints turned up to a time, and correct by what the gyro turned."""
        settings, before = self.model.settings, self.at
        angles = tuple([angle_at(samples, t) for samples in self.samples])
        turned = tuple(map(sub, angles, before))
        dt = (t - self.t) / SECOND
        travel = self.model.body.travel(before, angles)
        distance, turn, sideways = travel[:3]
        errors = self.model.rolling.errors(travel, turned)
        left_yaw, right_yaw, slid, way_left, way_right, rolled, rounding, turning, walks = errors
        x, y, yaw, bias, scale, slip_left, slip_right, angle = self.x
        length, slipped = (1.0 - scale) * distance, left_yaw * slip_left + right_yaw * slip_right
        aside = (1.0 - scale) * sideways
        dx, dy, ux, uy, wx, wy = arc_slopes(yaw, length, turn + slipped, aside)
        keep_left = math.exp(-way_left / settings.slip_length)
        keep_right = math.exp(-way_right / settings.slip_length)
        gyro_factor, slip_factor, _ = self.noise
        slip_variance = slip_factor * settings.turn_slip * settings.turn_slip
        along = slip_factor * settings.travel_noise * settings.travel_noise * rolled
        across = settings.sideways_noise * settings.sideways_noise * rolled
        single = both = 0.0
        if walks is not None:
            walk = 2.0 * slip_variance * settings.slip_length
            single, both = walk * walks[0], walk * walks[3]
            along, across = along + walk * walks[1], across + walk * walks[2]
        yaw_share = left_yaw * left_yaw + right_yaw * right_yaw
        late = settings.turn_lag * (turn / dt - self.turning)
        self.turning = turn / dt
        gyro = self.gyro
        turn_noise = (
            0.0 if gyro is None else gyro_factor * gyro.sigma * gyro.sigma * (gyro.interval / SECOND) * dt
        )
        self.x = (
            x + dx, y + dy, yaw + turn + slipped, bias, scale, keep_left * slip_left, keep_right * slip_right,
            angle + slipped + bias * dt,
        )  # fmt: skip
        self.P = self.model.engine.predict(
            self.P,
            MoveErrors(
                -dy, dx, sideways * uy - distance * ux, -distance * uy - sideways * ux, wx, wy,
                left_yaw, right_yaw, dt, keep_left, keep_right,
                along * ux * ux + across * uy * uy - 2.0 * both * ux * uy,
                (along - across) * ux * uy + both * (ux * ux - uy * uy),
                along * uy * uy + across * ux * ux + 2.0 * both * ux * uy,
                settings.bias_walk * settings.bias_walk * dt,
                settings.scale_walk * settings.scale_walk * rolled,
                slip_variance * (1.0 - keep_left * keep_left),
                slip_variance * (1.0 - keep_right * keep_right), turn_noise, late * late + single,
            ),
        )  # fmt: skip
        self.t, self.at = t, angles
        so_far = self.travelled
        self.travelled = so_far[0] + distance, so_far[1] + sideways, so_far[2] + slid
        stood, most = self.stood[1], 1.5 * settings.resolution
        for j in self.model.rolling.wheels:
            if abs(angles[j] - stood[j]) > most:
                self.stood = t, angles
                break
        self.raw = arc_end(self.raw, distance, turn, sideways)
        if gyro is not None:
            by_slip = slip_variance * yaw_share / (dt * dt)
            learns = by_slip < self.P[BIAS_BIAS] and not self.doubt
            rounding *= settings.resolution
            variance = rounding * rounding / 12.0 + (settings.jitter / dt * turning) ** 2
            self._compare(gyro, variance, learns, yaw_share)
        self.smooth = arc_end(self.smooth, length, self.x[YAW] - yaw, aside)

    # -- gyro ----------------------------------------------------------------------------------------------

    def _on_gyro(self, item: GyroRate) -> None:
        gyro = self.gyro
        last = gyro.samples[-1] if gyro is not None else (NEVER, 0.0, 0.0)
        silent = item.t - last[0]
        if gyro is not None and gyro.source != item.source:
            if silent <= 2 * GYRO_GAP:
                self._report(item.source, item.t, GateResult.UNUSED)
                return
            bias_variance = self.model.settings.bias_sigma**2
            self.x = (*self.x[:BIAS], 0.0, *self.x[BIAS + 1 :])
            self.P = cross_zeroed(self.P, BIAS, bias_variance)
        if gyro is None or silent > GYRO_GAP:
            sample = (item.t, item.rate, 0.0)
            self.gyro = Gyro(item.source, item.sigma, GYRO_GAP, (sample,), None, item.t)
        elif silent <= 0:
            self._report(item.source, item.t, GateResult.CONFLICT)
        else:
            angle = last[2] + 0.5 * (last[1] + item.rate) * (silent / SECOND)
            kept = gyro.samples
            while len(kept) > 1 and (kept[1][0] <= self.t or len(kept) > MAX_INPUTS // 4):
                kept = kept[1:]
            sample = (item.t, item.rate, angle)
            self.gyro = Gyro(item.source, item.sigma, silent, (*kept, sample), gyro.zero, gyro.used)

    def _compare(self, gyro: Gyro, variance: float, learns: bool, yaw_share: float) -> None:
        """Correct by the gyro's angle less that of the joints, whose variance this is."""
        turned = _gyro_angle(gyro, self.t)
        if turned is None:
            if self.t - gyro.samples[-1][0] > GYRO_GAP:
                self.gyro = gyro._replace(zero=None)
            return
        settings = self.model.settings
        turned -= self.raw[2]
        if gyro.zero is None:
            self._zero_gyro(gyro, turned, variance)
            return
        if gyro.samples[-1][0] <= gyro.used:
            return
        innovation = turned - gyro.zero - self.x[TURN]
        x, P, distance = self.model.engine.turn(self.x, self.P, innovation, variance)
        if distance <= CHI_SQUARE[settings.confidence][0]:
            if not learns:  # the optimal update of all but the bias (Schmidt 1966)
                x = (*x[:BIAS], self.x[BIAS], *x[BIAS + 1 :])
                P = (*P[:BIAS_BIAS], self.P[BIAS_BIAS], *P[BIAS_BIAS + 1 :])
            self.x, self.P = x, P
            self.gyro = Gyro(
                gyro.source, gyro.sigma, gyro.interval, gyro.samples, gyro.zero, gyro.samples[-1][0]
            )
            self._bound()
            self._accepted(gyro.source)
            result = GateResult.ACCEPTED
        else:
            result = self._contradiction(gyro, turned, innovation, variance)
        self._report(gyro.source, self.t, result, distance, 1)
        self._learn_noise(math.copysign(math.sqrt(distance), innovation), moving=yaw_share > 0.0)

    def _learn_noise(self, innovation: float, *, moving: bool) -> None:
        """Raise what is more than the settings state: in motion the slip, at rest the noise of the gyro. Of
        that only what changes from sample to sample is noise: a gyro that reads a turn at rest has another
        fault."""
        gyro_factor, slip_factor, last = self.noise
        if moving:
            square = min(innovation * innovation, MOST_SQUARE)
            slip_factor = min(max(slip_factor * (1.0 + NOISE_RATE * (square - 1.0)), 1.0), MOST_NOISE)
        else:
            square = min((innovation - last) ** 2 / 2.0, MOST_SQUARE)
            gyro_factor = min(max(gyro_factor * (1.0 + NOISE_RATE * (square - 1.0)), 1.0), MOST_NOISE)
        self.noise = gyro_factor, slip_factor, innovation

    def _contradiction(self, gyro: Gyro, turned: float, innovation: float, variance: float) -> GateResult:
        """Leave out a gyro that contradicts the wheels; the yaw may be wrong by as much."""
        result = self._rejection(gyro.source, self.t)
        if result is GateResult.FORCED:  # its bias may be any, and resting wheels do not show it
            self.P = cross_zeroed(self.P, BIAS, self.model.settings.bias_sigma**2)
            self.doubt = True
        self._zero_gyro(gyro, turned, variance)
        P = list(self.P)
        P[AT[YAW][YAW]] += innovation * innovation
        self.P = tuple(P)
        return result

    def _zero_gyro(self, gyro: Gyro, turned: float, variance: float) -> None:
        self.x = (*self.x[:TURN], 0.0)
        self.P = cross_zeroed(self.P, TURN, variance)
        self.gyro = gyro._replace(zero=turned, used=gyro.samples[-1][0])

    # -- poses ---------------------------------------------------------------------------------------------

    def _on_pose(self, item: PoseFix | Relocated | ScanEnd) -> None:
        if isinstance(item, ScanEnd):
            return
        if isinstance(item, Relocated):
            x, y, yaw = item.value.tolist()
            P = self.P
            for row in POSE:
                P = cross_zeroed(P, row, 0.0)
            whole = unpacked(P)
            whole[:3, :3] = item.noise
            self.x, self.P, self.rejected = (x, y, yaw, *self.x[BIAS:]), pack(whole), ()
            return
        rows = POSE[: len(item.value)]
        y = [float(value) - self.x[row] for value, row in zip(item.value, rows, strict=True)]
        if len(rows) > YAW:
            y[YAW] = wrap(y[YAW])
        if item.drift is not None:
            self.P = _widened(self.P, item.drift)
        packed, share = self.P, None
        if item.shared is not None:
            packed, share = relative(packed, rows, item.shared)
        x_new, P_new, distance = self.model.engine.update(self.x, packed, rows, tuple(y), item.noise)
        if distance > CHI_SQUARE[self.model.settings.confidence][len(rows) - 1] and item.drift is not None:
            off = y[X] * y[X] + y[Y] * y[Y]
            packed = _widened(packed, np.diag([off, off, y[YAW] * y[YAW]]))
            x_new, P_new, _ = self.model.engine.update(self.x, packed, rows, tuple(y), item.noise)
            result = GateResult.ACCEPTED
            self._accepted(item.source)
        elif distance <= CHI_SQUARE[self.model.settings.confidence][len(rows) - 1]:
            result = GateResult.ACCEPTED
            self._accepted(item.source)
        else:
            result = self._rejection(item.source, item.t)
            if result is GateResult.FORCED:
                share = None
                packed = _inflated(self.P, rows, y)
                x_new, P_new, _ = self.model.engine.update(self.x, packed, rows, tuple(y), item.noise)
        if result is not GateResult.REJECTED:
            self.x = x_new
            self.P = P_new if share is None else pack(unpacked(P_new) + share)
            self._bound()
            if self.P[BIAS_BIAS] < (self.model.settings.bias_sigma / 5.0) ** 2:
                self.doubt = False
        self._report(item.source, item.t, result, distance, len(rows))

    # -- gates ---------------------------------------------------------------------------------------------

    def _accepted(self, source: str) -> None:
        if self.rejected:
            self.rejected = tuple(pair for pair in self.rejected if pair[0] != source)

    def _rejection(self, source: str, t: Nanos) -> GateResult:
        """Return whether the sensor is rejected, or has been for so long that it must be accepted."""
        since = dict(self.rejected).get(source)
        if since is None:
            self.rejected = (*self.rejected, (source, t))
        elif t - since >= self.model.settings.lockout:
            self._accepted(source)
            return GateResult.FORCED
        return GateResult.REJECTED

    def _bound(self) -> None:
        """Keep bias, scale and slip within their bounds."""
        x, y, yaw, bias, scale, left, right, turn = self.x
        settings = self.model.settings
        slip = settings.slip_bound
        if (
            abs(bias) > settings.bias_bound
            or abs(scale) > settings.scale_bound
            or abs(left) > slip
            or abs(right) > slip
        ):
            bias = max(-settings.bias_bound, min(settings.bias_bound, bias))
            scale = max(-settings.scale_bound, min(settings.scale_bound, scale))
            left, right = max(-slip, min(slip, left)), max(-slip, min(slip, right))
            self.x = x, y, yaw, bias, scale, left, right, turn


BIAS_BIAS = AT[BIAS][BIAS]


def shifted(states: Sequence[FilterState], by: Pose) -> list[FilterState]:
    """Return states in a frame "map" that was turned and shifted."""
    c, s = math.cos(by.yaw), math.sin(by.yaw)
    turn = np.eye(len(states[0].x))
    turn[:2, :2] = [[c, -s], [s, c]]
    covariances = [pack(turn @ unpacked(state.P) @ turn.T) for state in states]
    moved = []
    for state, P in zip(states, covariances, strict=True):
        x, y, yaw, *rest = state.x
        place = by.x + c * x - s * y, by.y + s * x + c * y, yaw + by.yaw
        moved.append(replace(state, x=(*place, *rest), P=P))
    return moved


def moved_fix(item: PoseFix, by: Pose) -> PoseFix:
    """Return a fix in that frame, if it was made from this belief: others are of where the robot truly is."""
    if item.drift is None:
        return item
    c, s = math.cos(by.yaw), math.sin(by.yaw)
    turn = np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
    value = turn @ item.value + (by.x, by.y, by.yaw)
    noise, drift = turn @ item.noise @ turn.T, turn @ item.drift @ turn.T
    shared = None if item.shared is None else turn @ item.shared @ turn.T
    return replace(item, value=value, noise=noise, shared=shared, drift=drift)


def source_of(item: Input) -> str:
    """Return the name of what measured an input; "" of none."""
    if isinstance(item, WheelAngle):
        return item.motor
    return "" if isinstance(item, Relocated | ScanEnd) else item.source


def _gyro_angle(gyro: Gyro, t: Nanos) -> float | None:
    """Return the gyro's angle at a time: between samples by trapezoids, after the last by its rate."""
    samples = gyro.samples
    last = samples[-1]
    if t >= last[0]:
        if t - last[0] > GYRO_HOLD * gyro.interval:
            return None
        return last[2] + last[1] * ((t - last[0]) / SECOND)
    after = last
    for before in reversed(samples[:-1]):
        if before[0] <= t:
            dt = (t - before[0]) / SECOND
            slope = (after[1] - before[1]) / ((after[0] - before[0]) / SECOND)
            return before[2] + (before[1] + 0.5 * slope * dt) * dt
        after = before
    return None


def _widened(packed: Packed, noise: Floats) -> Packed:
    """Return a covariance with this added to that of x, y and yaw."""
    (xx, _, _), (yx, yy, _), (hx, hy, hh) = noise.tolist()
    a, b, c, d, e, f, *rest = packed
    return (a + xx, b + yx, c + yy, d + hx, e + hy, f + hh, *rest)


def _inflated(packed: Packed, rows: Sequence[int], y: Sequence[float]) -> Packed:
    """Return a covariance that covers an innovation: larger for what was observed, and for the usual causes:
    the distance scale (wheels that spin on the spot), of a wrong yaw the gyro's bias."""
    P = unpacked(packed)
    factor = max(value * value / P[row, row] for value, row in zip(y, rows, strict=True))
    scale = np.ones(len(P))
    scale[[*rows, SCALE, *([BIAS] if YAW in rows else ())]] = math.sqrt(min(max(1.0, factor), MAX_INFLATION))
    return pack(P * np.outer(scale, scale))
