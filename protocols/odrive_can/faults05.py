"""The faults of an ODrive of firmware 0.5.x: the vendor's names, the likely cause, the remedy.

Rules. Five words of error bits: the axis' own in the heartbeat, and those of its components (motor, encoder,
controller and sensorless estimator), each requested by a message of its own. Names as in the choices of the
DBC `odrive-cansimple-0.5.6.dbc` of package odrive-can 2.1.0; a bit that is not the axis' has its component in
the name too, since UNSTABLE_GAIN alone is three bits. A fault's code is the bit plus its word's base, the
word's number << 48: no code has two meanings, whichever line a device is of.
"""

from __future__ import annotations

from enum import IntFlag

from protocols.odrive_can.faults import fault_table
from protocols.plugin import FaultInfo

BASE_SHIFT = 48
MOTOR_BASE, ENCODER_BASE, CONTROLLER_BASE, SENSORLESS_BASE, AXIS_BASE = (n << BASE_SHIFT for n in range(1, 6))
"""Added to a bit to make its fault's code. (A bit of 0.6.x is its own code.)"""


class AxisError(IntFlag):
    """`ODrive.Axis.Error`: the heartbeat's bits."""

    INVALID_STATE = 0x1
    MOTOR_FAILED = 0x40
    SENSORLESS_ESTIMATOR_FAILED = 0x80
    ENCODER_FAILED = 0x100
    CONTROLLER_FAILED = 0x200
    WATCHDOG_TIMER_EXPIRED = 0x800
    MIN_ENDSTOP_PRESSED = 0x1000
    MAX_ENDSTOP_PRESSED = 0x2000
    ESTOP_REQUESTED = 0x4000
    HOMING_WITHOUT_ENDSTOP = 0x20000
    OVER_TEMP = 0x40000
    UNKNOWN_POSITION = 0x80000


class MotorError(IntFlag):
    """`ODrive.Motor.Error`: 64 bits."""

    PHASE_RESISTANCE_OUT_OF_RANGE = 0x1
    PHASE_INDUCTANCE_OUT_OF_RANGE = 0x2
    DRV_FAULT = 0x8
    CONTROL_DEADLINE_MISSED = 0x10
    MODULATION_MAGNITUDE = 0x80
    CURRENT_SENSE_SATURATION = 0x400
    CURRENT_LIMIT_VIOLATION = 0x1000
    MODULATION_IS_NAN = 0x10000
    MOTOR_THERMISTOR_OVER_TEMP = 0x20000
    FET_THERMISTOR_OVER_TEMP = 0x40000
    TIMER_UPDATE_MISSED = 0x80000
    CURRENT_MEASUREMENT_UNAVAILABLE = 0x100000
    CONTROLLER_FAILED = 0x200000
    I_BUS_OUT_OF_RANGE = 0x400000
    BRAKE_RESISTOR_DISARMED = 0x800000
    SYSTEM_LEVEL = 0x1000000
    BAD_TIMING = 0x2000000
    UNKNOWN_PHASE_ESTIMATE = 0x4000000
    UNKNOWN_PHASE_VEL = 0x8000000
    UNKNOWN_TORQUE = 0x10000000
    UNKNOWN_CURRENT_COMMAND = 0x20000000
    UNKNOWN_CURRENT_MEASUREMENT = 0x40000000
    UNKNOWN_VBUS_VOLTAGE = 0x80000000
    UNKNOWN_VOLTAGE_COMMAND = 0x100000000
    UNKNOWN_GAINS = 0x200000000
    CONTROLLER_INITIALIZING = 0x400000000
    UNBALANCED_PHASES = 0x800000000


class EncoderError(IntFlag):
    """`ODrive.Encoder.Error`."""

    UNSTABLE_GAIN = 0x1
    CPR_POLEPAIRS_MISMATCH = 0x2
    NO_RESPONSE = 0x4
    UNSUPPORTED_ENCODER_MODE = 0x8
    ILLEGAL_HALL_STATE = 0x10
    INDEX_NOT_FOUND_YET = 0x20
    ABS_SPI_TIMEOUT = 0x40
    ABS_SPI_COM_FAIL = 0x80
    ABS_SPI_NOT_READY = 0x100
    HALL_NOT_CALIBRATED_YET = 0x200


class ControllerError(IntFlag):
    """`ODrive.Controller.Error`."""

    OVERSPEED = 0x1
    INVALID_INPUT_MODE = 0x2
    UNSTABLE_GAIN = 0x4
    INVALID_MIRROR_AXIS = 0x8
    INVALID_LOAD_ENCODER = 0x10
    INVALID_ESTIMATE = 0x20
    INVALID_CIRCULAR_RANGE = 0x40
    SPINOUT_DETECTED = 0x80


