"""The faults of an ODrive of firmware 0.6.x: the vendor's names, the likely cause, the remedy.

Rules. One row per bit of `ODrive.Error` and per value of `ODrive.ProcedureResult`; names as in
odriverobotics/ODriveArduino@f52eef5 `src/ODriveEnums.h`. A bit without a row is reported by its number. Codes
above 32 bits are not the device's: a procedure result, or what the driver itself detects (in either
firmware line; `faults05` has the bits of 0.5.x).
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from enum import IntEnum, IntFlag
from typing import TypeVar

from protocols.plugin import FaultInfo


class Error(IntFlag):
    """`ODrive.Error`: bits of Heartbeat.Axis_Error, Get_Error.Active_Errors and Get_Error.Disarm_Reason."""

    INITIALIZING = 0x1
    SYSTEM_LEVEL = 0x2
    TIMING_ERROR = 0x4
    MISSING_ESTIMATE = 0x8
    BAD_CONFIG = 0x10
    DRV_FAULT = 0x20
    MISSING_INPUT = 0x40
    DC_BUS_OVER_VOLTAGE = 0x100
    DC_BUS_UNDER_VOLTAGE = 0x200
    DC_BUS_OVER_CURRENT = 0x400
    DC_BUS_OVER_REGEN_CURRENT = 0x800
    CURRENT_LIMIT_VIOLATION = 0x1000
    MOTOR_OVER_TEMP = 0x2000
    INVERTER_OVER_TEMP = 0x4000
    VELOCITY_LIMIT_VIOLATION = 0x8000
    POSITION_LIMIT_VIOLATION = 0x10000
    WATCHDOG_TIMER_EXPIRED = 0x1000000
    ESTOP_REQUESTED = 0x2000000
    SPINOUT_DETECTED = 0x4000000
    BRAKE_RESISTOR_DISARMED = 0x8000000
    THERMISTOR_DISCONNECTED = 0x10000000
    CALIBRATION_ERROR = 0x40000000


class Result(IntEnum):
    """`ODrive.ProcedureResult`: the outcome of the last state request."""

    SUCCESS = 0
    BUSY = 1
    CANCELLED = 2
    DISARMED = 3
    NO_RESPONSE = 4
    POLE_PAIR_CPR_MISMATCH = 5
    PHASE_RESISTANCE_OUT_OF_RANGE = 6
    PHASE_INDUCTANCE_OUT_OF_RANGE = 7
    UNBALANCED_PHASES = 8
    INVALID_MOTOR_TYPE = 9
    ILLEGAL_HALL_STATE = 10
    TIMEOUT = 11
    HOMING_WITHOUT_ENDSTOP = 12
    INVALID_STATE = 13
    NOT_CALIBRATED = 14
    NOT_CONVERGING = 15


PROCEDURE = 1 << 32
"""Added to a procedure result, to distinguish it from an error bit."""
DUPLICATE_NODE = 2 << 32
WRONG_FIRMWARE = 3 << 32
NOT_ARMED = 4 << 32


Bit = TypeVar("Bit", bound=IntFlag | IntEnum)


def fault_table(rows: Mapping[Bit, tuple[str, str]], prefix: str = "") -> dict[int, FaultInfo]:
    """Return the faults by bit or value, from (cause, remedy) each; the name is prefix and member."""
    return {int(bit): FaultInfo(f"{prefix}{bit.name}", *texts) for bit, texts in rows.items()}


ERRORS = fault_table(
    {
        Error.INITIALIZING: ("the device is starting", "wait; if it stays, check its supply"),
        Error.SYSTEM_LEVEL: (
            "a fault of the firmware, or memory corrupted",
            "reboot it; if it comes back, update its firmware",
        ),
        Error.TIMING_ERROR: (
            "the firmware missed a deadline of its control loop",
            "reboot it; lower its cyclic message rates",
        ),
        Error.MISSING_ESTIMATE: (
            "no valid position or velocity: encoder not calibrated, not connected or disturbed",
            "check the encoder's cable and magnet, then calibrate",
        ),
        Error.BAD_CONFIG: (
            "a setting of the device is missing or contradicts another",
            "compare its configuration with a known one",
        ),
        Error.DRV_FAULT: (
            "the gate driver reported a fault: short circuit, over-current or over-temperature",
            "unplug the motor, look for shorts between phases, reboot",
        ),
        Error.MISSING_INPUT: ("no valid set-point", "check what is sent, and which input mode is set"),
        Error.DC_BUS_OVER_VOLTAGE: (
            "braking fed energy back into a supply that cannot take it",
            "fit or configure a brake resistor, brake more gently",
        ),
        Error.DC_BUS_UNDER_VOLTAGE: (
            "the supply sagged or is off",
            "check battery, fuse and cables; lower the current limit",
        ),
        Error.DC_BUS_OVER_CURRENT: (
            "more supply current than dc_max_positive_current",
            "accelerate more gently, or raise the limit",
        ),
        Error.DC_BUS_OVER_REGEN_CURRENT: (
            "more current fed back than dc_max_negative_current allows",
            "configure the brake resistor, or raise the limit if a battery can take it",
        ),
        Error.CURRENT_LIMIT_VIOLATION: (
            "motor current above its hard limit",
            "check gains and phase wires; raise current_hard_max",
        ),
        Error.MOTOR_OVER_TEMP: ("the motor is too hot", "let it cool; reduce load or current limit"),
        Error.INVERTER_OVER_TEMP: ("the power stage is too hot", "let it cool; improve its cooling"),
        Error.VELOCITY_LIMIT_VIOLATION: (
            "the shaft turned faster than vel_limit × vel_limit_tolerance",
            "check for a load that drives the motor; raise vel_limit; lower vel_gain if it overshot",
        ),
        Error.POSITION_LIMIT_VIOLATION: (
            "the position left the range allowed on the device",
            "move it back by hand",
        ),
        Error.WATCHDOG_TIMER_EXPIRED: (
            "no set-point came within watchdog_timeout",
            "find out why the host stopped sending, then clear; set-points must come faster than the timeout",
        ),
        Error.ESTOP_REQUESTED: (
            "an emergency stop was sent over the bus",
            "make sure it is safe, then clear",
        ),
        Error.SPINOUT_DETECTED: (
            "electrical and mechanical power are inconsistent: the encoder slipped or is badly calibrated",
            "fasten the encoder, calibrate its offset again",
        ),
        Error.BRAKE_RESISTOR_DISARMED: (
            "the brake resistor is switched off after a fault",
            "clear; check resistor and its settings",
        ),
        Error.THERMISTOR_DISCONNECTED: (
            "the motor's thermistor is not connected",
            "check its cable, or switch it off in the settings",
        ),
        Error.CALIBRATION_ERROR: (
            "a calibration failed",
            "read the procedure result, calibrate with the shaft free",
        ),
    }
)
FAULT_TABLE06 = {bit: info for bit, info in ERRORS.items() if bit != Error.INITIALIZING}
"""Every fault that a device reports by itself, by code. (INITIALIZING counts as a state.)"""

_CALIBRATE = "calibrate with the vendor's tool, shaft free, and save"
RESULTS = fault_table(
    {
        Result.CANCELLED: (
            "another state was requested meanwhile",
            "request it again; is there a second host?",
        ),
        Result.DISARMED: ("the axis disarmed by a fault", "read the disarm reason, remove it, clear"),
        Result.NO_RESPONSE: ("the encoder does not answer", "check its cable and settings"),
        Result.POLE_PAIR_CPR_MISMATCH: (
            "pole pairs or encoder resolution are set wrongly",
            "correct them, calibrate again",
        ),
        Result.PHASE_RESISTANCE_OUT_OF_RANGE: ("phase resistance is not plausible", "check the phase wires"),
        Result.PHASE_INDUCTANCE_OUT_OF_RANGE: ("phase inductance is not plausible", "check the phase wires"),
        Result.UNBALANCED_PHASES: ("the three phases differ", "check the phase wires"),
        Result.INVALID_MOTOR_TYPE: ("motor_type does not allow this", "correct motor_type"),
        Result.ILLEGAL_HALL_STATE: ("the Hall sensors contradict each other", "check their wires"),
        Result.TIMEOUT: ("the procedure took too long", "is the shaft blocked? try again"),
        Result.HOMING_WITHOUT_ENDSTOP: ("no end stop is configured", "configure one"),
        Result.INVALID_STATE: ("the requested state is not allowed now", _CALIBRATE),
        Result.NOT_CALIBRATED: ("motor or encoder is not calibrated", _CALIBRATE),
        Result.NOT_CONVERGING: ("the calibration did not settle", "calibrate with the shaft free"),
    }
)


def bits(errors: int) -> Iterator[int]:
    """Yield the set bits of an error word, lowest first."""
    for shift in range(errors.bit_length()):
        if errors >> shift & 1:
            yield 1 << shift


def fault_info(bit: int, table: Mapping[int, FaultInfo] = ERRORS) -> FaultInfo:
    """Return what is known of one error bit."""
    known = table.get(bit)
    return known or FaultInfo(
        f"error bit 0x{bit:X}", "not known to this driver", "look it up for this firmware"
    )


def names(errors: int, table: Mapping[int, FaultInfo] = ERRORS) -> str:
    """Return the vendor's names of all set bits, as text."""
    return ", ".join(fault_info(bit, table).name for bit in bits(errors))


def result_name(result: int) -> str:
    """Return the vendor's name of a procedure result."""
    return Result(result).name if result in Result._value2member_map_ else f"procedure result {result}"


def state_name(state: int, enum: type[IntEnum]) -> str:
    """Return the vendor's name of an axis state."""
    return enum(state).name if state in enum._value2member_map_ else f"axis state {state}"
