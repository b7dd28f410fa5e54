"""The objects, power states and faults of a drive with two motors, one node and one power state.

Rules. An object with sides has its left value at subindex 1, the right one at 2. In a combined value
(subindex 3), in statusword and fault code the left one is in the lower 16 bits.

Sources: README.md.
"""

from __future__ import annotations

import math
from collections.abc import Mapping

from protocols.canopen.objects import Access, Key, Object, Objects, Type
from protocols.messages import MILLISECOND, Mode, Nanos
from protocols.plugin import FaultInfo

LEFT, RIGHT, BOTH = 1, 2, 3
SIDES = LEFT, RIGHT
RIGHT_OFFSET = 128
"""Added to the node id: the address of the right motor."""
RPM = math.pi / 30.0
"""rad/s"""
OFFLINE_TIME, SYNCHRONOUS, FAULT_CODE = (0x2000, 0), (0x200F, 0), (0x603F, 0)
CONTROL, STATUS, MODE = (0x6040, 0), (0x6041, 0), (0x6060, 0)
POSITION, VELOCITY = 0x6064, 0x606C
ACCELERATION, DECELERATION, TARGET = 0x6083, 0x6084, 0x60FF
SET_POINT = TARGET, BOTH
VELOCITY_MODE = 3
TIMER_UNIT: Nanos = MILLISECOND // 2
"""Of the event timers of its PDOs: not that of CiA 301."""
LACKS = frozenset({0x1003, 0x1006, 0x1008, 0x1010, 0x1011, 0x1016, 0x1029})
"""Objects of CiA 301 that the drive does not have."""


def _object(index: int, sub: int, name: str, type_: Type, access: Access = "rw") -> Object:
    return Object(
        (index, sub), f"{name}{(0, ' left', ' right', ' both')[sub] or ''}", type_, access, "", True
    )


OBJECTS = Objects(
    [
        _object(*OFFLINE_TIME, "Communication offline time", Type.U16),
        _object(*SYNCHRONOUS, "Synchronous control", Type.U16),
        _object(*FAULT_CODE, "Fault code", Type.U32, "ro"),
        _object(*CONTROL, "Controlword", Type.U16),
        _object(*STATUS, "Statusword", Type.U32, "ro"),
        _object(*MODE, "Mode of operation", Type.I8),
        *(_object(POSITION, side, "Position", Type.I32, "ro") for side in SIDES),
        *(_object(VELOCITY, side, "Velocity", Type.I32, "ro") for side in SIDES),
        *(_object(ACCELERATION, side, "Acceleration time", Type.U32) for side in SIDES),
        *(_object(DECELERATION, side, "Deceleration time", Type.U32) for side in SIDES),
        *(_object(TARGET, side, "Target velocity", Type.I32) for side in SIDES),
        _object(*SET_POINT, "Target velocity", Type.U32),
    ]
)


def motion(side: int) -> tuple[Key, Key]:
    """Return the objects of a motor's position and velocity."""
    return (POSITION, side), (VELOCITY, side)


def side_of(address: int) -> int:
    """Return the side of a motor, by its address."""
    return RIGHT if address > RIGHT_OFFSET else LEFT


def combine(left: int, right: int) -> int:
    """Return two 16-bit values as one."""
    return (left & 0xFFFF) | (right & 0xFFFF) << 16


def part(value: int, side: int) -> int:
    """Return one side's signed value of a combined one."""
    half = value >> 16 * (side - 1) & 0xFFFF
    return half - (half >> 15 << 16)


# -- power states -------------------------------------------------------------------------------------

OFF, READY, SWITCHED_ON, ENABLED, QUICK_STOP, FAULT = 0x40, 0x21, 0x23, 0x27, 0x07, 0x08
"""Values of the statusword, without the bits of its mode."""
DISABLE, STOP, SHUTDOWN, SWITCH_ON, ENABLE, RESET = 0x00, 0x02, 0x06, 0x07, 0x0F, 0x80
"""Values of the controlword."""
ARMING: Mapping[int, int] = {OFF: SHUTDOWN, READY: SWITCH_ON, SWITCHED_ON: ENABLE, QUICK_STOP: ENABLE}
"""The controlword that leads a state nearer to ENABLED."""
STATES: Mapping[int, tuple[Mode, str]] = {
    OFF: (Mode.READY, "switch on disabled"),
    READY: (Mode.READY, "ready to switch on"),
    SWITCHED_ON: (Mode.READY, "switched on"),
    ENABLED: (Mode.ARMED, "operation enabled"),
    QUICK_STOP: (Mode.ARMED, "quick stop"),
    FAULT: (Mode.FAULT, "fault"),
}


def state_of(word: int) -> int:
    """Return the power state in the statusword of one side, by the bits that the manual gives."""
    if word & 0x08:
        return FAULT
    if word & 0x04:
        return ENABLED if word & 0x20 else QUICK_STOP
    return SWITCHED_ON if word & 0x02 else READY if word & 0x01 else OFF


# -- faults -------------------------------------------------------------------------------------------

OTHER_MOTOR, UNKNOWN, NOT_ENABLED, DUPLICATE = 0x1_0000, 0x1_0001, 0x1_0002, 0x1_0003
"""Faults without a bit in the code of the side; the last two are the driver's."""
OF_DRIVE = 0x103
"""Bits of faults that concern both motors: they are in the left half of the code."""
# fmt: off
FAULTS: Mapping[int, FaultInfo] = {
    0x0001: FaultInfo("over-voltage", "supply too high, or braking energy", "a lower supply, a bleeder"),
    0x0002: FaultInfo("under-voltage", "supply too low, or a loose connector", "charge, check the cables"),
    0x0004: FaultInfo("over-current", "current too high for a moment, or a loose motor cable", "check them"),
    0x0008: FaultInfo("overload", "the motor is blocked, or a cable or a parameter is wrong", "free it"),
    0x0010: FaultInfo("current out of tolerance", "the current does not follow", "check cables, gains"),
    0x0020: FaultInfo("encoder out of tolerance", "the motor is blocked, or its encoder", "free it"),
    0x0040: FaultInfo("velocity out of tolerance", "the velocity does not follow", "check load, gains"),
    0x0080: FaultInfo("reference voltage", "its circuit failed", "have the drive repaired"),
    0x0100: FaultInfo("EEPROM", "it could not be read or written", "restore the factory settings"),
    0x0200: FaultInfo("hall sensor", "a loose motor cable, motor or drive", "check the cables"),
    0x0400: FaultInfo("motor temperature", "too much current for too long", "let it cool down"),
    0x1000: FaultInfo("encoder", "its cable is loose or broken", "check the encoder's cable"),
    0x2000: FaultInfo("velocity set-point", "it exceeds the rated velocity", "a lower max_rpm"),
    OTHER_MOTOR: FaultInfo("the other motor is in fault", "both motors have one power state", "see there"),
}
# fmt: on
ALL_FAULTS: Mapping[int, FaultInfo] = {
    **FAULTS,
    UNKNOWN: FaultInfo("unknown fault", "its code has no known bit", "see its manual"),
    NOT_ENABLED: FaultInfo("did not enable", "it answers, but is not enabled", "check its supply, clear"),
    DUPLICATE: FaultInfo("duplicate node id", "two drives answer at one node id", "change one of them"),
}


def faults_of(code: int, side: int) -> frozenset[int]:
    """Return the faults of one side in object 603F."""
    bits = code >> 16 | code & OF_DRIVE if side == RIGHT else code & 0xFFFF
    return frozenset(each for each in FAULTS if each & bits) or frozenset({UNKNOWN if bits else OTHER_MOTOR})