class SensorlessError(IntFlag):
    """`ODrive.SensorlessEstimator.Error`."""

    UNSTABLE_GAIN = 0x1
    UNKNOWN_CURRENT_MEASUREMENT = 0x2


_CALIBRATE = "calibrate motor and encoder with the vendor's tool, shaft free, and save"
_PHASES = "check the phase wires and the calibration current, then calibrate again"
_ENCODER = "check the encoder's cable, supply and settings"
_FIRMWARE = "clear; if it comes back, reboot the board and update its firmware"
_FOLLOWS = "it follows from another fault: look for that one"
_INPUTS = "a value that the current control needs is missing"

AXIS_FAULTS: dict[int, FaultInfo] = {
    AxisError.INVALID_STATE: FaultInfo(
        "INVALID_STATE",
        "the requested state is not possible now, most often because motor or encoder is not calibrated",
        _CALIBRATE,
        latching=False,  # the next state request clears it (ODrive@f9b5419 `MotorControl/axis.cpp`)
    ),
    **fault_table(
        {
            AxisError.MOTOR_FAILED: ("the motor has an error of its own", "read the motor's error"),
            AxisError.SENSORLESS_ESTIMATOR_FAILED: (
                "the estimator has an error of its own",
                "read the sensorless error",
            ),
            AxisError.ENCODER_FAILED: ("the encoder has an error of its own", "read the encoder's error"),
            AxisError.CONTROLLER_FAILED: (
                "the controller has an error of its own",
                "read the controller's error",
            ),
            AxisError.WATCHDOG_TIMER_EXPIRED: (
                "no frame came for the axis within watchdog_timeout; it runs while the axis is idle too",
                "find out why the host stopped sending, then clear; frames must come faster than the timeout",
            ),
            AxisError.MIN_ENDSTOP_PRESSED: (
                "the lower end stop was reached",
                "move the axis back by hand, then clear",
            ),
            AxisError.MAX_ENDSTOP_PRESSED: (
                "the upper end stop was reached",
                "move the axis back by hand, then clear",
            ),
            AxisError.ESTOP_REQUESTED: (
                "an emergency stop was sent over the bus",
                "make sure it is safe, then clear",
            ),
            AxisError.HOMING_WITHOUT_ENDSTOP: ("homing was requested without an end stop", "configure one"),
            AxisError.OVER_TEMP: ("motor or power stage is too hot", "let it cool; reduce the load"),
            AxisError.UNKNOWN_POSITION: ("there is no valid position", _ENCODER),
        }
    ),
}
MOTOR_FAULTS = fault_table(
    {
        MotorError.PHASE_RESISTANCE_OUT_OF_RANGE: ("phase resistance is not plausible", _PHASES),
        MotorError.PHASE_INDUCTANCE_OUT_OF_RANGE: ("phase inductance is not plausible", _PHASES),
        MotorError.DRV_FAULT: (
            "the gate driver reported a fault: short circuit, over-current or over-temperature",
            "unplug the motor, look for shorts between phases, reboot",
        ),
        MotorError.CONTROL_DEADLINE_MISSED: ("the firmware missed a deadline of its control loop", _FIRMWARE),
        MotorError.MODULATION_MAGNITUDE: (
            "the supply is too low for the requested current, or the current control is badly tuned",
            "check supply and current_control_bandwidth",
        ),
        MotorError.CURRENT_SENSE_SATURATION: (
            "more current than the sensing can measure",
            "lower the current limit, or raise requested_current_range; check gains and phase wires",
        ),
        MotorError.CURRENT_LIMIT_VIOLATION: (
            "motor current above current_lim plus its margin",
            "check gains and phase wires; raise current_lim_margin",
        ),
        MotorError.MODULATION_IS_NAN: ("a setting or gain is not a number", _FIRMWARE),
        MotorError.MOTOR_THERMISTOR_OVER_TEMP: (
            "the motor is too hot",
            "let it cool; reduce load or current limit",
        ),
        MotorError.FET_THERMISTOR_OVER_TEMP: (
            "the power stage is too hot",
            "let it cool; improve its cooling",
        ),
        MotorError.TIMER_UPDATE_MISSED: ("the firmware missed a deadline of its timers", _FIRMWARE),
        MotorError.CURRENT_MEASUREMENT_UNAVAILABLE: ("the current could not be measured", _FIRMWARE),
        MotorError.CONTROLLER_FAILED: ("the controller gave no torque", _FOLLOWS),
        MotorError.I_BUS_OUT_OF_RANGE: (
            "current from or into the supply is beyond the axis' I_bus_hard limits",
            "accelerate and brake more gently, or widen the limits",
        ),
        MotorError.BRAKE_RESISTOR_DISARMED: (
            "the brake resistor is switched off after a fault",
            "clear; check resistor and its settings",
        ),
        MotorError.SYSTEM_LEVEL: (
            "a fault of the whole board: supply too low or high, its current out of limits, brake resistor",
            "check battery, fuse, cables and brake resistor; the vendor's tool shows odrv0.error over USB",
        ),
        MotorError.BAD_TIMING: ("the firmware's timing is disturbed", _FIRMWARE),
        MotorError.UNKNOWN_PHASE_ESTIMATE: (
            "the encoder gives no phase: not calibrated, or lost",
            _CALIBRATE,
        ),
        MotorError.UNKNOWN_PHASE_VEL: ("the encoder gives no velocity: not calibrated, or lost", _CALIBRATE),
        MotorError.UNKNOWN_TORQUE: ("the controller gave no torque", _FOLLOWS),
        MotorError.UNKNOWN_CURRENT_COMMAND: (_INPUTS, _FOLLOWS),
        MotorError.UNKNOWN_CURRENT_MEASUREMENT: (_INPUTS, _FOLLOWS),
        MotorError.UNKNOWN_VBUS_VOLTAGE: (_INPUTS, _FOLLOWS),
        MotorError.UNKNOWN_VOLTAGE_COMMAND: (_INPUTS, _FOLLOWS),
        MotorError.UNKNOWN_GAINS: ("the gains of the current control are not known", _CALIBRATE),
        MotorError.CONTROLLER_INITIALIZING: ("the current control was not ready yet", "clear, and try again"),
        MotorError.UNBALANCED_PHASES: ("the three phases differ", _PHASES),
    },
    "motor ",
)
ENCODER_FAULTS = fault_table(
    {
        EncoderError.UNSTABLE_GAIN: ("encoder.config.bandwidth is too high", "lower it"),
        EncoderError.CPR_POLEPAIRS_MISMATCH: (
            "pole pairs or encoder resolution are set wrongly",
            "correct them, calibrate again",
        ),
        EncoderError.NO_RESPONSE: ("the encoder does not answer", _ENCODER),
        EncoderError.UNSUPPORTED_ENCODER_MODE: ("encoder.config.mode does not allow this", "correct it"),
        EncoderError.ILLEGAL_HALL_STATE: (
            "the Hall sensors contradict each other",
            "check their wires, add filters",
        ),
        EncoderError.INDEX_NOT_FOUND_YET: (
            "the index pulse was not detected yet",
            "run the index search first",
        ),
        EncoderError.ABS_SPI_TIMEOUT: ("the absolute encoder does not answer", _ENCODER),
        EncoderError.ABS_SPI_COM_FAIL: ("the absolute encoder's replies are corrupted", _ENCODER),
        EncoderError.ABS_SPI_NOT_READY: ("the absolute encoder is not ready", _ENCODER),
        EncoderError.HALL_NOT_CALIBRATED_YET: ("the Hall sensors are not calibrated", _CALIBRATE),
    },
    "encoder ",
)
CONTROLLER_FAULTS = fault_table(
    {
        ControllerError.OVERSPEED: (
            "the shaft turned faster than vel_limit × vel_limit_tolerance",
            "check for a load that drives the motor; raise vel_limit; lower vel_gain if it overshot",
        ),
        ControllerError.INVALID_INPUT_MODE: ("input_mode does not exist", "set a valid one"),
        ControllerError.UNSTABLE_GAIN: ("input_filter_bandwidth is too high", "lower it"),
        ControllerError.INVALID_MIRROR_AXIS: ("axis_to_mirror is no axis of the board", "correct it"),
        ControllerError.INVALID_LOAD_ENCODER: ("load_encoder_axis is no axis of the board", "correct it"),
        ControllerError.INVALID_ESTIMATE: ("the encoder gives no valid position or velocity", _CALIBRATE),
        ControllerError.INVALID_CIRCULAR_RANGE: ("circular_setpoint_range is not above 0", "correct it"),
        ControllerError.SPINOUT_DETECTED: (
            "electrical and mechanical power are inconsistent: the encoder slipped or is badly calibrated",
            "fasten the encoder, calibrate its offset again",
        ),
    },
    "controller ",
)
SENSORLESS_FAULTS = fault_table(
    {
        SensorlessError.UNSTABLE_GAIN: ("the estimator's observer gain is too high", "lower it"),
        SensorlessError.UNKNOWN_CURRENT_MEASUREMENT: (_INPUTS, _FOLLOWS),
    },
    "sensorless ",
)

FAULTS_BY_BASE = {
    AXIS_BASE: AXIS_FAULTS,
    MOTOR_BASE: MOTOR_FAULTS,
    ENCODER_BASE: ENCODER_FAULTS,
    CONTROLLER_BASE: CONTROLLER_FAULTS,
    SENSORLESS_BASE: SENSORLESS_FAULTS,
}
FAULT_TABLE05 = {base + bit: info for base, table in FAULTS_BY_BASE.items() for bit, info in table.items()}
"""Every fault by code."""
