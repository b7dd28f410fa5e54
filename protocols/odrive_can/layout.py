"""One message ↔ the bytes of one frame: the codes of its fields, and the functions that pack and unpack it.

Rules. All values are little-endian, floats IEEE-754 binary32, feed-forwards int16 × 0.001 that saturate. No
number that is not finite is encoded (ValueError: a defect of ours) or decoded (None: the frame is malformed).
−0.0 and denormals become 0.0. Whatever does not depend on a frame is computed once, in `layout`.
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
"""Smallest normal binary32: smaller magnitudes count as 0."""

Direction: TypeAlias = Literal["to_device", "from_device", "both"]
Encode: TypeAlias = Callable[[Any], bytes]
"""A message → the bytes of its frame."""
Decode: TypeAlias = Callable[[bytes], Any]
"""Eight bytes → the message, or None if a number in them is not finite."""


@dataclass(frozen=True, slots=True)
class Layout:
    """One row of the message table."""

    message: type[Any]
    cmd: int
    direction: Direction
    codes: str
    """One letter per field: b bit 0, 7 bit 7 of the byte before, B u8, c u8 that may be left out, H u16,
    i i32, I u32, S u48, Q u64, f binary32, n binary32 or NaN, m int16 × 0.001."""
    dlc: int
    """Bytes that are sent, and the fewest that are accepted from a device."""
    encode: Encode
    decode: Decode


def layout(message: type[Any], cmd: int, direction: Direction, codes: str, dlc: int = 8) -> Layout:
    """Return a row of the message table."""
    frame = "<" + "".join(_STRUCT.get(code, code) for code in codes)
    packer = struct.Struct(frame + "x" * (8 - struct.calcsize(frame)))
    encode, decode = _codec(message, codes, packer)
    if direction == "to_device" and dlc < 8:
        encode = _truncated(encode, dlc)
    return Layout(message, cmd, direction, codes, dlc, encode, decode)


def _truncated(encode: Encode, dlc: int) -> Encode:
    return lambda message: encode(message)[:dlc]


# -- one field, by its code -------------------------------------------------------------------------

_STRUCT = {"S": "6s", "m": "h", "n": "f", "b": "B", "c": "B", "7": ""}


def binary32(value: float) -> float:
    """Return the value as binary32 carries it, saturated. ValueError if it is not finite, in both
    directions."""
    if -FLOAT_MAX <= value <= FLOAT_MAX:
        return 0.0 if -FLOAT_TINY < value < FLOAT_TINY else value
    if not math.isfinite(value):
        raise ValueError(f"{value} is not finite: it is never sent")
    return math.copysign(FLOAT_MAX, value)


def milli(value: float) -> int:
    """Return counts of 0.001 in int16, saturated: a wrapped feed-forward would push the other way."""
    if -32.768 <= value <= 32.767:
        return round(value / MILLI)
    if not math.isfinite(value):
        raise ValueError(f"{value} is not finite: it is never sent")
    return 32767 if value > 0 else -32768


def _unchanged(value: Any) -> Any:  # noqa: ANN401 -- whatever the field is
    return value


_PACK: dict[str, Callable[[Any], Any]] = {
    "S": lambda serial: serial.to_bytes(6, "little"),
    "f": binary32,
    "n": lambda value: math.nan if value is None else binary32(value),
    "m": milli,
    "c": lambda value: value or 0,
}
_UNPACK: dict[str, Callable[[Any], Any]] = {
    "S": lambda data: int.from_bytes(data, "little"),
    "f": binary32,
    "n": lambda value: binary32(value) if math.isfinite(value) else None,
    "m": lambda count: count * MILLI,
    "b": lambda value: value & 1,
}


# -- one message, by the codes of its fields ---------------------------------------------------------

Codec: TypeAlias = tuple[Encode, Decode]
FieldsOf: TypeAlias = Callable[[Any], tuple[Any, ...]]


def _codec(message: type[Any], codes: str, packer: struct.Struct) -> Codec:
    """Return the functions of a message. Set-points, estimates and heartbeats are the bulk of all traffic and
    have functions of their own; the other messages share one pair."""
    names = tuple(field.name for field in fields(message))
    match codes:
        case "ff":
            return _two_floats(message, attrgetter(*names), packer)
        case "fmm":
            return _float_and_feed_forwards(message, attrgetter(*names), packer)
        case "IBBb":
            return _heartbeat06(message, attrgetter(*names), packer)
        case "IBbbb7":
            return _heartbeat05(message, attrgetter(*names), packer)
    fields_of = _fields_of(names)
    if set(codes) <= set("BHiIQ"):
        return lambda value: packer.pack(*fields_of(value)), lambda data: message(*packer.unpack(data))
    return _any_fields(message, fields_of, codes, packer)


def _two_floats(message: type[Any], fields_of: FieldsOf, packer: struct.Struct) -> Codec:
    pack, unpack = packer.pack, packer.unpack

    def encode(value: Any) -> bytes:  # noqa: ANN401 -- a message
        a, b = fields_of(value)
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


def _float_and_feed_forwards(message: type[Any], fields_of: FieldsOf, packer: struct.Struct) -> Codec:
    pack, unpack = packer.pack, packer.unpack

    def encode(value: Any) -> bytes:  # noqa: ANN401 -- a message
        a, b, c = fields_of(value)
        return pack(binary32(a), milli(b), milli(c))

    def decode(data: bytes) -> Any:  # noqa: ANN401 -- a message
        a, b, c = unpack(data)
        if not math.isfinite(a):
            return None
        return message(0.0 if -FLOAT_TINY < a < FLOAT_TINY else a, b * MILLI, c * MILLI)

    return encode, decode


def _heartbeat06(message: type[Any], fields_of: FieldsOf, packer: struct.Struct) -> Codec:
    unpack = packer.unpack

    def decode(data: bytes) -> Any:  # noqa: ANN401 -- a message
        a, b, c, d = unpack(data)
        return message(a, b, c, d & 1)

    return lambda value: packer.pack(*fields_of(value)), decode


def _heartbeat05(message: type[Any], fields_of: FieldsOf, packer: struct.Struct) -> Codec:
    """Two numbers and four flags, the last two of which share a byte."""
    pack, unpack = packer.pack, packer.unpack

    def encode(value: Any) -> bytes:  # noqa: ANN401 -- a message
        a, b, c, d, e, f = fields_of(value)
        return pack(a, b, c & 1, d & 1, e & 1 | (f & 1) << 7)

    def decode(data: bytes) -> Any:  # noqa: ANN401 -- a message
        a, b, c, d, e = unpack(data)
        return message(a, b, c & 1, d & 1, e & 1, e >> 7)

    return encode, decode


def _any_fields(message: type[Any], fields_of: FieldsOf, codes: str, packer: struct.Struct) -> Codec:
    pack, unpack = packer.pack, packer.unpack
    to_raw = tuple(_PACK.get(code, _unchanged) for code in codes)
    from_raw = tuple(_UNPACK.get(code, _unchanged) for code in codes)

    def encode(value: Any) -> bytes:  # noqa: ANN401 -- a message
        return pack(*[f(x) for f, x in zip(to_raw, fields_of(value), strict=True)])

    def decode(data: bytes) -> Any:  # noqa: ANN401 -- a message
        try:
            return message(*[f(x) for f, x in zip(from_raw, unpack(data), strict=True)])
        except ValueError:  # a float that is not finite: the frame is malformed
            return None

    return encode, decode


def _fields_of(names: tuple[str, ...]) -> FieldsOf:
    if not names:
        return lambda _: ()
    fields_of = attrgetter(*names)
    return fields_of if len(names) > 1 else lambda message: (fields_of(message),)
