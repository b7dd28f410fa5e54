"""One message ↔ the bytes of one frame: the fields by their letters, and the code for each shape of message.

Rules. All values are little-endian, floats IEEE-754 binary32, feed-forwards int16 × 0.001 that saturate. No
number that is not finite is encoded (ValueError: our own mistake) or decoded (None: the frame is bad). −0.0
and denormals become 0.0. Everything that can be known before a frame comes is worked out once, in `layout`.
"""

from __future__ import annotations

import math
import struct
from collections.abc import Callable
from dataclasses import dataclass, fields
from operator import attrgetter
from typing import Any, Literal, TypeAlias

MILLI = 0.001
"""Scale of the feed-forwards of Set_Input_Pos: turns/s and N·m per count."""
FEED_FORWARD_MAX = 32767 * MILLI
FLOAT_MAX = 3.4028234663852886e38
FLOAT_TINY = 2.0**-126
"""Smallest normal binary32: below it a number counts as 0."""

Direction: TypeAlias = Literal["to_device", "from_device", "both"]
Encode: TypeAlias = Callable[[Any], bytes]
"""A message → the bytes of its frame."""
Decode: TypeAlias = Callable[[bytes], Any]
"""Eight bytes → the message, or None if a number in them is not finite."""


@dataclass(frozen=True, slots=True)
class Layout:
    """One row of the table: how one message stands in a frame."""

    message: type[Any]
    cmd: int
    direction: Direction
    codes: str
    """One letter per field: b bit 0, 7 bit 7 of the byte before, B u8, c u8 that may be left out, H u16,
    i i32, I u32, S u48, Q u64, f binary32, n binary32 or NaN, m int16 × 0.001."""
    dlc: int
    """Bytes that we send, and the fewest that are taken from a device."""
    encode: Encode
    decode: Decode


def layout(message: type[Any], cmd: int, direction: Direction, codes: str, dlc: int = 8) -> Layout:
    """A row of the table."""
    frame = "<" + "".join(_STRUCT.get(code, code) for code in codes)
    packer = struct.Struct(frame + "x" * (8 - struct.calcsize(frame)))
    encode, decode = _shape(message, codes, packer)
    if direction == "to_device" and dlc < 8:
        encode = _cut(encode, dlc)
    return Layout(message, cmd, direction, codes, dlc, encode, decode)


def _cut(encode: Encode, dlc: int) -> Encode:
    return lambda message: encode(message)[:dlc]


# -- one field, by its letter -----------------------------------------------------------------------

_STRUCT = {"S": "6s", "m": "h", "n": "f", "b": "B", "c": "B", "7": ""}


def binary32(value: float) -> float:
    """Saturating. ValueError for what is not finite, in both directions: it is neither said nor believed."""
    if -FLOAT_MAX <= value <= FLOAT_MAX:
        return 0.0 if -FLOAT_TINY < value < FLOAT_TINY else value
    if not math.isfinite(value):
        raise ValueError(f"{value} is not finite: it never reaches the wire")
    return math.copysign(FLOAT_MAX, value)


def milli(value: float) -> int:
    """int16 × 0.001, saturating: a wrapped feed-forward would kick the other way."""
    if -32.768 <= value <= 32.767:
        return round(value / MILLI)
    if not math.isfinite(value):
        raise ValueError(f"{value} is not finite: it never reaches the wire")
    return 32767 if value > 0 else -32768


def _same(value: Any) -> Any:  # noqa: ANN401 -- whatever the field is
    return value


_TO_WIRE: dict[str, Callable[[Any], Any]] = {
    "S": lambda serial: serial.to_bytes(6, "little"),
    "f": binary32,
    "n": lambda value: math.nan if value is None else binary32(value),
    "m": milli,
    "c": lambda value: value or 0,
}
_FROM_WIRE: dict[str, Callable[[Any], Any]] = {
    "S": lambda data: int.from_bytes(data, "little"),
    "f": binary32,
    "n": lambda value: binary32(value) if math.isfinite(value) else None,
    "m": lambda count: count * MILLI,
    "b": lambda value: value & 1,
}


# -- one message, by its shape ----------------------------------------------------------------------

Shape: TypeAlias = tuple[Encode, Decode]
Take: TypeAlias = Callable[[Any], tuple[Any, ...]]
"""The fields of a message."""


