"""`Options` of the driver, the same for both motors of a drive, and `Settings` of the drive itself."""

from __future__ import annotations

from dataclasses import dataclass

from protocols.toolkit.options import bounded, check_bounds


@dataclass(frozen=True, slots=True)
class Options:
    """Configuration of the driver."""

    max_rpm: int = bounded(300, 1, 3000)
    """Largest velocity that is commanded."""
    steps_per_rpm: int = bounded(1, 1, 10)
    """Steps of the target velocity in one rpm, as configured in the drive (1 as delivered)."""
    counts: int = bounded(4096, 16, 1_000_000)
    """Of the encoder in one revolution: four times object 200E."""
    acceleration_ms: int = bounded(100, 0, 32767)
    """Time in which it gets up to speed (6083), written before it is enabled."""
    deceleration_ms: int = bounded(100, 0, 32767)
    """Time in which it slows down (6084)."""
    timeout_ms: int = bounded(200, 20, 32767)
    """Communication offline time (2000), written before it is enabled."""
    feedback_ms: int = bounded(10, 2, 1000)
    """Period of its TPDOs, and in which a drive is read that is not commanded yet."""
    sdo_timeout_ms: int = bounded(100, 10, 5000)
    """Time after which a request without a response is repeated."""
    offline_ms: int = bounded(500, 50, 60_000)
    """Time without a response after which the motor is offline."""

    def __post_init__(self) -> None:
        check_bounds(self)


@dataclass(frozen=True, slots=True)
class Settings:
    """Configuration of the drive."""

    offline_time_ms: int = bounded(1000, 0, 32767)
    """Object 2000 as saved; 0: no watchdog"""
    max_torque: float = bounded(10.0, 0.1, 1000.0)
    """N·m"""

    def __post_init__(self) -> None:
        check_bounds(self)
