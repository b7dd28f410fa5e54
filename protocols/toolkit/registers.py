"""Parameters of a device by name, number and type: the registers of its protocol."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Literal, TypeAlias

from protocols.messages import ReadParameter, Request, WriteParameter
from protocols.suggest import did_you_mean
from protocols.toolkit.table import Field, Row, Table, f32, sint, uint

Type: TypeAlias = Literal["u8", "u16", "u32", "i16", "i32", "f32"]
_FIELDS: Mapping[Type, Field] = {
    "u8": uint("value", 8),
    "u16": uint("value", 16),
    "u32": uint("value", 32),
    "i16": sint("value", 16),
    "i32": sint("value", 32),
    "f32": f32("value"),
}
_TABLE = Table(Row(kind, (), (field,)) for kind, field in _FIELDS.items())


@dataclass(frozen=True, slots=True)
class Register:
    """One parameter."""

    name: str
    """The vendor's."""
    number: int
    type: Type
    writable: bool = True
    sign: int = 0
    """The bit that is the sign of a magnitude, of an unsigned type; 0: there is none."""

    @property
    def size(self) -> int:
        """Return its bytes."""
        return _FIELDS[self.type].bits // 8

    def ends(self) -> tuple[float, float]:
        """Return the lowest and the highest value."""
        most = (1 << self.sign) - 1
        return (-most, most) if self.sign else _FIELDS[self.type].ends()


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
        low, high = register.ends()
        if low <= value <= high and (register.type == "f32" or value == int(value)):
            return ""
        return f"{name} cannot be {value:g}: it is {register.type}, {low:g} … {high:g}"

    def wrong_request(
        self, request: Request, save: str = "", protected: Mapping[str, str] | None = None
    ) -> str | None:
        """Return why a request to read or write a parameter cannot be carried out, "" if it can; None if it
        is another request. `save`: the parameter that saves all when 1 is written; `protected`: why others
        are not written, by name."""
        match request:
            case WriteParameter(_, name, value) if save and name == save:
                return "" if value == 1 else f"{name} takes 1"
            case WriteParameter(_, name) if protected and name in protected:
                return protected[name]
            case WriteParameter(_, name, value):
                return self.wrong(name, value)
            case ReadParameter(_, name):
                return self.wrong(name)
        return None

    def raw(self, name: str, value: float) -> int:
        """Return a value as the bits of its register, unsigned."""
        data = _TABLE.encode(self.by_name[name].type, value=value).data
        return int.from_bytes(data, "little")

    def value(self, number: int, raw: int) -> tuple[str, float | None]:
        """Return the name and value of a register's bits; None if it has no name, or is not finite."""
        register = self.by_number.get(number)
        if register is None:
            return "", None
        values = _TABLE.read(register.type, raw.to_bytes(8, "little")[: register.size])
        return register.name, float(values["value"]) if values else None
