"""The extended Kalman filter of the base's motion.

Rules. The joints predict: every increment of their angles moves the pose by an exact motion of constant
twist (`Base.travel`), ungated, and none is lost. All else corrects: the gyro by what it turned while the
joints turned, and poses from outside. Each correction is gated as a vector by its squared Mahalanobis
distance against chi-square.

State (`engine`): x, y, yaw in the frame "odom"; gyro bias; distance scale: the share of the wheels' travel
that the base does not move; slip of each side's wheels as far as it turns the base, a Gauss-Markov process
over the distance that they roll (`wheel_odometry.Rolling`); turn: the gyro's angle less that of the wheels,
so that noise of the gyro is process noise, rounding of the wheels is measurement noise, and neither adds up
where it does not in truth. Scale, slips and bias are bounded. The scale is learnt from outside references
only. So is the bias, except while it is less certain than what slip could turn the base: at rest, and in
very slow motion.

Inputs come in any order within `rewind`: they are kept sorted, each with the state after it, and a late one
makes the later ones run again, gates included. So state and decisions depend on the inputs, not on the order
of their arrival.
"""

from __future__ import annotations

import math
from bisect import bisect_left, bisect_right
from collections import defaultdict
from collections.abc import Sequence
from dataclasses import dataclass
from operator import sub
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from brain.belief import Floats, Pose
from brain.bodies.body import Base
from brain.bodies.plane import Twist, wrap
from brain.perception.engine import (
    AT,
    BIAS,
    ENGINES,
    SCALE,
    TURN,
    YAW,
    Engine,
    Move,
    Packed,
    Vector,
    X,
    Y,
    cross_zeroed,
    pack,
    pose_part,
    relative,
    unpacked,
)  # fmt: skip
from brain.perception.filter_inputs import (
    GateResult,
    GyroRate,
    Input,
    Judged,
    Nis,
    PoseFix,
    Relocated,
    WheelAngle,
    is_valid,
)
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
from protocols.messages import MILLISECOND, SECOND, Nanos, seconds

NEVER: Nanos = -(1 << 62)
GYRO_GAP: Nanos = 250 * MILLISECOND
"""A gyro silent for longer has lost its angle."""
STILL_FOR: Nanos = 300 * MILLISECOND
"""Wheels that have not turned for this time rest."""
GYRO_HOLD = 1.5
"""Intervals for which a gyro's last rate holds."""
SPEED_OVER: Nanos = 20 * MILLISECOND
"""The twist is the mean over at least this time."""
FARTHEST: Nanos = 100 * MILLISECOND
"""Longest extrapolation by the twist."""
MAX_INPUTS = 600
MAX_WAITING = 16
"""Most inputs that are run again, and poses that wait for the wheels."""
NOISE_RATE, MOST_SQUARE, MOST_NOISE = 0.02, 25.0, 400.0
"""Share of one innovation in the noise, its largest square, and the largest factor"""
MAX_INFLATION = 1e6
"""Largest factor on a variance."""
POSE = (X, Y, YAW)


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
class State:
    """All that is known after an input. Only the step that makes it writes to it."""

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
    way: tuple[float, float, float] = (0.0, 0.0, 0.0)
    """Sums since the start, without jumps: m forward and to the left in the moving frame, and rad that a slip
    of 1 of all joints would have turned the base by"""
    gyro: Gyro | None = None
    waiting: tuple[PoseFix | Relocated, ...] = ()
    """Poses newer than t, oldest first"""
    rejected: tuple[tuple[str, Nanos], ...] = ()
    """Sources that the gate rejects, and since when"""
    noise: tuple[float, float, float] = (1.0, 1.0, 0.0)
    """Factors on the variances of the gyro and of slip, found from innovations at rest and in motion, and the
    newest innovation over its standard deviation"""
    turning: float = 0.0
    """Yaw rate by the wheels [rad/s], over the last travel"""
    still: tuple[Nanos, tuple[float, ...]] = (NEVER, ())
    """Since when the wheels have been at these angles, to a count"""
    doubt: bool = False
    """The gyro contradicted the wheels for long: its bias is not learnt from the wheels until it is known
    """

    @property
    def resting(self) -> bool:
        """Whether the wheels have not turned for a while."""
        return self.t - self.still[0] >= STILL_FOR

    def copy(self) -> State:
        """Return a state for the next step to write to."""
        return State(
            self.x, self.P, self.smooth, self.raw, self.t, self.samples, self.at, self.way, self.gyro,
            self.waiting, self.rejected, self.noise, self.turning, self.still,
            self.doubt,
        )  # fmt: skip

    def __deepcopy__(self, memo: dict[int, Any]) -> State:
        return self  # never changed again


