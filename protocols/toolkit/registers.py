"""Parameters of a device by name, number and type: the registers of its protocol."""

from __future__ import annotations

import struct
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from math import isfinite
from typing import Literal, TypeAlias

from protocols.messages import MILLISECOND, Nanos
from protocols.suggest import did_you_mean
from protocols.toolkit.table import FLOAT_MAX, TINY, saturated

Type: TypeAlias = Literal["u8", "u16", "u32", "i16", "i32", "f32"]
ENDS: Mapping[str, tuple[float, float]] = {
    "u8": (0, 0xFF),
    "u16": (0, 0xFFFF),
    "u32": (0, 0xFFFF_FFFF),
    "i16": (-0x8000, 0x7FFF),
    "i32": (-0x8000_0000, 0x7FFF_FFFF),
    "f32": (-FLOAT_MAX, FLOAT_MAX),
}


@dataclass(frozen=True, slots=True)
class Register:
    """One parameter."""

    name: str
    """The vendor's."""
    number: int
    type: Type
    writable: bool = True


class Registers:
    """The parameters of a device, by name and by number."""

    def __init__(self, *registers: Register) -> None:
        self.by_name = {each.name: each for each in registers}
        self.by_number = {each.number: each for each in registers}

    def __deepcopy__(self, memo: object) -> Registers:
        """Registers are constants."""
        return self

    def wrong(self, name: str, value: float | None = None) -> str:
        """Return why a parameter cannot be read or (with a value) written, "" if it can."""
        register = self.by_name.get(name)
        if register is None:
            hint = did_you_mean(name, self.by_name)
            return f"no parameter {name!r}{hint}; there are {', '.join(self.by_name)}"
        if value is None:
            return ""
        if not register.writable:
            return f"{name} is read only"
        low, high = ENDS[register.type]
        if low <= value <= high and (register.type == "f32" or value == int(value)):
            return ""
        return f"{name} cannot be {value:g}: it is {register.type}, {low:g} … {high:g}"

    def raw(self, name: str, value: float) -> int:
        """Return a value as the bits of its register, unsigned."""
        kind = self.by_name[name].type
        if kind == "f32":
            value = value if -FLOAT_MAX <= value <= FLOAT_MAX else saturated(value, -FLOAT_MAX, FLOAT_MAX)
            bits: int = struct.unpack("<I", struct.pack("<f", value if abs(value) >= TINY else 0.0))[0]
            return bits
        return int(value) & (1 << int(kind[1:])) - 1

    def value(self, number: int, raw: int) -> tuple[str, float | None]:
        """Return the name and value of a register's bits; None if it has no name, or is not finite."""
        register = self.by_number.get(number)
        if register is None:
            return "", None
        if register.type == "f32":
            value: float = struct.unpack("<f", struct.pack("<I", raw & 0xFFFF_FFFF))[0]
            return register.name, ((value if abs(value) >= TINY else 0.0) if isfinite(value) else None)
        bits = int(register.type[1:])
        raw &= (1 << bits) - 1
        signed = register.type[0] == "i" and raw >> bits - 1
        return register.name, float(raw - (1 << bits) if signed else raw)


@dataclass(slots=True)
class RegisterCache:
    """What is known of the registers of one device since it was last forgotten, and what was asked for."""

    known: dict[str, float] = field(default_factory=dict)
    asked: dict[str, Nanos] = field(default_factory=dict)
    """When each register was last asked for or written."""
    answer: Nanos = 200 * MILLISECOND
    """Time within which a frame may be the answer about a register."""
    retry: Nanos = 50 * MILLISECOND

    def ask(self, now: Nanos, name: str) -> str:
        """Record that a register is asked for; return its name."""
        self.asked[name] = now
        return name

    def put(self, name: str, value: float) -> None:
        """Record the content of a register."""
        self.known[name] = value

    def forget(self) -> None:
        """Forget everything: the device may have restarted."""
        self.known.clear()
        self.asked.clear()

    def is_asked(self, t: Nanos, name: str) -> bool:
        """True if a frame received now may be the answer about this register."""
        return name in self.asked and t - self.asked[name] < self.answer

    def missing(self, now: Nanos, names: Iterable[str]) -> list[str]:
        """Return which of these are not known, and may be asked for now."""
        return [name for name in names if name not in self.known and self._retry(now, name)]

    def different(self, wanted: Mapping[str, float]) -> dict[str, float]:
        """Return the registers that are known to hold something else."""
        return {n: v for n, v in wanted.items() if abs(self.known.get(n, v) - v) > 1e-3 * max(1.0, abs(v))}

    def to_write(self, now: Nanos, wanted: Mapping[str, float]) -> list[tuple[str, float]]:
        """Return the registers that hold something else, and may be written now."""
        return [(name, value) for name, value in self.different(wanted).items() if self._retry(now, name)]

    def _retry(self, now: Nanos, name: str) -> bool:
        return now - self.asked.get(name, -self.retry) >= self.retry
