"""The object dictionary: types, objects, tables of them, and the communication profile of every device.

Rules. One line per object; `to_bytes` and `from_bytes` are the only conversion between value and bytes.
Nothing wraps: a value outside its type is a ValueError when encoded, and bytes of a wrong length decode to
None. A device may have more objects than its table here, and need not have all of them.

Source: CiA 301.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from enum import Enum
from typing import Literal, TypeAlias

Key: TypeAlias = tuple[int, int]
"""(index, subindex)"""
Access: TypeAlias = Literal["ro", "rw", "wo", "const"]


class Type(Enum):
    """Data types of CiA 301: (code in an EDS, bits, signed). Bits 0: text of any length."""

    I8 = (0x02, 8, True)
    I16 = (0x03, 16, True)
    I32 = (0x04, 32, True)
    U8 = (0x05, 8, False)
    U16 = (0x06, 16, False)
    U32 = (0x07, 32, False)
    TEXT = (0x09, 0, False)

    def __init__(self, code: int, bits: int, signed: bool) -> None:
        self.code = code
        self.bits = bits
        self.signed = signed
        self.low = -(1 << bits - 1) if signed else 0
        """Smallest value."""
        self.high = (1 << bits - signed) - 1
        """Largest value."""


@dataclass(frozen=True, slots=True)
class Object:
    """One value in a device's dictionary."""

    key: Key
    name: str
    type: Type
    access: Access = "rw"
    unit: str = ""
    mappable: bool = False


def title(key: Key) -> str:
    """Return an object's address as text, as `find` takes it: "6083", "608F:01"."""
    return f"{key[0]:04X}:{key[1]:02X}" if key[1] else f"{key[0]:04X}"


def declared(writes: Iterable[tuple[Key, int]]) -> dict[str, tuple[float, ...]]:
    """Return objects and values that are written, as `Spec.set_up` has them."""
    found: dict[str, tuple[float, ...]] = {}
    for key, value in writes:
        found[title(key)] = (*found.get(title(key), ()), float(value))
    return found


