"""The extended Kalman filter of the base's motion, on filterpy.

Rules. Every measurement brings its own time; the filter predicts to that time, so no caller computes a dt. A
measurement up to `rewind` late is inserted at its time, and the later ones are applied again; an older one is
not used. Each is gated as a vector by its squared Mahalanobis distance against chi-square; a rejected one
changes nothing and is counted. No gate locks the filter out: when a sensor has been rejected for longer than
`lockout` without interruption, its next measurement is accepted with the covariance inflated, and that is
counted too. Values that are not finite never enter. State and motion: `brain.perception.motion_model`.
"""

from __future__ import annotations

import math
from collections import deque
from dataclasses import dataclass
from typing import Any

import numpy as np

from brain.belief import Floats
from brain.bodies.differential import wrap
from brain.perception.ekf_settings import CHI_SQUARE, EkfSettings
from brain.perception.measurement import GateResult, Measurement
from brain.perception.motion_model import POSE, SIZE, SLIP, YAW, X, jacobian, process_noise, propagate
from protocols.messages import Nanos, seconds


@dataclass(slots=True)
class Nis:
    """Normalised innovations squared (NIS) of one sensor since the start: is the filter consistent?

    NIS is an innovation's squared Mahalanobis distance, a chi-square of as many degrees of freedom as
    the measurement has components, if the covariances are right (Bar-Shalom, Li, Kirubarajan 2001, section
    5.4). Every measurement that the gate judged counts once, as first judged, rejected ones too."""

    count: int = 0
    """Measurements."""
    freedom: int = 0
    """Sum of their degrees of freedom."""
    total: float = 0.0
    """Sum of the squared distances."""
    beyond: int = 0
    """Measurements beyond the 95 % quantile: one in twenty if the filter is consistent."""

    def add(self, distance: float, quantile: float, freedom: int) -> None:
        """Add a squared distance, with the 95 % quantile for its degrees of freedom."""
        self.count += 1
        self.freedom += freedom
        self.total += distance
        self.beyond += distance > quantile

    @property
    def mean(self) -> float:
        """Per degree of freedom: 1 if consistent, above 1 if overconfident, below 1 if too cautious; 0 before
        the first measurement."""
        return self.total / self.freedom if self.freedom else 0.0


@dataclass(frozen=True, slots=True)
class _Entry:
    """A measurement, the gate's decision, and the state after it."""

    t: Nanos
    measurement: Measurement | None
    """None: the start"""
    result: GateResult
    state: Floats
    covariance: Floats
    inflation: float = 1.0
    """Factor on the variances before it was applied."""


