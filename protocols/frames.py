"""Frames: what is transferred on a bus, and the states of a bus. Values only."""

from __future__ import annotations

from dataclasses import dataclass
from enum import StrEnum
from typing import TypeAlias

from protocols.messages import Nanos


@dataclass(frozen=True, slots=True)
class CanFrame:
    """A CAN frame; `fd` marks CAN FD (up to 64 data bytes), `brs` its bit-rate switch."""

    id: int
    data: bytes = b""
    extended: bool = False
    remote: bool = False
    """A remote frame (RTR) requests data and carries none; its `data` is empty."""
    fd: bool = False
    brs: bool = False

    def __str__(self) -> str:
        """Return candump's notation: `123#DEADBEEF`, `123#R`, `12345678##1DEADBEEF`."""
        head = f"{self.id:08X}" if self.extended else f"{self.id:03X}"
        if self.remote:
            return f"{head}#R"
        return f"{head}{f'##{int(self.brs)}' if self.fd else '#'}{self.data.hex().upper()}"


Frame: TypeAlias = CanFrame | bytes
"""One CAN frame, or any run of serial bytes (a piece of a stream, cut anywhere)."""


@dataclass(frozen=True, slots=True)
class Packet:
    """A frame on a bus, and its time: of reception (stamped by the bus) or of sending."""

    t: Nanos
    bus: str
    frame: Frame


class BusState(StrEnum):
    """The state of a bus. Reported on change only."""

    UP = "up"
    PASSIVE = "passive"
    """Error-passive: it still works, badly."""
    OFF = "off"
    """Bus-off: nothing is transmitted."""
    FULL = "full"
    """The transmit queue is full; the newest command wins, older ones were dropped."""
    GONE = "gone"
    """The interface or port has disappeared."""
    BACK = "back"
    """It has come back after GONE or OFF."""
