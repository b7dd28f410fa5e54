"""The object dictionary, as far as it is supported here: index and subindex, type, access, unit, name.

Rules. One line per object; `to_bytes` and `from_bytes` are the only conversion between value and bytes.
Nothing wraps: a value outside its type is a ValueError when encoded, and bytes of a wrong length decode to
None. A drive may have more objects than these, and need not have all of them.

Source: CiA 301 and CiA 402-2 (indices, types and units as in ros-industrial/ros2_canopen@6ada196
`canopen_tests/config/cia402/cia402_slave.eds`, where it has them).
"""

from __future__ import annotations

from collections.abc import Mapping
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

    @property
    def bits(self) -> int:
        """Length; 0 for text."""
        return self.type.bits


def title(key: Key) -> str:
    """Return an object's address as text, as `find` takes it: "6083", "608F:01"."""
    return f"{key[0]:04X}:{key[1]:02X}" if key[1] else f"{key[0]:04X}"


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


# -- the objects ----------------------------------------------------------------------------------------

_ROWS: list[Object] = []


def _object(
    index: int,
    sub: int,
    name: str,
    type_: Type,
    access: Access = "rw",
    unit: str = "",
    *,
    mappable: bool = False,
) -> Key:
    _ROWS.append(Object((index, sub), name, type_, access, unit, mappable))
    return index, sub


