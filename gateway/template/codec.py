"""What stands on the wire: bytes ↔ values. No words, no time, and no state but a stream's.

Rules. Making a message takes values that the wire can hold; reading one takes any bytes, gives None or
nothing for what is no message, and never raises. A number that is not finite or out of range is no number.

FILL IN, this file first, from the manual. The clauses "bytes", "counts" and "vectors" tell.
The invented device speaks frames of 8 bytes, little-endian:

    0x100 + address   order u8, 0 0 0, velocity f32 [rad/s]
    0x200 + address   mode u8, fault u8, velocity i16 [0.01 rad/s], position f32 [rad]
"""

from __future__ import annotations

import math
import struct
from collections.abc import Collection, Sequence
from dataclasses import dataclass
from enum import IntEnum
from typing import Literal

from protocols.plugin import Tally
from protocols.wire import CanFrame, Wire
from protocols.words import MILLISECOND, Nanos

NAME = "blank"
BUS: Literal["can", "canfd", "serial"] = "can"
FD = False
"""Whether its frames are CAN FD (with bit-rate switch)."""

COMMAND, STATUS = 0x100, 0x200
"""CAN ids from the host and from the device, less the address."""
MAX_ADDRESS = 0x3F
MAX_SPEED = 100.0
"""rad/s, the most that it can be told"""
VELOCITY_UNIT = 0.01
"""rad/s"""
MAX_TOLD = 327.67
"""rad/s, the most that it can tell"""
MAX_TURNED = 1e6
"""rad"""
TINY = 2.0**-126
"""The smallest normal float32: what is smaller is zero on this wire."""
STATUS_PERIOD: Nanos = 10 * MILLISECOND
WATCHDOG, TOO_HOT = 1, 2
"""Codes of its faults; 0 is none."""

_DOWN = struct.Struct("<Bxxxf")
_UP = struct.Struct("<BBhf")


class Order(IntEnum):
    """What the host may say."""

    STOP = 0
    RUN = 1
    CLEAR = 2


class DeviceMode(IntEnum):
    """What the device may be doing."""

    READY = 0
    RUNNING = 1
    FAULT = 2


@dataclass(frozen=True, slots=True)
class Status:
    """What the device tells of itself."""

    mode: DeviceMode
    fault: int
    velocity: float
    """rad/s"""
    position: float
    """rad"""


def command(address: int, order: Order, velocity: float = 0.0) -> Wire:
    """An order of the host's; a velocity within ±MAX_SPEED [rad/s] goes with RUN."""
    return message(COMMAND, address, _DOWN.pack(order, _normal(velocity)))


def status(address: int, said: Status) -> Wire:
    """What the device says; whatever does not fit is told as the nearest that does."""
    velocity = round(_cut(said.velocity, MAX_TOLD) / VELOCITY_UNIT)
    position = _normal(_cut(said.position, MAX_TURNED))
    return message(STATUS, address, _UP.pack(said.mode, said.fault, velocity, position))


def read_command(payload: bytes) -> tuple[Order, float] | None:
    """An order and its velocity [rad/s]; None if the device would not obey."""
    order, velocity = _DOWN.unpack(payload)
    if order not in tuple(Order) or not abs(velocity) <= MAX_SPEED * (1 + 2.0**-24):
        return None
    return Order(order), _normal(velocity)


def read_status(payload: bytes) -> Status | None:
    """What the device said; None if it cannot have said that."""
    mode, fault, velocity, position = _UP.unpack(payload)
    if mode not in tuple(DeviceMode) or not abs(position) <= MAX_TURNED:
        return None
    if fault not in ((WATCHDOG, TOO_HOT) if mode == DeviceMode.FAULT else (0,)) or velocity == -0x8000:
        return None
    return Status(DeviceMode(mode), fault, velocity * VELOCITY_UNIT, _normal(position))


def messages(wire: Wire) -> Sequence[str]:
    """The names of the messages to a device in this wire."""
    found = [read_command(payload) for _, payload in Reader(COMMAND, range(1, MAX_ADDRESS + 1)).read(wire)]
    return [read[0].name.lower() for read in found if read]


def _normal(value: float) -> float:
    """Without denormals and without a negative zero."""
    return value if abs(value) >= TINY else 0.0


def _cut(value: float, limit: float) -> float:
    return max(-limit, min(limit, value)) if math.isfinite(value) else 0.0


# -- frames --------------------------------------------------------------------------------------------


def ids(kind: int, address: int) -> frozenset[int]:
    """The CAN ids of this kind (COMMAND or STATUS) at this address."""
    return frozenset({kind + address})


def message(kind: int, address: int, payload: bytes) -> Wire:
    """A payload on its way to or from an address."""
    return CanFrame(kind + address, payload, fd=FD, brs=FD)


class Reader:
    """Takes wires apart into (address, payload), and counts the others: not for us, or spoilt."""

    def __init__(self, kind: int, addresses: Collection[int], tally: Tally | None = None) -> None:
        self._addresses = {kind + address: address for address in addresses}
        self.tally = tally or Tally()

    def read(self, wire: Wire) -> list[tuple[int, bytes]]:
        """What is in this wire for these addresses, of the right length."""
        ours = isinstance(wire, CanFrame) and not wire.extended and not wire.remote and wire.fd is FD
        if not isinstance(wire, CanFrame) or not ours or wire.id not in self._addresses:
            self.tally.foreign += 1
            return []
        if len(wire.data) != _UP.size:
            self.tally.bad += 1
            return []
        return [(self._addresses[wire.id], wire.data)]

    def drop(self) -> None:
        """Forget a message begun, since its rest will not come: a frame comes whole."""
