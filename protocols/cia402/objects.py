"""The object dictionary, as far as it is spoken here: index and subindex, type, access, unit, name.

Rules. One row per object; `to_bytes` and `from_bytes` are the only place where a value meets its bytes.
Nothing wraps: a value outside its type is a ValueError on the way out, and bytes of a wrong length are None
on the way in. A drive may have more objects than these, and need not have all of them.

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
        """In an EDS."""
        self.bits = bits
        """Length; 0 for text."""
        self.signed = signed
        """Whether it is a two's complement."""
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

    def title(self) -> str:
        """As `find` takes it and a person reads it: "6083" or "608F:01"."""
        return title(self.key)


def title(key: Key) -> str:
    """An object's address as text: "6083", "608F:01"."""
    return f"{key[0]:04X}:{key[1]:02X}" if key[1] else f"{key[0]:04X}"


def to_bytes(type_: Type, value: int) -> bytes:
    """The value's bytes. ValueError if the type does not hold it."""
    if not type_.low <= value <= type_.high:
        raise ValueError(f"{value} is outside {type_.name} ({type_.low} to {type_.high})")
    return value.to_bytes(type_.bits // 8, "little", signed=type_.signed)


def from_bytes(type_: Type, data: bytes) -> int | None:
    """The value; None if the bytes are not as many as the type has."""
    if len(data) * 8 != type_.bits:
        return None
    return int.from_bytes(data, "little", signed=type_.signed)


def fits(type_: Type, value: int) -> bool:
    """Whether the type holds the value."""
    return type_.low <= value <= type_.high


# -- by name --------------------------------------------------------------------------------------------

DEVICE_TYPE: Key = (0x1000, 0)
ERROR_REGISTER: Key = (0x1001, 0)
SYNC_COB_ID: Key = (0x1005, 0)
SYNC_PERIOD: Key = (0x1006, 0)
DEVICE_NAME: Key = (0x1008, 0)
HARDWARE_VERSION: Key = (0x1009, 0)
SOFTWARE_VERSION: Key = (0x100A, 0)
EMCY_COB_ID: Key = (0x1014, 0)
CONSUMER_HEARTBEAT: Key = (0x1016, 1)
PRODUCER_HEARTBEAT: Key = (0x1017, 0)
VENDOR_ID: Key = (0x1018, 1)
PRODUCT_CODE: Key = (0x1018, 2)
REVISION: Key = (0x1018, 3)
SERIAL_NUMBER: Key = (0x1018, 4)
ERROR_BEHAVIOUR: Key = (0x1029, 1)

ABORT_CONNECTION: Key = (0x6007, 0)
ERROR_CODE: Key = (0x603F, 0)
CONTROLWORD: Key = (0x6040, 0)
STATUSWORD: Key = (0x6041, 0)
QUICK_STOP_OPTION: Key = (0x605A, 0)
SHUTDOWN_OPTION: Key = (0x605B, 0)
DISABLE_OPTION: Key = (0x605C, 0)
HALT_OPTION: Key = (0x605D, 0)
FAULT_OPTION: Key = (0x605E, 0)
MODE: Key = (0x6060, 0)
MODE_DISPLAY: Key = (0x6061, 0)
POSITION_DEMAND: Key = (0x6062, 0)
POSITION: Key = (0x6064, 0)
FOLLOWING_WINDOW: Key = (0x6065, 0)
FOLLOWING_TIME: Key = (0x6066, 0)
POSITION_WINDOW: Key = (0x6067, 0)
POSITION_WINDOW_TIME: Key = (0x6068, 0)
VELOCITY_DEMAND: Key = (0x606B, 0)
VELOCITY: Key = (0x606C, 0)
VELOCITY_WINDOW: Key = (0x606D, 0)
VELOCITY_WINDOW_TIME: Key = (0x606E, 0)
VELOCITY_THRESHOLD: Key = (0x606F, 0)
TARGET_TORQUE: Key = (0x6071, 0)
MAX_TORQUE: Key = (0x6072, 0)
TORQUE_DEMAND: Key = (0x6074, 0)
RATED_CURRENT: Key = (0x6075, 0)
RATED_TORQUE: Key = (0x6076, 0)
TORQUE: Key = (0x6077, 0)
CURRENT: Key = (0x6078, 0)
DC_VOLTAGE: Key = (0x6079, 0)
TARGET_POSITION: Key = (0x607A, 0)
HOME_OFFSET: Key = (0x607C, 0)
SOFT_LIMIT_LOW: Key = (0x607D, 1)
SOFT_LIMIT_HIGH: Key = (0x607D, 2)
MAX_PROFILE_VELOCITY: Key = (0x607F, 0)
MAX_MOTOR_SPEED: Key = (0x6080, 0)
PROFILE_VELOCITY: Key = (0x6081, 0)
PROFILE_ACCELERATION: Key = (0x6083, 0)
PROFILE_DECELERATION: Key = (0x6084, 0)
QUICK_STOP_DECELERATION: Key = (0x6085, 0)
TORQUE_SLOPE: Key = (0x6087, 0)
ENCODER_INCREMENTS: Key = (0x608F, 1)
ENCODER_REVOLUTIONS: Key = (0x608F, 2)
GEAR_MOTOR: Key = (0x6091, 1)
GEAR_SHAFT: Key = (0x6091, 2)
FEED: Key = (0x6092, 1)
FEED_SHAFT: Key = (0x6092, 2)
HOMING_METHOD: Key = (0x6098, 0)
HOMING_SPEED_SWITCH: Key = (0x6099, 1)
HOMING_SPEED_ZERO: Key = (0x6099, 2)
HOMING_ACCELERATION: Key = (0x609A, 0)
VELOCITY_OFFSET: Key = (0x60B1, 0)
TORQUE_OFFSET: Key = (0x60B2, 0)
INTERPOLATION_VALUE: Key = (0x60C2, 1)
INTERPOLATION_INDEX: Key = (0x60C2, 2)
TARGET_VELOCITY: Key = (0x60FF, 0)
SUPPORTED_MODES: Key = (0x6502, 0)

TARGETS = frozenset({TARGET_POSITION, TARGET_VELOCITY, TARGET_TORQUE, VELOCITY_OFFSET, TORQUE_OFFSET})
"""What is a set-point while a drive is enabled."""

_ROWS: tuple[tuple[Key, str, Type, Access, str, bool], ...] = (
    (DEVICE_TYPE, "Device type", Type.U32, "ro", "", False),
    (ERROR_REGISTER, "Error register", Type.U8, "ro", "", True),
    (SYNC_COB_ID, "COB-ID SYNC message", Type.U32, "rw", "", False),
    (SYNC_PERIOD, "Communication cycle period", Type.U32, "rw", "µs", False),
    (DEVICE_NAME, "Manufacturer device name", Type.TEXT, "const", "", False),
    (HARDWARE_VERSION, "Manufacturer hardware version", Type.TEXT, "const", "", False),
    (SOFTWARE_VERSION, "Manufacturer software version", Type.TEXT, "const", "", False),
    (EMCY_COB_ID, "COB-ID EMCY", Type.U32, "ro", "", False),
    (CONSUMER_HEARTBEAT, "Consumer heartbeat time", Type.U32, "rw", "node << 16 | ms", False),
    (PRODUCER_HEARTBEAT, "Producer heartbeat time", Type.U16, "rw", "ms", False),
    (VENDOR_ID, "Vendor-ID", Type.U32, "ro", "", False),
    (PRODUCT_CODE, "Product code", Type.U32, "ro", "", False),
    (REVISION, "Revision number", Type.U32, "ro", "", False),
    (SERIAL_NUMBER, "Serial number", Type.U32, "ro", "", False),
    (ERROR_BEHAVIOUR, "Communication error", Type.U8, "rw", "", False),
    (ABORT_CONNECTION, "Abort connection option code", Type.I16, "rw", "", False),
    (ERROR_CODE, "Error code", Type.U16, "ro", "", True),
    (CONTROLWORD, "Controlword", Type.U16, "rw", "", True),
    (STATUSWORD, "Statusword", Type.U16, "ro", "", True),
    (QUICK_STOP_OPTION, "Quick stop option code", Type.I16, "rw", "", False),
    (SHUTDOWN_OPTION, "Shutdown option code", Type.I16, "rw", "", False),
    (DISABLE_OPTION, "Disable operation option code", Type.I16, "rw", "", False),
    (HALT_OPTION, "Halt option code", Type.I16, "rw", "", False),
    (FAULT_OPTION, "Fault reaction option code", Type.I16, "rw", "", False),
    (MODE, "Modes of operation", Type.I8, "rw", "", True),
    (MODE_DISPLAY, "Modes of operation display", Type.I8, "ro", "", True),
    (POSITION_DEMAND, "Position demand value", Type.I32, "ro", "position", True),
    (POSITION, "Position actual value", Type.I32, "ro", "position", True),
    (FOLLOWING_WINDOW, "Following error window", Type.U32, "rw", "position", False),
    (FOLLOWING_TIME, "Following error time out", Type.U16, "rw", "ms", False),
    (POSITION_WINDOW, "Position window", Type.U32, "rw", "position", False),
    (POSITION_WINDOW_TIME, "Position window time", Type.U16, "rw", "ms", False),
    (VELOCITY_DEMAND, "Velocity demand value", Type.I32, "ro", "velocity", True),
    (VELOCITY, "Velocity actual value", Type.I32, "ro", "velocity", True),
    (VELOCITY_WINDOW, "Velocity window", Type.U16, "rw", "velocity", False),
    (VELOCITY_WINDOW_TIME, "Velocity window time", Type.U16, "rw", "ms", False),
    (VELOCITY_THRESHOLD, "Velocity threshold", Type.U16, "rw", "velocity", False),
    (TARGET_TORQUE, "Target torque", Type.I16, "rw", "‰ of rated torque", True),
    (MAX_TORQUE, "Max torque", Type.U16, "rw", "‰ of rated torque", True),
    (TORQUE_DEMAND, "Torque demand", Type.I16, "ro", "‰ of rated torque", True),
    (RATED_CURRENT, "Motor rated current", Type.U32, "rw", "mA", False),
    (RATED_TORQUE, "Motor rated torque", Type.U32, "rw", "mN·m", False),
    (TORQUE, "Torque actual value", Type.I16, "ro", "‰ of rated torque", True),
    (CURRENT, "Current actual value", Type.I16, "ro", "‰ of rated current", True),
    (DC_VOLTAGE, "DC link circuit voltage", Type.U32, "ro", "mV", True),
    (TARGET_POSITION, "Target position", Type.I32, "rw", "position", True),
    (HOME_OFFSET, "Home offset", Type.I32, "rw", "position", False),
    (SOFT_LIMIT_LOW, "Min position limit", Type.I32, "rw", "position", False),
    (SOFT_LIMIT_HIGH, "Max position limit", Type.I32, "rw", "position", False),
    (MAX_PROFILE_VELOCITY, "Max profile velocity", Type.U32, "rw", "velocity", True),
    (MAX_MOTOR_SPEED, "Max motor speed", Type.U32, "rw", "rpm", True),
    (PROFILE_VELOCITY, "Profile velocity", Type.U32, "rw", "velocity", True),
    (PROFILE_ACCELERATION, "Profile acceleration", Type.U32, "rw", "acceleration", True),
    (PROFILE_DECELERATION, "Profile deceleration", Type.U32, "rw", "acceleration", True),
    (QUICK_STOP_DECELERATION, "Quick stop deceleration", Type.U32, "rw", "acceleration", True),
    (TORQUE_SLOPE, "Torque slope", Type.U32, "rw", "‰ of rated torque per s", True),
    (ENCODER_INCREMENTS, "Encoder increments", Type.U32, "rw", "increments", False),
    (ENCODER_REVOLUTIONS, "Motor revolutions", Type.U32, "rw", "turns of the motor", False),
    (GEAR_MOTOR, "Motor shaft revolutions", Type.U32, "rw", "turns of the motor", False),
    (GEAR_SHAFT, "Driving shaft revolutions", Type.U32, "rw", "turns of the shaft", False),
    (FEED, "Feed", Type.U32, "rw", "position", False),
    (FEED_SHAFT, "Shaft revolutions", Type.U32, "rw", "turns of the shaft", False),
    (HOMING_METHOD, "Homing method", Type.I8, "rw", "", False),
    (HOMING_SPEED_SWITCH, "Speed during search for switch", Type.U32, "rw", "velocity", False),
    (HOMING_SPEED_ZERO, "Speed during search for zero", Type.U32, "rw", "velocity", False),
    (HOMING_ACCELERATION, "Homing acceleration", Type.U32, "rw", "acceleration", False),
    (VELOCITY_OFFSET, "Velocity offset", Type.I32, "rw", "velocity", True),
    (TORQUE_OFFSET, "Torque offset", Type.I16, "rw", "‰ of rated torque", True),
    (INTERPOLATION_VALUE, "Interpolation time period value", Type.U8, "rw", "10^index s", False),
    (INTERPOLATION_INDEX, "Interpolation time index", Type.I8, "rw", "", False),
    (TARGET_VELOCITY, "Target velocity", Type.I32, "rw", "velocity", True),
    (SUPPORTED_MODES, "Supported drive modes", Type.U32, "ro", "", False),
)

# -- how PDOs are configured ------------------------------------------------------------------------------

RPDO_COMMUNICATION = 0x1400
RPDO_MAPPING = 0x1600
TPDO_COMMUNICATION = 0x1800
TPDO_MAPPING = 0x1A00
COB_ID = 1
TRANSMISSION = 2
INHIBIT = 3
"""Subindex of the inhibit time, in 100 µs (TPDO only)."""
EVENT_TIMER = 5
"""Subindex of the event timer, in ms; of an RPDO: the deadline for the next one."""
PDO_NUMBERS = (1, 2, 3, 4)
MAPPED_MOST = 8
"""Objects in one PDO, as far as spoken here."""


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
    """Subindex 0 of every record and array: its highest subindex."""
    missing = {row.key[0] for row in rows if row.key[1]} - {row.key[0] for row in rows if not row.key[1]}
    return [Object((index, 0), f"{index:04X} highest subindex", Type.U8, "ro") for index in sorted(missing)]


def _all() -> Mapping[Key, Object]:
    rows = [Object(*row) for row in _ROWS]
    rows += _pdo_rows(RPDO_COMMUNICATION, RPDO_MAPPING, "RPDO")
    rows += _pdo_rows(TPDO_COMMUNICATION, TPDO_MAPPING, "TPDO")
    rows += _counts(rows)
    return {row.key: row for row in sorted(rows, key=lambda row: row.key)}


OBJECTS: Mapping[Key, Object] = _all()
_BY_NAME = {row.name.casefold(): row for row in OBJECTS.values()}


def find(text: str) -> Object | None:
    """An object by its name, or by its address as "6083", "0x6083", "608F:01", "608Fsub1"."""
    named = _BY_NAME.get(text.strip().casefold())
    key = parse(text) if named is None else named.key
    return None if key is None else OBJECTS.get(key)


def parse(text: str) -> Key | None:
    """The address in a text, whether the object is known or not; None if it is no address."""
    plain = text.strip().casefold().removeprefix("0x").replace("sub", ":").replace(" ", "")
    index, _, sub = plain.partition(":")
    try:
        key = int(index, 16), int(sub, 16) if sub else 0
    except ValueError:
        return None
    return key if len(index) == 4 and 0 <= key[1] <= 0xFF and index.isalnum() else None
