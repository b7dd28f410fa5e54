"""`Options` of the driver, the same for both motors of a drive, and `Settings` of the drive itself."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated

from protocols.bounds import Bounds, check


@dataclass(frozen=True, slots=True)
class Options:
    """Configuration of the driver."""

    max_rpm: Annotated[int, Bounds(1, 3000)] = 300
    """Largest velocity that is commanded."""
    steps_per_rpm: Annotated[int, Bounds(1, 10)] = 1
    """Steps of the target velocity in one rpm, as configured in the drive (1 as delivered)."""
    counts: Annotated[int, Bounds(16, 1_000_000)] = 4096
    """Of the encoder in one revolution: four times object 200E."""
    acceleration_ms: Annotated[int, Bounds(0, 32767)] = 100
    """Time in which it gets up to speed (6083), written before it is enabled."""
    deceleration_ms: Annotated[int, Bounds(0, 32767)] = 100
    """Time in which it slows down (6084)."""
    timeout_ms: Annotated[int, Bounds(20, 32767)] = 200
    """Communication offline time (2000), written before it is enabled."""
    feedback_ms: Annotated[int, Bounds(2, 1000)] = 10
    """Period of its TPDOs, and in which a drive is read that is not commanded yet."""
    sdo_timeout_ms: Annotated[int, Bounds(10, 5000)] = 100
    """Time after which a request without a response is repeated."""
    offline_ms: Annotated[int, Bounds(50, 60_000)] = 500
    """Time without a response after which the motor is offline."""

    def __post_init__(self) -> None:
        check(self)


@dataclass(frozen=True, slots=True)
class Settings:
    """Configuration of the drive."""

    offline_time_ms: Annotated[int, Bounds(0, 32767)] = 1000
    """Object 2000 as saved; 0: no watchdog"""
    max_torque: Annotated[float, Bounds(0.1, 1000.0)] = 10.0
    """N·m"""

    def __post_init__(self) -> None:
        check(self)
