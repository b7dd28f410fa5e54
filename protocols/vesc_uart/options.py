"""`Options` of the driver, and `Settings` of the controller as it is in simulation."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated

from protocols.bounds import Bounds
from protocols.vesc.options import MotorOptions, MotorSettings


@dataclass(frozen=True, slots=True)
class Options(MotorOptions):
    """Configuration of the driver over a serial line."""

    uart_id: Annotated[int, Bounds(0, 253)] = 0
    """VESC ID of the controller at the end of the line; the others are reached through its CAN. The same for
    all controllers of a line."""
    feedback_ms: Annotated[int, Bounds(2, 1000)] = 20
    """Period in which motion, fault and timeout are asked for."""
    slow_ms: Annotated[int, Bounds(20, 60_000)] = 200
    """Period in which temperature and voltage are asked for."""


@dataclass(frozen=True, slots=True)
class Settings(MotorSettings):
    """Configuration of the controller in simulation, on a serial line."""

    firmware_major: Annotated[int, Bounds(0, 255)] = 6
    firmware_minor: Annotated[int, Bounds(0, 255)] = 6
    """Below 5.03 it tells no timeout."""
    serial_number: Annotated[int, Bounds(0, (1 << 96) - 1)] = 0
    """The processor's; 0: derived from the address."""
