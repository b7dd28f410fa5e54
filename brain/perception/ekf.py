"""An extended Kalman filter of the base's motion, on filterpy.

Rules of this file. Every measurement brings its own time; the filter predicts to that time, so no
caller forms a dt. A measurement up to `rewind` late is put in its place and what came after it is
applied again; an older one is refused. Each is gated as a vector by its squared Mahalanobis distance
against chi-square; a refused one changes nothing and is counted. No gate locks the filter out: when
a sensor has been refused for longer than `lockout` without a break, its next measurement is taken
with the covariance widened, and that is counted too. What is not finite never enters. The state and
how it moves: `brain.perception.motion_model`.
"""

from __future__ import annotations

import math
from collections import deque
from dataclasses import dataclass
from typing import Any

import numpy as np

from brain.belief import Floats
from brain.bodies.differential import wrap
from brain.perception.ekf import Nis
from brain.perception.ekf_settings import CHI_SQUARE, EkfSettings
from brain.perception.measurement import Measurement, Verdict
from brain.perception.motion_model import POSE, SIZE, SLIP, YAW, X, jacobian, move, process_noise
from protocols.messages import Nanos, seconds


@dataclass(frozen=True, slots=True)
class _Entry:
    """A measurement in its place, what was decided on it, and the state after it."""

    t: Nanos
    measurement: Measurement | None
    """None: the start"""
    verdict: Verdict
    state: Floats
    covariance: Floats
    doubt: float = 1.0
    """By what the variances were widened before it was taken."""


class Ekf:
    """The filter: `hear` measurements in any order, read the state."""

    def __init__(self, settings: EkfSettings) -> None:
        self.settings = settings
        self.t: Nanos | None = None
        """Time of the newest measurement; None before the first."""
        self.nis: dict[str, Nis] = {}
        """How well the covariances fit what came, by source."""
        self._filter = _filter(settings)
        self._history: deque[_Entry] = deque()
        self._refused_since: dict[str, Nanos] = {}

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

    def observe(self, measurement: Measurement) -> Verdict:
        """Put one measurement in its place, and say what became of it."""
        if not _finite(measurement):
            return Verdict.NOT_FINITE
        t = measurement.t
        if self.t is None:
            self._start(t)
        later = self._back_to(t)
        if later is None:
            return Verdict.LATE
        verdict = self._judge(measurement)
        for entry in later:
            self._predict(entry.t)
            self._repeat(entry)
        self._forget()
        return verdict

    def at(self, t: Nanos) -> tuple[Floats, Floats] | None:
        """State and covariance at a time within the rewind (newer: predicted); None if older."""
        entry = next((e for e in reversed(self._history) if e.t <= t), None)
        if entry is None:
            return None
        dt = seconds(t - entry.t)
        F = jacobian(entry.state, dt)
        covariance = F @ entry.covariance @ F.T + process_noise(entry.state, dt, self.settings)
        return move(entry.state, dt), covariance

    def refused_for(self, source: str, t: Nanos) -> float:
        """How long [s] the gate has refused this sensor without a break, up to a time."""
        return max(0.0, seconds(t - self._refused_since.get(source, t)))

    def _start(self, t: Nanos) -> None:
        self.t = t
        self._history.append(_Entry(t, None, Verdict.ACCEPTED, self.state, self.covariance))

    def _back_to(self, t: Nanos) -> list[_Entry] | None:
        """Stand at time t; what lies after it, to be done again. None if t is too long ago."""
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
            self._filter.x = move(state, dt)  # filterpy's own mean is F x: the arc is exact
            self.t = t

    def _judge(self, measurement: Measurement) -> Verdict:
        prior = self.state, self.covariance
        freedom = len(measurement.value)
        gate = CHI_SQUARE[self.settings.confidence][freedom - 1]
        doubt = 1.0
        distance = self._update(measurement)
        nis = self.nis.setdefault(measurement.source, Nis())
        nis.add(distance, CHI_SQUARE[0.95][freedom - 1], freedom)
        since = self._refused_since.get(measurement.source)
        if distance <= gate:
            verdict = Verdict.ACCEPTED
            self._refused_since.pop(measurement.source, None)
        elif since is not None and measurement.t - since >= self.settings.lockout:
            verdict = Verdict.FORCED
            self._refused_since.pop(measurement.source, None)
            self._filter.x, self._filter.P = prior
            doubt = self._doubt(measurement)
            self._widened(measurement, doubt)
        else:
            verdict = Verdict.REFUSED
            self._refused_since.setdefault(measurement.source, measurement.t)
            self._filter.x, self._filter.P = prior
        self._remember(measurement, verdict, doubt)
        return verdict

    def _doubt(self, measurement: Measurement) -> float:
        """By what the variances must grow for the state to be as far off as the measurement just
        refused says that it is."""
        H = measurement.matrix
        believed = np.diag(H @ self.covariance @ H.T)
        return min(max(1.0, float(np.max(self._filter.y**2 / believed))), WIDEST)

    def _repeat(self, entry: _Entry) -> None:
        """Apply a measurement again, as it was decided on before."""
        if entry.measurement is not None and entry.verdict is not Verdict.REFUSED:
            if entry.verdict is Verdict.FORCED:
                self._widened(entry.measurement, entry.doubt)
            else:
                self._update(entry.measurement)
        self._remember(entry.measurement, entry.verdict, entry.doubt)

    def _update(self, measurement: Measurement) -> float:
        """Take a measurement in; its squared Mahalanobis distance before that."""
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

    def _widened(self, measurement: Measurement, doubt: float) -> None:
        """Take a measurement in that contradicts the state, after doubting what it is about; and the
        slip, if it is about the place, for wheels that spin on the spot are how places go wrong."""
        scale = np.ones(SIZE)
        about = np.any(measurement.matrix != 0.0, axis=0)
        about[SLIP] |= about[X]
        scale[about] = math.sqrt(doubt)
        self._filter.P = self._filter.P * np.outer(scale, scale)
        self._update(measurement)

    def _remember(self, measurement: Measurement | None, verdict: Verdict, doubt: float) -> None:
        assert self.t is not None
        self._history.append(_Entry(self.t, measurement, verdict, self.state, self.covariance, doubt))

    def _forget(self) -> None:
        oldest = self._history[-1].t - self.settings.rewind
        while len(self._history) > 1 and self._history[1].t <= oldest:
            self._history.popleft()


WIDEST = 1e6
"""How much a variance is widened at most."""


def _filter(settings: EkfSettings) -> Any:  # noqa: ANN401 -- filterpy has no types
    from filterpy.kalman import ExtendedKalmanFilter  # here, because it takes seconds to import

    made = ExtendedKalmanFilter(dim_x=SIZE, dim_z=1)
    made.x = np.zeros(SIZE)
    made.x[POSE] = settings.start_x, settings.start_y, wrap(settings.start_yaw)
    sigmas = (settings.start_sigma,) * 3 + (1.0, 1.0, settings.bias_sigma, settings.slip_sigma)
    made.P = np.diag(np.square(sigmas))
    return made


def _finite(measurement: Measurement) -> bool:
    return bool(np.isfinite(measurement.value).all() and np.isfinite(measurement.noise).all())