DEVICE_TYPE = _object(0x1000, 0, "Device type", Type.U32, "ro")
ERROR_REGISTER = _object(0x1001, 0, "Error register", Type.U8, "ro", mappable=True)
SYNC_COB_ID = _object(0x1005, 0, "COB-ID SYNC message", Type.U32)
SYNC_PERIOD = _object(0x1006, 0, "Communication cycle period", Type.U32, unit="µs")
DEVICE_NAME = _object(0x1008, 0, "Manufacturer device name", Type.TEXT, "const")
HARDWARE_VERSION = _object(0x1009, 0, "Manufacturer hardware version", Type.TEXT, "const")
SOFTWARE_VERSION = _object(0x100A, 0, "Manufacturer software version", Type.TEXT, "const")
EMCY_COB_ID = _object(0x1014, 0, "COB-ID EMCY", Type.U32, "ro")
CONSUMER_HEARTBEAT = _object(0x1016, 1, "Consumer heartbeat time", Type.U32, unit="node << 16 | ms")
PRODUCER_HEARTBEAT = _object(0x1017, 0, "Producer heartbeat time", Type.U16, unit="ms")
VENDOR_ID = _object(0x1018, 1, "Vendor-ID", Type.U32, "ro")
PRODUCT_CODE = _object(0x1018, 2, "Product code", Type.U32, "ro")
REVISION = _object(0x1018, 3, "Revision number", Type.U32, "ro")
SERIAL_NUMBER = _object(0x1018, 4, "Serial number", Type.U32, "ro")
ERROR_BEHAVIOUR = _object(0x1029, 1, "Communication error", Type.U8)
ABORT_CONNECTION = _object(0x6007, 0, "Abort connection option code", Type.I16)
ERROR_CODE = _object(0x603F, 0, "Error code", Type.U16, "ro", mappable=True)
CONTROLWORD = _object(0x6040, 0, "Controlword", Type.U16, mappable=True)
STATUSWORD = _object(0x6041, 0, "Statusword", Type.U16, "ro", mappable=True)
QUICK_STOP_OPTION = _object(0x605A, 0, "Quick stop option code", Type.I16)
SHUTDOWN_OPTION = _object(0x605B, 0, "Shutdown option code", Type.I16)
DISABLE_OPTION = _object(0x605C, 0, "Disable operation option code", Type.I16)
HALT_OPTION = _object(0x605D, 0, "Halt option code", Type.I16)
FAULT_OPTION = _object(0x605E, 0, "Fault reaction option code", Type.I16)
MODE = _object(0x6060, 0, "Modes of operation", Type.I8, mappable=True)
MODE_DISPLAY = _object(0x6061, 0, "Modes of operation display", Type.I8, "ro", mappable=True)
POSITION_DEMAND = _object(0x6062, 0, "Position demand value", Type.I32, "ro", "position", mappable=True)
POSITION = _object(0x6064, 0, "Position actual value", Type.I32, "ro", "position", mappable=True)
FOLLOWING_WINDOW = _object(0x6065, 0, "Following error window", Type.U32, unit="position")
FOLLOWING_TIME = _object(0x6066, 0, "Following error time out", Type.U16, unit="ms")
POSITION_WINDOW = _object(0x6067, 0, "Position window", Type.U32, unit="position")
POSITION_WINDOW_TIME = _object(0x6068, 0, "Position window time", Type.U16, unit="ms")
VELOCITY_DEMAND = _object(0x606B, 0, "Velocity demand value", Type.I32, "ro", "velocity", mappable=True)
VELOCITY = _object(0x606C, 0, "Velocity actual value", Type.I32, "ro", "velocity", mappable=True)
VELOCITY_WINDOW = _object(0x606D, 0, "Velocity window", Type.U16, unit="velocity")
VELOCITY_WINDOW_TIME = _object(0x606E, 0, "Velocity window time", Type.U16, unit="ms")
VELOCITY_THRESHOLD = _object(0x606F, 0, "Velocity threshold", Type.U16, unit="velocity")
TARGET_TORQUE = _object(0x6071, 0, "Target torque", Type.I16, unit="‰ of rated torque", mappable=True)
MAX_TORQUE = _object(0x6072, 0, "Max torque", Type.U16, unit="‰ of rated torque", mappable=True)
TORQUE_DEMAND = _object(0x6074, 0, "Torque demand", Type.I16, "ro", "‰ of rated torque", mappable=True)
RATED_CURRENT = _object(0x6075, 0, "Motor rated current", Type.U32, unit="mA")
RATED_TORQUE = _object(0x6076, 0, "Motor rated torque", Type.U32, unit="mN·m")
TORQUE = _object(0x6077, 0, "Torque actual value", Type.I16, "ro", "‰ of rated torque", mappable=True)
CURRENT = _object(0x6078, 0, "Current actual value", Type.I16, "ro", "‰ of rated current", mappable=True)
DC_VOLTAGE = _object(0x6079, 0, "DC link circuit voltage", Type.U32, "ro", "mV", mappable=True)
TARGET_POSITION = _object(0x607A, 0, "Target position", Type.I32, unit="position", mappable=True)
HOME_OFFSET = _object(0x607C, 0, "Home offset", Type.I32, unit="position")
SOFT_LIMIT_LOW = _object(0x607D, 1, "Min position limit", Type.I32, unit="position")
SOFT_LIMIT_HIGH = _object(0x607D, 2, "Max position limit", Type.I32, unit="position")
MAX_PROFILE_VELOCITY = _object(0x607F, 0, "Max profile velocity", Type.U32, unit="velocity", mappable=True)
MAX_MOTOR_SPEED = _object(0x6080, 0, "Max motor speed", Type.U32, unit="rpm", mappable=True)
PROFILE_VELOCITY = _object(0x6081, 0, "Profile velocity", Type.U32, unit="velocity", mappable=True)
PROFILE_ACCELERATION = _object(
    0x6083, 0, "Profile acceleration", Type.U32, unit="acceleration", mappable=True
)
PROFILE_DECELERATION = _object(
    0x6084, 0, "Profile deceleration", Type.U32, unit="acceleration", mappable=True
)
QUICK_STOP_DECELERATION = _object(
    0x6085, 0, "Quick stop deceleration", Type.U32, unit="acceleration", mappable=True
)
TORQUE_SLOPE = _object(0x6087, 0, "Torque slope", Type.U32, unit="‰ of rated torque per s", mappable=True)
ENCODER_INCREMENTS = _object(0x608F, 1, "Encoder increments", Type.U32, unit="increments")
ENCODER_REVOLUTIONS = _object(0x608F, 2, "Motor revolutions", Type.U32, unit="turns of the motor")
GEAR_MOTOR = _object(0x6091, 1, "Motor shaft revolutions", Type.U32, unit="turns of the motor")
GEAR_SHAFT = _object(0x6091, 2, "Driving shaft revolutions", Type.U32, unit="turns of the shaft")
FEED = _object(0x6092, 1, "Feed", Type.U32, unit="position")
FEED_SHAFT = _object(0x6092, 2, "Shaft revolutions", Type.U32, unit="turns of the shaft")
HOMING_METHOD = _object(0x6098, 0, "Homing method", Type.I8)
HOMING_SPEED_SWITCH = _object(0x6099, 1, "Speed during search for switch", Type.U32, unit="velocity")
HOMING_SPEED_ZERO = _object(0x6099, 2, "Speed during search for zero", Type.U32, unit="velocity")
HOMING_ACCELERATION = _object(0x609A, 0, "Homing acceleration", Type.U32, unit="acceleration")
VELOCITY_OFFSET = _object(0x60B1, 0, "Velocity offset", Type.I32, unit="velocity", mappable=True)
TORQUE_OFFSET = _object(0x60B2, 0, "Torque offset", Type.I16, unit="‰ of rated torque", mappable=True)
INTERPOLATION_VALUE = _object(0x60C2, 1, "Interpolation time period value", Type.U8, unit="10^index s")
INTERPOLATION_INDEX = _object(0x60C2, 2, "Interpolation time index", Type.I8)
TARGET_VELOCITY = _object(0x60FF, 0, "Target velocity", Type.I32, unit="velocity", mappable=True)
SUPPORTED_MODES = _object(0x6502, 0, "Supported drive modes", Type.U32, "ro")

