"""`Options` of the driver; the `Settings` of the axis are those over CAN, without those of CAN itself."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated

from protocols.bounds import Bounds
from protocols.odrive_can.options import AxisOptions, AxisSettings

__all__ = ["Options", "Settings"]


@dataclass(frozen=True, slots=True)
class Options(AxisOptions):
    """How the driver behaves, over a serial line."""

    state_ms: Annotated[int, Bounds(5, 1000)] = 50
    """Period in which state and errors are asked for."""


Settings = AxisSettings
