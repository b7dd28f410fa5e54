"""`Options` of the driver, and `Settings` of the controller as it is in simulation."""

from __future__ import annotations

from dataclasses import dataclass

from protocols.toolkit.options import bounded
from protocols.vesc.options import MotorOptions, MotorSettings


@dataclass(frozen=True, slots=True)
class Options(MotorOptions):
    """Configuration of the driver over a serial line."""

    uart_id: int = bounded(0, 0, 253)
    """VESC ID of the controller at the end of the line; the others are reached through its CAN. The same for
    all controllers of a line."""
    feedback_ms: int = bounded(20, 2, 1000)
    """Period in which motion, fault and timeout are asked for."""
    slow_ms: int = bounded(200, 20, 60_000)
    """Period in which temperature and voltage are asked for."""


@dataclass(frozen=True, slots=True)
class Settings(MotorSettings):
    """Configuration of the controller in simulation, on a serial line."""

    firmware_major: int = bounded(6, 0, 255)
    firmware_minor: int = bounded(6, 0, 255)
    """Below 5.03 it tells no timeout."""
    serial_number: int = bounded(0, 0, (1 << 96) - 1)
    """The processor's; 0: derived from the address."""
