"""The buses: the only rooms that touch a wire. Nothing here knows a protocol.

A bus never blocks, never raises on what the wire does (it tells a BusState), stamps what it reads
with the clock it was opened with, and is closed exactly once.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Protocol

from protocols.frames import BusState, Frame, Packet
from protocols.messages import Nanos


class Bus(Protocol):
    """One CAN interface, one serial port, or a world of twins that looks like one."""

    name: str
    """The bus's name in the robot file."""

    def read(self, now: Nanos) -> tuple[Sequence[BusState], Sequence[Packet]]:
        """What has changed and what has come in up to `now`, in order of arrival."""
        ...

    def write(self, now: Nanos, frames: Sequence[Frame]) -> None:
        """Put wires on the bus, in order."""
        ...

    def close(self) -> None:
        """Give the wire back."""
        ...
