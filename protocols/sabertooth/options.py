"""`Options` of the driver, and `Settings` of the motor as it is in simulation."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, ClassVar

from protocols.bounds import Bounds, check
from protocols.sabertooth.table import TIMEOUT_UNIT_MS


@dataclass(frozen=True, slots=True)
class Options:
    """Configuration of the driver."""

    full_scale: Annotated[float, Bounds(1e-3, 1e4)] = 20.0
    """rad/s of the shaft at full power, as measured with the load that it usually has: nothing checks it."""
    timeout_ms: Annotated[int, Bounds(TIMEOUT_UNIT_MS, 127 * TIMEOUT_UNIT_MS)] = 300
    """Serial timeout, in steps of 100 ms, sent before a motor is driven and again while it is."""
    autobaud: bool = True
    """AAh is sent before the first message: boards that have to find the baud rate wait for it."""

    feedback_ms: ClassVar[int] = 50
    """Period in which it is looked whether what it was sent has lapsed."""
    offline_ms: ClassVar[int] = 50

    def __post_init__(self) -> None:
        rest = self.timeout_ms % TIMEOUT_UNIT_MS
        wrong = f"timeout_ms is {self.timeout_ms}: it has steps of {TIMEOUT_UNIT_MS}"
        check(self, ("timeout_ms", wrong if rest else ""))


@dataclass(frozen=True, slots=True)
class Settings:
    """What the motor truly is."""

    share: Annotated[float, Bounds(0.2, 2.0)] = 1.0
    """Its speed without load at full power, of `full_scale`."""
    torque_constant: Annotated[float, Bounds(1e-4, 100.0)] = 0.5
    """N·m/A"""
    resistance: Annotated[float, Bounds(1e-3, 100.0)] = 0.5
    """Ω"""
    max_torque: Annotated[float, Bounds(0.01, 1000.0)] = 5.0
    """N·m"""

    def __post_init__(self) -> None:
        check(self)
