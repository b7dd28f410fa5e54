"""Messages as bytes: `pack` and `unpack`, for recordings and for the serial protocol `plain`.

Rules of this file. `pack` is exact and canonical: a message has one encoding, and `unpack` returns an equal
message, bit for bit (float64 throughout, also for the ranges of a scan). `pack` raises ValueError for what is
no message (a mistake of the caller); `unpack` returns None for malformed bytes, and never raises.

A packed message is a msgpack array: the message's code (`CODES`, never renumbered), then its fields in the
order of its class; of a kind of sensor that is not ours the code is the kind's name. Floats are float64;
fixed tuples are arrays; a tuple of any length, of floats or of points, is a binary string of little-endian
float64, and one of messages an array of them. Decoding also accepts integers and float32 for floats, since
many msgpack writers shorten numbers.
"""

from __future__ import annotations

import math
import struct
import types
from collections.abc import Callable, Sequence
from dataclasses import MISSING, dataclass, fields
from functools import cache
from operator import attrgetter
from typing import Any, Union, get_args, get_origin, get_type_hints

import msgpack

from protocols import messages, sensors
from protocols.messages import Message, Mode, Plain

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
    33: messages.Confirm,
    34: messages.SetAddress,
    51: messages.Drive,
    52: messages.Mission,
    53: messages.Pause,
    54: messages.Resume,
    55: messages.Drop,
    66: messages.Locate,
    67: messages.Grid,
    **messages.STEPS,
    70: messages.Feedback,
    71: messages.State,
    72: messages.Fault,
    73: messages.Found,
    74: messages.Done,
    75: messages.Refused,
    76: messages.Parameter,
    **{kind.code: kind.message for kind in sensors.OURS if kind.code is not None},
}
"""The message type of each code, the first element of a packed message. A code is never reused. Arm and Kept
have none: they are decoded from frames, and neither sent nor recorded."""


def _defaults(kind: type[Message]) -> list[Any]:
    """Return the defaults of the last fields of a message, of those that have one."""
    return [one.default for one in fields(kind) if one.default is not MISSING]


ADDED_FIELDS: dict[type[Message], list[Any]] = {
    messages.Hold: [0.0],
    messages.Found: [False],
    messages.Leave: [False, False],
    **{kind.message: list(kind.added) for kind in sensors.OURS if kind.added},
    messages.Drive: [0.0],
    **{kind: _defaults(kind) for kind in messages.STEPS.values()},
}
"""Defaults of fields that were added at the end of a message: older recordings lack them."""
MAX_ITEMS = 64
"""Items of an array: more than any message has fields, and the most steps in one place of a mission,"""
MAX_DEPTH = 16
"""and the most arrays within each other."""
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


def _bytes(value: object) -> bytes:
    if type(value) is not bytes:
        raise ValueError(f"{value!r:.40} is not a binary string")
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


def _encode_points(points: object) -> bytes:
    if not isinstance(points, tuple) or not all(isinstance(p, tuple) and len(p) == 2 for p in points):
        raise TypeError(f"{points!r} is not a tuple of points")
    return _encode_floats(tuple(number for point in points for number in point))


def _decode_points(data: object) -> tuple[tuple[float, float], ...]:
    numbers = _decode_floats(data)
    return tuple(zip(numbers[::2], numbers[1::2], strict=True))


def _encode_named(named: object) -> list[list[Any]]:
    if not isinstance(named, tuple) or not all(isinstance(one, tuple) and len(one) == 2 for one in named):
        raise TypeError(f"{named!r} is not a tuple of names with values")
    return [[_str(name), _encode_plain(value)] for name, value in named]


def _encode_plain(value: object) -> object:
    if isinstance(value, tuple) and len(value) <= MAX_ITEMS:
        return [_encode_plain(one) for one in value]
    return _plain(value, 0)


def _decode_named(rows: object) -> tuple[tuple[str, Plain], ...]:
    if type(rows) is not list or not all(type(row) is list and len(row) == 2 for row in rows):
        raise ValueError("not names with values")
    return tuple((_str(name), _decode_plain(value)) for name, value in rows)


def _decode_plain(value: object) -> Any:  # noqa: ANN401 -- a `Plain`
    return tuple(map(_decode_plain, value)) if type(value) is list else _plain(value, 1)


def _plain(value: object, way: int) -> object:
    """Return a number, text or bool encoded or decoded; None as it is."""
    if value is None:
        return None
    if type(value) not in (float, int, bool, str):
        raise ValueError(f"{value!r} is no number, text, bool, or tuple of at most {MAX_ITEMS} of them")
    return _SCALARS[type(value)][way](value)


def _check_finite(values: Sequence[float]) -> None:
    # A finite sum proves it in a fifth of the time; only a sum that overflows needs the slow check.
    if not math.isfinite(sum(values)) and not all(map(math.isfinite, values)):
        raise ValueError("not finite")


_Convert = Callable[[object], object]
_SCALARS: dict[object, tuple[_Convert, _Convert]] = {
    float: (_encode_float, _decode_float),
    int: (_int, _int),
    bool: (_bool, _bool),
    str: (_str, _str),
    bytes: (_bytes, _bytes),
    Mode: (_encode_mode, _decode_mode),
}


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


def _nested(kinds: frozenset[type]) -> tuple[_Convert, _Convert]:
    """Return the encoder and the decoder of a tuple of messages of these types."""

    def encode(values: object) -> list[list[Any]]:
        if not isinstance(values, tuple) or len(values) > MAX_ITEMS:
            raise ValueError(f"not a tuple of at most {MAX_ITEMS}")
        rows: list[list[Any]] = []
        for value in values:
            if type(value) not in kinds:
                raise ValueError(f"{value!r} has no place there")
            layout = _BY_TYPE[type(value)]
            rows.append([layout.code, *_converted(layout.encode, layout.values(value))])
        return rows

    def decode(rows: object) -> tuple[Message, ...]:
        if type(rows) is not list:
            raise ValueError("not an array")
        values: list[Message] = []
        for row in rows:
            layout, items = _decoded(row)
            if layout.message_type not in kinds:
                raise ValueError(f"a {layout.message_type.__name__} has no place there")
            values.append(layout.message_type(*items))
        return tuple(values)

    return encode, decode


