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
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Literal, NamedTuple, TypeAlias

from protocols.frames import EXTENDED_BIT, ID_BITS, CanFrame, Frame, IdMask
from protocols.plugin import Range

FLOAT_MAX = 3.4028234663852886e38
TINY = 2.0**-126
"""Smallest normal binary32: a smaller magnitude counts as 0."""
BINARY32 = 2.0**-24 * 1.01
"""Largest relative error of rounding to binary32."""

REMEMBERED = 4096
"""Ids of which a table remembers what they are."""

Direction: TypeAlias = Literal["to_device", "from_device"]
DIRECTIONS: tuple[Direction, Direction] = "to_device", "from_device"
Order: TypeAlias = Literal["little", "big"]
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
        match self.kind:
            case "span":
                return self.low, self.high
            case "f32":
                return -FLOAT_MAX, FLOAT_MAX
            case "int":
                half = 1 << self.bits - 1
                return -half * self.unit, (half - 1) * self.unit
        return 0.0, ((1 << self.bits) - 1) * self.unit

    def range(self, unit: float = 1.0, inside: int = 0) -> Range:
        """Return the range in other units (`unit`: SI per unit of the field); `inside`: without as many
        counts at either end, where a device that saturates cannot be distinguished from one that measures."""
        low, high = self.ends()
        if self.kind == "f32":
            return Range(low * min(unit, 1.0), high * min(unit, 1.0), 1e-12, BINARY32)
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


def unused(bits: int = 8, value: int = 0) -> Field:
    """Bits that are sent as this value and not looked at."""
    return Field("", "uint", bits, low=value)


def fields(text: str) -> tuple[Field, ...]:
    """Return the numbers of a text: "count:u32 speed:i32 voltage:u16*0.1" are counts from 0, with a sign, and
    of which one is 0.1."""
    found = []
    for word in text.split():
        name, _, kind = word.partition(":")
        bits, _, unit = kind[1:].partition("*")
        found.append((sint if kind[0] == "i" else uint)(name, int(bits), float(unit or 1.0)))
    return tuple(found)


# -- rows --------------------------------------------------------------------------------------------------


@dataclass(frozen=True, slots=True)
class Row:
    """One message."""

    name: str
    """The vendor's."""
    id: tuple[Field, ...]
    """The fields of its CAN id, the highest bits first. "address" is the device's."""
    fields: tuple[Field, ...]
    """Of its data: in order of bytes, within a byte (or a number) as `order` has it."""
    direction: Direction = "to_device"
    order: Order = "little"
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

    def field(self, name: str) -> Field:
        """Return the field of this name, of the data or the id."""
        return next(field for field in (*self.fields, *self.id) if field.name == name)

    def first_byte(self) -> int | None:
        """Return the first byte of its data, if that is constant."""
        if not self.fields or self.fields[0].kind != "const" or self.fields[0].bits < 8:
            return None
        value, bits = int(self.fields[0].low), self.fields[0].bits
        return value & 0xFF if self.order == "little" else value >> bits - 8

    def id_parts(self) -> Iterator[tuple[Field, int, int]]:
        """Yield the fields of the id, with the place of the lowest bit and the mask of each."""
        at = sum(field.bits for field in self.id)
        if at > (29 if self.extended else 11):
            raise ValueError(f"{self.name}: an id of {at} bits")
        for field in self.id:
            at -= field.bits
            yield field, at, (1 << field.bits) - 1 << at

    def ids(self) -> RowIds:
        """Return its ids, for whoever asks often."""
        address = [(at, bits >> at) for field, at, bits in self.id_parts() if field.name == "address"]
        return RowIds(self, *self.id_mask(), tuple(address))

    def id_mask(self) -> IdMask:
        """Return the id's bits that are constant, and which these are."""
        number, mask = EXTENDED_BIT * self.extended, ID_BITS
        for field, at, bits in self.id_parts():
            if field.kind == "const":
                number |= int(field.low) << at
            else:
                mask &= ~bits
        return number, mask


class RowIds(NamedTuple):
    """The ids of a row."""

    row: Row
    constant: int
    mask: int
    address: tuple[tuple[int, int], ...]
    """Where the address is: the place of the lowest bit, and the mask of its number."""

    def of(self, address: int) -> IdMask:
        """Return the constant bits of the id of one device, and which these are."""
        number, mask = self.constant, self.mask
        for at, width in self.address:
            number, mask = number | address << at, mask | width << at
        return number, mask


