"""`Options` of the driver, and `Settings` of the motor as it is in simulation."""

from __future__ import annotations

from dataclasses import dataclass

from protocols.sabertooth.table import TIMEOUT_UNIT_MS
from protocols.toolkit.options import bounded, check_bounds


@dataclass(frozen=True, slots=True)
class Options:
    """Configuration of the driver."""

    full_scale: float = bounded(20.0, 1e-3, 1e4)
    """rad/s of the shaft at full power, as measured with the load that it usually has: nothing checks it."""
    timeout_ms: int = bounded(300, TIMEOUT_UNIT_MS, 127 * TIMEOUT_UNIT_MS)
    """Serial timeout, in steps of 100 ms, sent before a motor is driven and again while it is."""
    autobaud: bool = True
    """AAh is sent before the first message: boards that have to find the baud rate wait for it."""

    def __post_init__(self) -> None:
        rest = self.timeout_ms % TIMEOUT_UNIT_MS
        wrong = f"timeout_ms is {self.timeout_ms}: it has steps of {TIMEOUT_UNIT_MS}"
        check_bounds(self, (wrong,) if rest else ())


@dataclass(frozen=True, slots=True)
class Settings:
    """What the motor truly is."""

    share: float = bounded(1.0, 0.2, 2.0)
    """Its speed without load at full power, of `full_scale`."""
    torque_constant: float = bounded(0.5, 1e-4, 100.0)
    """N·m/A"""
    resistance: float = bounded(0.5, 1e-3, 100.0)
    """Ω"""
    max_torque: float = bounded(5.0, 0.01, 1000.0)
    """N·m"""

    def __post_init__(self) -> None:
        check_bounds(self)
