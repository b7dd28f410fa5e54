"""What sensors say to the filter: measurements, and what became of them.

Rules of this file. Values only. A measurement says: value = H · state + noise, at its own time.
"""

from __future__ import annotations

from dataclasses import dataclass
from enum import StrEnum

import numpy as np

from brain.belief import Floats, Pose
from brain.perception.motion import BIAS, POSE, SIZE, YAW, V, W
from protocols.messages import Nanos


class Verdict(StrEnum):
    """What became of a measurement."""

    ACCEPTED = "accepted"
    REFUSED = "refused by the gate"
    FORCED = "believed again after refusals"
    """Taken although the gate refused it, with the covariance widened: see `lockout`."""
    LATE = "too late"
    NOT_FINITE = "not finite"


@dataclass(frozen=True, slots=True)
class Measurement:
    """What one sensor says at one time: value = H · state + noise of covariance R."""

    source: str
    """Gates and lockouts are kept by this name."""
    t: Nanos
    value: Floats
    """m of them: m ≤ 3"""
    matrix: Floats
    """H, m × 7"""
    noise: Floats
    """R, m × m"""
    heading: int | None = None
    """Which component is a heading, whose residual must be wrapped."""


def wheels(source: str, t: Nanos, linear: float, angular: float, noise: Floats) -> Measurement:
    """Treads' speed [m/s] and rate of turn [rad/s] as the wheels have them; R is 2 × 2."""
    return Measurement(source, t, np.array([linear, angular]), _WHEELS, noise)


def gyro(source: str, t: Nanos, rate: float, sigma: float) -> Measurement:
    """Rate of turn about the robot's own z axis [rad/s], bias included."""
    return Measurement(source, t, np.array([rate]), _GYRO, np.array([[sigma * sigma]]))


def resting(source: str, t: Nanos, rate: float, sigma: float) -> Measurement:
    """What the gyro reads [rad/s] while the base is known to rest: its bias, and nothing else."""
    return Measurement(source, t, np.array([rate]), _RESTING, np.array([[sigma * sigma]]))


def located(source: str, t: Nanos, pose: Pose, noise: Floats) -> Measurement:
    """A pose, from a reference outside the robot; R is 3 × 3."""
    return Measurement(source, t, np.array([pose.x, pose.y, pose.yaw]), _LOCATED, noise, heading=YAW)


_WHEELS = np.eye(SIZE)[[V, W]]
_GYRO = np.eye(SIZE)[[W]] + np.eye(SIZE)[[BIAS]]
_RESTING = np.eye(SIZE)[[BIAS]]
_LOCATED = np.eye(SIZE)[POSE]
