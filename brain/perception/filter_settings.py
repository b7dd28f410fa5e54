"""The filter's settings, and the chi-square quantiles of its gates."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Annotated, Literal

from brain.perception.engine import ENGINES
from protocols.bounds import Bounds, Duration, Invalid, check
from protocols.messages import MILLISECOND

CHI_SQUARE: dict[float, tuple[float, float, float]] = {
    0.95: (3.841459, 5.991465, 7.814728),
    0.99: (6.634897, 9.210340, 11.344867),
    0.999: (10.827566, 13.815511, 16.266236),
}
"""Quantiles of chi-square by confidence, for 1, 2 and 3 degrees of freedom."""


@dataclass(frozen=True, slots=True)
class FilterSettings:
    """Initial state, error model and gates."""

    engine: Literal["structured", "filterpy"] = "structured"
    """What computes the filter: ours, or filterpy, as a check"""
    start_x: Annotated[float, Bounds(-1e4, 1e4, "m")] = 0.0
    """m, in the frames "map" and "odom" """
    start_y: Annotated[float, Bounds(-1e4, 1e4, "m")] = 0.0
    """m"""
    start_yaw: Annotated[float, Bounds(-10.0, 10.0, "rad")] = 0.0
    """rad"""
    start_sigma: Annotated[float, Bounds(1e-6, 100.0, "m")] = 1e-3
    """m: near 0, since the start defines the frame"""
    start_yaw_sigma: Annotated[float, Bounds(1e-6, 4.0, "rad")] = 1e-3
    """rad; larger where position fixes define the frame"""
    resolution: Annotated[float, Bounds(1e-8, 1.0, "rad")] = 2.0 * math.pi / 131072.0
    """rad of the wheel: one count of the encoder, seen through the gear"""
    jitter: Annotated[float, Bounds(0.0, 0.1, "s")] = 2e-5
    """s: jitter of the wheels' time stamps"""
    shortest: Annotated[Duration, Bounds(0.0, 100.0)] = 4 * MILLISECOND
    """Shorter travels are joined."""
    jump_margin: Annotated[float, Bounds(1.0, 10.0)] = 2.0
    """An angle that changes faster than the wheel's largest speed times this has jumped."""
    turn_slip: Annotated[float, Bounds(1e-6, 1.0)] = 0.01
    """Standard deviation of each wheel's slip, as a share of what it rolls; here it turns the base"""
    slip_length: Annotated[float, Bounds(0.01, 1000.0, "m")] = 0.3
    """m: its correlation length: a Gauss-Markov process over the distance that the wheel rolls"""
    turn_lag: Annotated[float, Bounds(0.0, 1.0, "s")] = 0.002
    """s by which the base may follow the turn of its wheels (tyres give way), or the gyro's stamps be off"""
    travel_noise: Annotated[float, Bounds(0.0, 1.0)] = 0.004
    """m per √m rolled: error along the path by slip that both wheels share"""
    sideways_noise: Annotated[float, Bounds(0.0, 1.0)] = 0.003
    """m per √m rolled: lateral displacement"""
    scale_sigma: Annotated[float, Bounds(0.0, 0.1)] = 0.03
    """Initial standard deviation of the distance scale: the share of the wheels' travel that the base does
    not move"""
    scale_walk: Annotated[float, Bounds(0.0, 0.1)] = 3e-4
    """Per √m: random walk of the distance scale"""
    scale_bound: Annotated[float, Bounds(0.0, 0.1)] = 0.1
    """Largest distance scale"""
    slip_bound: Annotated[float, Bounds(0.0, 1.0)] = 0.1
    """Largest slip of a wheel; that of a base that turns by slipping is larger in turns (`Base.turn_slip`)"""
    bias_sigma: Annotated[float, Bounds(1e-6, 1.0, "rad/s")] = 0.05
    """rad/s: gyro bias at switch-on"""
    bias_walk: Annotated[float, Bounds(0.0, 1.0)] = 1e-4
    """rad/s per √s: random walk of the gyro bias"""
    bias_bound: Annotated[float, Bounds(0.0, 1.0, "rad/s")] = 0.2
    """rad/s: largest gyro bias"""
    confidence: float = 0.999
    """Of the chi-square gates: 0.95, 0.99 or 0.999"""
    lockout: Annotated[Duration, Bounds(0.0, 10_000.0)] = 400 * MILLISECOND
    """After this time of uninterrupted rejections the sensor's next measurement is accepted again."""
    rewind: Annotated[Duration, Bounds(0.0, 1000.0)] = 500 * MILLISECOND
    """Largest delay of a measurement."""

    def __post_init__(self) -> None:
        check(self)
        if self.confidence not in CHI_SQUARE:
            raise Invalid(
                ("confidence", f"confidence must be one of {list(CHI_SQUARE)}, not {self.confidence!r}")
            )
        if self.engine not in ENGINES:
            raise Invalid(("engine", f"engine must be one of {list(ENGINES)}, not {self.engine!r}"))
