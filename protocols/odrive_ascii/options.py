"""`Options` of the driver; the `Settings` of the axis are those over CAN, without those of CAN itself."""

from __future__ import annotations

from dataclasses import dataclass

from protocols.odrive_can.options import AxisOptions, AxisSettings
from protocols.toolkit.options import bounded

__all__ = ["Options", "Settings"]


@dataclass(frozen=True, slots=True)
class Options(AxisOptions):
    """How the driver behaves, over a serial line."""

    state_ms: int = bounded(50, 5, 1000)
    """Period in which state and errors are asked for."""


Settings = AxisSettings
