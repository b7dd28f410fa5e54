"""Registers as a map of bytes, read and written by address: one, several in a row, or a block at once.

Rules. A map is a constant, written as a text: a row has address, type and name of a register, and "r" if it
is only read. Types are those of `Register`, and m10, m11 …: two bytes with a magnitude, whose sign is this
bit; bits above it mean nothing. Writing saturates, and raises ValueError for a number that is not finite.
"""

from __future__ import annotations

import re
import struct
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from math import inf, isfinite
from typing import Any, Literal, NamedTuple, TypeAlias, cast

from protocols.messages import Position, Torque, Velocity
from protocols.toolkit.registers import Register, Registers, Type

Target: TypeAlias = tuple[int, int]
"""Address and size of what is read."""
Values: TypeAlias = dict[str, int]
"""What registers hold, by name."""
SetPoint: TypeAlias = Position | Velocity | Torque
LAYOUTS = 1024
"""Runs of bytes of which the layout is kept"""
FORMS: Mapping[Type, str] = {"u8": "B", "u16": "H", "u32": "I", "i16": "h", "i32": "i"}


def rows(*texts: str, shift: int = 0) -> list[Register]:
    """Return the registers of texts: rows are lines, or stand between "|"; `shift`: how far they lie from
    the addresses given."""
    found = []
    for at, kind, name, *access in map(str.split, filter(None, re.split(r"\n|\|", "|".join(texts)))):
        sign = int(kind[1:]) if kind[0] == "m" else 0
        type_ = cast("Type", "u16" if sign else kind)
        found.append(Register(name, int(at) + shift, type_, not access, sign))
    return found


@dataclass(frozen=True, slots=True)
class GoalRegister:
    """The register of a set-point, in one mode of a device."""

    register: str
    command: type[SetPoint]
    unit: float
    """One step in the command's unit; below 0 where it pushes the other way"""
    zero: int = 0
    """Where the command is 0."""
    ends: tuple[float, float] = (-inf, inf)

    def raw(self, value: float) -> float:
        """Return what the register holds for the number of a command."""
        low, high = self.ends
        return min(max(value / self.unit + self.zero, low), high)

    def obeyed(self, name: str, raw: int) -> SetPoint:
        """Return the command that the device obeys."""
        return self.command(name, (raw - self.zero) * self.unit + 0.0)  # no -0.0, of a unit below 0


class Layout(NamedTuple):
    """How registers lie in a run of bytes."""

    read: Callable[[bytes], Values]
    whole: bool
    """They fill the run."""