class Filter:
    """The filter. Plain data: a deep copy continues exactly as the original."""

    def __init__(self, body: Base, settings: FilterSettings) -> None:
        self.body = body
        self.settings = settings
        self.nis: defaultdict[str, Nis] = defaultdict(Nis)
        """By source."""
        self._engine: Engine = ENGINES[settings.engine]()
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
        self._origin = State(
            (*start, 0.0, 0.0, 0.0, 0.0, 0.0),
            pack(np.diag(np.square(sigmas))),
            start,
            start,
            samples=((),) * len(body.joints),
        )
        """State before the oldest input that is kept."""
        self._trimmed: Nanos = NEVER
        """Time of the newest input before those."""
        self._keys: list[tuple[Any, ...]] = []
        self._items: list[Input] = []
        self._states: list[State] = []
        self._reported: dict[tuple[str, Nanos], None] = {}
        self._judged: list[Judged] = []
        self._joints = Rolling(body, settings.turn_slip)
        self._wheels = self._joints.wheels
        self._number = {motor: number for number, motor in enumerate(body.joints)}
        self._fastest = body.top_speeds

    # -- what is believed ----------------------------------------------------------------------------------

    @property
    def state(self) -> State:
        """The newest state."""
        return self._states[-1] if self._states else self._origin

    @property
    def t(self) -> Nanos | None:
        """Newest time that all joints have reached; None before."""
        return None if self.state.t == NEVER else self.state.t

    @property
    def covariance(self) -> Floats:
        """Of x, y, yaw, bias, scale and the slips of both sides, 7 × 7."""
        return unpacked(self.state.P)[:TURN, :TURN]

    @property
    def bias(self) -> float:
        """Gyro bias [rad/s]."""
        return self.state.x[BIAS]

    @property
    def bias_sigma(self) -> float:
        """Standard deviation of the gyro bias [rad/s]."""
        return math.sqrt(self.state.P[AT[BIAS][BIAS]])

    @property
    def scale(self) -> float:
        """Distance scale: the share of the wheels' travel that the base does not move."""
        return self.state.x[SCALE]

    @property
    def twist(self) -> Twist:
        """Motion of the base."""
        new = self.state
        i = bisect_right(self._states, new.t - SPEED_OVER, key=_time) - 1
        old = self._states[i] if i >= 0 else self._origin
        if old.t == NEVER or old.t >= new.t:
            return Twist()
        dt = seconds(new.t - old.t)
        share = (1.0 - new.x[SCALE]) / dt
        ahead, aside = share * (new.way[0] - old.way[0]), share * (new.way[1] - old.way[1])
        return Twist(ahead, (new.smooth[2] - old.smooth[2]) / dt, aside)

    def at(self, t: Nanos) -> tuple[Pose, Floats] | None:
        """Return pose and its covariance 3 × 3 at a time; None if beyond what is kept, or too far ahead."""
        i = bisect_right(self._states, t, key=_time) - 1
        state = self._states[i] if i >= 0 else self._origin
        if not state.t <= t <= max(state.t, self.state.t) + FARTHEST or state.t == NEVER:
            return None
        end: Point = (state.x[X], state.x[Y], state.x[YAW])
        if i + 1 < len(self._states):
            after = self._states[i + 1]
            share = (t - state.t) / (after.t - state.t)
            rolled = share * (1.0 - state.x[SCALE])
            ahead, aside = after.way[0] - state.way[0], after.way[1] - state.way[1]
            end = arc_end(end, rolled * ahead, share * (after.smooth[2] - state.smooth[2]), rolled * aside)
        elif t > state.t:
            end = arc_end(end, *self.twist.scaled(seconds(t - state.t)))
        return Pose(end[0], end[1], wrap(end[2])), pose_part(state.P)

    def poses(self, times: npt.NDArray[np.int64]) -> Floats | None:
        """Return the poses at these times, n × 3, of a motion without leaps that ends in the newest pose;
        None if one is beyond what is kept, or too far ahead. Yaw is not wrapped."""
        first = bisect_right(self._states, int(times.min()), key=_time)
        new, knots = self.state, [self._states[first - 1] if first else self._origin]
        if knots[0].t == NEVER:
            return None
        for state in self._states[first:]:
            if state.t != knots[-1].t:
                knots.append(state)
        twist, steps = self.twist, [seconds(FARTHEST) * k / 4 for k in (1, 2, 3, 4)]
        ahead = [arc_end(new.smooth, *twist.scaled(dt)) for dt in steps]
        at = np.array([*(seconds(state.t - new.t) for state in knots), *steps])
        wanted = (times - new.t) / SECOND
        if wanted.min() < at[0] or wanted.max() > at[-1]:
            return None
        path = np.array([*(state.smooth for state in knots), *ahead])
        x, y, yaw = (np.interp(wanted, at, path[:, k]) for k in range(3))
        turned = new.x[YAW] - new.smooth[2]
        c, s = math.cos(turned), math.sin(turned)
        x, y = x - new.smooth[0], y - new.smooth[1]
        return np.column_stack((new.x[X] + c * x - s * y, new.x[Y] + s * x + c * y, yaw + turned))

    # -- inputs --------------------------------------------------------------------------------------------

    def reset(self, t: Nanos, pose: Pose, covariance: Floats) -> bool:
        """Set the pose at a time, keeping bias, scale and slip; False if that is too long ago."""
        judged = self.observe([Relocated(t, np.array([pose.x, pose.y, pose.yaw]), covariance)])
        return all(each.source for each in judged)  # what has no source is this

    def observe(self, inputs: Sequence[Input]) -> list[Judged]:
        """Apply inputs, each at its own time; return the decisions that were made for the first time. A pose
        is judged when all joints have reached its time."""
        self._judged = []
        first = len(self._keys)
        newest = self._keys[-1][0] if self._keys else NEVER
        oldest = max(newest - self.settings.rewind, self._trimmed + 1)
        for item in inputs:
            if not is_valid(item):
                self._judged.append(Judged(_source(item), item.t, GateResult.NOT_FINITE))
            elif item.t < oldest:
                self._judged.append(Judged(_source(item), item.t, GateResult.LATE))
            else:
                key = _key(item)
                behind = not self._keys or self._keys[-1] < key
                place = len(self._keys) if behind else bisect_left(self._keys, key)
                if place == len(self._keys) or self._keys[place] != key:  # else it is the same input again
                    self._keys.insert(place, key)
                    self._items.insert(place, item)
                    first = min(first, place)
        del self._states[first:]
        state = self.state
        for item in self._items[first:]:
            state = self._after(state, item)
            self._states.append(state)
        self._trim()
        return self._judged

    def _trim(self) -> None:
        if not self._keys:
            return
        count = bisect_left(self._keys, (self._keys[-1][0] - self.settings.rewind,))
        count = max(count, len(self._keys) - MAX_INPUTS)
        if count > 0:
            self._origin, self._trimmed = self._states[count - 1], self._keys[count - 1][0]
            del self._keys[:count], self._items[:count], self._states[:count]
        if len(self._reported) > 2 * MAX_INPUTS:
            oldest = self._keys[0][0]
            self._reported = {key: None for key in self._reported if key[1] >= oldest}

    def _after(self, before: State, item: Input) -> State:
        state = before.copy()
        if isinstance(item, GyroRate):
            self._on_gyro(state, item)
        elif isinstance(item, WheelAngle):
            self._on_wheel(state, item)
        elif state.t == item.t:
            self._on_pose(state, item)
        else:
            if len(state.waiting) >= MAX_WAITING:
                self._report(_source(state.waiting[0]), state.waiting[0].t, GateResult.LATE)
                state.waiting = state.waiting[1:]
            state.waiting = (*state.waiting, item)
        return state

    def _report(
        self, source: str, t: Nanos, result: GateResult, distance: float = 0.0, freedom: int = 0
    ) -> None:
        if (source, t) in self._reported:
            return
        self._reported[source, t] = None
        self._judged.append(Judged(source, t, result, distance, freedom))
        if freedom:
            quantile = CHI_SQUARE[0.95][freedom - 1]
            self.nis[source].add(distance, quantile, freedom)

    # -- wheels --------------------------------------------------------------------------------------------

    def _on_wheel(self, state: State, item: WheelAngle) -> None:
        number = self._number[item.motor]
        new = item.t, item.angle
        samples = state.samples[number]
        settings = self.settings
        if samples:
            if item.t <= samples[-1][0]:
                self._report(item.motor, item.t, GateResult.CONFLICT)
                return
            most = self._fastest[number]
            if jumped(most, samples[-1], new, settings.jump_margin, settings.resolution):
                self._report(item.motor, item.t, GateResult.JUMPED)
                state.samples, state.at, samples = ((),) * len(state.samples), (), ()
        each = list(state.samples)
        each[number] = added(samples, new, state.t)
        state.samples = tuple(each)
        if not all(state.samples):
            return
        t = min([each[-1][0] for each in state.samples])
        if not state.at:  # the start, or a new zero
            if t < max(each[0][0] for each in state.samples):
                return
            self._start(state, t)
        while state.waiting and state.waiting[0].t <= t:
            pose = state.waiting[0]
            state.waiting = state.waiting[1:]
            if pose.t > state.t:
                self._travel(state, pose.t)
            self._on_pose(state, pose)
        if t - state.t >= settings.shortest:
            self._travel(state, t)

    def _start(self, state: State, t: Nanos) -> None:
        """Take the joints' angles at a time as those of the present pose."""
        state.t = t
        state.at = tuple([angle_at(samples, t) for samples in state.samples])
        state.still = t, state.at

    def _travel(self, state: State, t: Nanos) -> None:
        """Move by what the joints turned up to a time, and correct by what the gyro turned."""
        settings, before = self.settings, state.at
        angles = tuple([angle_at(samples, t) for samples in state.samples])
        turned = tuple(map(sub, angles, before))
        dt = (t - state.t) / SECOND
        travel = self.body.travel(before, angles)
        distance, turn, sideways = travel[:3]
        errors = self._joints.errors(travel, turned)
        left_yaw, right_yaw, slid, way_left, way_right, rolled, rounding, turning, walks = errors
        x, y, yaw, bias, scale, slip_left, slip_right, angle = state.x
        length, slipped = (1.0 - scale) * distance, left_yaw * slip_left + right_yaw * slip_right
        aside = (1.0 - scale) * sideways
        dx, dy, ux, uy, wx, wy = arc_slopes(yaw, length, turn + slipped, aside)
        keep_left = math.exp(-way_left / settings.slip_length)
        keep_right = math.exp(-way_right / settings.slip_length)
        loud, slippery, _ = state.noise
        slip_variance = slippery * settings.turn_slip * settings.turn_slip
        along = slippery * settings.travel_noise * settings.travel_noise * rolled
        across = settings.sideways_noise * settings.sideways_noise * rolled
        single = both = 0.0
        if walks is not None:
            walk = 2.0 * slip_variance * settings.slip_length
            single, both = walk * walks[0], walk * walks[3]
            along, across = along + walk * walks[1], across + walk * walks[2]
        lever = left_yaw * left_yaw + right_yaw * right_yaw
        late = settings.turn_lag * (turn / dt - state.turning)
        state.turning = turn / dt
        gyro = state.gyro
        turn_noise = 0.0 if gyro is None else loud * gyro.sigma * gyro.sigma * (gyro.interval / SECOND) * dt
        state.x = (
            x + dx, y + dy, yaw + turn + slipped, bias, scale, keep_left * slip_left, keep_right * slip_right,
            angle + slipped + bias * dt,
        )  # fmt: skip
        state.P = self._engine.predict(
            state.P,
            Move(
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
        state.t, state.at = t, angles
        way = state.way
        state.way = way[0] + distance, way[1] + sideways, way[2] + slid
        still, most = state.still[1], 1.5 * settings.resolution
        for j in self._wheels:
            if abs(angles[j] - still[j]) > most:
                state.still = t, angles
                break
        state.raw = arc_end(state.raw, distance, turn, sideways)
        if gyro is not None:
            by_slip = slip_variance * lever / (dt * dt)
            learns = by_slip < state.P[BIAS_BIAS] and not state.doubt
            rounding *= settings.resolution
            variance = rounding * rounding / 12.0 + (settings.jitter / dt * turning) ** 2
            self._compare(state, gyro, variance, learns, lever)
        state.smooth = arc_end(state.smooth, length, state.x[YAW] - yaw, aside)

    # -- gyro ----------------------------------------------------------------------------------------------

    def _on_gyro(self, state: State, item: GyroRate) -> None:
        gyro = state.gyro
        last = gyro.samples[-1] if gyro is not None else (NEVER, 0.0, 0.0)
        silent = item.t - last[0]
        if gyro is not None and gyro.source != item.source:
            if silent <= 2 * GYRO_GAP:
                self._report(item.source, item.t, GateResult.UNUSED)
                return
            bias_variance = self.settings.bias_sigma**2
            state.x = (*state.x[:BIAS], 0.0, *state.x[BIAS + 1 :])
            state.P = cross_zeroed(state.P, BIAS, bias_variance)
        if gyro is None or silent > GYRO_GAP:
            sample = (item.t, item.rate, 0.0)
            state.gyro = Gyro(item.source, item.sigma, GYRO_GAP, (sample,), None, item.t)
        elif silent <= 0:
            self._report(item.source, item.t, GateResult.CONFLICT)
        else:
            angle = last[2] + 0.5 * (last[1] + item.rate) * (silent / SECOND)
            kept = gyro.samples
            while len(kept) > 1 and (kept[1][0] <= state.t or len(kept) > MAX_INPUTS // 4):
                kept = kept[1:]
            sample = (item.t, item.rate, angle)
            state.gyro = Gyro(item.source, item.sigma, silent, (*kept, sample), gyro.zero, gyro.used)

    def _compare(self, state: State, gyro: Gyro, variance: float, learns: bool, lever: float) -> None:
        """Correct by the gyro's angle less that of the joints, whose variance this is."""
        turned = _gyro_angle(gyro, state.t)
        if turned is None:
            if state.t - gyro.samples[-1][0] > GYRO_GAP:
                state.gyro = gyro._replace(zero=None)
            return
        settings = self.settings
        turned -= state.raw[2]
        if gyro.zero is None:
            self._zero_gyro(state, gyro, turned, variance)
            return
        if gyro.samples[-1][0] <= gyro.used:
            return
        innovation = turned - gyro.zero - state.x[TURN]
        x, P, distance = self._engine.turn(state.x, state.P, innovation, variance)
        if distance <= CHI_SQUARE[settings.confidence][0]:
            if not learns:  # the optimal update of all but the bias (Schmidt 1966)
                x = (*x[:BIAS], state.x[BIAS], *x[BIAS + 1 :])
                P = (*P[:BIAS_BIAS], state.P[BIAS_BIAS], *P[BIAS_BIAS + 1 :])
            state.x, state.P = x, P
            state.gyro = Gyro(
                gyro.source, gyro.sigma, gyro.interval, gyro.samples, gyro.zero, gyro.samples[-1][0]
            )
            self._bound(state)
            self._accepted(state, gyro.source)
            result = GateResult.ACCEPTED
        else:
            result = self._contradiction(state, gyro, turned, innovation, variance)
        self._report(gyro.source, state.t, result, distance, 1)
        self._learn_noise(state, math.copysign(math.sqrt(distance), innovation), moving=lever > 0.0)

    def _learn_noise(self, state: State, innovation: float, *, moving: bool) -> None:
        """Raise what is more than the settings state: in motion the slip, at rest the noise of the gyro. Of
        that only what changes from sample to sample is noise: a gyro that reads a turn at rest has another
        fault."""
        loud, slippery, last = state.noise
        if moving:
            square = min(innovation * innovation, MOST_SQUARE)
            slippery = min(max(slippery * (1.0 + NOISE_RATE * (square - 1.0)), 1.0), MOST_NOISE)
        else:
            square = min((innovation - last) ** 2 / 2.0, MOST_SQUARE)
            loud = min(max(loud * (1.0 + NOISE_RATE * (square - 1.0)), 1.0), MOST_NOISE)
        state.noise = loud, slippery, innovation

    def _contradiction(
        self, state: State, gyro: Gyro, turned: float, innovation: float, variance: float
    ) -> GateResult:
        """Leave out a gyro that contradicts the wheels; the yaw may be wrong by as much."""
        result = self._rejection(state, gyro.source, state.t)
        if result is GateResult.FORCED:  # its bias may be any, and resting wheels do not show it
            state.P = cross_zeroed(state.P, BIAS, self.settings.bias_sigma**2)
            state.doubt = True
        self._zero_gyro(state, gyro, turned, variance)
        P = list(state.P)
        P[AT[YAW][YAW]] += innovation * innovation
        state.P = tuple(P)
        return result

    def _zero_gyro(self, state: State, gyro: Gyro, turned: float, variance: float) -> None:
        state.x = (*state.x[:TURN], 0.0)
        state.P = cross_zeroed(state.P, TURN, variance)
        state.gyro = gyro._replace(zero=turned, used=gyro.samples[-1][0])

    # -- poses ---------------------------------------------------------------------------------------------

    def _on_pose(self, state: State, item: PoseFix | Relocated) -> None:
        if isinstance(item, Relocated):
            x, y, yaw = item.value.tolist()
            P = state.P
            for row in POSE:
                P = cross_zeroed(P, row, 0.0)
            whole = unpacked(P)
            whole[:3, :3] = item.noise
            state.x, state.P, state.rejected = (x, y, yaw, *state.x[BIAS:]), pack(whole), ()
            return
        rows = POSE[: len(item.value)]
        y = [float(value) - state.x[row] for value, row in zip(item.value, rows, strict=True)]
        if len(rows) > YAW:
            y[YAW] = wrap(y[YAW])
        packed, share = state.P, None
        if item.shared is not None:
            packed, share = relative(packed, rows, item.shared)
        x_new, P_new, distance = self._engine.update(state.x, packed, rows, tuple(y), item.noise)
        if distance <= CHI_SQUARE[self.settings.confidence][len(rows) - 1]:
            result = GateResult.ACCEPTED
            self._accepted(state, item.source)
        else:
            result = self._rejection(state, item.source, item.t)
            if result is GateResult.FORCED:
                share = None
                packed = _inflated(state.P, rows, y)
                x_new, P_new, _ = self._engine.update(state.x, packed, rows, tuple(y), item.noise)
        if result is not GateResult.REJECTED:
            state.x = x_new
            state.P = P_new if share is None else pack(unpacked(P_new) + share)
            self._bound(state)
            if state.P[BIAS_BIAS] < (self.settings.bias_sigma / 5.0) ** 2:
                state.doubt = False
        self._report(item.source, item.t, result, distance, len(rows))

    # -- gates ---------------------------------------------------------------------------------------------

    def _accepted(self, state: State, source: str) -> None:
        if state.rejected:
            state.rejected = tuple(pair for pair in state.rejected if pair[0] != source)

    def _rejection(self, state: State, source: str, t: Nanos) -> GateResult:
        """Return whether the sensor is rejected, or has been for so long that it must be accepted."""
        since = dict(state.rejected).get(source)
        if since is None:
            state.rejected = (*state.rejected, (source, t))
        elif t - since >= self.settings.lockout:
            self._accepted(state, source)
            return GateResult.FORCED
        return GateResult.REJECTED

    def _bound(self, state: State) -> None:
        """Keep bias, scale and slip within their bounds."""
        x, y, yaw, bias, scale, left, right, turn = state.x
        settings = self.settings
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
            state.x = x, y, yaw, bias, scale, left, right, turn


BIAS_BIAS = AT[BIAS][BIAS]


def _time(state: State) -> Nanos:
    return state.t


def _source(item: Input) -> str:
    if isinstance(item, WheelAngle):
        return item.motor
    return "" if isinstance(item, Relocated) else item.source


def _key(item: Input) -> tuple[Any, ...]:
    """Return the place of an input in the order in which inputs are applied."""
    if isinstance(item, GyroRate):
        return item.t, 0, item.source, item.rate, item.sigma
    if isinstance(item, WheelAngle):
        return item.t, 1, item.motor, item.angle
    shared = item.shared if isinstance(item, PoseFix) else None
    numbers = [array.ravel().tolist() for array in (item.value, item.noise, shared) if array is not None]
    return item.t, 2, _source(item), numbers


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


def _inflated(packed: Packed, rows: Sequence[int], y: Sequence[float]) -> Packed:
    """Return a covariance that covers an innovation: larger for what was observed, and for the usual causes:
    the distance scale (wheels that spin on the spot), of a wrong yaw the gyro's bias."""
    P = unpacked(packed)
    factor = max(value * value / P[row, row] for value, row in zip(y, rows, strict=True))
    scale = np.ones(len(P))
    scale[[*rows, SCALE, *([BIAS] if YAW in rows else ())]] = math.sqrt(min(max(1.0, factor), MAX_INFLATION))
    return pack(P * np.outer(scale, scale))
