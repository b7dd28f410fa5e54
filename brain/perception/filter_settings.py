"""What can be set of the filter, with its defaults; and the table of its gates. Values only."""

from __future__ import annotations

import math
from dataclasses import dataclass, fields

from protocols.messages import MILLISECOND, Nanos

CHI_SQUARE: dict[float, tuple[float, float, float]] = {
    0.95: (3.841459, 5.991465, 7.814728),
    0.99: (6.634897, 9.210340, 11.344867),
    0.999: (10.827566, 13.815511, 16.266236),
}
"""Quantiles of chi-square by confidence, for 1, 2 and 3 degrees of freedom."""


@dataclass(frozen=True, slots=True)
class EkfSettings:
    """Where the base starts, how much it is trusted to go on as it goes, and the gates."""

    start_x: float = 0.0
    """m, in the frame "odom" """
    start_y: float = 0.0
    start_yaw: float = 0.0
    """rad"""
    start_sigma: float = 1e-3
    """m and rad: the start is where the frame is, by definition"""
    linear_noise: float = 1.0
    """m/s per √s: how the treads' speed wanders"""
    angular_noise: float = 1.0
    """rad/s per √s: how the rate of turn wanders"""
    travel_noise: float = 0.005
    """m per √m: what the way along differs by, beside the slip"""
    sideways_noise: float = 0.003
    """m per √m: what the base is pushed sideways"""
    bias_sigma: float = 0.05
    """rad/s: the gyro's bias at switch-on"""
    bias_noise: float = 1e-4
    """rad/s per √s: how it wanders"""
    slip_sigma: float = 0.03
    """share: of the wheels' way, at the start"""
    slip_noise: float = 2e-3
    """share per √s: how the slip wanders while the base moves"""
    confidence: float = 0.999
    """Of the gates: 0.95, 0.99 or 0.999"""
    lockout: Nanos = 400 * MILLISECOND
    """A sensor refused for this long without a break is believed again."""
    rewind: Nanos = 500 * MILLISECOND
    """How late a measurement may come."""

    def __post_init__(self) -> None:
        for field in fields(self):
            value = getattr(self, field.name)
            if not math.isfinite(value):
                raise ValueError(f"{field.name} must be finite, not {value!r}")
            if not field.name.startswith("start_") and value < 0:
                raise ValueError(f"{field.name} must not be negative, but is {value!r}")
        if self.start_sigma <= 0.0:
            raise ValueError(f"start_sigma must be above 0, not {self.start_sigma!r}")
        if self.confidence not in CHI_SQUARE:
            raise ValueError(f"confidence must be one of {list(CHI_SQUARE)}, not {self.confidence!r}")