class Decoded(NamedTuple):
    """A message that was received."""

    name: str
    """ "" if the id is one of the table's, but the data fits none of its messages."""
    address: int
    """−1: the address is in data that do not fit."""
    values: Values


_Encode: TypeAlias = Callable[..., Any]
_Decode: TypeAlias = Callable[[int, int, bytes], Decoded | None]


class Line(NamedTuple):
    """How the messages of a table stand on a serial line."""

    frame: Callable[[bytes], bytes]
    """From a message without its checksum: the packet."""
    pack: Callable[[int, int, bytes], bytes] | None
    """From address, function (the low 8 bits of an id) and data: the message; None: a byte each, in this
    order, and the data."""


_Known: TypeAlias = tuple[_Decode, int, Decoded | None]
"""How frames of an id are decoded, the address in the id, and what is decoded if the data do not fit."""


class Table:
    """The messages of a protocol."""

    def __init__(self, rows: Iterable[Row], line: Line | None = None) -> None:
        """With a line, encoding returns packets in the place of CAN frames."""
        self.rows = tuple(rows)
        self._rows = {row.name: row for row in self.rows}
        self._encode: dict[str, _Encode] = {}
        self._decode: dict[str, _Decode] = {}
        for row in self.rows:
            self._encode[row.name], self._decode[row.name] = _compiled(row, line)
        self._ids = [row.ids() for row in self.rows]
        self._particular = sorted(self._ids, key=lambda ids: -ids.mask.bit_count())
        self._standard, self._extended = self._nothing_seen(False), self._nothing_seen(True)
        """By direction: the bits of ids that count, and what was looked up by these (inverted for a remote
        frame)."""
        self._decoded_last: tuple[Frame | None, Decoded | None] = (None, None)
        """The frame of which a device has asked last, and its message."""

    def _nothing_seen(self, extended: bool) -> dict[Direction, tuple[int, dict[int, _Known]]]:
        return {direction: (self._significant(direction, extended), {}) for direction in DIRECTIONS}

    def _significant(self, direction: Direction, extended: bool) -> int:
        """Return the bits of the ids of a format that tell messages and devices apart: not those of data."""
        bits = 0
        for row, _, mask, address in self._ids:
            if (row.direction, row.extended) == (direction, extended):
                bits |= mask | sum(width << at for at, width in address)
        return bits & ~EXTENDED_BIT

    def __deepcopy__(self, memo: object) -> Table:
        """A table is a constant: copies of a driver's state share it."""
        return self

    def row(self, name: str) -> Row:
        """Return a row by its name."""
        return self._rows[name]

    def encode(self, name: str, address: int = 0, /, **values: Any) -> CanFrame:  # noqa: ANN401 -- numbers
        """Return the frame of a message to or from the device at an address. Raises ValueError for a number
        that is not finite, TypeError for a field that is missing or unknown."""
        frame: CanFrame = self._encode[name](address, **values)
        return frame

    def encoder(self, name: str) -> Callable[..., CanFrame]:
        """Return `encode` for one message, in two thirds of the time: `encoder(name)(address, **values)`."""
        return self._encode[name]

    def packet_encoders(self) -> Mapping[str, Callable[..., bytes]]:
        """Return the same of a table with a line, by message."""
        return self._encode

    def decode(self, frame: Frame, direction: Direction) -> Decoded | None:
        """Return the message in a frame: the first row that fits; None if the id is none of the table's."""
        if not isinstance(frame, CanFrame) or frame.fd:
            return None
        significant, seen = (self._extended if frame.extended else self._standard)[direction]
        number = frame.id
        key = ~(number & significant) if frame.remote else number & significant
        try:
            decode, address, misfit = seen[key]
        except KeyError:
            decode, address, misfit = known = self._look_up(frame, direction)
            if len(seen) < REMEMBERED:
                seen[key] = known
        return decode(address, number, frame.data) or misfit

    def decode_bare(self, number: int, data: bytes, direction: Direction) -> Decoded | None:
        """Return the same of an extended id and data without a frame."""
        significant, seen = self._extended[direction]
        known = seen.get(number & significant)
        if known is None:
            return self.decode(CanFrame(number, data, extended=True), direction)
        decode, address, misfit = known
        return decode(address, number, data) or misfit

    def decode_once(self, frame: Frame) -> Decoded | None:
        """Return the message to a device in a frame, as `decode`: for twins, each of which receives every
        frame of a bus. It is decoded for the first of them; what is returned is not to be changed."""
        last = self._decoded_last
        if frame is not last[0]:
            last = self._decoded_last = frame, self.decode(frame, "to_device")
        return last[1]

    def _look_up(self, frame: CanFrame, direction: Direction) -> _Known:
        """Return how frames of an id are decoded. The most particular row comes first."""
        number = frame.id | EXTENDED_BIT if frame.extended else frame.id
        found: list[tuple[int | None, _Decode, int]] = []
        for row, constant, mask, bits in self._particular:
            if number & mask == constant and (row.direction, row.remote) == (direction, frame.remote):
                places = [number >> at & width for at, width in bits]
                address = places[0] if places else -any(field.name == "address" for field in row.fields)
                found.append((row.first_byte(), self._decode[row.name], address))
        if not found:
            return _first_of([]), 0, None
        _, decode, address = found[-1]
        return decode if len(found) == 1 else _first_of(found), address, Decoded("", address, {})

    def read(self, name: str, data: bytes) -> Values | None:
        """Return the numbers in the data of a message whose id has none; None if it is malformed."""
        decoded = self._decode[name](0, 0, data)
        return None if decoded is None else decoded.values

    # -- what the plugin's description is made of ----------------------------------------------------

    def names(self, frame: Frame) -> tuple[str, ...]:
        """Return the name of the message to a device in a frame, as `Plugin.messages` does."""
        decoded = self.decode(frame, "to_device")
        return (decoded.name,) if decoded is not None and decoded.name else ()

    def read_only(self, frame: Frame) -> bool:
        """True if a frame holds a message that changes nothing, as `Spec.read_only` does."""
        decoded = self.decode(frame, "to_device")
        return decoded is not None and decoded.name != "" and self._rows[decoded.name].read_only

    def ids(self, direction: Direction, address: int) -> tuple[IdMask, ...]:
        """Return the ids of the messages to or from a device, each once."""
        rows = [ids.of(address) for ids in self._ids if ids.row.direction == direction]
        return tuple(dict.fromkeys(rows))

    def range(self, message: str, field: str, unit: float = 1.0, inside: int = 0) -> Range:
        """Return the range of a field; see `Field.range`."""
        return self.row(message).field(field).range(unit, inside)


