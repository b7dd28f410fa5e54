"""Subframes ↔ the bytes of a CAN FD frame, identifiers, and the replies of a device.

Rules. Little-endian. The most negative value of an integer register, and NaN in a binary32, mean "not given":
that is None here and stays in this folder; no number that is not finite is encoded (ValueError: our own
mistake) or decoded. −0.0 and denormals become 0.0. What the firmware would obey of a malformed frame precedes
the flaw, so `parse` returns that too, and whether the frame is well-formed; a malformed reply has no meaning.
Source: mjbots/moteus@db1a762 `docs/protocol/can.md`; the rule for extended identifiers and padding: moteus
1.1.1 `transport.py`, `transport_device.py`.
"""

from __future__ import annotations

import math
import struct
from collections.abc import Mapping
from typing import NamedTuple, TypeAlias

from protocols.frames import CanFrame
from protocols.moteus.table import INTEGER, SCALES
from protocols.toolkit.table import FLOAT_MAX, TINY, saturated

INT8, INT16, INT32, F32 = range(4)
_CODES, _SIZES = "bhif", (1, 2, 4, 4)
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
ADDRESS_MAX = BROADCAST - 1
REPLY_BIT = 0x8000
STANDARD_MAX = 0x7FF
LENGTHS = (0, 1, 2, 3, 4, 5, 6, 7, 8, 12, 16, 20, 24, 32, 48, 64)
"""Bytes that a CAN FD frame can hold."""
_PADDED = tuple(min(size for size in LENGTHS if size >= length) for length in range(65))
SERIAL_BYTES = 8
"""A serial number is the first 8 bytes of a UUID, its first 16 digits as printed."""

Raw: TypeAlias = int | float
"""A value as it is encoded: counts, or a binary32."""


class Subframe(NamedTuple):
    """One subframe. What its kind does not have is 0 or empty."""

    code: int
    """WRITE … POLL, without resolution and count."""
    register: int = 0
    """The first register; of the diagnostic console, the channel."""
    resolution: int = 0
    raw: tuple[Raw, ...] = ()
    """Values of the registers from the first on, written or replied."""
    number: int = 0
    """READ: how many registers; POLL: how many bytes; of an error: its number."""
    data: bytes = b""
    """Of the console."""


# -- frames ------------------------------------------------------------------------------------------


def command_id(address: int, host: int = 0, prefix: int = 0) -> int:
    """Return the identifier of a frame to a device that it replies to."""
    return prefix << 16 | REPLY_BIT | host << 8 | address


def reply_id(address: int, host: int = 0, prefix: int = 0) -> int:
    """Return the identifier of a device's reply."""
    return prefix << 16 | address << 8 | host


def make_frame(identifier: int, data: bytes) -> CanFrame:
    """Return a CAN FD frame, padded with NOP to a valid length."""
    size = _PADDED[len(data)]
    if size != len(data):
        data += b"\x50" * (size - len(data))
    return CanFrame(identifier, data, identifier > STANDARD_MAX, False, True, True)


def serial_of(uuid: bytes) -> int:
    """Return the serial number in messages."""
    return int.from_bytes(uuid[:SERIAL_BYTES], "big")


# -- numbers -----------------------------------------------------------------------------------------


def to_single(value: float) -> float:
    """Saturate and normalise to the range of binary32. Raises ValueError if it is not finite."""
    if -FLOAT_MAX <= value <= FLOAT_MAX:
        return 0.0 if -TINY < value < TINY else value
    return saturated(value, -FLOAT_MAX, FLOAT_MAX)


def to_raw(register: int, resolution: int, value: float | None) -> Raw:
    """Encode a quantity: rounded to the nearest count, saturating; None is "not given"."""
    if resolution == F32:
        return math.nan if value is None else to_single(value)
    if value is None:
        return NOT_GIVEN[resolution]
    most, count = LARGEST[resolution], SCALES.get(register, INTEGER)[resolution]
    return max(-most, min(most, round(to_single(value) / count)))


def from_raw(register: int, resolution: int, raw: Raw) -> float | None:
    """Decode a quantity; None: not given. An infinity is not given either."""
    if resolution == F32:
        return to_single(raw) if math.isfinite(raw) else None
    return None if raw == NOT_GIVEN[resolution] else raw * SCALES.get(register, INTEGER)[resolution]


def quantities(subframe: Subframe) -> list[tuple[int, float | None]]:
    """Return the registers in a write or reply, and their quantities."""
    resolution = subframe.resolution
    return [(at, from_raw(at, resolution, raw)) for at, raw in enumerate(subframe.raw, subframe.register)]


# -- encoding ----------------------------------------------------------------------------------------


def varuint(value: int) -> bytes:
    """Encode seven bits a byte, the lowest first."""
    out = bytearray()
    while value > 0x7F:
        out.append(value & 0x7F | 0x80)
        value >>= 7
    return bytes((*out, value))


def header(code: int, register: int, resolution: int, count: int) -> bytes:
    """Return the header of a subframe of registers: its first byte counts up to three."""
    first = code + (resolution << 2)
    head = bytes((first + count,)) if count <= 3 else bytes((first,)) + varuint(count)
    return head + varuint(register)


def encode(subframe: Subframe) -> bytes:
    """Return the bytes of one subframe."""
    code, register, resolution, raw, number, data = subframe
    if code in (WRITE, REPLY):
        return header(code, register, resolution, len(raw)) + struct.pack(
            f"<{len(raw)}{_CODES[resolution]}", *raw
        )
    if code == READ:
        return header(code, register, resolution, number)
    return bytes((code,)) + varuint(register) + varuint(len(data) or number) + data


