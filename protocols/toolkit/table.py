"""The messages of a protocol as a table: one declaration gives codec, names, ids, ranges and resolution.

Rules. A `Row` is a constant. A `Table` turns each row into two functions when it is made, as `dataclasses`
does for a class, so that nothing about a row is looked up while frames pass. Encoding saturates, and raises
ValueError for a number that is not finite (a mistake of ours); decoding takes any frame and never raises.
−0.0 and denormals are 0.0 in both directions. Numbers that depend on a device (the ends of a span) are
numbers of its table: devices that differ have a table each.
"""

from __future__ import annotations

import math
import struct
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from typing import Any, Literal, TypeAlias

from protocols.frames import EXTENDED_BIT, CanFrame, Frame, IdMask
from protocols.plugin import Range

FLOAT_MAX = 3.4028234663852886e38
TINY = 2.0**-126
"""Smallest normal binary32: a smaller magnitude counts as 0."""
BINARY32 = 2.0**-24 * 1.01
"""Largest relative error of rounding to binary32."""

Direction: TypeAlias = Literal["to_device", "from_device"]
_DIRECTIONS: tuple[Direction, ...] = ("to_device", "from_device")
Values: TypeAlias = dict[str, Any]
"""Numbers of a message by field. A field that may be "not given" is None where it is not."""


# -- fields ------------------------------------------------------------------------------------------------


@dataclass(frozen=True, slots=True)
class Field:
    """Some bits of a message or of an id. Made by the functions below."""

    name: str
    """ "" for bits without a meaning of their own."""
    kind: Literal["uint", "int", "f32", "span", "const"]
    bits: int
    unit: float = 1.0
    """Value of one count of `uint` and `int`; 1.0: the value is an int."""
    low: float = 0.0
    """Ends of a `span`; `low` of a `const` is its value."""
    high: float = 0.0
    floor: bool = False
    """A span rounds down, as most vendors' code does, not to the nearest step."""
    optional: bool = False
    """NaN of an `f32` means "not given", an end of a `span` "there or beyond": None."""

    @property
    def step(self) -> float:
        """Value of one count."""
        return (self.high - self.low) / ((1 << self.bits) - 1) if self.kind == "span" else self.unit

    def ends(self) -> tuple[float, float]:
        """Return the lowest and highest value."""
        if self.kind in ("span", "const"):
            return self.low, self.high if self.kind == "span" else self.low
        if self.kind == "f32":
            return -FLOAT_MAX, FLOAT_MAX
        top = (1 << self.bits) - 1
        low = -(top >> 1) - 1 if self.kind == "int" else 0
        return low * self.unit, (top >> 1 if self.kind == "int" else top) * self.unit

    def range(self, unit: float = 1.0, inside: int = 0) -> Range:
        """Return the range in other units (`unit`: SI per unit of the field); `inside`: without as many
        counts at either end, where a device that saturates cannot be told from one that measures."""
        low, high = self.ends()
        if self.kind == "f32":
            return Range(low * unit if unit < 1 else low, high * unit if unit < 1 else high, 1e-12, BINARY32)
        error = self.step * (1.0 if self.floor else 0.5) * 1.001
        return Range((low + inside * self.step) * unit, (high - inside * self.step) * unit, error * unit)


def uint(name: str, bits: int = 8, unit: float = 1.0) -> Field:
    """Counts from 0."""
    return Field(name, "uint", bits, unit)


def sint(name: str, bits: int = 16, unit: float = 1.0) -> Field:
    """Counts in two's complement."""
    return Field(name, "int", bits, unit)


def f32(name: str, *, optional: bool = False) -> Field:
    """A binary32."""
    return Field(name, "f32", 32, optional=optional)


def span(
    name: str, bits: int, low: float, high: float, *, floor: bool = True, measured: bool = False
) -> Field:
    """low … high in 2ⁿ − 1 steps, rounded down or to the nearest; `measured`: an end is decoded as None."""
    return Field(name, "span", bits, low=low, high=high, floor=floor, optional=measured)


def const(value: int, bits: int = 8) -> Field:
    """Bits that are always the same."""
    return Field("", "const", bits, low=value)


