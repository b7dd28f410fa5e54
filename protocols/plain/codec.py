"""Messages on a plain line: words between sync bytes and a CRC, for the device at an address.

Rules of this file. `message` raises ValueError for what must not stand on the wire (our mistake); `Stream`
and `read` take any bytes and never raise. All numbers are little-endian:

    A5 57 | length u16 | length XOR FFFF u16 | body: address u8, packed word | CRC-32 u32 of the body

−0.0, and what is smaller than any normal binary32, stands as 0.0 and is read as 0.0.

In the body the word's own name (motor, sensor, bus, name) stands empty, since the address tells it, and
`t` holds the age of the measurement in ns when it was sent. CRC-32 is that of zlib and Ethernet
(reflected 0x04C11DB7). The complement lets a false or damaged length be seen at once, so that a reader
never waits for a message that does not come. `length` counts the body and is at most `MAX_BODY`.
"""

from __future__ import annotations

import struct
import zlib
from collections.abc import Sequence
from dataclasses import dataclass, fields
from typing import Any, TypeAlias

from protocols import messages
from protocols.message_codec import CODES, Kind, kind_of, pack_fields, unpack_fields
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
"""What one motor may be asked."""
LineRequest: TypeAlias = messages.Scan | messages.SetId
"""What the whole line may be asked."""
EVERYONE = 0
"""The address to which all devices listen (Scan, SetId); a device has one of 1 … 255."""
MAX_BODY = 0x4000
"""Bytes in the body of one message: a scan of some 2,000 beams."""
MAX_AGE: Nanos = 10 * messages.SECOND
"""Nothing that is sent is older; a message that says so is bad."""

TINY = 2.0**-126
"""Smallest normal binary32: no device means anything by less."""

_HEAD = struct.Struct("<2sHH")
_TAIL = struct.Struct("<I")

# -- what a message may say ----------------------------------------------------------------------------

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
"""What a number may be on the wire, in the unit of `protocols.messages`. A sender refuses what lies
outside, a receiver takes it for bad. Packed words in recordings know no limits."""

_LIMITED: dict[int, list[tuple[int, str, float, float]]] = {
    code: [
        (at, f.name, *LIMITS[f"{word.__name__}.{f.name}"])
        for at, f in enumerate(fields(word))
        if f"{word.__name__}.{f.name}" in LIMITS
    ]
    for code, word in CODES.items()
}
"""The same by code: place of the field, its name, lowest and highest."""


def _outside(kind: Kind, values: Sequence[Any]) -> str:
    """Which of a word's values may not stand in a message, as a sentence; "" if all may."""
    for at, name, low, high in _LIMITED[kind.code]:
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
    """−0.0 and what is smaller than `TINY` become 0.0."""
    for at, value in enumerate(values):
        if type(value) is float:
            if -TINY < value < TINY:
                values[at] = 0.0
        elif type(value) is tuple and not (value and min(value) >= TINY):  # a scan seldom needs the slow look
            values[at] = tuple([0.0 if -TINY < number < TINY else number for number in value])


# -- messages on a stream ------------------------------------------------------------------------------


def message(address: int, word: Message, now: Nanos = 0) -> bytes:
    """A word to or from the device at this address, as it stands on a stream.

    `now` is the moment of sending: a measurement's `t` becomes its age. Raises ValueError as `pack`
    does, and for a number outside `LIMITS`, an address outside 0 … 255 or a body that is too long."""
    kind = kind_of(word)
    values = list(kind.get(word))
    if wrong := _outside(kind, values):
        raise ValueError(f"{kind.word.__name__}: {wrong}")
    _normalise(values)
    if kind.name is not None:
        values[kind.name] = ""
    if kind.time is not None:
        values[kind.time] = min(max(now - values[kind.time], 0), MAX_AGE)
    if not 0 <= address <= 0xFF:
        raise ValueError(f"address {address} is not in 0 … 255")
    return frame(bytes((address,)) + pack_fields(kind, values))


def frame(body: bytes) -> bytes:
    """A body between sync, length and CRC."""
    if not 1 <= len(body) <= MAX_BODY:
        raise ValueError(f"a body of {len(body)} bytes; it may have 1 … {MAX_BODY}")
    return _HEAD.pack(SYNC, len(body), len(body) ^ 0xFFFF) + body + _TAIL.pack(zlib.crc32(body))


def read(body: bytes, t: Nanos, name: str) -> Message | None:
    """The word in a message's body, about the device called `name`, that came in at `t`; or None."""
    found = unpack_fields(body[1:])
    if found is None:
        return None
    kind, values = found
    if _outside(kind, values):
        return None
    _normalise(values)
    if kind.name is not None:
        values[kind.name] = name
    if kind.time is not None:
        if not 0 <= values[kind.time] <= MAX_AGE:
            return None
        values[kind.time] = t - values[kind.time]
    return kind.word(*values)


@dataclass(slots=True)
class Stream:
    """Takes a stream apart into bodies, however it was cut. Holds at most one message's bytes.

    What is not a message is skipped and counted: `bad` once for each message whose CRC is wrong,
    `noise` once for each run of other bytes between two messages. A message behind either is found,
    since after a wrong CRC the search goes on right behind the sync bytes."""

    bad: int = 0
    noise: int = 0
    _held: bytes = b""
    _skipping: bool = False
    """Whether the run of bytes that is being skipped has been counted."""

    def feed(self, data: bytes) -> list[bytes]:
        """The bodies of the messages that are complete with these bytes."""
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
        """Forget a message begun: the line was interrupted, its rest will not come."""
        self._held, self._skipping = b"", False

    def _find(self, held: bytes, at: int) -> int:
        """Where the next message may begin; whatever lies before is noise."""
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
    """Whether what is there of a head is right so far."""
    if len(held) - start < _HEAD.size:
        return SYNC.startswith(held[start : start + len(SYNC)])
    sync, length, complement = _HEAD.unpack_from(held, start)
    return bool(sync == SYNC and length ^ complement == 0xFFFF and 1 <= length <= MAX_BODY)


def _length(held: bytes, start: int) -> int | None:
    """The size of the whole message that begins here, or None if it is not all there."""
    if len(held) - start < _HEAD.size:
        return None
    size: int = _HEAD.size + _HEAD.unpack_from(held, start)[1] + _TAIL.size
    return size if len(held) - start >= size else None
