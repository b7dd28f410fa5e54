"""What stands on the wire: bytes ↔ values. No words, no time, and no state but a stream's.

Rules. Making a message takes values that the wire can hold; reading one takes any bytes, gives None or
nothing for what is no message, and never raises. A number that is not finite or out of range is no number.

FILL IN, this file first, from the manual. The clauses "bytes", "counts" and "vectors" tell.
The invented device speaks messages of 13 bytes, little-endian, with a CRC-16 (XMODEM) of the rest:

    A5 01 | address u8 | order u8, 0 0 0, velocity f32 [rad/s] | crc u16
    A5 02 | address u8 | mode u8, fault u8, velocity i16 [0.01 rad/s], position f32 [rad] | crc u16
"""

from __future__ import annotations

import binascii
import math
import struct
from collections.abc import Collection, Sequence
from dataclasses import dataclass
from enum import IntEnum
from typing import Literal

from protocols.plugin import Tally
from protocols.wire import Wire
from protocols.words import MILLISECOND, Nanos

NAME = "blank"
BUS: Literal["can", "canfd", "serial"] = "serial"

COMMAND, STATUS = 1, 2
"""Messages from the host, and from the device."""
MAX_ADDRESS = 0xFF
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
_HEAD = struct.Struct("<BBB")
_CRC = struct.Struct("<H")
SYNC = 0xA5
SIZE = _HEAD.size + _UP.size + _CRC.size
"""Bytes in a message, of either kind."""


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


# -- a stream ------------------------------------------------------------------------------------------


def ids(_kind: int, _address: int) -> frozenset[int]:
    """A serial line has no CAN ids."""
    return frozenset()


def message(kind: int, address: int, payload: bytes) -> Wire:
    """A payload on its way to or from an address."""
    body = _HEAD.pack(SYNC, kind, address) + payload
    return body + _CRC.pack(binascii.crc_hqx(body, 0))


class Reader:
    """Takes a stream apart into (address, payload), however it was cut. Holds one message at most.

    Counted is once what is not for us: each message to somebody else, each run of bytes that is no message;
    and as bad each message whose CRC is wrong. The search goes on right behind a false start."""

    def __init__(self, kind: int, addresses: Collection[int], tally: Tally | None = None) -> None:
        self._start = bytes((SYNC, kind))
        self._addresses = frozenset(addresses)
        self.tally = tally or Tally()
        self._held = b""
        self._skipping = False
        """Whether the run of bytes that is being skipped has been counted."""

    def read(self, wire: Wire) -> list[tuple[int, bytes]]:
        """What is complete with these bytes, for these addresses."""
        if not isinstance(wire, bytes):
            self.tally.foreign += 1
            return []
        held, at, found = self._held + wire, 0, list[tuple[int, bytes]]()
        while True:
            at = self._skip(held, at)
            whole = held[at : at + SIZE]
            if len(whole) < SIZE:
                break
            if binascii.crc_hqx(whole[: -_CRC.size], 0) != _CRC.unpack(whole[-_CRC.size :])[0]:
                self.tally.bad += 1
                self._skipping = True
                at += 1
                continue
            self._skipping = False
            at += SIZE
            if whole[2] in self._addresses:
                found.append((whole[2], whole[_HEAD.size : -_CRC.size]))
            else:
                self.tally.foreign += 1
        self._held = held[at:]
        return found

    def drop(self) -> None:
        """Forget a message begun, since its rest will not come."""
        self._held, self._skipping = b"", False

    def _skip(self, held: bytes, at: int) -> int:
        """Where the next message may begin; what lies before is counted as one."""
        start = at
        while start < len(held) and not self._start.startswith(held[start : start + 2]):
            start += 1
        if start > at and not self._skipping:
            self.tally.foreign += 1
            self._skipping = True
        return start
