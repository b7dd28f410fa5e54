"""CiA 402: power states, statusword, controlword, modes of operation.

Rules. Numbers and the pure functions that decode them; no state. A statusword that matches none of the eight
states decodes to None. A controlword decodes to a `Demand`; `state_machine` has which state obeys it.

Source: package canopen 2.4.1 `profiles/p402.py` (`State402`, `OperationMode`, `Homing`); CiA 402-2
"finite state automaton".
"""

from __future__ import annotations

from enum import Enum, IntEnum


class PowerState(Enum):
    """The states of the power drive system, named as in CiA 402."""

    NOT_READY = "NOT READY TO SWITCH ON"
    SWITCH_ON_DISABLED = "SWITCH ON DISABLED"
    READY = "READY TO SWITCH ON"
    SWITCHED_ON = "SWITCHED ON"
    OPERATION_ENABLED = "OPERATION ENABLED"
    QUICK_STOP = "QUICK STOP ACTIVE"
    FAULT_REACTION = "FAULT REACTION ACTIVE"
    FAULT = "FAULT"


POWERED = (PowerState.OPERATION_ENABLED, PowerState.QUICK_STOP)
"""The states in which a drive gives torque."""
STATE_BITS: dict[PowerState, tuple[int, int]] = {
    PowerState.NOT_READY: (0x4F, 0x00),
    PowerState.SWITCH_ON_DISABLED: (0x4F, 0x40),
    PowerState.READY: (0x6F, 0x21),
    PowerState.SWITCHED_ON: (0x6F, 0x23),
    PowerState.OPERATION_ENABLED: (0x6F, 0x27),
    PowerState.QUICK_STOP: (0x6F, 0x07),
    PowerState.FAULT_REACTION: (0x4F, 0x0F),
    PowerState.FAULT: (0x4F, 0x08),
}
"""(mask, value) of the statusword in each state."""

_BY_STATUS = tuple(
    next((state for state, (mask, value) in STATE_BITS.items() if status & mask == value), None)
    for status in range(0x80)
)


def state_of(statusword: int) -> PowerState | None:
    """Decode the power state of a statusword; None if it matches none."""
    return _BY_STATUS[statusword & 0x7F]


class Status:
    """Bits of the statusword beside those of the state. The last three depend on the mode."""

    VOLTAGE_ENABLED = 1 << 4
    REMOTE = 1 << 9
    LIMITED = 1 << 11
    REACHED = 1 << 10
    BIT_12 = 1 << 12  # PP: set-point acknowledged; PV: zero speed; HM: attained; cyclic: follows the command
    BIT_13 = 1 << 13  # PP, CSP: following error; HM: error


class Control:
    """Bits of the controlword beside those of a demand."""

    NEW_SETPOINT = 1 << 4  # PP
    START_HOMING = NEW_SETPOINT  # HM
    CHANGE_IMMEDIATELY = 1 << 5  # PP: do not finish the set-point before
    RELATIVE = 1 << 6  # PP
    FAULT_RESET = 1 << 7  # obeyed on its rising edge
    HALT = 1 << 8


class Demand(IntEnum):
    """State commands of the controlword; the value is the plain controlword that gives the command."""

    DISABLE_VOLTAGE = 0x00
    QUICK_STOP = 0x02
    SHUTDOWN = 0x06
    SWITCH_ON = 0x07
    ENABLE_OPERATION = 0x0F
    FAULT_RESET = 0x80


def demand_of(controlword: int, before: int) -> Demand | None:
    """Decode a controlword, given the one before; None while bit 7 stays set."""
    if controlword & Control.FAULT_RESET:
        return None if before & Control.FAULT_RESET else Demand.FAULT_RESET
    if not controlword & 0x02:
        return Demand.DISABLE_VOLTAGE
    if not controlword & 0x04:
        return Demand.QUICK_STOP
    if not controlword & 0x01:
        return Demand.SHUTDOWN
    return Demand.ENABLE_OPERATION if controlword & 0x08 else Demand.SWITCH_ON


class Mode(IntEnum):
    """Modes of operation, objects 6060 and 6061; `MODE_NAMES` spells them out."""

    NONE = 0
    PP = 1
    VL = 2
    PV = 3
    PT = 4
    HM = 6
    IP = 7
    CSP = 8
    CSV = 9
    CST = 10


MODE_NAMES: dict[Mode, str] = {
    Mode.NONE: "no mode",
    Mode.PP: "profile position",
    Mode.VL: "velocity",  # frequency converters
    Mode.PV: "profile velocity",
    Mode.PT: "profile torque",
    Mode.HM: "homing",
    Mode.IP: "interpolated position",
    Mode.CSP: "cyclic synchronous position",
    Mode.CSV: "cyclic synchronous velocity",
    Mode.CST: "cyclic synchronous torque",
}
CYCLIC = (Mode.CSP, Mode.CSV, Mode.CST)


def mode_name(value: int) -> str:
    """Return the name of a mode of operation in CiA 402."""
    return MODE_NAMES[Mode(value)] if value in set(Mode) else f"mode {value}"


def mode_bit(mode: Mode) -> int:
    """Return the bit of a mode in object 6502 (supported drive modes); 0 for no mode."""
    return 1 << mode >> 1


def supports(supported: int, mode: Mode) -> bool:
    """True if a value of object 6502 includes a mode; no mode is always included."""
    return not mode or bool(supported & mode_bit(mode))