def unused(bits: int = 8) -> Field:
    """Bits that are sent as 0 and not looked at."""
    return Field("", "uint", bits)


# -- rows --------------------------------------------------------------------------------------------------


@dataclass(frozen=True, slots=True)
class Row:
    """One message."""

    name: str
    """The vendor's."""
    id: tuple[Field, ...]
    """The fields of its CAN id, the highest bits first; empty on serial. "address" is the device's."""
    fields: tuple[Field, ...]
    """Of its data: in order of bytes, within a byte (or a number) as `order` has it."""
    direction: Direction = "to_device"
    order: Literal["little", "big"] = "little"
    """Little: the first field has the lowest bits; big: the highest, and numbers are big-endian."""
    sent: int = 0
    """Bytes that are sent, if more or fewer than the fields have (padding is 0)."""
    fewest: int = -1
    """Fewest bytes that are accepted, as if the rest were 0; −1: all."""
    read_only: bool = False
    """It neither moves, arms, clears nor configures anything."""
    extended: bool = False
    """Its id has 29 bits."""
    remote: bool = False
    """It is sent as a remote frame, without data: a request for the message with this id."""

    @property
    def size(self) -> int:
        """Bytes of its fields."""
        return (sum(field.bits for field in self.fields) + 7) // 8

    def field(self, name: str) -> Field:
        """Return the field of this name, of the data or the id."""
        return next(field for field in (*self.fields, *self.id) if field.name == name)


@dataclass(slots=True)
class Decoded:
    """A message that was received. (Never changed; a frozen one takes three times as long to create.)"""

    name: str
    """ "" if the id is one of the table's, but the data fits none of its messages."""
    address: int
    """−1: the address is in data that do not fit."""
    values: Values


@dataclass(frozen=True, slots=True)
class _Compiled:
    row: Row
    base: int
    """The id's constant bits, with the bit of its format."""
    mask: int
    """Which bits are constant."""
    shift: int
    """Of the address; −1: the id has none."""
    address_mask: int
    in_data: bool
    """The address is a field of the data."""
    encode: Callable[..., bytes]
    decode: Callable[[bytes], Values | None]
    encode_id: Callable[..., int] | None
    """For an id that carries more than an address."""
    decode_id: Callable[[bytes], Values | None] | None

    def address(self, number: int) -> int:
        """Return the address in an id; −1: it is in the data."""
        return -self.in_data if self.shift < 0 else number >> self.shift & self.address_mask


_Decode: TypeAlias = Callable[[bytes], Values | None]
_Candidate: TypeAlias = tuple[str, int, bool, _Decode, _Decode | None]
"""Name, address, whether a remote frame, and how to decode data and id."""


