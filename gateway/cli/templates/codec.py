"""Payloads ↔ values: what the bytes of a message mean. No messages of the gateway, no time, no state.

Rules. Encoding takes values that a payload can hold; decoding takes any bytes of the right length, returns
None for what is malformed, and never raises. A number that is not finite or out of range is malformed.

FILL IN, this file first, from the manual. The clauses "bytes", "counts" and "vectors" check it. The payloads
of the invented device have 8 bytes, little-endian:

    command   order u8, 0 0 0, velocity f32 [rad/s]
    status    mode u8, fault u8, velocity i16 [0.01 rad/s], position f32 [rad]

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
"""rad/s, the largest velocity in a command"""
VELOCITY_UNIT = 0.01
"""rad/s"""
MAX_MEASURED_SPEED = 327.67
"""rad/s, the largest velocity in a status"""
MAX_POSITION = 1e6
"""rad, the largest position in a status"""
TINY = 2.0**-126
"""The smallest normal float32: what is smaller is encoded as zero."""
STATUS_PERIOD: Nanos = 10 * MILLISECOND
WATCHDOG, TOO_HOT = 1, 2
"""Codes of its faults; 0 is none."""

_COMMAND = struct.Struct("<Bxxxf")
_STATUS = struct.Struct("<BBhf")


class Order(IntEnum):
    """What a command demands."""

    STOP = 0
    RUN = 1
    CLEAR = 2


class DeviceMode(IntEnum):
    """The state of the device."""

    READY = 0
    RUNNING = 1
    FAULT = 2


@dataclass(frozen=True, slots=True)
class Status:
    """The status that the device sends."""

    mode: DeviceMode
    fault: int
    velocity: float
    """rad/s"""
    position: float
    """rad"""


def encode_command(order: Order, velocity: float = 0.0) -> bytes:
    """Encode a command; a velocity within ±MAX_SPEED [rad/s] goes with RUN."""
    return _COMMAND.pack(order, _normalise(velocity))


def encode_status(status: Status) -> bytes:
    """Encode a status, each value limited to what the payload can hold."""
    velocity = round(_clamp(status.velocity, MAX_MEASURED_SPEED) / VELOCITY_UNIT)
    position = _normalise(_clamp(status.position, MAX_POSITION))
    return _STATUS.pack(status.mode, status.fault, velocity, position)


def decode_command(payload: bytes) -> tuple[Order, float] | None:
    """Return the order and its velocity [rad/s]; None if the device would not obey."""
    order, velocity = _COMMAND.unpack(payload)
    if order not in tuple(Order) or not abs(velocity) <= MAX_SPEED * (1 + 2.0**-24):
        return None
    return Order(order), _normalise(velocity)


def decode_status(payload: bytes) -> Status | None:
    """Return the status; None if no device can have sent it."""
    mode, fault, velocity, position = _STATUS.unpack(payload)
    if mode not in tuple(DeviceMode) or not abs(position) <= MAX_POSITION:
        return None
    if fault not in ((WATCHDOG, TOO_HOT) if mode == DeviceMode.FAULT else (0,)) or velocity == -0x8000:
        return None
    return Status(DeviceMode(mode), fault, velocity * VELOCITY_UNIT, _normalise(position))


def _normalise(value: float) -> float:
    """Return 0.0 for denormals and a negative zero."""
    return value if abs(value) >= TINY else 0.0


def _clamp(value: float, limit: float) -> float:
    return max(-limit, min(limit, value)) if math.isfinite(value) else 0.0