TARGETS = frozenset({TARGET_POSITION, TARGET_VELOCITY, TARGET_TORQUE, VELOCITY_OFFSET, TORQUE_OFFSET})
"""The set-points of an enabled drive."""

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


def _pdo_rows(first: int, mapping: int, what: str) -> list[Object]:
    rows = []
    for number in PDO_NUMBERS:
        index, name = first + number - 1, f"{what}{number}"
        rows += [
            Object((index, 0), f"{name} highest subindex", Type.U8, "ro"),
            Object((index, COB_ID), f"{name} COB-ID", Type.U32),
            Object((index, TRANSMISSION), f"{name} transmission type", Type.U8),
            Object((index, INHIBIT), f"{name} inhibit time", Type.U16, "rw", "100 µs"),
            Object((index, EVENT_TIMER), f"{name} event timer", Type.U16, "rw", "ms"),
            Object((mapping + number - 1, 0), f"{name} mapped objects", Type.U8),
        ]
        rows += [
            Object((mapping + number - 1, sub), f"{name} mapped object {sub}", Type.U32)
            for sub in range(1, MAPPED_MOST + 1)
        ]
    return rows


def _counts(rows: list[Object]) -> list[Object]:
    """Return subindex 0 of every record and array: its highest subindex."""
    missing = {row.key[0] for row in rows if row.key[1]} - {row.key[0] for row in rows if not row.key[1]}
    return [Object((index, 0), f"{index:04X} highest subindex", Type.U8, "ro") for index in sorted(missing)]


def _all() -> Mapping[Key, Object]:
    rows = _ROWS + _pdo_rows(RPDO_COMMUNICATION, RPDO_MAPPING, "RPDO")
    rows += _pdo_rows(TPDO_COMMUNICATION, TPDO_MAPPING, "TPDO")
    rows += _counts(rows)
    return {row.key: row for row in sorted(rows, key=lambda row: row.key)}


OBJECTS: Mapping[Key, Object] = _all()
_BY_NAME = {row.name.casefold(): row for row in OBJECTS.values()}


def find(text: str) -> Object | None:
    """Look up an object by its name, or by its address as "6083", "0x6083", "608F:01", "608Fsub1"."""
    named = _BY_NAME.get(text.strip().casefold())
    key = parse(text) if named is None else named.key
    return None if key is None else OBJECTS.get(key)


def parse(text: str) -> Key | None:
    """Parse an address, whether the object is known or not; None if it is no address."""
    plain = text.strip().casefold().removeprefix("0x").replace("sub", ":").replace(" ", "")
    index, _, sub = plain.partition(":")
    try:
        key = int(index, 16), int(sub, 16) if sub else 0
    except ValueError:
        return None
    return key if len(index) == 4 and 0 <= key[1] <= 0xFF and index.isalnum() else None
