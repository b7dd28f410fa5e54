"""Words in bytes: `pack` and `unpack`, for recordings and for the messages of `line`.

Rules of this file. `pack` is exact and canonical: a word has one encoding, and `unpack` gives an equal
word back, bit for bit (float64 throughout, also for the ranges of a scan). `pack` raises ValueError for
what is no word (our mistake); `unpack` gives None for what holds none, and never raises.

A packed word is a msgpack array: the word's code (`CODES`, never renumbered), then its fields in the
order of `protocols.messages`. Floats are float64; fixed tuples are arrays; a tuple of any length is a
binary string of little-endian float64. When reading, an integer is taken for a float, and float32 too,
since many msgpack writers shorten numbers.
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
}
"""What a packed word's first element means. A code is never given to another word."""
LATER: dict[type[Message], list[Any]] = {messages.Found: [False]}
"""Values of fields that were added at the end of a word: a recording from before lacks them."""
_INT_LOW, _INT_HIGH = -(2**63), 2**64 - 1


# -- fields: how a value of each type stands in msgpack, and how it is read back ------------------------


def _float_out(value: object) -> float:
    if not isinstance(value, float | int):
        raise TypeError(f"{value!r} is not a number")
    if not math.isfinite(value):
        raise ValueError(f"{value!r} is not finite")
    return float(value)


def _float_in(value: object) -> float:
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
        raise ValueError(f"{value!r} is not a truth value")
    return value


def _str(value: object) -> str:
    if type(value) is not str:
        raise ValueError(f"{value!r} is not a text")
    return value


def _mode_out(value: object) -> str:
    if not isinstance(value, Mode):
        raise TypeError(f"{value!r} is not a Mode")
    return value.value


def _mode_in(value: object) -> Mode:
    return Mode(_str(value))


def _floats_out(values: object) -> bytes:
    if not isinstance(values, tuple):
        raise TypeError(f"{values!r} is not a tuple")
    packed = struct.pack(f"<{len(values)}d", *values)
    _all_finite(values)
    return packed


def _floats_in(data: object) -> tuple[float, ...]:
    if type(data) is not bytes:
        raise ValueError("not a run of float64")
    values: tuple[float, ...] = struct.unpack(f"<{len(data) // 8}d", data)
    _all_finite(values)
    return values


def _all_finite(values: Sequence[float]) -> None:
    # A finite sum proves it in a fifth of the time; only a sum that overflows needs the slow look.
    if not math.isfinite(sum(values)) and not all(map(math.isfinite, values)):
        raise ValueError("not finite")


_Convert = Callable[[object], object]


def _vector(length: int) -> tuple[_Convert, _Convert]:
    def encode(values: object) -> list[float]:
        if not isinstance(values, tuple) or len(values) != length:
            raise ValueError(f"{values!r} is not a tuple of {length}")
        return [_float_out(value) for value in values]

    def decode(values: object) -> tuple[float, ...]:
        if type(values) is not list or len(values) != length:
            raise ValueError("not a vector")
        return tuple([_float_in(value) for value in values])

    return encode, decode


def _optional(encode: _Convert, decode: _Convert) -> tuple[_Convert, _Convert]:
    return (
        lambda value: None if value is None else encode(value),
        lambda value: None if value is None else decode(value),
    )


def _converters(hint: object) -> tuple[_Convert, _Convert]:
    """How to write and how to read a field of this type."""
    plain: dict[object, tuple[_Convert, _Convert]] = {
        float: (_float_out, _float_in),
        int: (_int, _int),
        bool: (_bool, _bool),
        str: (_str, _str),
        Mode: (_mode_out, _mode_in),
    }
    if hint in plain:
        return plain[hint]
    if get_origin(hint) is tuple:
        items = get_args(hint)
        return (_floats_out, _floats_in) if Ellipsis in items else _vector(len(items))
    if get_origin(hint) in (Union, types.UnionType):
        (inner,) = [part for part in get_args(hint) if part is not type(None)]
        return _optional(*_converters(inner))
    raise TypeError(f"no encoding for {hint}")


# -- kinds: one row per word ---------------------------------------------------------------------------


@dataclass(frozen=True, slots=True)
class Kind:
    """How one kind of word is written and read, and which of its fields the wire leaves out."""

    code: int
    word: type[Message]
    get: Callable[[Message], tuple[Any, ...]]
    encode: tuple[_Convert, ...]
    decode: tuple[_Convert, ...]
    name: int | None
    """Place of the word's own name among its fields: motor, sensor, bus or name."""
    time: int | None
    """Place of `t` among its fields."""


def _kind(code: int, word: type[Message]) -> Kind:
    names = [f.name for f in fields(word)]
    hints = get_type_hints(word)
    pairs = [_converters(hints[name]) for name in names]
    own = next((n for n in ("motor", "sensor", "bus", "name") if n in names), None)
    return Kind(
        code,
        word,
        _getter(names),
        tuple(encode for encode, _ in pairs),
        tuple(decode for _, decode in pairs),
        names.index(own) if own else None,
        names.index("t") if "t" in names else None,
    )


def _getter(names: list[str]) -> Callable[[Any], tuple[Any, ...]]:
    if len(names) > 1:
        return attrgetter(*names)
    return lambda word: tuple(getattr(word, name) for name in names)


KINDS = {code: _kind(code, word) for code, word in CODES.items()}
_BY_WORD = {kind.word: kind for kind in KINDS.values()}


# -- packed words --------------------------------------------------------------------------------------


def pack(word: Message) -> bytes:
    """The one encoding of a word. Raises ValueError for a value that is not finite or of a wrong type."""
    kind = kind_of(word)
    return pack_fields(kind, kind.get(word))


def unpack(data: bytes) -> Message | None:
    """The word in these bytes, or None if they hold none. Never raises."""
    read = unpack_fields(data)
    return None if read is None else read[0].word(*read[1])


def kind_of(word: Message) -> Kind:
    """The row of a word. Raises ValueError for what is none."""
    kind = _BY_WORD.get(type(word))
    if kind is None:
        raise ValueError(f"{word!r} is not a word")
    return kind


def pack_fields(kind: Kind, values: Sequence[Any]) -> bytes:
    """The encoding of a word of this kind with these fields. Raises ValueError as `pack` does."""
    row: list[Any] = [kind.code]
    try:
        row += [encode(value) for encode, value in zip(kind.encode, values, strict=True)]
        packed: bytes = msgpack.packb(row)
    except (TypeError, ValueError, OverflowError, struct.error) as error:
        raise ValueError(f"{kind.word.__name__}: {error}") from error
    return packed


def unpack_fields(data: bytes) -> tuple[Kind, list[Any]] | None:
    """The kind and fields of the word in these bytes, or None. Never raises."""
    try:
        row = msgpack.unpackb(data)
        if type(row) is not list or not row or type(row[0]) is not int:
            return None
        kind = KINDS.get(row[0])
        if kind is None:
            return None
        later = LATER.get(kind.word, [])
        row += later if len(row) + len(later) == len(kind.decode) + 1 else []
        if len(row) != len(kind.decode) + 1:
            return None
        return kind, [decode(value) for decode, value in zip(kind.decode, row[1:], strict=True)]
    except (ValueError, TypeError, OverflowError, struct.error, msgpack.UnpackException):
        return None
