"""The messages of the table on the bus: as CAN frames.

FILL IN (clauses "declared" and "foreign") the kind of frame.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Literal

from protocols.frames import CanFrame, Frame, IdMask
from protocols.toolkit.motor_driver import Rx
from protocols.toolkit.table import Decoded, Direction

from .table import TABLE

BUS: Literal["can", "canfd", "serial"] = "can"
FD = False
"""Its frames are CAN FD, with bit-rate switch."""


def ids(direction: Direction, address: int) -> tuple[IdMask, ...]:
    """Return the CAN ids to or from this address."""
    return TABLE.ids(direction, address)


def encode(name: str, address: int, **values: float) -> Frame:
    """Return a message to or from an address."""
    return replace(TABLE.encode(name, address, **values), fd=FD, brs=FD)


class Line:
    """What is received from one bus."""

    def read(self, frame: Frame, direction: Direction) -> list[Decoded | Rx]:
        """Return what a frame holds."""
        if not isinstance(frame, CanFrame) or frame.fd is not FD:
            return [Rx.IGNORED]
        return [TABLE.decode(replace(frame, fd=False), direction) or Rx.IGNORED]

    def drop(self) -> None:
        """Discard a partial message: there is none, a frame arrives whole."""
