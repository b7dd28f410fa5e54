"""`Options` of the driver, and `Settings` of the axis as it is in simulation."""

from __future__ import annotations

from dataclasses import dataclass

from protocols.odrive_can.options import AxisOptions, AxisSettings
from protocols.toolkit.options import bounded


@dataclass(frozen=True, slots=True)
class Options(AxisOptions):
    """How the driver behaves, over a serial line."""

    state_ms: int = bounded(50, 5, 1000)
    """Period in which state and errors are asked for."""


@dataclass(frozen=True, slots=True)
class Settings(AxisSettings):
    """The configuration of the device, in simulation."""

    answers_for_board: bool = True
    """It answers what is asked of the board. False for all axes of a board but one."""