class Ekf:
    """The filter: takes measurements in any order."""

    def __init__(self, settings: EkfSettings) -> None:
        self.settings = settings
        self.t: Nanos | None = None
        """Time of the newest measurement; None before the first."""
        self.nis: dict[str, Nis] = {}
        """By source."""
        self._filter = _filter(settings)
        self._history: deque[_Entry] = deque()
        self._rejected_since: dict[str, Nanos] = {}

    @property
    def state(self) -> Floats:
        """x, y, yaw, v, w, bias, slip; must not be written to."""
        state: Floats = self._filter.x
        return state

    @property
    def covariance(self) -> Floats:
        """7 × 7; must not be written to."""
        covariance: Floats = self._filter.P
        return covariance

    def observe(self, measurement: Measurement) -> GateResult:
        """Apply a measurement at its own time, and return the gate's decision."""
        if not _finite(measurement):
            return GateResult.NOT_FINITE
        t = measurement.t
        if self.t is None:
            self._start(t)
        later = self._rewind(t)
        if later is None:
            return GateResult.LATE
        result = self._judge(measurement)
        for entry in later:
            self._predict(entry.t)
            self._reapply(entry)
        self._trim()
        return result

    def at(self, t: Nanos) -> tuple[Floats, Floats] | None:
        """Return state and covariance at a time within the rewind (newer: predicted); None if older."""
        entry = next((e for e in reversed(self._history) if e.t <= t), None)
        if entry is None:
            return None
        dt = seconds(t - entry.t)
        F = jacobian(entry.state, dt)
        covariance = F @ entry.covariance @ F.T + process_noise(entry.state, dt, self.settings)
        return propagate(entry.state, dt), covariance

    def rejected_for(self, source: str, t: Nanos) -> float:
        """Return for how long [s] the gate has rejected this sensor without interruption, up to a time."""
        return max(0.0, seconds(t - self._rejected_since.get(source, t)))

    def _start(self, t: Nanos) -> None:
        self.t = t
        self._history.append(_Entry(t, None, GateResult.ACCEPTED, self.state, self.covariance))

    def _rewind(self, t: Nanos) -> list[_Entry] | None:
        """Go back to time t; return the later entries, to be applied again. None if t is too long ago."""
        if t < self._history[0].t:
            return None
        later: list[_Entry] = []
        while self._history[-1].t > t:
            later.append(self._history.pop())
        last = self._history[-1]
        self._filter.x, self._filter.P, self.t = last.state, last.covariance, last.t
        self._predict(t)
        return later[::-1]

    def _predict(self, t: Nanos) -> None:
        assert self.t is not None
        assert t >= self.t
        if t > self.t:
            dt = seconds(t - self.t)
            state = self.state
            self._filter.F = jacobian(state, dt)
            self._filter.Q = process_noise(state, dt, self.settings)
            self._filter.predict()
            self._filter.P = (self._filter.P + self._filter.P.T) / 2.0
            self._filter.x = propagate(state, dt)  # filterpy's own mean is F x: the arc is exact
            self.t = t

    def _judge(self, measurement: Measurement) -> GateResult:
        prior = self.state, self.covariance
        freedom = len(measurement.value)
        gate = CHI_SQUARE[self.settings.confidence][freedom - 1]
        inflation = 1.0
        distance = self._update(measurement)
        nis = self.nis.setdefault(measurement.source, Nis())
        nis.add(distance, CHI_SQUARE[0.95][freedom - 1], freedom)
        since = self._rejected_since.get(measurement.source)
        if distance <= gate:
            result = GateResult.ACCEPTED
            self._rejected_since.pop(measurement.source, None)
        elif since is not None and measurement.t - since >= self.settings.lockout:
            result = GateResult.FORCED
            self._rejected_since.pop(measurement.source, None)
            self._filter.x, self._filter.P = prior
            inflation = self._inflation(measurement)
            self._update_inflated(measurement, inflation)
        else:
            result = GateResult.REJECTED
            self._rejected_since.setdefault(measurement.source, measurement.t)
            self._filter.x, self._filter.P = prior
        self._record(measurement, result, inflation)
        return result

    def _inflation(self, measurement: Measurement) -> float:
        """Return the factor by which the variances must grow to cover the innovation just rejected."""
        H = measurement.matrix
        variance = np.diag(H @ self.covariance @ H.T)
        return min(max(1.0, float(np.max(self._filter.y**2 / variance))), MAX_INFLATION)

    def _reapply(self, entry: _Entry) -> None:
        """Apply a measurement again, with its former decision."""
        if entry.measurement is not None and entry.result is not GateResult.REJECTED:
            if entry.result is GateResult.FORCED:
                self._update_inflated(entry.measurement, entry.inflation)
            else:
                self._update(entry.measurement)
        self._record(entry.measurement, entry.result, entry.inflation)

    def _update(self, measurement: Measurement) -> float:
        """Apply a measurement; return its squared Mahalanobis distance before that."""
        H, heading = measurement.matrix, measurement.heading

        def residual(a: Floats, b: Floats) -> Floats:
            difference = a - b
            if heading is not None:
                difference[heading] = wrap(float(difference[heading]))
            return difference

        self._filter.update(
            measurement.value, lambda _: H, lambda x: H @ x, R=measurement.noise, residual=residual
        )
        self._filter.x[YAW] = wrap(float(self._filter.x[YAW]))
        self._filter.P = (self._filter.P + self._filter.P.T) / 2.0
        return float(self._filter.mahalanobis) ** 2

    def _update_inflated(self, measurement: Measurement, inflation: float) -> None:
        """Apply a measurement that contradicts the state, after inflating the variances of what it observes;
        and of the slip, if it observes the position: wheels spinning on the spot are the usual cause
        of a wrong position."""
        scale = np.ones(SIZE)
        observed = np.any(measurement.matrix != 0.0, axis=0)
        observed[SLIP] |= observed[X]
        scale[observed] = math.sqrt(inflation)
        self._filter.P = self._filter.P * np.outer(scale, scale)
        self._update(measurement)

    def _record(self, measurement: Measurement | None, result: GateResult, inflation: float) -> None:
        assert self.t is not None
        self._history.append(_Entry(self.t, measurement, result, self.state, self.covariance, inflation))

    def _trim(self) -> None:
        oldest = self._history[-1].t - self.settings.rewind
        while len(self._history) > 1 and (self._history[1].t <= oldest or len(self._history) > MAX_HISTORY):
            self._history.popleft()


MAX_HISTORY = 600
"""Measurements that are applied again after a late one; an older one counts as too late."""
MAX_INFLATION = 1e6
"""Largest factor on a variance."""


def _filter(settings: EkfSettings) -> Any:  # noqa: ANN401 -- filterpy has no types
    from filterpy.kalman import ExtendedKalmanFilter  # here, because it takes seconds to import

    ekf = ExtendedKalmanFilter(dim_x=SIZE, dim_z=1)
    ekf.x = np.zeros(SIZE)
    ekf.x[POSE] = settings.start_x, settings.start_y, wrap(settings.start_yaw)
    sigmas = (settings.start_sigma,) * 3 + (1.0, 1.0, settings.bias_sigma, settings.slip_sigma)
    ekf.P = np.diag(np.square(sigmas))
    return ekf


def _finite(measurement: Measurement) -> bool:
    return bool(np.isfinite(measurement.value).all() and np.isfinite(measurement.noise).all())
