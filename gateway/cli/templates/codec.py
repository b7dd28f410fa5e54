"""What the messages hold: payloads of bytes ↔ values. No words, no time, no state.

Rules. Making a message takes values that the wire can hold; reading one takes any bytes of the right length,
gives None for what is no message, and never raises. A number that is not finite or out of range is no number.

FILL IN, this file first, from the manual. The clauses "bytes", "counts" and "vectors" tell.
The invented device speaks payloads of 8 bytes, little-endian:

    to it     order u8, 0 0 0, velocity f32 [rad/s]
    from it   mode u8, fault u8, velocity i16 [0.01 rad/s], position f32 [rad]
"""

from __future__ import annotations

import math
import struct
from dataclasses import dataclass
from enum import IntEnum

from protocols.messages import MILLISECOND, Nanos

NAME = "blank"
SIZE = 8
"""Bytes in a payload, of either kind."""
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


def command(order: Order, velocity: float = 0.0) -> bytes:
    """An order of the host's; a velocity within ±MAX_SPEED [rad/s] goes with RUN."""
    return _DOWN.pack(order, _normal(velocity))


def status(said: Status) -> bytes:
    """What the device says; whatever does not fit is told as the nearest that does."""
    velocity = round(_cut(said.velocity, MAX_TOLD) / VELOCITY_UNIT)
    position = _normal(_cut(said.position, MAX_TURNED))
    return _UP.pack(said.mode, said.fault, velocity, position)


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


def _normal(value: float) -> float:
    """Without denormals and without a negative zero."""
    return value if abs(value) >= TINY else 0.0


def _cut(value: float, limit: float) -> float:
    return max(-limit, min(limit, value)) if math.isfinite(value) else 0.0