class MemoryMap(Registers):
    """The registers of devices that are programmed alike. A constant."""

    def __init__(
        self,
        registers: Iterable[Register],
        blocks: Mapping[str, Target],
        stored: int = 0,
        order: Literal["little", "big"] = "little",
    ) -> None:
        """`blocks`: what is read at once. Registers below `stored` are kept without supply."""
        super().__init__(*sorted(registers, key=lambda each: each.number))
        self.blocks, self.stored, self.order = blocks, stored, order
        self._order = "<" if order == "little" else ">"
        every = self.by_name.values()
        forms = {each.name: struct.Struct(self._order + FORMS[each.type]) for each in every}
        signs = {each.name: 1 << each.sign if each.sign else 0 for each in every}
        self._codes: dict[str, tuple[Callable[[float], bytes], float, float, int]] = {
            each.name: (forms[each.name].pack, *each.ends(), signs[each.name]) for each in every
        }
        self._kept = {
            each.name: (each.number, forms[each.name].unpack_from, signs[each.name]) for each in every
        }
        """How a register is read in an image of all of them."""
        self._targets = {each.name: (each.number, each.size) for each in self.by_name.values()}
        self._layouts: dict[Target, Layout] = {}
        self._within: dict[Target, tuple[Register, ...]] = {}

    def data(self, name: str, value: float) -> bytes:
        """Return a value as the bytes of its register, at the ends of its range beyond it."""
        pack, low, high, sign = self._codes[name]
        if not low <= value <= high:
            if not isfinite(value):
                raise ValueError(f"{name} is {value}: it is never sent")
            value = min(max(value, low), high)
        number = round(value)
        return pack(sign - number if sign and number < 0 else number)

    def runs(self, values: Mapping[str, float]) -> list[tuple[int, bytes]]:
        """Return what is written, in the order given: those that lie behind one another at once."""
        found: list[tuple[int, bytes]] = []
        for name, value in values.items():
            at, data = self.by_name[name].number, self.data(name, value)
            first, before = found[-1] if found else (at, b"")
            if before and first + len(before) == at:
                found[-1] = first, before + data
            else:
                found.append((at, data))
        return found

    def values(self, at: int, data: bytes) -> Values:
        """Return the values of the registers of which a run of bytes has all."""
        found = self._layouts.get((at, len(data)))
        return (self.layout(at, len(data)) if found is None else found).read(data)

    def held(self, name: str, image: bytes) -> int:
        """Return the value of a register in an image of all of them; 0 if there is no such register."""
        kept = self._kept.get(name)
        if kept is None:
            return 0
        at, unpack, sign = kept
        raw: int = unpack(image, at)[0]
        if not sign:
            return raw
        return -(raw & sign - 1) if raw & sign else raw & sign - 1

    def target(self, name: str) -> Target:
        """Return where a register lies."""
        return self._targets[name]

    def within(self, at: int, size: int) -> tuple[Register, ...]:
        """Return the registers of which a run of bytes has a part."""
        found = self._within.get((at, size))
        if found is None:
            ends = ((each, each.number + each.size) for each in self.by_name.values())
            found = tuple(each for each, end in ends if each.number < at + size and at < end)
            if len(self._within) >= LAYOUTS:
                self._within.clear()
            self._within[at, size] = found
        return found

    def is_stored(self, name: str) -> bool:
        """True if a register is kept without supply."""
        return self.by_name[name].number < self.stored

    def layout(self, at: int, size: int) -> Layout:
        """Return how the registers lie in a run of bytes, made once."""
        if (at, size) not in self._layouts:
            inside: list[Register] = []
            form, end = self._order, at
            for each in self.by_name.values():
                if end <= each.number and each.number + each.size <= at + size:
                    form += f"{each.number - end}x" + FORMS[each.type]
                    end = each.number + each.size
                    inside.append(each)
            if len(self._layouts) >= LAYOUTS:  # others may write anything
                self._layouts.clear()
            numbers = struct.Struct(f"{form}{at + size - end}x")
            whole = sum(each.size for each in inside) == size
            self._layouts[at, size] = Layout(_reader(inside, numbers), whole)
        return self._layouts[at, size]


def _reader(registers: Sequence[Register], numbers: struct.Struct) -> Callable[[bytes], Values]:
    """Return what makes values of a run of bytes, compiled: each answer is read by it."""
    taken = "".join(f"r{number}, " for number in range(len(registers)))
    values = ", ".join(f"{each.name!r}: {_value(each, f'r{at}')}" for at, each in enumerate(registers))
    scope: dict[str, Any] = {"unpack": numbers.unpack}
    statement = f"({taken}) = unpack(data)" if registers else "pass"
    source = f"def read(data):\n    {statement}\n    return {{{values}}}"
    exec(source, scope)  # noqa: S102 -- generated from the constants of registers alone
    read: Callable[[bytes], Values] = scope["read"]
    return read


def _value(register: Register, raw: str) -> str:
    """Return the expression for the value of a raw number."""
    sign, ones = 1 << register.sign, (1 << register.sign) - 1
    if register.sign == 8 * register.size - 1:  # no bits above it
        return f"{raw} if {raw} < {sign} else {sign} - {raw}"
    return f"-({raw} & {ones}) if {raw} & {sign} else {raw} & {ones}" if register.sign else raw
