"""Subframes ↔ the bytes of a CAN FD frame, identifiers, and the replies of a device.

Rules. Little-endian. The most negative value of an integer register, and NaN in a binary32, mean "not given":
that is None here; no number that is not finite is encoded (ValueError: our own mistake) or decoded. −0.0 and
denormals become 0.0. What the firmware would obey of a malformed frame precedes the flaw, so `parse` returns
that too, and whether the frame is well-formed; a malformed reply has no meaning. Sources:
mjbots/moteus@db1a762 `docs/protocol/can.md`, `fw/fdcan_micro_server.h` (formats of replies); extended
identifiers and padding: moteus 1.1.1 `transport.py`, `transport_device.py`.
"""

from __future__ import annotations

import math
import struct
from collections.abc import Mapping
from dataclasses import replace
from typing import NamedTuple, TypeAlias

from protocols.frames import CanFrame
from protocols.moteus.table import INTEGER, SCALES
from protocols.toolkit.table import FLOAT_MAX, TINY, saturated

INT8, INT16, INT32, F32 = range(4)
CODES, SIZES = "bhif", (1, 2, 4, 4)
LARGEST = (0x7F, 0x7FFF, 0x7FFFFFFF)
"""Counts, by resolution; the most negative number, one less than its opposite, is "not given"."""
WRITE, READ, REPLY, WRITE_ERROR, READ_ERROR = 0x00, 0x10, 0x20, 0x30, 0x31
TO_DEVICE, FROM_DEVICE, POLL, NOP = 0x40, 0x41, 0x42, 0x50
MAX_COUNT = 128  # registers in a valid subframe: no reply could hold more
BROADCAST = 0x7F
ADDRESS_MAX = BROADCAST - 1
REPLY_BIT = 0x8000
STANDARD_MAX = 0x7FF
LENGTHS = (0, 1, 2, 3, 4, 5, 6, 7, 8, 12, 16, 20, 24, 32, 48, 64)
"""Bytes that a CAN FD frame can hold."""
_PADDED = tuple(min(size for size in LENGTHS if size >= length) for length in range(65))
SERIAL_BYTES = 8  # a serial number is the first of a UUID, its first 16 digits as printed
Raw: TypeAlias = int | float  # a value as it is encoded: counts, or a binary32


class Subframe(NamedTuple):
    """One subframe. What its kind does not have is 0 or empty."""

    code: int  # WRITE … POLL, without resolution and count
    register: int = 0  # the first register; of the diagnostic console, the channel
    resolution: int = 0
    raw: tuple[Raw, ...] = ()  # values of the registers from the first on, written or replied
    number: int = 0  # READ: how many registers; POLL: how many bytes; of an error: its number
    data: bytes = b""  # of the console

    def quantities(self) -> list[tuple[int, float | None]]:
        """Return the registers of a write or reply, and what they hold."""
        start, resolution = self.register, self.resolution
        return [(at, from_raw(at, resolution, raw)) for at, raw in enumerate(self.raw, start)]


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


def make_reply(identifier: int, data: bytes, query: CanFrame) -> CanFrame:
    """Return the reply to a query: in its format, unless that is classic and the data need CAN FD, and with a
    rate switch only if the query had one."""
    return replace(make_frame(identifier, data), fd=query.fd or len(data) > 8, brs=query.brs)


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
    most = LARGEST[resolution]
    if value is None:
        return -most - 1
    return max(-most, min(most, round(to_single(value) / SCALES.get(register, INTEGER)[resolution])))


def from_raw(register: int, resolution: int, raw: Raw) -> float | None:
    """Decode a quantity; None: not given. An infinity is not given either."""
    if resolution == F32:
        return to_single(raw) if math.isfinite(raw) else None
    return None if raw < -LARGEST[resolution] else raw * SCALES.get(register, INTEGER)[resolution]


# -- encoding ----------------------------------------------------------------------------------------


def varuint(value: int) -> bytes:
    """Encode seven bits a byte, the lowest first."""
    return bytes((value,)) if value <= 0x7F else bytes((value & 0x7F | 0x80,)) + varuint(value >> 7)


def header(code: int, register: int, resolution: int, count: int) -> bytes:
    """Return the header of a subframe of registers: its first byte counts up to three."""
    first = code + (resolution << 2)
    head = bytes((first + count,)) if count <= 3 else bytes((first,)) + varuint(count)
    return head + varuint(register)


def encode(subframe: Subframe) -> bytes:
    """Return the bytes of one subframe."""
    code, register, resolution, raw, number, data = subframe
    if code in (WRITE, READ, REPLY):
        packed = struct.pack(f"<{len(raw)}{CODES[resolution]}", *raw)
        return header(code, register, resolution, number or len(raw)) + packed
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
    for count in range(5):
        value |= (data[at + count] & 0x7F) << 7 * count
        if not data[at + count] & 0x80:
            return value, at + count + 1
    raise IndexError