def _shape(message: type[Any], codes: str, packer: struct.Struct) -> Shape:
    """Set-points, estimates and heartbeats never cease and have code of their own; the rest shares one."""
    names = tuple(field.name for field in fields(message))
    match codes:
        case "ff":
            return _pair(message, attrgetter(*names), packer)
        case "fmm":
            return _fed_forward(message, attrgetter(*names), packer)
        case "IBBb":
            return _beat(message, attrgetter(*names), packer)
        case "IBbbb7":
            return _flags(message, attrgetter(*names), packer)
    take = _taker(names)
    if set(codes) <= set("BHiIQ"):
        return lambda value: packer.pack(*take(value)), lambda data: message(*packer.unpack(data))
    return _any(message, take, codes, packer)


def _pair(message: type[Any], take: Take, packer: struct.Struct) -> Shape:
    pack, unpack = packer.pack, packer.unpack

    def encode(value: Any) -> bytes:  # noqa: ANN401 -- a message
        a, b = take(value)
        if -FLOAT_MAX <= a <= FLOAT_MAX and -FLOAT_MAX <= b <= FLOAT_MAX:  # as binary32, without two calls
            return pack(
                0.0 if -FLOAT_TINY < a < FLOAT_TINY else a, 0.0 if -FLOAT_TINY < b < FLOAT_TINY else b
            )
        return pack(binary32(a), binary32(b))

    def decode(data: bytes) -> Any:  # noqa: ANN401 -- a message
        a, b = unpack(data)
        if not math.isfinite(a + b):  # two binary32 never overflow in binary64
            return None
        return message(0.0 if -FLOAT_TINY < a < FLOAT_TINY else a, 0.0 if -FLOAT_TINY < b < FLOAT_TINY else b)

    return encode, decode


def _fed_forward(message: type[Any], take: Take, packer: struct.Struct) -> Shape:
    pack, unpack = packer.pack, packer.unpack

    def encode(value: Any) -> bytes:  # noqa: ANN401 -- a message
        a, b, c = take(value)
        return pack(binary32(a), milli(b), milli(c))

    def decode(data: bytes) -> Any:  # noqa: ANN401 -- a message
        a, b, c = unpack(data)
        if not math.isfinite(a):
            return None
        return message(0.0 if -FLOAT_TINY < a < FLOAT_TINY else a, b * MILLI, c * MILLI)

    return encode, decode


def _beat(message: type[Any], take: Take, packer: struct.Struct) -> Shape:
    """Three numbers and a flag."""
    pack, unpack = packer.pack, packer.unpack

    def encode(value: Any) -> bytes:  # noqa: ANN401 -- a message
        a, b, c, d = take(value)
        return pack(a, b, c, d)

    def decode(data: bytes) -> Any:  # noqa: ANN401 -- a message
        a, b, c, d = unpack(data)
        return message(a, b, c, d & 1)

    return encode, decode


def _flags(message: type[Any], take: Take, packer: struct.Struct) -> Shape:
    """Two numbers and four flags, the last two of which share a byte."""
    pack, unpack = packer.pack, packer.unpack

    def encode(value: Any) -> bytes:  # noqa: ANN401 -- a message
        a, b, c, d, e, f = take(value)
        return pack(a, b, c & 1, d & 1, e & 1 | (f & 1) << 7)

    def decode(data: bytes) -> Any:  # noqa: ANN401 -- a message
        a, b, c, d, e = unpack(data)
        return message(a, b, c & 1, d & 1, e & 1, e >> 7)

    return encode, decode


def _any(message: type[Any], take: Take, codes: str, packer: struct.Struct) -> Shape:
    pack, unpack = packer.pack, packer.unpack
    to_wire = tuple(_TO_WIRE.get(code, _same) for code in codes)
    from_wire = tuple(_FROM_WIRE.get(code, _same) for code in codes)

    def encode(value: Any) -> bytes:  # noqa: ANN401 -- a message
        return pack(*[f(x) for f, x in zip(to_wire, take(value), strict=True)])

    def decode(data: bytes) -> Any:  # noqa: ANN401 -- a message
        try:
            return message(*[f(x) for f, x in zip(from_wire, unpack(data), strict=True)])
        except ValueError:  # a float that is not finite: the frame changes nothing
            return None

    return encode, decode


def _taker(names: tuple[str, ...]) -> Take:
    if not names:
        return lambda _: ()
    take = attrgetter(*names)
    return take if len(names) > 1 else lambda message: (take(message),)