# -- compiling ---------------------------------------------------------------------------------------------

CODES = {("uint", 8): "B", ("uint", 16): "H", ("uint", 32): "I", ("uint", 64): "Q", ("f32", 32): "f"}
CODES |= {("int", 8): "b", ("int", 16): "h", ("int", 32): "i", ("int", 64): "q"}
"""How `struct` has a field that is a number of its own."""


def _compiled(row: Row, line: Line | None) -> tuple[_Encode, _Decode]:
    """Return `encode(address, **values) -> frame` and `decode(address, id, data) -> message` of a row. With a
    line: packets in the place of frames."""
    scope: dict[str, Any] = {"CanFrame": CanFrame, "Decoded": Decoded, "saturated": saturated}
    scope |= {
        "error": struct.error,
        "new": tuple.__new__,  # in half the time of the class's own
        "nan": math.nan,
        "inf": math.inf,
        "to_f32": _to_f32,
        "f32": _f32,
    }
    size = (sum(field.bits for field in row.fields) + 7) // 8
    constant = row.id_mask()[0] & ~EXTENDED_BIT
    addressed = any(field.name == "address" for field in row.id)
    head = ("address" if addressed else f"{constant >> 8}"), f"{constant & 0xFF}"
    before = head if line is not None and line.pack is None else ()
    words, taken, packed = _data(row, scope, before)
    packed = f"({packed})[:{len(before) + row.sent}]" if 0 < row.sent < size else packed
    raws = [f"r{at} = {_raw(field)}" for at, field in enumerate(row.fields) if field.name]

    names = [field.name for field in row.fields if field.name]
    number = [str(constant)]
    values = [f"{f.name!r}: {_value(f, f'r{at}')}" for at, f in enumerate(row.fields) if f.name]
    address = next((f"r{at}" for at, field in enumerate(row.fields) if field.name == "address"), "address")
    for field, at, bits in row.id_parts():
        part = f"(number >> {at} & {bits >> at})" if at else f"(number & {bits})"
        if field.name == "address":
            number.append(f"address << {at}")
        elif field.name:
            names.append(field.name)
            number.append(f"({_raw(field)}) << {at}")
            values.append(f"{field.name!r}: {_value(field, part)}")
        elif field.kind == "uint":
            number.append(str(int(field.low) << at))

    shortest = size if row.fewest < 0 else row.fewest
    longest = max(8, row.sent) if row.fewest >= 0 or row.sent > size else size
    # Data of exactly this size are the usual case: nothing but `unpack` looks at their length.
    received = f"unpack_from(data) if {size} < len(data) <= {longest} else unpack(data)"
    received = received if longest > size else "unpack(data)"
    given = ", ".join(name for name in names if name != "address")
    made = f"CanFrame({' | '.join(number)}, {packed}, {row.extended}, {row.remote})"
    if line is not None:
        scope |= {"frame": line.frame, "message": line.pack}
        made = f"frame({packed})" if before else f"frame(message({', '.join(head)}, {packed}))"
    source = f"""
def encode(address{f", *, {given}" if given else ""}):
    {"; ".join(raws) or "pass"}
    return {made}

def decode(address, number, data):
    try:
        {words} = {received}
    except error:
        if not {shortest} <= len(data) < {size}:
            return None
        {words} = unpack(data.ljust({size}, b"\\0"))
    {taken}
    {_wrong(row.fields)}
    return new(Decoded, ({row.name!r}, {address}, {{{", ".join(values)}}}))
"""
    exec(source, scope)  # noqa: S102 -- generated from the constants of a row alone
    return scope["encode"], scope["decode"]