def parse(data: bytes) -> tuple[list[Subframe], bool]:
    """Return the subframes up to the first flaw, and whether there is none."""
    out: list[Subframe] = []
    at = 0
    try:
        while at < len(data):
            at = at + 1 if data[at] == NOP else _parse_next(data, at, out)
    except IndexError:  # the data end too soon, or this is no subframe
        return out, False
    return out, at == len(data)


def _parse_next(data: bytes, at: int, out: list[Subframe]) -> int:
    """Parse one subframe. Returns where it ends, or should. Raises IndexError at a flaw."""
    first = data[at]
    code, resolution, count = first & 0xF0, first >> 2 & 0x03, first & 0x03
    if code not in (WRITE, READ, REPLY):
        if first not in (WRITE_ERROR, READ_ERROR, TO_DEVICE, FROM_DEVICE, POLL):
            raise IndexError
        register, at = _varuint(data, at + 1)
        number, at = _varuint(data, at)
        end = at + number if first in (TO_DEVICE, FROM_DEVICE) else at
        if end <= len(data):
            out.append(Subframe(first, register, number=number, data=data[at:end]))
        return end
    count, at = (count, at + 1) if count else _varuint(data, at + 1)
    register, at = _varuint(data, at)
    if count > MAX_COUNT:
        raise IndexError
    if code == READ:
        out.append(Subframe(READ, register, resolution, number=count))
        return at
    whole = min(count, (len(data) - at) // SIZES[resolution])
    if whole:  # what precedes a flaw is obeyed
        raw = struct.unpack_from(f"<{whole}{CODES[resolution]}", data, at)
        out.append(Subframe(code, register, resolution, raw))
    return at + count * SIZES[resolution]


# -- replies -----------------------------------------------------------------------------------------


class Reply(NamedTuple):
    """One frame of a device: its registers, and the registers that it could not read or write."""

    values: Mapping[int, float | None]
    errors: tuple[Subframe, ...] = ()

    def error(self, code: int, register: int) -> int:
        """Return the number of the error of this kind about a register; 0: none."""
        return next((e.number for e in self.errors if (e.code, e.register) == (code, register)), 0)


_FAST = struct.Struct("<2sb2sfff2sb")
"""Mode as int8; position, velocity, torque as binary32; fault as int8."""
_FULL = struct.Struct("<2sb3s4f3s6h11s")
"""Current as well; as int16 motor temperature, trajectory, home state, voltage, temperature, fault."""
_HEADS = (b"\x21\x00", b"\x2c\x04\x01", b"\x24\x06\x0a", b"\x50" * 11)


def decode(data: bytes) -> Reply | None:
    """Decode a device's frame; None if it is malformed or no reply. The replies to the two queries that are
    sent all the time have known layouts, and are decoded without a loop, to the same result."""
    if len(data) == _FAST.size:
        a, mode, b, position, velocity, torque, c, fault = _FAST.unpack(data)
        usual = a == b"\x21\x00" and b == b"\x2f\x01" and c == b"\x21\x0f" and mode != -128 and fault != -128
        if usual and math.isfinite(position + velocity + torque):
            position = 0.0 if -TINY < position < TINY else position
            velocity = 0.0 if -TINY < velocity < TINY else velocity
            torque = 0.0 if -TINY < torque < TINY else torque
            return Reply({0: mode, 1: position, 2: velocity, 3: torque, 0x0F: fault})
    if len(data) == _FULL.size:
        a, mode, b, *floats, c, winding, done, home, voltage, board, fault, rest = _FULL.unpack(data)
        given = -0x8000 not in (winding, done, home, voltage, board, fault) and mode != -128
        if given and (a, b, c, rest) == _HEADS and math.isfinite(sum(floats)):
            values = {0: mode, **dict(enumerate(map(to_single, floats), 1)), 0x0A: winding * 0.1, 0x0B: done}
            return Reply(values | {0x0C: home, 0x0D: voltage * 0.1, 0x0E: board * 0.1, 0x0F: fault})
    subframes, well_formed = parse(data)
    replies = [each for each in subframes if each.code == REPLY]
    if not well_formed or len(data) not in LENGTHS or any(math.isinf(raw) for s in replies for raw in s.raw):
        return None
    if any(each.code not in (REPLY, WRITE_ERROR, READ_ERROR, FROM_DEVICE) for each in subframes):
        return None
    decoded = {register: value for each in replies for register, value in each.quantities()}
    return Reply(decoded, tuple(each for each in subframes if each.code in (WRITE_ERROR, READ_ERROR)))
