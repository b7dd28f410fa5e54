"""Framing on a plain serial line: one message between sync bytes and a CRC, to or from a device address.

Rules. `encode` raises ValueError for what must not be sent (our mistake); `Stream` and `decode` take any
bytes and never raise. All numbers are little-endian:

    A5 57 | length u16 | length XOR FFFF u16 | body: address u8, packed message | CRC-32 u32 of the body

−0.0, and what is smaller than any normal binary32, is sent as 0.0 and decoded as 0.0.

In the body the name of the device or bus (motor, sensor, bus, name) is empty, since the address identifies
it, and `t` is the age of the measurement [ns] when it was sent. CRC-32 is that of zlib and Ethernet
(reflected 0x04C11DB7). The complement reveals a false or damaged length at once, so that a receiver never
waits for a message that does not come. `length` counts the body and is at most `MAX_BODY`.
"""

from __future__ import annotations

import struct
import zlib
from collections.abc import Sequence
from dataclasses import dataclass, fields
from typing import Any, TypeAlias

from protocols import messages
from protocols.message_codec import CODES, Layout, layout_of, pack_fields, unpack_fields
from protocols.messages import Message, Nanos

NAME = "plain"
SYNC = b"\xa5\x57"
MotorRequest: TypeAlias = (
    messages.ClearFault
    | messages.Estop
    | messages.Zero
    | messages.ReadParameter
    | messages.WriteParameter
    | messages.Reboot
)
"""Requests to one motor."""
BroadcastRequest: TypeAlias = messages.Scan | messages.SetId
"""Requests to all devices on the line."""
BROADCAST = 0
"""The address to which all devices listen (Scan, SetId); a device has one of 1 … 255."""
MAX_BODY = 0x4000
"""Bytes in the body of one message: a scan of some 2,000 beams."""
MAX_AGE: Nanos = 10 * messages.SECOND
"""Largest age of a measurement; a message with a larger one is malformed."""
TINY = 2.0**-126
"""Smallest normal binary32: no device means anything by less."""

_HEAD = struct.Struct("<2sHH")
_TAIL = struct.Struct("<I")

# -- permitted values ----------------------------------------------------------------------------------

LIMITS: dict[str, tuple[float, float]] = {
    "Position.position": (-1e6, 1e6),
    "Position.velocity": (-1e5, 1e5),
    "Position.torque": (-1e4, 1e4),
    "Velocity.velocity": (-1e5, 1e5),
    "Velocity.torque": (-1e4, 1e4),
    "Torque.torque": (-1e4, 1e4),
    "Impedance.position": (-1e6, 1e6),
    "Impedance.velocity": (-1e5, 1e5),
    "Impedance.torque": (-1e4, 1e4),
    "Impedance.stiffness": (0.0, 1e6),
    "Impedance.damping": (0.0, 1e5),
    "Feedback.position": (-1e6, 1e6),
    "Feedback.velocity": (-1e5, 1e5),
    "Feedback.torque": (-1e4, 1e4),
    "Feedback.current": (-1e5, 1e5),
    "Feedback.voltage": (-1e4, 1e4),
    "Feedback.temperature": (-273.15, 1e4),
    "Imu.angular_velocity": (-1e4, 1e4),
    "Imu.linear_acceleration": (-1e5, 1e5),
    "Imu.orientation": (-1.001, 1.001),
    "LaserScan.angle_min": (-1e3, 1e3),
    "LaserScan.angle_increment": (-1e3, 1e3),
    "LaserScan.range_min": (0.0, 1e6),
    "LaserScan.range_max": (0.0, 1e6),
    "LaserScan.ranges": (0.0, 1e6),
    "Fix.latitude": (-90.0, 90.0),
    "Fix.longitude": (-180.0, 180.0),
    "Fix.altitude": (-1e7, 1e7),
    "Fix.variance": (0.0, 1e15),
}
"""Permitted values on the line, by "Message.field", in the units of `protocols.messages`. A sender refuses to
encode what lies outside, a receiver takes it for malformed. Packed messages in recordings have no limits."""

_LIMITED: dict[int, list[tuple[int, str, float, float]]] = {
    code: [
        (at, f.name, *LIMITS[f"{kind.__name__}.{f.name}"])
        for at, f in enumerate(fields(kind))
        if f"{kind.__name__}.{f.name}" in LIMITS
    ]
    for code, kind in CODES.items()
}
"""The same by message code: index of the field, its name, lowest and highest value."""


def _out_of_limits(layout: Layout, values: Sequence[Any]) -> str:
    """Return which field of a message lies outside `LIMITS`, as a sentence; "" if none does."""
    for at, name, low, high in _LIMITED[layout.code]:
        value = values[at]
        if value is None:
            continue
        if type(value) is tuple:
            inside = not value or (low <= min(value) and max(value) <= high)
        else:
            inside = low <= value <= high
        if not inside:
            return f"{name} {value!r} is not in {low:g} … {high:g}"
    return ""