def _data(row: Row, scope: dict[str, Any], before: Sequence[str]) -> tuple[str, str, str]:
    """Return the numbers of which data is made (raw numbers r0, r1 …; words w0, w1 … with parts of such),
    the statements that take the other raw numbers from these words, and the expression for the data, behind
    bytes that stand before them."""
    words = _words(row.fields)
    order, codes = "<" if row.order == "little" else ">", "".join(code for code, _, _ in words)
    packer = struct.Struct(order + codes)
    padded = struct.Struct(f"{order}{len(before)}B{codes}{max(0, row.sent - packer.size)}x")
    scope |= {"pack": padded.pack, "unpack": packer.unpack, "unpack_from": packer.unpack_from}
    names = [f"w{number}" for number in range(len(words))]
    taken = []
    packed: list[list[str]] = [[] for _ in words]
    start = 0
    for at, field in enumerate(row.fields):
        end, ones = start + field.bits, (1 << field.bits) - 1
        whole = (_code(field), start, end) in words
        sent, parts = f"r{at}" if field.name else str(int(field.low)), []
        if field.name and not whole:
            sent = {"f32": f"to_f32({sent})", "int": f"({sent} & {ones})"}.get(field.kind, sent)
        for number, (_, first, last) in enumerate(words):
            low, high = max(start, first), min(end, last)
            if low < high:
                little = row.order == "little"
                place, part = (low - first, low - start) if little else (last - high, end - high)
                packed[number].append(_bits(sent, part, high - low, field.bits, place))
                parts.append(_bits(f"w{number}", place, high - low, last - first, part))
        bits, half = " | ".join(parts), ones // 2 + 1
        if whole:
            names[words.index((_code(field), start, end))] = f"r{at}"
        elif field.name or field.kind == "const":
            bits = {"f32": f"f32({bits})", "int": f"(({bits}) ^ {half}) - {half}"}.get(field.kind, bits)
            taken.append(f"r{at} = {bits}")
        start = end
    received = "".join(f"{name}, " for name in names)
    return (
        f"({received})",
        "; ".join(taken) or "pass",
        f"pack({', '.join((*before, *map(' | '.join, packed)))})",
    )


def _bits(name: str, at: int, count: int, width: int, to: int) -> str:
    """Return the expression for some bits of a number of this width, moved from one place to another."""
    mask = f" & {(1 << count) - 1}" if at + count < width else ""
    taken = f"({name} >> {at}{mask})" if at else f"({name}{mask})" if mask else name
    return f"({taken} << {to})" if to else taken