def _optional(encode: _Convert, decode: _Convert) -> tuple[_Convert, _Convert]:
    return (
        lambda value: None if value is None else encode(value),
        lambda value: None if value is None else decode(value),
    )


def _converters(hint: object) -> tuple[_Convert, _Convert]:
    """Return the encoder and the decoder of fields of this type."""
    if hint in _SCALARS:
        return _SCALARS[hint]
    if get_origin(hint) is tuple:
        items = get_args(hint)
        if Ellipsis not in items:
            return _vector(len(items))
        if items[0] is float:
            return _encode_floats, _decode_floats
        if get_origin(items[0]) is tuple and get_args(items[0])[0] is str:
            return _encode_named, _decode_named
        if get_origin(items[0]) is tuple:
            return _encode_points, _decode_points
        return _nested(frozenset(get_args(items[0])))
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
    bytes: frozenset({bytes}),
}
"""By the type of a field, the types of the values that need no conversion. An int that was decoded has 64
bits; one to be encoded must be checked."""


# -- layouts: one per message type -----------------------------------------------------------------------


@dataclass(frozen=True, slots=True)
class MessageLayout:
    """How one type of message is encoded and decoded, and which of its fields `plain` leaves out."""

    code: int | str
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


def _layout(code: int | str, message_type: type[Message]) -> MessageLayout:
    names = [f.name for f in fields(message_type)]
    hints = get_type_hints(message_type)
    fast = [_AS_IT_IS.get(hints[name], frozenset()) for name in names]
    pairs = [_converters(hints[name]) for name in names]
    subject = next((n for n in ("motor", "sensor", "bus", "name") if n in names), None)
    return MessageLayout(
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


@cache
def _others() -> dict[object, MessageLayout]:
    """Return the layouts of readings of kinds of sensors that are not ours, by their names and classes."""
    layouts = [_layout(kind.name, kind.message) for kind in sensors.kinds().strangers]
    return {key: layout for layout in layouts for key in (layout.code, layout.message_type)}


# -- packed messages -------------------------------------------------------------------------------------


def pack(message: Message) -> bytes:
    """Encode a message. Raises ValueError for a value that is not finite or of a wrong type."""
    layout = layout_of(message)
    return pack_fields(layout, layout.values(message))


def unpack(data: bytes) -> Message | None:
    """Decode a message; None if the bytes hold none. Never raises."""
    unpacked = unpack_fields(data)
    return None if unpacked is None else unpacked[0].message_type(*unpacked[1])


def kind_in(data: bytes) -> str:
    """Return the name of the kind of sensor, not one of ours, whose reading these bytes are; "" if none."""
    try:
        row = msgpack.unpackb(data, max_array_len=MAX_ITEMS, max_map_len=0, max_ext_len=0)
    except (ValueError, TypeError, OverflowError, msgpack.UnpackException):
        return ""
    return row[0] if type(row) is list and row and type(row[0]) is str else ""


def layout_of(message: Message) -> MessageLayout:
    """Return the layout of a message. Raises ValueError for anything else."""
    layout = _BY_TYPE.get(type(message)) or _others().get(type(message))
    if layout is None:
        raise ValueError(f"{message!r} is not a message")
    return layout


def pack_fields(layout: MessageLayout, values: Sequence[Any]) -> bytes:
    """Encode a message with these fields. Raises ValueError as `pack` does."""
    try:
        row = [layout.code, *_converted(layout.encode, values)]
        if layout.message_type in (messages.Mission, messages.Perform):
            _check_depth(row)
        packed: bytes = msgpack.packb(row)
    except (TypeError, ValueError, OverflowError, RecursionError, struct.error) as error:
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


def unpack_fields(data: bytes) -> tuple[MessageLayout, list[Any]] | None:
    """Decode the layout and fields of a message; None if the bytes hold none. Never raises."""
    try:
        row = msgpack.unpackb(data, max_array_len=MAX_ITEMS, max_map_len=0, max_ext_len=0)
        return _decoded(row)
    except (ValueError, TypeError, OverflowError, struct.error, msgpack.UnpackException):
        return None


def _decoded(row: object) -> tuple[MessageLayout, list[Any]]:
    """Return the layout and the fields of a row. Raises ValueError if it is no message."""
    if type(row) is not list or not row or type(row[0]) not in (int, str):
        raise ValueError("not a message")
    layout = LAYOUTS.get(row[0]) or _others().get(row[0])
    if layout is None:
        raise ValueError(f"no message has the code {row[0]!r}")
    added, missing = ADDED_FIELDS.get(layout.message_type, []), len(layout.decode) + 1 - len(row)
    row += added[-missing:] if 0 < missing <= len(added) else []
    if len(row) != len(layout.decode) + 1:
        raise ValueError("too many fields, or too few")
    if layout.message_type in (messages.Mission, messages.Perform):
        _check_depth(row)
    return layout, _converted(layout.decode, row[1:])


def _check_depth(row: object) -> None:
    """Raise ValueError if a row has too many arrays within each other."""
    arrays, depth = [row], 0
    while arrays:
        depth += 1
        arrays = [item for array in arrays if type(array) is list for item in array if type(item) is list]
    if depth > MAX_DEPTH:
        raise ValueError(f"more than {MAX_DEPTH} arrays within each other")
