"""Messages as bytes: `pack` and `unpack`, for recordings and for the serial protocol `plain`.

Rules of this file. `pack` is exact and canonical: a message has one encoding, and `unpack` returns an equal
message, bit for bit (float64 throughout, also for the ranges of a scan). `pack` raises ValueError for what is
no message (a mistake of the caller); `unpack` returns None for malformed bytes, and never raises.

A packed message is a msgpack array: the message's code (`CODES`, never renumbered), then its fields in the
order of `protocols.messages`. Floats are float64; fixed tuples are arrays; a tuple of any length is a
binary string of little-endian float64. Decoding also accepts integers and float32 for floats, since many
msgpack writers shorten numbers.
"""

from __future__ import annotations

import math
import struct
import types
from collections.abc import Callable, Sequence
from dataclasses import dataclass, fields
from operator import attrgetter
from typing import Any, Union, get_args, get_origin, get_type_hints

import msgpack

from protocols import messages
from protocols.messages import Message, Mode

CODES: dict[int, type[Message]] = {
    1: messages.Idle,
    2: messages.Hold,
    3: messages.Position,
    4: messages.Velocity,
    5: messages.Torque,
    6: messages.Impedance,
    20: messages.Stop,
    21: messages.Release,
    22: messages.ClearFault,
    23: messages.Estop,
    24: messages.Scan,
    25: messages.SetId,
    26: messages.Zero,
    27: messages.Home,
    28: messages.ReadParameter,
    29: messages.WriteParameter,
    30: messages.Reboot,
    31: messages.Set,
    32: messages.Leave,
    50: messages.Goal,
    51: messages.Drive,
    70: messages.Feedback,
    71: messages.State,
    72: messages.Fault,
    73: messages.Found,
    74: messages.Done,
    75: messages.Refused,
    76: messages.Parameter,
    77: messages.Imu,
    78: messages.LaserScan,
    79: messages.Fix,
    80: messages.PoseReading,
}
"""The message type of each code, the first element of a packed message. A code is never reused. Arm has none:
it is decoded from frames, and neither sent nor recorded."""
ADDED_FIELDS: dict[type[Message], list[Any]] = {
    messages.Found: [False],
    messages.Leave: [False, False],
    messages.LaserScan: [0],
}
"""Defaults of fields that were added at the end of a message: older recordings lack them."""
MAX_ITEMS = 64
"""Items of an array: more than any message has fields."""
_INT_LOW, _INT_HIGH = -(2**63), 2**64 - 1


# -- fields: encoding and decoding by type ---------------------------------------------------------------


def _encode_float(value: object) -> float:
    if not isinstance(value, float | int):
        raise TypeError(f"{value!r} is not a number")
    if not math.isfinite(value):
        raise ValueError(f"{value!r} is not finite")
    return float(value)


def _decode_float(value: object) -> float:
    if type(value) is float:
        if math.isfinite(value):
            return value
        raise ValueError("not finite")
    if type(value) is int:
        return float(value)
    raise ValueError("not a number")


def _int(value: object) -> int:
    if type(value) is not int or not _INT_LOW <= value <= _INT_HIGH:
        raise ValueError(f"{value!r} is not an integer of 64 bits")
    return value


def _bool(value: object) -> bool:
    if type(value) is not bool:
        raise ValueError(f"{value!r} is not a bool")
    return value


def _str(value: object) -> str:
    if type(value) is not str:
        raise ValueError(f"{value!r} is not a string")
    return value


def _encode_mode(value: object) -> str:
    if not isinstance(value, Mode):
        raise TypeError(f"{value!r} is not a Mode")
    return value.value


def _decode_mode(value: object) -> Mode:
    return Mode(_str(value))


def _encode_floats(values: object) -> bytes:
    if not isinstance(values, tuple):
        raise TypeError(f"{values!r} is not a tuple")
    packed = struct.pack(f"<{len(values)}d", *values)
    _check_finite(values)
    return packed


def _decode_floats(data: object) -> tuple[float, ...]:
    if type(data) is not bytes:
        raise ValueError("not an array of float64")
    values: tuple[float, ...] = struct.unpack(f"<{len(data) // 8}d", data)
    _check_finite(values)
    return values


def _check_finite(values: Sequence[float]) -> None:
    # A finite sum proves it in a fifth of the time; only a sum that overflows needs the slow check.
    if not math.isfinite(sum(values)) and not all(map(math.isfinite, values)):
        raise ValueError("not finite")


_Convert = Callable[[object], object]


def _vector(length: int) -> tuple[_Convert, _Convert]:
    def encode(values: object) -> list[float]:
        if not isinstance(values, tuple) or len(values) != length:
            raise ValueError(f"{values!r} is not a tuple of {length}")
        return [_encode_float(value) for value in values]

    def decode(values: object) -> tuple[float, ...]:
        if type(values) is not list or len(values) != length:
            raise ValueError("not a vector")
        return tuple([_decode_float(value) for value in values])

    return encode, decode


def _optional(encode: _Convert, decode: _Convert) -> tuple[_Convert, _Convert]:
    return (
        lambda value: None if value is None else encode(value),
        lambda value: None if value is None else decode(value),
    )