def _words(fields: Sequence[Field]) -> list[tuple[str, int, int]]:
    """Cut data into numbers that `struct` has (code, first bit, the one behind the last): the fields that are
    such numbers, and the bytes between them."""
    words: list[tuple[str, int, int]] = []
    start = cut = 0
    for bits, code in (
        *((each.bits, _code(each)) for each in fields),
        (-sum(f.bits for f in fields) % 8, ""),
    ):
        start += bits
        if code and (start - bits, start % 8) == (cut, 0):
            words.append((code, cut, start))
            cut = start
        while start % 8 == 0 and cut < start:
            width = max(width for width in (8, 16, 32, 64) if width <= start - cut)
            words.append((CODES["uint", width], cut, cut + width))
            cut += width
    return words


def _code(field: Field) -> str:
    """Return how `struct` has a field; "" if it has none like it."""
    kind = "uint" if field.kind in ("const", "span") else field.kind
    return CODES.get((kind, field.bits), "")


def _raw(field: Field) -> str:
    """Return the expression for the raw number of a field to be sent."""
    x, (low, high) = field.name, field.ends()
    if field.kind == "const" or not x:
        return str(int(field.low))
    if field.kind == "f32":
        finite = f"{x} if {low!r} <= {x} <= {high!r} else saturated({x}, {low!r}, {high!r})"
        absent = f"nan if {x} is None else " if field.optional else ""
        return f"({absent}0.0 if {-TINY!r} < {x} < {TINY!r} else {finite})"
    if field.kind != "span" and field.unit == 1.0:  # a number is compared with its like in less time
        half = 1 << field.bits - 1
        low, high = (-half, half - 1) if field.kind == "int" else (0, 2 * half - 1)
    inside = f"({x} if {low!r} <= {x} <= {high!r} else saturated({x}, {low!r}, {high!r}))"
    if field.kind == "span":
        steps = f"({inside} - {low!r}) * {1.0 / field.step!r}"
        return f"int({steps} + 1e-6)" if field.floor else f"round({steps})"
    whole = f"{inside} if type({x}) is int else int({inside})"
    return f"({whole})" if field.unit == 1.0 else f"round({inside} / {field.unit!r})"


def _value(field: Field, raw: str) -> str:
    """Return the expression for the value of a raw number."""
    if field.kind == "f32":
        value = f"{raw} if {raw} >= {TINY!r} or {raw} <= {-TINY!r} else 0.0"
        return f"None if {raw} != {raw} else {value}" if field.optional else value
    if field.kind == "span":
        value = f"{raw} * {field.step!r} + {field.low!r}"
        return f"{value} if 0 < {raw} < {(1 << field.bits) - 1} else None" if field.optional else value
    return raw if field.unit == 1.0 else f"{raw} * {field.unit!r}"


def _wrong(fields: Sequence[Field]) -> str:
    """Return the statement that refuses wrong constants and numbers that are not finite."""
    wrong = [f"r{at} != {int(f.low)}" for at, f in enumerate(fields) if f.kind == "const"]
    floats = [f"r{at}" for at, f in enumerate(fields) if f.kind == "f32" and not f.optional and f.name]
    # Two binary32 never overflow a binary64: their sum is finite if both are. Nothing else by 0 is 0.
    wrong += [f"({' + '.join(floats)}) * 0.0 != 0.0"] if floats else []
    wrong += [f"r{at} in (inf, -inf)" for at, f in enumerate(fields) if f.optional and f.kind == "f32"]
    return f"if {' or '.join(wrong)}: return None" if wrong else "pass"


def _first_of(rows: Sequence[tuple[int | None, _Decode, int]]) -> _Decode:
    """Return how data are decoded that can be of several rows; of each: its first byte, if that is constant,
    how it is decoded, and the address in its id."""
    others = [row[1:] for row in rows if row[0] is None]
    by_first = {byte: [row[1:] for row in rows if row[0] in (None, byte)] for byte, _, _ in rows}

    def decode(_: int, number: int, data: bytes) -> Decoded | None:
        for row, address in by_first.get(data[0] if data else 0, others):
            decoded = row(address, number, data)
            if decoded is not None:
                return decoded
        return None

    return decode


def saturated(value: float, low: float, high: float) -> float:
    """Return the end of a range that a value lies beyond: a number that wraps would push the other way.
    Raises ValueError if it is not finite."""
    if not math.isfinite(value):
        raise ValueError(f"{value} is not finite: it is never sent")
    return low if value < low else high


def _to_f32(value: float) -> int:
    return int.from_bytes(struct.pack(">f", value), "big")


def _f32(raw: int) -> float:
    value: float = struct.unpack(">f", raw.to_bytes(4, "big"))[0]
    return value