class Table:
    """The messages of a protocol."""

    def __init__(self, rows: Iterable[Row]) -> None:
        self.rows = tuple(rows)
        compiled = [_compile(row) for row in self.rows]
        self._by_name = {each.row.name: each for each in compiled}
        self._lookup: dict[Direction, list[tuple[int, dict[int, list[_Compiled]]]]] = {
            direction: _by_id([each for each in compiled if each.row.direction == direction])
            for direction in _DIRECTIONS
        }
        self._seen: dict[Direction, dict[int, Sequence[_Candidate]]] = {each: {} for each in _DIRECTIONS}

    def __deepcopy__(self, memo: object) -> Table:
        """A table is a constant: copies of a driver's state share it."""
        return self

    def row(self, name: str) -> Row:
        """Return a row by its name."""
        return self._by_name[name].row

    # -- encoding ------------------------------------------------------------------------------------

    def encode(self, name: str, address: int = 0, /, **values: Any) -> CanFrame:  # noqa: ANN401 -- numbers
        """Return the frame of a message to or from the device at an address. Raises ValueError for a number
        that is not finite, TypeError for a field that is missing or unknown."""
        each = self._by_name[name]
        number = each.base | address << each.shift if each.shift >= 0 else each.base
        if each.encode_id is not None:
            names = [field.name for field in each.row.id if field.name not in ("", "address")]
            number |= each.encode_id(**{key: values.pop(key) for key in names})
        row = each.row
        if each.in_data:
            values["address"] = address
        if number & EXTENDED_BIT:
            return CanFrame(number & ~EXTENDED_BIT, each.encode(**values), True, row.remote)
        return CanFrame(number, each.encode(**values), False, row.remote)

    def data(self, name: str, /, **values: Any) -> bytes:  # noqa: ANN401 -- numbers
        """Return the data of a message alone (on serial, its body)."""
        return self._by_name[name].encode(**values)

    # -- decoding ------------------------------------------------------------------------------------

    def decode(self, frame: Frame, direction: Direction) -> Decoded | None:
        """Return the message in a frame: the first row that fits; None if the id is none of the table's."""
        if not isinstance(frame, CanFrame) or frame.fd:
            return None
        number = frame.id | EXTENDED_BIT if frame.extended else frame.id
        candidates = self._seen[direction].get(number)
        if candidates is None:
            candidates = self._candidates(number, direction)
        misfit: Decoded | None = None
        for name, address, remote, decode, decode_id in candidates:
            if remote is frame.remote:
                values = decode(frame.data)
                if values is not None:
                    if decode_id is not None:
                        values |= decode_id(frame.id.to_bytes(4, "big")) or {}
                    return Decoded(name, values["address"] if address < 0 else address, values)
                misfit = Decoded("", address, {})
        return misfit

    def _candidates(self, number: int, direction: Direction) -> Sequence[_Candidate]:
        """Return the rows that an id can be of. Ids of 11 bits are looked up once."""
        rows = [each for mask, rows in self._lookup[direction] for each in rows.get(number & mask, ())]
        candidates = tuple(
            (each.row.name, each.address(number), each.row.remote, each.decode, each.decode_id)
            for each in rows
        )
        if number < 0x800:
            self._seen[direction][number] = candidates
        return candidates

    def read(self, name: str, data: bytes) -> Values | None:
        """Return the numbers in the data of a message; None if it is malformed."""
        return self._by_name[name].decode(data)

    # -- what the plugin's description is made of ----------------------------------------------------

    def names(self, frame: Frame) -> tuple[str, ...]:
        """Return the name of the message to a device in a frame, as `Plugin.messages` does."""
        decoded = self.decode(frame, "to_device")
        return (decoded.name,) if decoded is not None and decoded.name else ()

    def read_only(self, frame: Frame) -> bool:
        """True if a frame holds a message that changes nothing, as `Spec.read_only` does."""
        decoded = self.decode(frame, "to_device")
        return decoded is not None and bool(decoded.name) and self._by_name[decoded.name].row.read_only

    def ids(self, direction: Direction, address: int, without: Iterable[str] = ()) -> tuple[IdMask, ...]:
        """Return the ids of the messages to or from a device as (id, mask), each once."""
        chosen = [each for each in self._by_name.values() if each.row.direction == direction]
        return tuple(
            dict.fromkeys(_id_mask(each, address) for each in chosen if each.row.name not in without)
        )

    def range(self, message: str, field: str, unit: float = 1.0, inside: int = 0) -> Range:
        """Return the range of a field; see `Field.range`."""
        return self.row(message).field(field).range(unit, inside)


def _id_mask(each: _Compiled, address: int) -> IdMask:
    number, mask = each.base, each.mask
    if each.shift >= 0:
        number, mask = number | address << each.shift, mask | each.address_mask << each.shift
    return number, mask


def _by_id(compiled: list[_Compiled]) -> list[tuple[int, dict[int, list[_Compiled]]]]:
    """Return, for each mask of constant bits, the rows by these bits; the most particular mask first."""
    found: dict[int, dict[int, list[_Compiled]]] = {}
    for each in compiled:
        found.setdefault(each.mask, {}).setdefault(each.base, []).append(each)
    return sorted(found.items(), key=lambda item: -item[0].bit_count())


# -- compiling ---------------------------------------------------------------------------------------------


