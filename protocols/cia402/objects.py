"""The objects of the profile CiA 402, as far as they are supported here: type, access, unit, name.

"position", "velocity" and "acceleration" are the drive's own units: `units` has them.

Source: CiA 402-2 (indices, types and units as in ros-industrial/ros2_canopen@6ada196
`canopen_tests/config/cia402/cia402_slave.eds`, where it has them).
"""

from __future__ import annotations

from protocols.canopen import objects as co
from protocols.canopen.objects import Access, Key, Object, Objects, Type, title

_ROWS: list[Object] = []


def _row(
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


ABORT_CONNECTION = _row(0x6007, 0, "Abort connection option code", Type.I16)
ERROR_CODE = _row(0x603F, 0, "Error code", Type.U16, "ro", mappable=True)
CONTROLWORD = _row(0x6040, 0, "Controlword", Type.U16, mappable=True)
STATUSWORD = _row(0x6041, 0, "Statusword", Type.U16, "ro", mappable=True)
QUICK_STOP_OPTION = _row(0x605A, 0, "Quick stop option code", Type.I16)
SHUTDOWN_OPTION = _row(0x605B, 0, "Shutdown option code", Type.I16)
DISABLE_OPTION = _row(0x605C, 0, "Disable operation option code", Type.I16)
HALT_OPTION = _row(0x605D, 0, "Halt option code", Type.I16)
FAULT_OPTION = _row(0x605E, 0, "Fault reaction option code", Type.I16)
MODE = _row(0x6060, 0, "Modes of operation", Type.I8, mappable=True)
MODE_DISPLAY = _row(0x6061, 0, "Modes of operation display", Type.I8, "ro", mappable=True)
POSITION_DEMAND = _row(0x6062, 0, "Position demand value", Type.I32, "ro", "position", mappable=True)
POSITION = _row(0x6064, 0, "Position actual value", Type.I32, "ro", "position", mappable=True)
FOLLOWING_WINDOW = _row(0x6065, 0, "Following error window", Type.U32, unit="position")
FOLLOWING_TIME = _row(0x6066, 0, "Following error time out", Type.U16, unit="ms")
POSITION_WINDOW = _row(0x6067, 0, "Position window", Type.U32, unit="position")
POSITION_WINDOW_TIME = _row(0x6068, 0, "Position window time", Type.U16, unit="ms")
VELOCITY_DEMAND = _row(0x606B, 0, "Velocity demand value", Type.I32, "ro", "velocity", mappable=True)
VELOCITY = _row(0x606C, 0, "Velocity actual value", Type.I32, "ro", "velocity", mappable=True)
VELOCITY_WINDOW = _row(0x606D, 0, "Velocity window", Type.U16, unit="velocity")
VELOCITY_WINDOW_TIME = _row(0x606E, 0, "Velocity window time", Type.U16, unit="ms")
VELOCITY_THRESHOLD = _row(0x606F, 0, "Velocity threshold", Type.U16, unit="velocity")
TARGET_TORQUE = _row(0x6071, 0, "Target torque", Type.I16, unit="‰ of rated torque", mappable=True)
MAX_TORQUE = _row(0x6072, 0, "Max torque", Type.U16, unit="‰ of rated torque", mappable=True)
TORQUE_DEMAND = _row(0x6074, 0, "Torque demand", Type.I16, "ro", "‰ of rated torque", mappable=True)
RATED_CURRENT = _row(0x6075, 0, "Motor rated current", Type.U32, unit="mA")
RATED_TORQUE = _row(0x6076, 0, "Motor rated torque", Type.U32, unit="mN·m")
TORQUE = _row(0x6077, 0, "Torque actual value", Type.I16, "ro", "‰ of rated torque", mappable=True)
CURRENT = _row(0x6078, 0, "Current actual value", Type.I16, "ro", "‰ of rated current", mappable=True)
DC_VOLTAGE = _row(0x6079, 0, "DC link circuit voltage", Type.U32, "ro", "mV", mappable=True)
TARGET_POSITION = _row(0x607A, 0, "Target position", Type.I32, unit="position", mappable=True)
HOME_OFFSET = _row(0x607C, 0, "Home offset", Type.I32, unit="position")
SOFT_LIMIT_LOW = _row(0x607D, 1, "Min position limit", Type.I32, unit="position")
SOFT_LIMIT_HIGH = _row(0x607D, 2, "Max position limit", Type.I32, unit="position")
MAX_PROFILE_VELOCITY = _row(0x607F, 0, "Max profile velocity", Type.U32, unit="velocity", mappable=True)
MAX_MOTOR_SPEED = _row(0x6080, 0, "Max motor speed", Type.U32, unit="rpm", mappable=True)
PROFILE_VELOCITY = _row(0x6081, 0, "Profile velocity", Type.U32, unit="velocity", mappable=True)
PROFILE_ACCELERATION = _row(0x6083, 0, "Profile acceleration", Type.U32, "rw", "acceleration", mappable=True)
PROFILE_DECELERATION = _row(0x6084, 0, "Profile deceleration", Type.U32, "rw", "acceleration", mappable=True)
QUICK_STOP_DECELERATION = _row(
    0x6085, 0, "Quick stop deceleration", Type.U32, "rw", "acceleration", mappable=True
)
TORQUE_SLOPE = _row(0x6087, 0, "Torque slope", Type.U32, unit="‰ of rated torque per s", mappable=True)
ENCODER_INCREMENTS = _row(0x608F, 1, "Encoder increments", Type.U32, unit="increments")
ENCODER_REVOLUTIONS = _row(0x608F, 2, "Motor revolutions", Type.U32, unit="turns of the motor")
GEAR_MOTOR = _row(0x6091, 1, "Motor shaft revolutions", Type.U32, unit="turns of the motor")
GEAR_SHAFT = _row(0x6091, 2, "Driving shaft revolutions", Type.U32, unit="turns of the shaft")
FEED = _row(0x6092, 1, "Feed", Type.U32, unit="position")
FEED_SHAFT = _row(0x6092, 2, "Shaft revolutions", Type.U32, unit="turns of the shaft")
VELOCITY_NUMERATOR = _row(0x6096, 1, "Velocity factor numerator", Type.U32)
VELOCITY_DIVISOR = _row(0x6096, 2, "Velocity factor divisor", Type.U32)
ACCELERATION_NUMERATOR = _row(0x6097, 1, "Acceleration factor numerator", Type.U32)
ACCELERATION_DIVISOR = _row(0x6097, 2, "Acceleration factor divisor", Type.U32)
HOMING_METHOD = _row(0x6098, 0, "Homing method", Type.I8)
HOMING_SPEED_SWITCH = _row(0x6099, 1, "Speed during search for switch", Type.U32, unit="velocity")
HOMING_SPEED_ZERO = _row(0x6099, 2, "Speed during search for zero", Type.U32, unit="velocity")
HOMING_ACCELERATION = _row(0x609A, 0, "Homing acceleration", Type.U32, "rw", "acceleration")
POSITION_UNIT = _row(0x60A8, 0, "SI unit position", Type.U32)
VELOCITY_UNIT = _row(0x60A9, 0, "SI unit velocity", Type.U32)
ACCELERATION_UNIT = _row(0x60AA, 0, "SI unit acceleration", Type.U32)
VELOCITY_OFFSET = _row(0x60B1, 0, "Velocity offset", Type.I32, unit="velocity", mappable=True)
TORQUE_OFFSET = _row(0x60B2, 0, "Torque offset", Type.I16, unit="‰ of rated torque", mappable=True)
INTERPOLATION_VALUE = _row(0x60C2, 1, "Interpolation time period value", Type.U8, unit="10^index s")
INTERPOLATION_INDEX = _row(0x60C2, 2, "Interpolation time index", Type.I8)
FOLLOWING_ERROR = _row(0x60F4, 0, "Following error actual value", Type.I32, "ro", "position", mappable=True)
DIGITAL_INPUTS = _row(0x60FD, 0, "Digital inputs", Type.U32, "ro", "bits", mappable=True)
DIGITAL_OUTPUTS = _row(0x60FE, 1, "Digital outputs", Type.U32, "rw", "bits", mappable=True)
OUTPUTS_MASK = _row(0x60FE, 2, "Digital outputs bit mask", Type.U32, "rw", "bits")
TARGET_VELOCITY = _row(0x60FF, 0, "Target velocity", Type.I32, unit="velocity", mappable=True)
SUPPORTED_MODES = _row(0x6502, 0, "Supported drive modes", Type.U32, "ro")

TARGETS = frozenset({TARGET_POSITION, TARGET_VELOCITY, TARGET_TORQUE, VELOCITY_OFFSET, TORQUE_OFFSET})
"""The set-points of an enabled drive."""

OBJECTS = Objects(_ROWS)
SIGNATURES: dict[str, tuple[Key, bytes]] = {"save": (co.STORE, b"save"), "load": (co.RESTORE, b"load")}
"""Parameters that are written with 1: all is saved, or at the next restart as delivered."""


def decoded(parameter: str) -> str:
    """Return the name that the command decoder has for a parameter, as `Spec.decoded` does."""
    key = None if parameter in SIGNATURES else OBJECTS.find(parameter)
    return parameter if key is None else title(key)