def to_bytes(type_: Type, value: int) -> bytes:
    """Encode a value. ValueError if it is outside the type."""
    if not type_.low <= value <= type_.high:
        raise ValueError(f"{value} is outside {type_.name} ({type_.low} to {type_.high})")
    return value.to_bytes(type_.bits // 8, "little", signed=type_.signed)


def from_bytes(type_: Type, data: bytes) -> int | None:
    """Decode a value; None if the number of bytes is not the type's."""
    if len(data) * 8 != type_.bits:
        return None
    return int.from_bytes(data, "little", signed=type_.signed)


def parse(text: str) -> Key | None:
    """Parse an address, whether the object is known or not; None if it is no address."""
    plain = text.strip().casefold().removeprefix("0x").replace("sub", ":").replace(" ", "")
    index, _, sub = plain.partition(":")
    try:
        key = int(index, 16), int(sub, 16) if sub else 0
    except ValueError:
        return None
    return key if len(index) == 4 and 0 <= key[1] <= 0xFF and index.isalnum() else None


# -- the communication profile ---

_ROWS: list[Object] = []


def _row(index: int, sub: int, name: str, type_: Type, access: Access = "rw", unit: str = "") -> Key:
    _ROWS.append(Object((index, sub), name, type_, access, unit))
    return index, sub


DEVICE_TYPE = _row(0x1000, 0, "Device type", Type.U32, "ro")
ERROR_REGISTER = 0x1001, 0
_ROWS.append(Object(ERROR_REGISTER, "Error register", Type.U8, "ro", mappable=True))
ERROR_COUNT = _row(0x1003, 0, "Number of errors", Type.U8)
ERROR_HISTORY = 0x1003
"""Index of the last errors: subindex 1 is the newest."""
HISTORY_MOST = 8
_ROWS += [Object((0x1003, sub), f"Error {sub}", Type.U32, "ro") for sub in range(1, HISTORY_MOST + 1)]
SYNC_COB_ID = _row(0x1005, 0, "COB-ID SYNC message", Type.U32)
SYNC_PERIOD = _row(0x1006, 0, "Communication cycle period", Type.U32, unit="µs")
DEVICE_NAME = _row(0x1008, 0, "Manufacturer device name", Type.TEXT, "const")
HARDWARE_VERSION = _row(0x1009, 0, "Manufacturer hardware version", Type.TEXT, "const")
SOFTWARE_VERSION = _row(0x100A, 0, "Manufacturer software version", Type.TEXT, "const")
STORE = _row(0x1010, 1, "Store all parameters", Type.U32)
RESTORE = _row(0x1011, 1, "Restore all default parameters", Type.U32)
EMCY_COB_ID = _row(0x1014, 0, "COB-ID EMCY", Type.U32, "ro")
CONSUMER_HEARTBEAT = _row(0x1016, 1, "Consumer heartbeat time", Type.U32, unit="node << 16 | ms")
PRODUCER_HEARTBEAT = _row(0x1017, 0, "Producer heartbeat time", Type.U16, unit="ms")
VENDOR_ID = _row(0x1018, 1, "Vendor-ID", Type.U32, "ro")
PRODUCT_CODE = _row(0x1018, 2, "Product code", Type.U32, "ro")
REVISION = _row(0x1018, 3, "Revision number", Type.U32, "ro")
SERIAL_NUMBER = _row(0x1018, 4, "Serial number", Type.U32, "ro")
ERROR_BEHAVIOUR = _row(0x1029, 1, "Communication error", Type.U8)

# -- PDO parameters ---------------------------------------------------------------------------------------

RPDO_COMMUNICATION = 0x1400
RPDO_MAPPING = 0x1600
TPDO_COMMUNICATION = 0x1800
TPDO_MAPPING = 0x1A00
MAPPING_OFFSET = RPDO_MAPPING - RPDO_COMMUNICATION
"""From the communication parameter of a PDO to its mapping parameter, RPDO and TPDO alike."""
PDO_PARAMETERS = range(RPDO_COMMUNICATION, TPDO_MAPPING + MAPPING_OFFSET)
COB_ID = 1
TRANSMISSION = 2
INHIBIT = 3
"""Subindex of the inhibit time, in 100 µs (TPDO only)."""
EVENT_TIMER = 5
"""Subindex of the event timer, in ms; of an RPDO: the deadline for the next one."""
PDO_NUMBERS = (1, 2, 3, 4)
MAPPED_MOST = 8
"""Objects in one PDO, as far as supported here."""


def _pdo_rows(first: int, what: str) -> list[Object]:
    rows = []
    for number in PDO_NUMBERS:
        index, mapped, name = first + number - 1, first + MAPPING_OFFSET + number - 1, f"{what}{number}"
        rows += [
            Object((index, 0), f"{name} highest subindex", Type.U8, "ro"),
            Object((index, COB_ID), f"{name} COB-ID", Type.U32),
            Object((index, TRANSMISSION), f"{name} transmission type", Type.U8),
            Object((index, INHIBIT), f"{name} inhibit time", Type.U16, "rw", "100 µs"),
            Object((index, EVENT_TIMER), f"{name} event timer", Type.U16, "rw", "ms"),
            Object((mapped, 0), f"{name} mapped objects", Type.U8),
            *(
                Object((mapped, sub), f"{name} mapped object {sub}", Type.U32)
                for sub in range(1, MAPPED_MOST + 1)
            ),
        ]
    return rows


_ROWS += _pdo_rows(RPDO_COMMUNICATION, "RPDO") + _pdo_rows(TPDO_COMMUNICATION, "TPDO")


class Objects(dict[Key, Object]):
    """The objects of one kind of device, by key, those of every device among them; never changed."""

    def __init__(self, rows: Iterable[Object]) -> None:
        rows = [*_ROWS, *rows]
        counted = {row.key[0] for row in rows if not row.key[1]}
        rows += [
            Object((index, 0), f"{index:04X} highest subindex", Type.U8, "ro")
            for index in sorted({row.key[0] for row in rows} - counted)
        ]
        super().__init__({row.key: row for row in sorted(rows, key=lambda row: row.key)})
        self._named = {row.name.casefold(): row for row in rows}
        self.indices = frozenset(index for index, _ in self)

    def __deepcopy__(self, _: dict[int, object]) -> Objects:
        return self

    def find(self, text: str) -> Key | None:
        """Return the key of a name in the table, or of any address: "6083", "0x6083", "608F:01"."""
        named = self._named.get(text.strip().casefold())
        return parse(text) if named is None else named.key
