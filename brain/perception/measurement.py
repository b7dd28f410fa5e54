"""Measurements for the filter: value = H · state + noise, each at its own time; and what the gate decided."""

from __future__ import annotations

from dataclasses import dataclass
from enum import StrEnum

import numpy as np

from brain.belief import Floats, Pose
from brain.perception.motion_model import BIAS, POSE, SIZE, YAW, V, W
from protocols.messages import Nanos


class GateResult(StrEnum):
    """What the filter did with a measurement."""

    ACCEPTED = "accepted"
    REJECTED = "rejected by the gate"
    FORCED = "accepted again after rejections"
    """Accepted although the gate rejected it, with the covariance inflated: see `EkfSettings.lockout`."""
    LATE = "too late"
    NOT_FINITE = "not finite"


@dataclass(frozen=True, slots=True)
class Measurement:
    """One measurement at one time: value = H · state + noise of covariance R."""

    source: str
    """Gate statistics and lockouts are kept by this name."""
    t: Nanos
    value: Floats
    """m ≤ 3 components"""
    matrix: Floats
    """H, m × 7"""
    noise: Floats
    """R, m × m"""
    heading: int | None = None
    """Index of the component that is a heading, whose residual must be wrapped."""


def wheels(source: str, t: Nanos, linear: float, angular: float, noise: Floats) -> Measurement:
    """Return the wheels' tread speed [m/s] and yaw rate [rad/s] as a measurement; R is 2 × 2."""
    return Measurement(source, t, np.array([linear, angular]), _WHEELS, noise)


def gyro(source: str, t: Nanos, rate: float, sigma: float) -> Measurement:
    """Return the yaw rate about the robot's z axis [rad/s], bias included, as a measurement."""
    return Measurement(source, t, np.array([rate]), _GYRO, np.array([[sigma * sigma]]))


def gyro_at_rest(source: str, t: Nanos, rate: float, sigma: float) -> Measurement:
    """Return the gyro's reading [rad/s] of a base at rest as a measurement of its bias."""
    return Measurement(source, t, np.array([rate]), _BIAS, np.array([[sigma * sigma]]))


def pose_fix(source: str, t: Nanos, pose: Pose, noise: Floats) -> Measurement:
    """Return a pose from a reference outside the robot as a measurement; R is 3 × 3."""
    return Measurement(source, t, np.array([pose.x, pose.y, pose.yaw]), _POSE, noise, heading=YAW)


_WHEELS = np.eye(SIZE)[[V, W]]
_GYRO = np.eye(SIZE)[[W]] + np.eye(SIZE)[[BIAS]]
_BIAS = np.eye(SIZE)[[BIAS]]
_POSE = np.eye(SIZE)[POSE]
