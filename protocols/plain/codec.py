"""Words in bytes: `pack`/`unpack` for recordings, and messages on a serial stream for the wire.

Rules of this file. `pack` is exact and canonical: a word has one encoding, and `unpack` gives an equal
word back, bit for bit (float64 throughout, also for the ranges of a scan). `pack` raises ValueError for
what is no word (our mistake); whatever is read gives None or a count, and never raises.

A packed word is a msgpack array: the word's code (`CODES`, never renumbered), then its fields in the
order of `protocols.words`. Floats are float64; fixed tuples are arrays; a tuple of any length is a
binary string of little-endian float64. When reading, an integer is taken for a float, and float32 too,
since many msgpack writers shorten numbers.

A message on a stream, all little-endian (`Stream` reads them, `message` writes them):

    A5 57 | length u16 | length XOR FFFF u16 | body: address u8, packed word | CRC-32 u32 of the body

In the body the word's own name (motor, sensor, bus, name) stands empty, since the address tells it, and
`t` holds the age of the measurement in ns when it was sent. CRC-32 is that of zlib and Ethernet
(reflected 0x04C11DB7). The complement lets a false or damaged length be seen at once, so that a reader
never waits for a message that does not come. `length` counts the body and is at most `MAX_BODY`.
"""

from __future__ import annotations

import math
import struct
import types
import zlib
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, fields
from operator import attrgetter
from typing import Any, TypeAlias, Union, get_args, get_origin, get_type_hints

import msgpack

from protocols import words
from protocols.words import Mode, Nanos, Word

CODES: dict[int, type[Word]] = {
    1: words.Idle,
    2: words.Hold,
    3: words.Position,
    4: words.Velocity,
    5: words.Torque,
    6: words.Impedance,
    20: words.Stop,
    21: words.Release,
    22: words.ClearFault,
    23: words.Estop,
    24: words.Scan,
    25: words.SetId,
    26: words.Zero,
    27: words.Home,
    28: words.ReadParameter,
    29: words.WriteParameter,
    30: words.Reboot,
    31: words.Set,
    50: words.Goal,
    51: words.Drive,
    70: words.Feedback,
    71: words.State,
    72: words.Fault,
    73: words.Found,
    74: words.Done,
    75: words.Refused,
    76: words.Parameter,
    77: words.Imu,
    78: words.LaserScan,
    79: words.Fix,
}
"""What a packed word's first element means. A code is never given to another word."""

NAME = "plain"
SYNC = b"\xa5\x57"
MotorRequest: TypeAlias = (
    words.ClearFault | words.Estop | words.Zero | words.ReadParameter | words.WriteParameter | words.Reboot
)
"""What one motor may be asked."""
LineRequest: TypeAlias = words.Scan | words.SetId
"""What the whole line may be asked."""
EVERYONE = 0
"""The address to which all devices listen (Scan, SetId); a device has one of 1 … 255."""
MAX_BODY = 0x4000
"""Bytes in the body of one message: a scan of some 2,000 beams."""
MAX_AGE: Nanos = 10 * words.SECOND
"""Nothing that is sent is older; a message that says so is bad."""

_HEAD = struct.Struct("<2sHH")
_TAIL = struct.Struct("<I")
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
    if type(data) is not bytes or len(data) % 8:
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
        str: (_str, _str),
        Mode: (_mode_out, _mode_in),
    }
    if hint in plain:
        return plain[hint]
    if get_origin(hint) is tuple:
        items = get_args(hint)
        return (_floats_out, _floats_in) if items[-1] is Ellipsis else _vector(len(items))
    if get_origin(hint) in (Union, types.UnionType):
        (inner,) = [part for part in get_args(hint) if part is not type(None)]
        return _optional(*_converters(inner))
    raise TypeError(f"no encoding for {hint}")


# -- kinds: one row per word ---------------------------------------------------------------------------