def write(register: int, *values: float | None, resolution: int = F32) -> bytes:
    """Return a subframe that writes quantities to the registers from the first on."""
    raw = tuple(to_raw(register + at, resolution, value) for at, value in enumerate(values))
    return encode(Subframe(WRITE, register, resolution, raw))


def read(register: int, resolution: int = F32, count: int = 1) -> bytes:
    """Return a query for the registers from the first on."""
    return header(READ, register, resolution, count)


# -- decoding ----------------------------------------------------------------------------------------


def _varuint(data: bytes, at: int) -> tuple[int, int]:
    """Return a number and where it ends. Raises IndexError if it does not end, or is too long."""
    value = 0
    for shift in range(0, 35, 7):
        value |= (data[at] & 0x7F) << shift
        at += 1
        if not data[at - 1] & 0x80:
            return value, at
    raise IndexError


def parse(data: bytes) -> tuple[list[Subframe], bool]:
    """Return the subframes up to the first flaw, and whether there is none."""
    out, at = list[Subframe](), 0
    try:
        while at < len(data):
            at = _parse_next(data, at, out)
    except IndexError:  # the data end too soon, or this is no subframe
        return out, False
    return out, True


def _parse_next(data: bytes, at: int, out: list[Subframe]) -> int:
    """Parse one subframe. Returns where it ends. Raises IndexError at a flaw."""
    first, at = data[at], at + 1
    kind, resolution = first & 0xF0, first >> 2 & 0x03
    if first == NOP:
        return at
    if kind in (WRITE, READ, REPLY):
        count, at = (first & 0x03, at) if first & 0x03 else _varuint(data, at)
        register, at = _varuint(data, at)
        if count > MAX_COUNT:
            raise IndexError
        if kind == READ:
            out.append(Subframe(READ, register, resolution, number=count))
            return at
        whole = min(count, (len(data) - at) // _SIZES[resolution])
        if whole:  # what precedes a flaw is obeyed
            raw = struct.unpack_from(f"<{whole}{_CODES[resolution]}", data, at)
            out.append(Subframe(kind, register, resolution, raw))
        end = at + count * _SIZES[resolution]
    elif first in (WRITE_ERROR, READ_ERROR, TO_DEVICE, FROM_DEVICE, POLL):
        register, at = _varuint(data, at)
        number, end = _varuint(data, at)
        if first in (TO_DEVICE, FROM_DEVICE):
            at, end = end, end + number
            if end <= len(data):
                out.append(Subframe(first, register, data=data[at:end]))
        else:
            out.append(Subframe(first, register, number=number))
    else:
        raise IndexError
    if end > len(data):
        raise IndexError
    return end


# -- replies -----------------------------------------------------------------------------------------


class Reply(NamedTuple):
    """One frame of a device: its registers, the registers that it could not read or write, console output."""

    values: Mapping[int, float | None]
    errors: tuple[Subframe, ...] = ()
    console: bytes = b""


def decode(data: bytes) -> Reply | None:
    """Decode a device's frame; None if it is malformed or no reply.

    The replies to the two queries that are sent all the time have known lengths and layouts, and are decoded
    without a loop, to the same result."""
    if len(data) == _FAST.size or len(data) == _FULL.size:
        values = _fast(data) if len(data) == _FAST.size else _full(data)
        if values is not None:
            return Reply(values)
    if len(data) not in LENGTHS:
        return None
    subframes, well_formed = parse(data)
    return _reply(subframes) if well_formed else None


def _reply(subframes: list[Subframe]) -> Reply | None:
    values: dict[int, float | None] = {}
    errors: list[Subframe] = []
    console = b""
    for subframe in subframes:
        if subframe.code == REPLY:
            if any(map(math.isinf, subframe.raw)):
                return None
            values.update(quantities(subframe))
        elif subframe.code in (WRITE_ERROR, READ_ERROR):
            errors.append(subframe)
        elif subframe.code == FROM_DEVICE:
            console += subframe.data
        else:
            return None
    return Reply(values, tuple(errors), console)


_FAST = struct.Struct("<2sb2sfff2sb")
"""Mode as int8; position, velocity, torque as binary32; fault as int8."""
_FULL = struct.Struct("<2sb3sffff3shhhhhh11s")
"""Current as well; as int16 motor temperature, trajectory, home state, voltage, temperature, fault."""


def _fast(data: bytes) -> dict[int, float | None] | None:
    a, mode, b, position, velocity, torque, c, fault = _FAST.unpack(data)
    if a != b"\x21\x00" or b != b"\x2f\x01" or c != b"\x21\x0f" or mode == -128 or fault == -128:
        return None
    if not math.isfinite(position + velocity + torque):
        return None
    return {
        0: mode,
        1: 0.0 if -TINY < position < TINY else position,
        2: 0.0 if -TINY < velocity < TINY else velocity,
        3: 0.0 if -TINY < torque < TINY else torque,
        0x0F: fault,
    }


def _full(data: bytes) -> dict[int, float | None] | None:
    a, mode, b, *floats, c, h0, h1, h2, h3, h4, h5, padding = _FULL.unpack(data)
    if a != b"\x21\x00" or b != b"\x2c\x04\x01" or c != b"\x24\x06\x0a" or padding != b"\x50" * 11:
        return None
    if mode == -128 or not math.isfinite(sum(floats)):
        return None
    values: dict[int, float | None] = {0: mode}
    values.update(enumerate(map(to_single, floats), 1))
    for register, value in enumerate((h0, h1, h2, h3, h4, h5), 0x0A):
        values[register] = from_raw(register, INT16, value)
    return values