def _compile(row: Row) -> _Compiled:
    width = sum(field.bits for field in row.id)
    if row.id and width > (29 if row.extended else 11):
        raise ValueError(f"{row.name}: an id of {width} bits")
    left, base, mask, shift, address_mask, carries = width, 0, 0, -1, 0, False
    for field in row.id:
        left -= field.bits
        ones = (1 << field.bits) - 1
        if field.kind == "const":
            base, mask = base | int(field.low) << left, mask | ones << left
        elif field.name == "address":
            shift, address_mask = left, ones
        else:
            carries = True
    outside = 0x1FFF_FFFF >> width << width if row.id else 0
    base, mask = base | EXTENDED_BIT * row.extended, mask | outside | EXTENDED_BIT
    encode, decode = _functions(row.fields, row.order, row.sent or row.size, row.fewest, remote=row.remote)
    encode_id: Callable[..., int] | None = None
    decode_id = None
    if carries:
        free = tuple(Field("", "uint", f.bits) if f.name in ("", "address") else f for f in row.id)
        head = (unused(32 - width), *free)
        pack, decode_id = _functions(head, "big", 4, 4)
        encode_id = lambda **values: int.from_bytes(pack(**values), "big")  # noqa: E731
    in_data = shift < 0 and any(field.name == "address" for field in row.fields)
    return _Compiled(row, base, mask, shift, address_mask, in_data, encode, decode, encode_id, decode_id)


_CODES = {("uint", 8): "B", ("uint", 16): "H", ("uint", 32): "I", ("uint", 64): "Q"}
_CODES |= {("int", bits): code.lower() for (_, bits), code in _CODES.items()}


def _functions(
    fields: tuple[Field, ...],
    order: Literal["little", "big"],
    sent: int,
    fewest: int,
    *,
    remote: bool = False,
) -> tuple[Callable[..., bytes], Callable[[bytes], Values | None]]:
    """Return `encode(**values) -> bytes` and `decode(bytes) -> values | None` of these fields."""
    size = (sum(field.bits for field in fields) + 7) // 8
    scope: dict[str, Any] = {
        "saturated": saturated,
        "isfinite": math.isfinite,
        "nan": math.nan,
        "FMAX": FLOAT_MAX,
    }
    scope |= {"TINY": TINY, "f32_bits": _f32_bits, "f32_value": _f32_value}
    named = [field.name for field in fields if field.name]
    signature = f"*, {', '.join(named)}" if named else ""
    raws = [_to_raw(field) for field in fields]
    codes = [_struct_code(field) for field in fields]
    if all(codes):
        packer = struct.Struct(("<" if order == "little" else ">") + "".join(codes))
        scope |= {"pack": packer.pack, "unpack": packer.unpack}
        packed = f"pack({', '.join(raws)})"
        taken = [f"{_variables(len(fields))} unpack(data)"] if fields else []
    else:
        shifts = _shifts(fields, order, size)
        raws = [_f32_raw(field, raw) for field, raw in zip(fields, raws, strict=True)]
        number = " | ".join(
            f"({raw}) << {shift}"
            if field.kind not in ("int",)
            else f"(({raw}) & {(1 << field.bits) - 1}) << {shift}"
            for field, raw, shift in zip(fields, raws, shifts, strict=True)
        )
        packed = f"({number}).to_bytes({size}, {order!r})"
        taken = [f"n = int.from_bytes(data, {order!r})"]
        taken += [f"r{at} = {_bits(f, s)}" for at, (f, s) in enumerate(zip(fields, shifts, strict=True))]
    if sent > size:
        packed += f" + {bytes(sent - size)!r}"
    elif sent < size:
        packed = f"({packed})[:{sent}]"
    encode = f"def encode({signature}):\n    return {packed}\n"
    lines = ["def decode(data):"]
    if not remote:
        shortest = size if fewest < 0 else fewest
        lines.append(f"    if len(data) != {size}:")
        lines.append(
            f"        if not {shortest} <= len(data) <= {max(8, sent)}:"
            if fewest >= 0 or sent > size
            else "        if True:"
        )
        lines.append("            return None")
        if fewest >= 0 or sent > size:
            lines.append(f"        data = data[:{size}].ljust({size}, b'\\0')")
    else:
        taken = []
    lines += [f"    {line}" for line in taken]
    lines += [f"    {line}" for line in _checks(fields)] if not remote else []
    pairs = [f"{f.name!r}: {_from_raw(at, f)}" for at, f in enumerate(fields) if f.name] if not remote else []
    lines.append(f"    return {{{', '.join(pairs)}}}")
    exec(encode + "\n".join(lines), scope)  # noqa: S102 -- generated from the constants of a row alone
    return scope["encode"], scope["decode"]