def _converters(hint: object) -> tuple[_Convert, _Convert]:
    """Return the encoder and the decoder of fields of this type."""
    scalars: dict[object, tuple[_Convert, _Convert]] = {
        float: (_encode_float, _decode_float),
        int: (_int, _int),
        bool: (_bool, _bool),
        str: (_str, _str),
        Mode: (_encode_mode, _decode_mode),
    }
    if hint in scalars:
        return scalars[hint]
    if get_origin(hint) is tuple:
        items = get_args(hint)
        return (_encode_floats, _decode_floats) if Ellipsis in items else _vector(len(items))
    if get_origin(hint) in (Union, types.UnionType):
        (inner,) = [part for part in get_args(hint) if part is not type(None)]
        return _optional(*_converters(inner))
    raise TypeError(f"no encoding for {hint}")


_AS_IT_IS: dict[Any, frozenset[type]] = {
    float: frozenset({float}),
    float | None: frozenset({float, type(None)}),
    int: frozenset({int}),
    bool: frozenset({bool}),
    str: frozenset({str}),
}
"""By the type of a field, the types of the values that need no conversion. An int that was decoded has 64
bits; one to be encoded must be checked."""


# -- layouts: one per message type -----------------------------------------------------------------------


@dataclass(frozen=True, slots=True)
class Layout:
    """How one type of message is encoded and decoded, and which of its fields `plain` leaves out."""

    code: int
    message_type: type[Message]
    values: Callable[[Message], tuple[Any, ...]]
    """Returns the values of all fields."""
    encode: tuple[tuple[frozenset[type], _Convert], ...]
    """Of each field: the types of values that are valid as they are (of floats, if finite), and how to
    convert and check any other."""
    decode: tuple[tuple[frozenset[type], _Convert], ...]
    name: int | None
    """Index of the field that names the subject: motor, sensor, bus or name."""
    time: int | None
    """Index of the field `t`."""


def _layout(code: int, message_type: type[Message]) -> Layout:
    names = [f.name for f in fields(message_type)]
    hints = get_type_hints(message_type)
    fast = [_AS_IT_IS.get(hints[name], frozenset()) for name in names]
    pairs = [_converters(hints[name]) for name in names]
    subject = next((n for n in ("motor", "sensor", "bus", "name") if n in names), None)
    return Layout(
        code,
        message_type,
        _getter(names),
        tuple((valid - {int}, encode) for valid, (encode, _) in zip(fast, pairs, strict=True)),
        tuple((valid, decode) for valid, (_, decode) in zip(fast, pairs, strict=True)),
        names.index(subject) if subject else None,
        names.index("t") if "t" in names else None,
    )


def _getter(names: list[str]) -> Callable[[Any], tuple[Any, ...]]:
    if len(names) > 1:
        return attrgetter(*names)
    return lambda message: tuple(getattr(message, name) for name in names)


LAYOUTS = {code: _layout(code, message_type) for code, message_type in CODES.items()}
_BY_TYPE = {layout.message_type: layout for layout in LAYOUTS.values()}


# -- packed messages -------------------------------------------------------------------------------------


def pack(message: Message) -> bytes:
    """Encode a message. Raises ValueError for a value that is not finite or of a wrong type."""
    layout = layout_of(message)
    return pack_fields(layout, layout.values(message))


def unpack(data: bytes) -> Message | None:
    """Decode a message; None if the bytes hold none. Never raises."""
    unpacked = unpack_fields(data)
    return None if unpacked is None else unpacked[0].message_type(*unpacked[1])


def layout_of(message: Message) -> Layout:
    """Return the layout of a message. Raises ValueError for anything else."""
    layout = _BY_TYPE.get(type(message))
    if layout is None:
        raise ValueError(f"{message!r} is not a message")
    return layout


def pack_fields(layout: Layout, values: Sequence[Any]) -> bytes:
    """Encode a message with these fields. Raises ValueError as `pack` does."""
    try:
        packed: bytes = msgpack.packb([layout.code, *_converted(layout.encode, values)])
    except (TypeError, ValueError, OverflowError, struct.error) as error:
        raise ValueError(f"{layout.message_type.__name__}: {error}") from error
    return packed


def _converted(converters: Sequence[tuple[frozenset[type], _Convert]], values: Sequence[Any]) -> list[Any]:
    converted = list(values)
    for at, (valid, convert) in enumerate(converters):
        value = converted[at]
        kind = type(value)
        if kind not in valid or (kind is float and not math.isfinite(value)):
            converted[at] = convert(value)
    return converted


def unpack_fields(data: bytes) -> tuple[Layout, list[Any]] | None:
    """Decode the layout and fields of a message; None if the bytes hold none. Never raises."""
    try:
        row = msgpack.unpackb(data, max_array_len=MAX_ITEMS, max_map_len=0, max_ext_len=0)
        if type(row) is not list or not row or type(row[0]) is not int:
            return None
        layout = LAYOUTS.get(row[0])
        if layout is None:
            return None
        added = ADDED_FIELDS.get(layout.message_type, [])
        row += added if len(row) + len(added) == len(layout.decode) + 1 else []
        if len(row) != len(layout.decode) + 1:
            return None
        return layout, _converted(layout.decode, row[1:])
    except (ValueError, TypeError, OverflowError, struct.error, msgpack.UnpackException):
        return None
