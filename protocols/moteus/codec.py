"""Subframes ↔ the bytes of a CAN FD frame, and the identifiers of frames.

Rules. Little-endian. The most negative value of an integer register, and NaN in a binary32, mean "not given":
that is None here and stays in this folder; no number that is not finite is encoded (ValueError: our own
mistake) or decoded. −0.0 and denormals become 0.0. What the firmware would obey of a malformed frame precedes
the flaw, so `parse` returns that too, and whether the frame is well-formed. Source: mjbots/moteus@db1a762
`docs/protocol/can.md`; the rule for extended identifiers and padding: moteus 1.1.1 `transport.py`,
`transport_device.py`.
"""

from __future__ import annotations

import math
import struct
from dataclasses import dataclass
from typing import TypeAlias

from protocols.frames import CanFrame
from protocols.moteus.registers import scale_of

INT8, INT16, INT32, F32 = range(4)
_VALUE = tuple(struct.Struct(code) for code in ("<b", "<h", "<i", "<f"))
NOT_GIVEN = (-0x80, -0x8000, -0x80000000)
"""By resolution; in a binary32 it is NaN."""
LARGEST = (0x7F, 0x7FFF, 0x7FFFFFFF)

WRITE, READ, REPLY = 0x00, 0x10, 0x20
WRITE_ERROR, READ_ERROR = 0x30, 0x31
TO_DEVICE, FROM_DEVICE, POLL = 0x40, 0x41, 0x42
NOP = 0x50
MAX_COUNT = 128
"""Most registers in a valid subframe: no reply could hold more."""

BROADCAST = 0x7F
REPLY_BIT = 0x8000
STANDARD_MAX = 0x7FF
LENGTHS = frozenset({0, 1, 2, 3, 4, 5, 6, 7, 8, 12, 16, 20, 24, 32, 48, 64})
"""Bytes that a CAN FD frame can hold."""
PADDED = tuple(min(size for size in LENGTHS if size >= length) for length in range(65))

FLOAT_MAX = 3.4028234663852886e38
FLOAT_TINY = 2.0**-126
Raw: TypeAlias = int | float
"""A value as it is encoded: counts, or a binary32."""


@dataclass(frozen=True, slots=True)
class Values:
    """Values of the registers from `start` on, written or replied."""

    code: int
    """WRITE or REPLY."""
    start: int
    resolution: int
    raw: tuple[Raw, ...]


@dataclass(frozen=True, slots=True)
class Query:
    """A query for the registers from `start` on."""

    start: int
    resolution: int
    count: int


@dataclass(frozen=True, slots=True)
class Error:
    """A register that could not be written (WRITE_ERROR) or read (READ_ERROR)."""

    code: int
    register: int
    number: int


@dataclass(frozen=True, slots=True)
class Console:
    """A piece of the diagnostic console: to the device, from it, or a poll for its output."""

    code: int
    channel: int
    data: bytes = b""
    most: int = 0
    """Bytes requested by a POLL."""


Subframe: TypeAlias = Values | Query | Error | Console


# -- frames ------------------------------------------------------------------------------------------


def command_id(address: int, host: int = 0, prefix: int = 0) -> int:
    """Return the identifier of a frame to a device that it replies to."""
    return prefix << 16 | REPLY_BIT | host << 8 | address


def reply_id(address: int, host: int = 0, prefix: int = 0) -> int:
    """Return the identifier of a device's reply."""
    return prefix << 16 | address << 8 | host


def make_frame(identifier: int, data: bytes) -> CanFrame:
    """Return a CAN FD frame, padded with NOP to a valid length."""
    size = PADDED[len(data)]
    if size != len(data):
        data += b"\x50" * (size - len(data))
    return CanFrame(identifier, data, identifier > STANDARD_MAX, False, True, True)


# -- numbers -----------------------------------------------------------------------------------------


def normalise(value: float) -> float:
    """Return 0.0 for a negative zero and denormals."""
    return 0.0 if -FLOAT_TINY < value < FLOAT_TINY else value


def to_single(value: float) -> float:
    """Saturate and normalise to the range of binary32. Raises ValueError if it is not finite."""
    if -FLOAT_MAX <= value <= FLOAT_MAX:
        return normalise(value)
    if not math.isfinite(value):
        raise ValueError(f"{value} is not finite: it is never sent")
    return math.copysign(FLOAT_MAX, value)


