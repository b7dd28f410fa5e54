"""The extended Kalman filter of the base's motion.

Rules. The joints predict: every increment of their angles moves the pose by an exact motion of constant
twist (`Base.travel`), ungated, and none is lost. All else corrects: the gyro by what it turned while the
joints turned, and poses from outside. Each correction is gated as a vector by its squared Mahalanobis
distance against chi-square.

State (`engine`): x, y, yaw in the frame "map"; gyro bias; distance scale: the share of the wheels' travel
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
from typing import Any

import numpy as np
import numpy.typing as npt

from brain.belief import Floats, Pose
from brain.bodies.body import Base
from brain.bodies.plane import Twist, wrap
from brain.perception.engine import AT, BIAS, SCALE, TURN, YAW, X, Y, pose_part, unpacked
from brain.perception.filter_inputs import (
    GateResult,
    GyroRate,
    Input,
    Judged,
    Nis,
    PoseFix,
    Relocated,
    ScanEnd,
    WheelAngle,
    is_valid,
)  # fmt: skip
from brain.perception.filter_settings import CHI_SQUARE, FilterSettings
from brain.perception.filter_state import (
    MAX_INPUTS,
    NEVER,
    FilterModel,
    FilterState,
    moved_fix,
    shifted,
    source_of,
)  # fmt: skip
from brain.perception.wheel_odometry import Point, arc_end
from protocols.messages import MILLISECOND, SECOND, Nanos, seconds

SPEED_OVER: Nanos = 20 * MILLISECOND
"""The twist is the mean over at least this time."""
FARTHEST: Nanos = 100 * MILLISECOND
"""Longest extrapolation by the twist."""


class Filter:
    """The filter. Plain data: a deep copy continues exactly as the original."""

    def __init__(self, body: Base, settings: FilterSettings) -> None:
        self.settings = settings
        self.nis: defaultdict[str, Nis] = defaultdict(Nis)
        """By source."""
        self._origin = first = FilterState.first(FilterModel.of(body, settings))
        self.odom: Point = first.smooth
        """Pose by wheels and gyro alone, at `t`: what was learnt later of the past does not move it"""
        self._moved: Nanos = NEVER
        """Up to when it has moved"""
        """State before the oldest input that is kept."""
        self._trimmed: Nanos = NEVER
        """Time of the newest input before those."""
        self._keys: list[tuple[Any, ...]] = []
        self._items: list[Input] = []
        self._states: list[FilterState] = []
        self._reported: dict[tuple[str, Nanos], None] = {}
        self._judged: list[Judged] = []

    # -- what is believed ----------------------------------------------------------------------------------

    @property
    def state(self) -> FilterState:
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
        ahead, aside = (
            share * (new.travelled[0] - old.travelled[0]),
            share * (new.travelled[1] - old.travelled[1]),
        )
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
            ahead, aside = after.travelled[0] - state.travelled[0], after.travelled[1] - state.travelled[1]
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

    def shift(self, by: Pose) -> None:
        """Turn and shift the frame "map": all that is believed in it, also of the past, and the fixes that
        were made from this belief. The motion in "odom" is none of its concern."""
        self._origin, *self._states = shifted([self._origin, *self._states], by)
        self._items = [moved_fix(item, by) if isinstance(item, PoseFix) else item for item in self._items]
        self._keys = [_key(item) for item in self._items]

    def observe(self, inputs: Sequence[Input]) -> list[Judged]:
        """Apply inputs, each at its own time; return the decisions that were made for the first time. A pose
        is judged when all joints have reached its time."""
        self._judged = []
        first = len(self._keys)
        newest = self._keys[-1][0] if self._keys else NEVER
        oldest = max(newest - self.settings.rewind, self._trimmed + 1)
        for item in inputs:
            if not is_valid(item):
                self._judged.append(Judged(source_of(item), item.t, GateResult.NOT_FINITE))
            elif item.t < oldest and isinstance(item, ScanEnd):
                continue
            elif item.t < oldest:
                self._judged.append(Judged(source_of(item), item.t, GateResult.LATE))
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
            state = state.after(item)
            self._states.append(state)
            for judged in state.judged:
                self._report(judged)
        self._move()
        self._trim()
        return self._judged

    def _move(self) -> None:
        """Move the pose in "odom" by what the base has moved since."""
        new = self.state
        if self._moved == NEVER:
            self._moved = new.t
        if new.t <= self._moved:
            return
        i = bisect_right(self._states, self._moved, key=_time) - 1
        old = self._states[i] if i >= 0 else self._origin
        start = old.smooth
        if old.t < self._moved:
            after = self._states[i + 1]
            share = (self._moved - old.t) / (after.t - old.t)
            x, y, yaw = (a + share * (b - a) for a, b in zip(start, after.smooth, strict=True))
            start = x, y, yaw
        x, y, yaw = self.odom
        turned = yaw - start[2]
        c, s = math.cos(turned), math.sin(turned)
        dx, dy = new.smooth[0] - start[0], new.smooth[1] - start[1]
        self.odom = x + c * dx - s * dy, y + s * dx + c * dy, new.smooth[2] + turned
        self._moved = new.t

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

    def _report(self, judged: Judged) -> None:
        """Note a decision, unless it was made before: an input that runs again is judged again."""
        source, t = judged.source, judged.t
        if (source, t) in self._reported:
            return
        self._reported[source, t] = None
        self._judged.append(judged)
        if judged.freedom:
            quantile = CHI_SQUARE[0.95][judged.freedom - 1]
            self.nis[source].add(judged.distance, quantile, judged.freedom)


def _time(state: FilterState) -> Nanos:
    return state.t


def _key(item: Input) -> tuple[Any, ...]:
    """Return the place of an input in the order in which inputs are applied."""
    if isinstance(item, GyroRate):
        return item.t, 0, item.source, item.rate, item.sigma
    if isinstance(item, WheelAngle):
        return item.t, 1, item.motor, item.angle
    if isinstance(item, ScanEnd):
        return item.t, 2, "", []
    more = (item.shared, item.drift) if isinstance(item, PoseFix) else ()
    numbers = [array.ravel().tolist() for array in (item.value, item.noise, *more) if array is not None]
    return item.t, 2, source_of(item), numbers
