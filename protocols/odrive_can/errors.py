"""The faults of an ODrive: the vendor's names, the likely cause, the remedy.

Rules. One section per word of error bits, one line per bit: bit, name: cause | remedy. Names of 0.6.x as in
`enums.py` of package odrive 0.6.11.post1, those of 0.5.x as in the choices of the DBC
`odrive-cansimple-0.5.6.dbc` of package odrive-can 2.1.0; a bit of a component of 0.5.x has the component in
its name too, since UNSTABLE_GAIN alone is three bits. A fault's code is the bit plus the word's base: 0 for
0.6.x, in 0.5.x the word's number << 48. Codes in between are the driver's own: no code has two meanings. A
bit without a line is reported by its number.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

from protocols.plugin import FaultInfo
from protocols.toolkit.faults import Faults, faults

BASE_SHIFT = 48
_PHRASES = {
    "calibrate": "calibrate motor and encoder with the vendor's tool, shaft free, and save",
    "current": "lower the calibration current, or raise current_soft_max",
    "encoder": "check the encoder's cable, supply and settings",
    "firmware": "clear; if it comes back, reboot it and update its firmware",
    "follows": "it follows from another fault: look for that one",
    "gate_driver": "the gate driver reported a short circuit, over-current or over-temperature"
    " | unplug the motor, look for shorts between phases, reboot",
    "missing": "a value that the current control needs is missing",
    "overspeed": "the shaft turned faster than vel_limit × vel_limit_tolerance"
    " | check for a load that drives the motor; raise vel_limit; lower vel_gain if it overshot",
    "phases": "check the phase wires and the calibration current, then calibrate again",
    "spinout": "electrical and mechanical power are inconsistent: the encoder slipped or is badly calibrated"
    " | fasten the encoder, calibrate its offset again",
    "watchdog": "find out why the host stopped sending, then clear; frames must come faster than the timeout",
}
"""What several lines of the tables have in common."""


_TEXT = """
== 0: `ODrive.Error` of 0.6.x: bits of Axis_Error, Active_Errors and Disarm_Reason
0x1 INITIALIZING: the device is starting | wait; if it stays, check its supply
0x2 SYSTEM_LEVEL: a fault of the firmware, or memory corrupted | {firmware}
0x4 TIMING_ERROR: a deadline of the control loop was missed | reboot it; lower its cyclic message rates
0x8 MISSING_ESTIMATE: no valid position: encoder not calibrated or connected, or disturbed | {encoder}
0x10 BAD_CONFIG: a setting is missing or contradicts another | compare its configuration with a known one
0x20 DRV_FAULT: {gate_driver}
0x40 MISSING_INPUT: no valid set-point | check what is sent, and which input mode is set
0x100 DC_BUS_OVER_VOLTAGE: braking fed more back than the supply takes | fit a brake resistor, brake gently
0x200 DC_BUS_UNDER_VOLTAGE: the supply sagged or is off | check battery, fuse, cables; lower current limit
0x400 DC_BUS_OVER_CURRENT: more than dc_max_positive_current | accelerate more gently, or raise the limit
0x800 DC_BUS_OVER_REGEN_CURRENT: more fed back than dc_max_negative_current | set up brake resistor or limit
0x1000 CURRENT_LIMIT_VIOLATION: motor current above current_hard_max | check gains and phase wires; raise it
0x2000 MOTOR_OVER_TEMP: the motor is too hot | let it cool; reduce load or current limit
0x4000 INVERTER_OVER_TEMP: the power stage is too hot | let it cool; improve its cooling
0x8000 VELOCITY_LIMIT_VIOLATION: {overspeed}
0x10000 POSITION_LIMIT_VIOLATION: the position left the range allowed on the device | move it back by hand
0x20000 REQUESTED_CURRENT_TOO_HIGH: a calibration needs more than the current limit allows | {current}
0x1000000 WATCHDOG_TIMER_EXPIRED: no set-point came within watchdog_timeout | {watchdog}
0x2000000 ESTOP_REQUESTED: an emergency stop was sent over the bus | make sure it is safe, then clear
0x4000000 SPINOUT_DETECTED: {spinout}
0x8000000 BRAKE_RESISTOR_DISARMED: it is switched off after a fault | clear; check resistor and its settings
0x10000000 THERMISTOR_DISCONNECTED: no thermistor of the motor | check its cable, or switch it off
0x40000000 CALIBRATION_ERROR: a calibration failed | read the procedure result, calibrate with the shaft free
== 0: `ODrive.ProcedureResult` of 0.6.x: the outcome of the last state request
2 CANCELLED: another state was requested meanwhile | request it again; is there a second host?
3 DISARMED: the axis disarmed by a fault | read the disarm reason, remove it, clear
4 NO_RESPONSE: the encoder does not answer | check its cable and settings
5 POLE_PAIR_CPR_MISMATCH: pole pairs or encoder resolution are wrong | correct them, calibrate again
6 PHASE_RESISTANCE_OUT_OF_RANGE: phase resistance is not plausible | check the phase wires
7 PHASE_INDUCTANCE_OUT_OF_RANGE: phase inductance is not plausible | check the phase wires
8 UNBALANCED_PHASES: the three phases differ | check the phase wires
9 INVALID_MOTOR_TYPE: motor_type does not allow this | correct motor_type
10 ILLEGAL_HALL_STATE: the Hall sensors contradict each other | check their wires
11 TIMEOUT: the procedure took too long | is the shaft blocked? try again
12 HOMING_WITHOUT_ENDSTOP: no end stop is configured | configure one
13 INVALID_STATE: the requested state is not allowed now | {calibrate}
14 NOT_CALIBRATED: motor or encoder is not calibrated | {calibrate}
15 NOT_CONVERGING: the calibration did not settle | calibrate with the shaft free
16 REQUESTED_CURRENT_TOO_HIGH: it needs more than the current limit allows | {current}
== 5: `ODrive.Axis.Error` of 0.5.x: the heartbeat's bits
0x1 INVALID_STATE: the requested state is not possible now, most often as it is not calibrated | {calibrate}
0x40 MOTOR_FAILED: the motor has an error of its own | read the motor's error
0x80 SENSORLESS_ESTIMATOR_FAILED: the estimator has an error of its own | read the sensorless error
0x100 ENCODER_FAILED: the encoder has an error of its own | read the encoder's error
0x200 CONTROLLER_FAILED: the controller has an error of its own | read the controller's error
0x800 WATCHDOG_TIMER_EXPIRED: no frame within watchdog_timeout; it runs while idle too | {watchdog}
0x1000 MIN_ENDSTOP_PRESSED: the lower end stop was reached | move the axis back by hand, then clear
0x2000 MAX_ENDSTOP_PRESSED: the upper end stop was reached | move the axis back by hand, then clear
0x4000 ESTOP_REQUESTED: an emergency stop was sent over the bus | make sure it is safe, then clear
0x20000 HOMING_WITHOUT_ENDSTOP: homing was requested without an end stop | configure one
0x40000 OVER_TEMP: motor or power stage is too hot | let it cool; reduce the load
0x80000 UNKNOWN_POSITION: there is no valid position | {encoder}
== 1 motor: `ODrive.Motor.Error`
0x1 PHASE_RESISTANCE_OUT_OF_RANGE: phase resistance is not plausible | {phases}
0x2 PHASE_INDUCTANCE_OUT_OF_RANGE: phase inductance is not plausible | {phases}
0x8 DRV_FAULT: {gate_driver}
0x10 CONTROL_DEADLINE_MISSED: the firmware missed a deadline of its control loop | {firmware}
0x80 MODULATION_MAGNITUDE: supply too low, or badly tuned | check it and current_control_bandwidth
0x400 CURRENT_SENSE_SATURATION: more current than can be measured | lower its limit; check gains and wires
0x1000 CURRENT_LIMIT_VIOLATION: above current_lim and margin | check gains, phase wires; raise the margin
0x10000 MODULATION_IS_NAN: a setting or gain is not a number | {firmware}
0x20000 MOTOR_THERMISTOR_OVER_TEMP: the motor is too hot | let it cool; reduce load or current limit
0x40000 FET_THERMISTOR_OVER_TEMP: the power stage is too hot | let it cool; improve its cooling
0x80000 TIMER_UPDATE_MISSED: the firmware missed a deadline of its timers | {firmware}
0x100000 CURRENT_MEASUREMENT_UNAVAILABLE: the current could not be measured | {firmware}
0x200000 CONTROLLER_FAILED: the controller gave no torque | {follows}
0x400000 I_BUS_OUT_OF_RANGE: supply current beyond I_bus_hard | drive more gently, or widen the limits
0x800000 BRAKE_RESISTOR_DISARMED: it is switched off after a fault | clear; check resistor and its settings
0x1000000 SYSTEM_LEVEL: a fault of the board: supply or brake resistor | check both; odrv0.error over USB
0x2000000 BAD_TIMING: the firmware's timing is disturbed | {firmware}
0x4000000 UNKNOWN_PHASE_ESTIMATE: the encoder gives no phase: not calibrated, or lost | {calibrate}
0x8000000 UNKNOWN_PHASE_VEL: the encoder gives no velocity: not calibrated, or lost | {calibrate}
0x10000000 UNKNOWN_TORQUE: the controller gave no torque | {follows}
0x20000000 UNKNOWN_CURRENT_COMMAND: {missing} | {follows}
0x40000000 UNKNOWN_CURRENT_MEASUREMENT: {missing} | {follows}
0x80000000 UNKNOWN_VBUS_VOLTAGE: {missing} | {follows}
0x100000000 UNKNOWN_VOLTAGE_COMMAND: {missing} | {follows}
0x200000000 UNKNOWN_GAINS: gains of the current control are not known | {calibrate}
0x400000000 CONTROLLER_INITIALIZING: the current control was not ready yet | clear, and try again
0x800000000 UNBALANCED_PHASES: the three phases differ | {phases}
== 2 encoder: `ODrive.Encoder.Error`
0x1 UNSTABLE_GAIN: encoder.config.bandwidth is too high | lower it
0x2 CPR_POLEPAIRS_MISMATCH: pole pairs or encoder resolution are wrong | correct them, calibrate again
0x4 NO_RESPONSE: the encoder does not answer | check its cable, supply and settings
0x8 UNSUPPORTED_ENCODER_MODE: encoder.config.mode does not allow this | correct it
0x10 ILLEGAL_HALL_STATE: the Hall sensors contradict each other | check their wires, add filters
0x20 INDEX_NOT_FOUND_YET: the index pulse was not detected yet | run the index search first
0x40 ABS_SPI_TIMEOUT: the absolute encoder does not answer | check its cable, supply and settings
0x80 ABS_SPI_COM_FAIL: the absolute encoder's replies are corrupted | check its cable, supply and settings
0x100 ABS_SPI_NOT_READY: the absolute encoder is not ready | check its cable, supply and settings
0x200 HALL_NOT_CALIBRATED_YET: the Hall sensors are not calibrated | {calibrate}
== 3 controller: `ODrive.Controller.Error`
0x1 OVERSPEED: {overspeed}
0x2 INVALID_INPUT_MODE: input_mode does not exist | set a valid one
0x4 UNSTABLE_GAIN: input_filter_bandwidth is too high | lower it
0x8 INVALID_MIRROR_AXIS: axis_to_mirror is no axis of the board | correct it
0x10 INVALID_LOAD_ENCODER: load_encoder_axis is no axis of the board | correct it
0x20 INVALID_ESTIMATE: the encoder gives no valid position or velocity | {calibrate}
0x40 INVALID_CIRCULAR_RANGE: circular_setpoint_range is not above 0 | correct it
0x80 SPINOUT_DETECTED: {spinout}
== 4 sensorless: `ODrive.SensorlessEstimator.Error`
0x1 UNSTABLE_GAIN: the estimator's observer gain is too high | lower it
0x2 UNKNOWN_CURRENT_MEASUREMENT: {missing} | {follows}
== 0: what the driver finds
0x200000000 duplicate node id: two devices answer at it | give one of them another
0x300000000 firmware unknown: it answers neither Get_Version nor as 0.5.x would | do our frames arrive? cable?
0x300000001 firmware not supported: it reports neither 0.5 nor 0.6 by Get_Version | update this driver
0x300000002 firmware 0.5.x: it answers, but not Get_Version | set firmware = "0.5", or update the device
0x300000003 firmware 0.6.x: Get_Version reports it, the robot file states 0.5 | set firmware = "0.6" in that
0x300000004 firmware changed: from 0.5.x to 0.6.x: replaced, or two at one node id | look for a second device
0x400000000 did not arm: no closed loop in 5 attempts | check it with the vendor's tool, then clear
"""


class Word:
    """A word of error bits, or a list of codes. A constant."""

    def __init__(self, section: str) -> None:
        """`section`: number and prefix of the names, then a line for each fault."""
        head, *lines = section.strip().splitlines()
        number, *prefix = head.partition(":")[0].split()
        self.base = int(number) << BASE_SHIFT
        known = faults("\n".join(lines), _PHRASES)
        self.bits = {info.name: bit for bit, info in known.items()}  # By the vendor's name.
        self.faults: dict[int, FaultInfo] = {  # By code.
            self.base + bit: replace(info, name=" ".join((*prefix, info.name))) for bit, info in known.items()
        }

    def __deepcopy__(self, memo: object) -> Word:
        """A word is a constant."""
        return self

    def code(self, name: str) -> int:
        """Return the code of an error."""
        return self.base + self.bits[name]

    def codes(self, errors: int) -> Sequence[int]:
        """Return the codes of the set bits, lowest first."""
        return [self.base + (1 << shift) for shift in range(errors.bit_length()) if errors >> shift & 1]


ERRORS, RESULTS, AXIS, MOTOR, ENCODER, CONTROLLER, SENSORLESS, DRIVER = map(Word, _TEXT.split("== ")[1:])
INITIALIZING = ERRORS.bits["INITIALIZING"]
PROCEDURE = 1 << 32  # Added to a procedure result to make a code.
SUCCESS, BUSY = 0, 1
RESULT_NAMES = {SUCCESS: "SUCCESS", BUSY: "BUSY"} | {number: name for name, number in RESULTS.bits.items()}
INCONCLUSIVE = (SUCCESS, BUSY, RESULTS.bits["CANCELLED"], RESULTS.bits["DISARMED"])
"""Results that may be left from before a state request: they do not show how it ended."""
DUPLICATE_NODE, FIRMWARE_UNKNOWN, FIRMWARE_OTHER, FIRMWARE_05, FIRMWARE_06, FIRMWARE_CHANGED, NOT_ARMED = (
    DRIVER.faults
)
DEVICE06 = {code: info for code, info in ERRORS.faults.items() if code != INITIALIZING}
"""Every fault that a device of 0.6.x reports by itself. (INITIALIZING counts as a state.)"""
DEVICE05 = AXIS.faults | MOTOR.faults | ENCODER.faults | CONTROLLER.faults | SENSORLESS.faults
_INVALID_STATE = AXIS.base + AXIS.bits["INVALID_STATE"]
# The next state request clears it (ODrive@f9b5419 `MotorControl/axis.cpp`).
DEVICE05[_INVALID_STATE] = replace(DEVICE05[_INVALID_STATE], latching=False)


def _bit(code: int) -> FaultInfo:
    """Return what is known of a bit without a line."""
    bit = code % (1 << BASE_SHIFT)
    return FaultInfo(f"error bit 0x{bit:X}", "not known to this driver", "look it up for this firmware")


FAULTS = Faults(
    DEVICE06 | DEVICE05 | {PROCEDURE + n: info for n, info in RESULTS.faults.items()} | DRIVER.faults, _bit
)
"""Every fault by code, those of the driver too."""