def to_raw(register: int, resolution: int, value: float | None) -> Raw:
    """Encode a quantity: rounded to the nearest count, saturating; None is "not given"."""
    if resolution == F32:
        return math.nan if value is None else to_single(value)
    if value is None:
        return NOT_GIVEN[resolution]
    most = LARGEST[resolution]
    return max(-most, min(most, round(to_single(value) / scale_of(register)[resolution])))


def from_raw(register: int, resolution: int, raw: Raw) -> float | None:
    """Decode a quantity; None: not given. An infinity is not given either."""
    if resolution == F32:
        return to_single(raw) if math.isfinite(raw) else None
    return None if raw == NOT_GIVEN[resolution] else raw * scale_of(register)[resolution]


# -- encoding ----------------------------------------------------------------------------------------


def varuint(value: int) -> bytes:
    """Encode seven bits a byte, the lowest first."""
    out = bytearray()
    while value > 0x7F:
        out.append(value & 0x7F | 0x80)
        value >>= 7
    out.append(value)
    return bytes(out)


def header(code: int, start: int, resolution: int, count: int) -> bytes:
    """Return the header of a subframe: its first byte counts up to three registers."""
    first = code + (resolution << 2)
    if count <= 3:
        return bytes((first + count,)) + varuint(start)
    return bytes((first,)) + varuint(count) + varuint(start)


def encode(subframe: Subframe) -> bytes:
    """Return the bytes of one subframe."""
    match subframe:
        case Values(code, start, resolution, raw):
            packed = b"".join(_VALUE[resolution].pack(value) for value in raw)
            return header(code, start, resolution, len(raw)) + packed
        case Query(start, resolution, count):
            return header(READ, start, resolution, count)
        case Error(code, register, number):
            return bytes((code,)) + varuint(register) + varuint(number)
        case Console(code, channel, data, most):
            body = varuint(most) if code == POLL else varuint(len(data)) + data
            return bytes((code,)) + varuint(channel) + body


def write(start: int, *values: float | None, resolution: int = F32) -> bytes:
    """Return a subframe that writes quantities to the registers from `start` on."""
    raw = tuple(to_raw(start + i, resolution, value) for i, value in enumerate(values))
    return encode(Values(WRITE, start, resolution, raw))


# -- decoding ----------------------------------------------------------------------------------------


class _Malformed(Exception):
    """The bytes end too soon, or are no subframe."""


@dataclass(slots=True)
class _Reader:
    data: bytes
    at: int = 0

    def take(self, count: int) -> bytes:
        if self.at + count > len(self.data):
            raise _Malformed
        self.at += count
        return self.data[self.at - count : self.at]

    def byte(self) -> int:
        if self.at >= len(self.data):
            raise _Malformed
        self.at += 1
        return self.data[self.at - 1]

    def varuint(self) -> int:
        value = 0
        for shift in range(0, 35, 7):
            byte = self.byte()
            value |= (byte & 0x7F) << shift
            if not byte & 0x80:
                return value
        raise _Malformed

    def count(self, first: int) -> int:
        count = first & 0x03 or self.varuint()
        if count > MAX_COUNT:
            raise _Malformed
        return count


def parse(data: bytes) -> tuple[list[Subframe], bool]:
    """Return the subframes up to the first flaw, and whether there is none."""
    reader, out = _Reader(data), list[Subframe]()
    try:
        while reader.at < len(data):
            _parse_next(reader, out)
    except _Malformed:
        return out, False
    return out, True


def _parse_next(reader: _Reader, out: list[Subframe]) -> None:
    first = reader.byte()
    kind, resolution = first & 0xF0, first >> 2 & 0x03
    if kind in (WRITE, REPLY):
        _parse_values(reader, out, kind, resolution, reader.count(first))
    elif kind == READ:
        count = reader.count(first)
        out.append(Query(reader.varuint(), resolution, count))
    elif first in (WRITE_ERROR, READ_ERROR):
        out.append(Error(first, reader.varuint(), reader.varuint()))
    elif first in (TO_DEVICE, FROM_DEVICE):
        out.append(Console(first, reader.varuint(), reader.take(reader.varuint())))
    elif first == POLL:
        out.append(Console(first, reader.varuint(), b"", reader.varuint()))
    elif first != NOP:
        raise _Malformed


def _parse_values(reader: _Reader, out: list[Subframe], code: int, resolution: int, count: int) -> None:
    start, raw, value = reader.varuint(), list[Raw](), _VALUE[resolution]
    try:
        raw.extend(value.unpack(reader.take(value.size))[0] for _ in range(count))
    finally:  # what precedes the flaw is obeyed
        if raw:
            out.append(Values(code, start, resolution, tuple(raw)))