@dataclass(frozen=True, slots=True)
class Kind:
    """How one kind of word is written and read, and which of its fields the wire leaves out."""

    code: int
    word: type[Word]
    get: Callable[[Word], tuple[Any, ...]]
    encode: tuple[_Convert, ...]
    decode: tuple[_Convert, ...]
    name: int | None
    """Place of the word's own name among its fields: motor, sensor, bus or name."""
    time: int | None
    """Place of `t` among its fields."""


def _kind(code: int, word: type[Word]) -> Kind:
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


_BY_CODE = {code: _kind(code, word) for code, word in CODES.items()}
_BY_WORD = {kind.word: kind for kind in _BY_CODE.values()}


# -- packed words --------------------------------------------------------------------------------------


def pack(word: Word) -> bytes:
    """The one encoding of a word. Raises ValueError for a value that is not finite or of a wrong type."""
    kind = _kind_of(word)
    return _pack(kind, kind.get(word))


def unpack(data: bytes) -> Word | None:
    """The word in these bytes, or None if they hold none. Never raises."""
    read = _unpack(data)
    return None if read is None else read[0].word(*read[1])


def _kind_of(word: Word) -> Kind:
    kind = _BY_WORD.get(type(word))
    if kind is None:
        raise ValueError(f"{word!r} is not a word")
    return kind


def _pack(kind: Kind, values: Sequence[Any]) -> bytes:
    row: list[Any] = [kind.code]
    try:
        row += [encode(value) for encode, value in zip(kind.encode, values, strict=True)]
        packed: bytes = msgpack.packb(row)
    except (TypeError, ValueError, OverflowError, struct.error) as error:
        raise ValueError(f"{kind.word.__name__}: {error}") from error
    return packed


def _unpack(data: bytes) -> tuple[Kind, list[Any]] | None:
    try:
        row = msgpack.unpackb(data)
        if type(row) is not list or not row or type(row[0]) is not int:
            return None
        kind = _BY_CODE.get(row[0])
        if kind is None or len(row) != len(kind.decode) + 1:
            return None
        return kind, [decode(value) for decode, value in zip(kind.decode, row[1:], strict=True)]
    except (ValueError, TypeError, OverflowError, struct.error, msgpack.UnpackException):
        return None


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
"""What a number may be on the wire, in the unit of `protocols.words`. A sender refuses what lies
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


# -- messages on a stream ------------------------------------------------------------------------------


def message(address: int, word: Word, now: Nanos = 0) -> bytes:
    """A word to or from the device at this address, as it stands on a stream.

    `now` is the moment of sending: a measurement's `t` becomes its age. Raises ValueError as `pack`
    does, and for a number outside `LIMITS`, an address outside 0 … 255 or a body that is too long."""
    kind = _kind_of(word)
    values = list(kind.get(word))
    if wrong := _outside(kind, values):
        raise ValueError(f"{kind.word.__name__}: {wrong}")
    if kind.name is not None:
        values[kind.name] = ""
    if kind.time is not None:
        values[kind.time] = min(max(now - values[kind.time], 0), MAX_AGE)
    if not 0 <= address <= 0xFF:
        raise ValueError(f"address {address} is not in 0 … 255")
    return frame(bytes((address,)) + _pack(kind, values))


def frame(body: bytes) -> bytes:
    """A body between sync, length and CRC."""
    if not 1 <= len(body) <= MAX_BODY:
        raise ValueError(f"a body of {len(body)} bytes; it may have 1 … {MAX_BODY}")
    return _HEAD.pack(SYNC, len(body), len(body) ^ 0xFFFF) + body + _TAIL.pack(zlib.crc32(body))


def read(body: bytes, t: Nanos, name: str) -> Word | None:
    """The word in a message's body, about the device called `name`, that came in at `t`; or None."""
    found = _unpack(body[1:])
    if found is None:
        return None
    kind, values = found
    if _outside(kind, values):
        return None
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
    _skipping: bool = field(default=False)
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
