"""The filter's settings, and the chi-square quantiles of its gates."""

from __future__ import annotations

from dataclasses import dataclass

from brain.checks import within
from protocols.messages import MILLISECOND, Nanos

CHI_SQUARE: dict[float, tuple[float, float, float]] = {
    0.95: (3.841459, 5.991465, 7.814728),
    0.99: (6.634897, 9.210340, 11.344867),
    0.999: (10.827566, 13.815511, 16.266236),
}
"""Quantiles of chi-square by confidence, for 1, 2 and 3 degrees of freedom."""


@dataclass(frozen=True, slots=True)
class EkfSettings:
    """Initial state, process noise and gates."""

    start_x: float = 0.0
    """m, in the frame "odom" """
    start_y: float = 0.0
    start_yaw: float = 0.0
    """rad"""
    start_sigma: float = 1e-3
    """m and rad: near 0, since the start defines the frame"""
    linear_noise: float = 1.0
    """m/s per √s: random walk of the tread speed"""
    angular_noise: float = 1.0
    """rad/s per √s: random walk of the yaw rate"""
    travel_noise: float = 0.005
    """m per √m: error of the distance travelled, in addition to slip"""
    sideways_noise: float = 0.003
    """m per √m: lateral displacement"""
    bias_sigma: float = 0.05
    """rad/s: gyro bias at switch-on"""
    bias_noise: float = 1e-4
    """rad/s per √s: random walk of the gyro bias"""
    slip_sigma: float = 0.03
    """Initial slip, as a share of the wheels' travel"""
    slip_noise: float = 2e-3
    """Share per √s: random walk of the slip while the base moves"""
    confidence: float = 0.999
    """Of the chi-square gates: 0.95, 0.99 or 0.999"""
    lockout: Nanos = 400 * MILLISECOND
    """After this time of uninterrupted rejections the sensor's next measurement is accepted again."""
    rewind: Nanos = 500 * MILLISECOND
    """Largest delay of a measurement."""

    def __post_init__(self) -> None:
        within(
            self,
            start_x=(-1e4, 1e4, "m"),
            start_y=(-1e4, 1e4, "m"),
            start_yaw=(-10.0, 10.0, "rad"),
            start_sigma=(1e-6, 100.0),
            linear_noise=(0.0, 100.0),
            angular_noise=(0.0, 100.0),
            travel_noise=(0.0, 1.0),
            sideways_noise=(0.0, 1.0),
            bias_sigma=(0.0, 1.0, "rad/s"),
            bias_noise=(0.0, 1.0),
            slip_sigma=(0.0, 1.0),
            slip_noise=(0.0, 1.0),
            lockout=(0.0, 10_000.0),
            rewind=(0.0, 1000.0),
        )
        if self.confidence not in CHI_SQUARE:
            raise ValueError(f"confidence must be one of {list(CHI_SQUARE)}, not {self.confidence!r}")