def _normalise(values: list[Any]) -> None:
    """Replace −0.0 and what is smaller than `TINY` by 0.0."""
    for at, value in enumerate(values):
        if type(value) is float:
            if -TINY < value < TINY:
                values[at] = 0.0
        elif type(value) is tuple and not (value and min(value) >= TINY):  # most scans skip the slow path
            values[at] = tuple([0.0 if -TINY < number < TINY else number for number in value])


# -- one message ---------------------------------------------------------------------------------------


def encode(address: int, message: Message, now: Nanos = 0) -> bytes:
    """Encode a message to or from the device at this address, framed.

    `now` is the time of sending: a measurement's `t` becomes its age. Raises ValueError as `pack` does, and
    for a number outside `LIMITS`, an address outside 0 … 255 or a body that is too long."""
    layout = layout_of(message)
    values = list(layout.values(message))
    if wrong := _out_of_limits(layout, values):
        raise ValueError(f"{layout.message_type.__name__}: {wrong}")
    _normalise(values)
    if layout.name is not None:
        values[layout.name] = ""
    if layout.time is not None:
        values[layout.time] = min(max(now - values[layout.time], 0), MAX_AGE)
    if not 0 <= address <= 0xFF:
        raise ValueError(f"address {address} is not in 0 … 255")
    return frame(bytes((address,)) + pack_fields(layout, values))


def frame(body: bytes) -> bytes:
    """Put a body between sync bytes, length and CRC. Raises ValueError for an empty or too long one."""
    if not 1 <= len(body) <= MAX_BODY:
        raise ValueError(f"a body of {len(body)} bytes; it may have 1 … {MAX_BODY}")
    return _HEAD.pack(SYNC, len(body), len(body) ^ 0xFFFF) + body + _TAIL.pack(zlib.crc32(body))


def decode(body: bytes, t: Nanos, name: str) -> Message | None:
    """Decode the body of a message of the device called `name`, received at `t`; None if it is malformed."""
    unpacked = unpack_fields(body[1:])
    if unpacked is None:
        return None
    layout, values = unpacked
    if _out_of_limits(layout, values):
        return None
    _normalise(values)
    if layout.name is not None:
        values[layout.name] = name
    if layout.time is not None:
        if not 0 <= values[layout.time] <= MAX_AGE:
            return None
        values[layout.time] = t - values[layout.time]
    return layout.message_type(*values)


# -- messages on a stream ------------------------------------------------------------------------------


@dataclass(slots=True)
class Stream:
    """Splits a byte stream into message bodies, however it was cut. Holds at most one message's bytes.

    What is not a message is skipped and counted: `bad` once for each message whose CRC is wrong, `noise`
    once for each run of other bytes between two messages. A message behind either is found, since after a
    wrong CRC the search goes on right behind the sync bytes."""

    bad: int = 0
    noise: int = 0
    _held: bytes = b""
    _skipping: bool = False
    """The run of bytes that is being skipped has been counted."""

    def feed(self, data: bytes) -> list[bytes]:
        """Return the bodies of the messages that these bytes complete."""
        held, at, bodies = self._held + data, 0, []
        while True:
            start = self._find(held, at)
            size = _length(held, start)
            if size is None:
                break
            body = held[start + _HEAD.size : start + size - _TAIL.size]
            if _TAIL.unpack_from(held, start + size - _TAIL.size)[0] == zlib.crc32(body):
                bodies.append(body)
                self._skipping = False
                at = start + size
            else:
                self.bad += 1
                self._skipping = True
                at = start + len(SYNC)
        self._held = held[start:]
        return bodies

    def drop(self) -> None:
        """Discard a partial message: the line was interrupted, its rest will not come."""
        self._held, self._skipping = b"", False

    def _find(self, held: bytes, at: int) -> int:
        """Return where the next message may begin; whatever lies before is noise."""
        start = at
        while True:
            start = held.find(SYNC[0], start)
            if start < 0:
                start = len(held)
                break
            if _may_begin(held, start):
                break
            start += 1
        if start > at and not self._skipping:
            self.noise += 1
            self._skipping = True
        return start


def _may_begin(held: bytes, start: int) -> bool:
    """True if the part of a header that is there is valid so far."""
    if len(held) - start < _HEAD.size:
        return SYNC.startswith(held[start : start + len(SYNC)])
    sync, length, complement = _HEAD.unpack_from(held, start)
    return bool(sync == SYNC and length ^ complement == 0xFFFF and 1 <= length <= MAX_BODY)


def _length(held: bytes, start: int) -> int | None:
    """Return the size of the message that begins here, or None if it is not complete."""
    if len(held) - start < _HEAD.size:
        return None
    size: int = _HEAD.size + _HEAD.unpack_from(held, start)[1] + _TAIL.size
    return size if len(held) - start >= size else None