def _variables(count: int) -> str:
    return "".join(f"r{at}, " for at in range(count)) + "="


def _struct_code(field: Field) -> str:
    """Return how `struct` has a field; "" if it has not."""
    if field.kind == "f32":
        return "f"
    return _CODES.get(("int" if field.kind == "int" else "uint", field.bits), "")


def _shifts(fields: tuple[Field, ...], order: str, size: int) -> list[int]:
    """Return how far each field lies from the lowest bit of the data as one number."""
    before = [sum(field.bits for field in fields[:at]) for at in range(len(fields))]
    if order == "little":
        return before
    return [8 * size - at - field.bits for at, field in zip(before, fields, strict=True)]


def _bits(field: Field, shift: int) -> str:
    raw = f"n >> {shift} & {(1 << field.bits) - 1}" if shift else f"n & {(1 << field.bits) - 1}"
    if field.kind == "f32":
        return f"f32_value({raw})"
    if field.kind != "int":
        return raw
    return f"(({raw}) ^ {1 << field.bits - 1}) - {1 << field.bits - 1}"


def _f32_raw(field: Field, raw: str) -> str:
    return f"f32_bits({raw})" if field.kind == "f32" else raw


def _to_raw(field: Field) -> str:
    """Return the expression for the raw number of a field to be sent."""
    x = field.name
    low, high = field.ends()
    if field.kind == "const" or not x:
        return str(int(field.low))
    if field.kind == "f32":
        value = (
            f"((0.0 if -TINY < {x} < TINY else {x}) if -FMAX <= {x} <= FMAX else saturated({x}, -FMAX, FMAX))"
        )
        return f"(nan if {x} is None else {value})" if field.optional else value
    inside = f"({x} if {low!r} <= {x} <= {high!r} else saturated({x}, {low!r}, {high!r}))"
    if field.kind == "span":
        steps = f"({inside} - {low!r}) * {1.0 / field.step!r}"
        return f"int({steps} + 1e-6)" if field.floor else f"round({steps})"
    return f"int({inside})" if field.unit == 1.0 else f"round({inside} / {field.unit!r})"


def _from_raw(at: int, field: Field) -> str:
    r = f"r{at}"
    if field.kind == "f32":
        value = f"(0.0 if -TINY < {r} < TINY else {r})"
        return f"(None if {r} != {r} else {value})" if field.optional else value
    if field.kind == "span":
        value = f"{r} * {field.step!r} + {field.low!r}"
        return f"(None if {r} in (0, {(1 << field.bits) - 1}) else {value})" if field.optional else value
    return r if field.unit == 1.0 else f"{r} * {field.unit!r}"


def _checks(fields: tuple[Field, ...]) -> list[str]:
    """Return the lines that refuse wrong constants and numbers that are not finite."""
    wrong = [f"r{at} != {int(f.low)}" for at, f in enumerate(fields) if f.kind == "const"]
    floats = [f"r{at}" for at, f in enumerate(fields) if f.kind == "f32" and not f.optional and f.name]
    # Two binary32 never overflow a binary64: their sum is finite if both are.
    wrong += [f"not isfinite({' + '.join(floats)})"] if floats else []
    wrong += [
        f"(r{at} - r{at} != 0.0 and r{at} == r{at})"
        for at, f in enumerate(fields)
        if f.optional and f.kind == "f32"
    ]
    return [f"if {' or '.join(wrong)}:", "    return None"] if wrong else []


def saturated(value: float, low: float, high: float) -> float:
    """Return the end of a range that a value lies beyond: a number that wraps would push the other way.
    Raises ValueError if it is not finite."""
    if not math.isfinite(value):
        raise ValueError(f"{value} is not finite: it is never sent")
    return low if value < low else high


def _f32_bits(value: float) -> int:
    return int.from_bytes(struct.pack(">f", value), "big")


def _f32_value(raw: int) -> float:
    value: float = struct.unpack(">f", raw.to_bytes(4, "big"))[0]
    return value
