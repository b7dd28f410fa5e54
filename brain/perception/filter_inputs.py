"""What the filter takes, each input at its own time; and what it returns about them."""

from __future__ import annotations

import math
from collections import deque
from dataclasses import dataclass, field
from enum import StrEnum
from math import isfinite
from typing import TypeAlias

import numpy as np

from brain.belief import Floats
from protocols.messages import Nanos


class GateResult(StrEnum):
    """What the filter did with a measurement."""

    ACCEPTED = "accepted"
    REJECTED = "rejected by the gate"
    FORCED = "accepted again after rejections"
    """Accepted although the gate rejected it, with the covariance inflated: see `FilterSettings.lockout`."""
    LATE = "too late"
    NOT_FINITE = "not finite"
    JUMPED = "position jumped"
    CONFLICT = "two values for one time"
    UNUSED = "not used beside another gyro"


@dataclass(frozen=True, slots=True)
class WheelAngle:
    """Angle of a wheel [rad] at the joint's output shaft."""

    motor: str
    t: Nanos
    angle: float


@dataclass(frozen=True, slots=True)
class GyroRate:
    """Rate about the robot's z axis [rad/s], bias included, and the standard deviation of one reading."""

    source: str
    t: Nanos
    rate: float
    sigma: float


@dataclass(frozen=True, slots=True)
class PoseFix:
    """A pose, or a position, in the frame "map", measured by a reference outside the robot."""

    source: str
    t: Nanos
    value: Floats
    """x, y, yaw; or x, y"""
    noise: Floats
    """Its covariance: 3 × 3 or 2 × 2"""
    shared: Floats | None = None
    """Covariance of the reference itself at this pose, if it was made from this filter's poses: a map's
    anchors"""
    drift: Floats | None = None
    """Covariance 3 × 3 by which the motion since the last such fix may be wrong beside what the filter
    knows of. If it is given the fix is certain: one beyond the gate is no reason to refuse it, but shows
    that the motion was wrong by as much."""


@dataclass(frozen=True, slots=True)
class Relocated:
    """The robot is here, whatever was believed: pose, and its covariance 3 × 3."""

    t: Nanos
    value: Floats
    noise: Floats


@dataclass(frozen=True, slots=True)
class ScanEnd:
    """A scan ended then: the wheels are to move the pose up to exactly this time, however short the travel
    is."""

    t: Nanos


Input: TypeAlias = WheelAngle | GyroRate | PoseFix | Relocated | ScanEnd


@dataclass(frozen=True, slots=True)
class Judged:
    """The filter's decision on one measurement. Of a gyro: on what it turned in one travel of the wheels."""

    source: str
    t: Nanos
    result: GateResult
    distance: float = 0.0
    """Squared Mahalanobis distance; 0 if it never came to the gate"""
    freedom: int = 0
    """Degrees of freedom"""


WINDOW = 50
"""Measurements in the window of a source's NIS."""


@dataclass(slots=True)
class Nis:
    """Normalised innovations squared (NIS) of one sensor: is the filter consistent?

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
    window: deque[tuple[float, int]] = field(default_factory=lambda: deque(maxlen=WINDOW))
    """Squared distances and degrees of freedom of the newest."""

    def add(self, distance: float, quantile: float, freedom: int) -> None:
        """Add a squared distance, with the 95 % quantile for its degrees of freedom."""
        self.count += 1
        self.freedom += freedom
        self.total += distance
        self.beyond += distance > quantile
        self.window.append((distance, freedom))

    @property
    def mean(self) -> float:
        """Per degree of freedom: 1 if consistent, above 1 if overconfident, below 1 if too cautious; 0 before
        the first measurement."""
        return self.total / self.freedom if self.freedom else 0.0

    def recent(self, most: float = math.inf) -> float:
        """Return the same over the window, each measurement with at most `most` per degree of freedom."""
        freedom = sum(n for _, n in self.window)
        return sum(min(d, most * n) for d, n in self.window) / freedom if freedom else 0.0


def is_valid(item: Input) -> bool:
    """Return whether an input is finite, and its noise a covariance."""
    if isinstance(item, WheelAngle):
        return isfinite(item.angle)
    if isinstance(item, GyroRate):
        return isfinite(item.rate) and 0.0 < item.sigma < 1e6
    if isinstance(item, ScanEnd):
        return True
    size = len(item.value)
    more = (item.shared, item.drift) if isinstance(item, PoseFix) else ()
    matrices = [item.noise, *(matrix for matrix in more if matrix is not None)]
    if size not in (2, 3) or any(matrix.shape != (size, size) for matrix in matrices):
        raise ValueError(f"a pose of 2 or 3 numbers with its covariances, not {item!r}")
    if not all(np.isfinite(array).all() for array in (item.value, *matrices)):
        return False
    try:
        np.linalg.cholesky(item.noise)
    except np.linalg.LinAlgError:
        return False
    return True
