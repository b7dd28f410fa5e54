"""`Options` of the driver, and `Settings` of the board as it is in simulation."""

from __future__ import annotations

import math
from dataclasses import dataclass

from protocols.roboclaw.table import TIMEOUT_UNIT_MS
from protocols.toolkit.options import bounded, check_bounds

MOST = (1 << 31) - 1


@dataclass(frozen=True, slots=True)
class Options:
    """Configuration of the driver."""

    counts: int = bounded(4096, 1, 100_000_000)
    """Of the encoder in one revolution of the shaft at which the gateway counts: four times its lines."""
    max_qpps: int = bounded(44_000, 1, MOST)
    """counts/s: largest speed that is commanded; not more than the board's QPPS, its speed at full power."""
    acceleration: int = bounded(200_000, 1, MOST)
    """counts/s², on the way to a position."""
    timeout_ms: int = bounded(200, TIMEOUT_UNIT_MS, 255 * TIMEOUT_UNIT_MS)
    """Serial timeout, in steps of 100 ms, written before a motor is armed: the same for both of a board."""
    feedback_ms: int = bounded(20, 2, 1000)
    """Period in which position and speed are asked for."""
    poll_ms: int = bounded(50, 5, 500)
    """Period in which status and duty are asked for; all else is asked for ten times less often."""
    offline_ms: int = bounded(250, 20, 10_000)
    """Time without an answer after which the motor is offline."""
    answer_ms: float = bounded(3.0, 0.1, 50.0)
    """The longest time that the board waits before it answers, its USB port or adapter included."""
    scan: bool = True
    """A scan may ask all addresses."""

    def __post_init__(self) -> None:
        rest = self.timeout_ms % TIMEOUT_UNIT_MS
        check_bounds(
            self, (f"timeout_ms is {self.timeout_ms}: it has steps of {TIMEOUT_UNIT_MS}",) if rest else ()
        )

    @property
    def unit(self) -> float:
        """rad of one count"""
        return math.tau / self.counts


@dataclass(frozen=True, slots=True)
class Settings:
    """Configuration of the board, and its motor."""

    timeout: int = bounded(0, 0, 255)
    """Serial timeout as saved, in 0.1 s; 0: off"""
    velocity_p: int = bounded(65536, 0, MOST)
    """1/65536"""
    velocity_i: int = bounded(32768, 0, MOST)
    velocity_d: int = bounded(16384, 0, MOST)
    qpps: int = bounded(44_000, 0, MOST)
    """Speed at full power; as delivered 44000"""
    older_status: bool = False
    """Its firmware is older than 4.1.3x: a status of 16 bits."""
    max_torque: float = bounded(5.0, 0.01, 1000.0)
    """N·m"""
    torque_constant: float = bounded(0.05, 1e-4, 100.0)
    """N·m/A"""
    resistance: float = bounded(0.1, 1e-3, 100.0)
    """Ω"""
    supply: float = bounded(24.0, 6.0, 60.0)
    """V"""
    temperature: float = bounded(30.0, 0.0, 150.0)
    """°C"""

    def __post_init__(self) -> None:
        check_bounds(self)
