"""The registers of a moteus: numbers, names, what a count is worth, and the values of the mode register.

Rules. Tables only. A scale is given for 8, 16 and 32 bit integers; a binary32 holds the quantity itself, in
the vendor's units (revolutions at the output shaft, s, N·m, A, V, °C). Numbers, names and scales:
mjbots/moteus@db1a762 `docs/protocol/registers.md`, checked against moteus 1.1.1 by a test.
"""

from __future__ import annotations

from collections.abc import Mapping
from enum import IntEnum
from typing import TypeAlias

Scale: TypeAlias = tuple[float, float, float, float]
"""What one count is worth, by resolution."""


class Register(IntEnum):
    """What the driver and the twin know by name."""

    MODE = 0x000
    POSITION = 0x001
    VELOCITY = 0x002
    TORQUE = 0x003
    Q_CURRENT = 0x004
    D_CURRENT = 0x005
    ABS_POSITION = 0x006
    POWER = 0x007
    MOTOR_TEMPERATURE = 0x00A
    TRAJECTORY_COMPLETE = 0x00B
    HOME_STATE = 0x00C
    VOLTAGE = 0x00D
    TEMPERATURE = 0x00E
    FAULT = 0x00F
    PWM_PHASE_A = 0x010
    PWM_PHASE_B = 0x011
    PWM_PHASE_C = 0x012
    VOLTAGE_PHASE_A = 0x014
    VOLTAGE_PHASE_B = 0x015
    VOLTAGE_PHASE_C = 0x016
    VFOC_THETA = 0x018
    VFOC_VOLTAGE = 0x019
    VOLTAGEDQ_D = 0x01A
    VOLTAGEDQ_Q = 0x01B
    COMMAND_Q_CURRENT = 0x01C
    COMMAND_D_CURRENT = 0x01D
    VFOC_THETA_RATE = 0x01E
    COMMAND_POSITION = 0x020
    COMMAND_VELOCITY = 0x021
    COMMAND_FEEDFORWARD_TORQUE = 0x022
    COMMAND_KP_SCALE = 0x023
    COMMAND_KD_SCALE = 0x024
    COMMAND_POSITION_MAX_TORQUE = 0x025
    COMMAND_STOP_POSITION = 0x026
    COMMAND_TIMEOUT = 0x027
    COMMAND_VELOCITY_LIMIT = 0x028
    COMMAND_ACCEL_LIMIT = 0x029
    COMMAND_FIXED_VOLTAGE_OVERRIDE = 0x02A
    COMMAND_ILIMIT_SCALE = 0x02B
    COMMAND_FIXED_CURRENT_OVERRIDE = 0x02C
    COMMAND_IGNORE_POSITION_BOUNDS = 0x02D
    POSITION_KP = 0x030
    POSITION_KI = 0x031
    POSITION_KD = 0x032
    POSITION_FEEDFORWARD = 0x033
    POSITION_COMMAND = 0x034
    CONTROL_POSITION = 0x038
    CONTROL_VELOCITY = 0x039
    CONTROL_TORQUE = 0x03A
    POSITION_ERROR = 0x03B
    VELOCITY_ERROR = 0x03C
    TORQUE_ERROR = 0x03D
    COMMAND_WITHIN_LOWER_BOUND = 0x040
    COMMAND_WITHIN_UPPER_BOUND = 0x041
    COMMAND_WITHIN_FEEDFORWARD_TORQUE = 0x042
    COMMAND_WITHIN_KP_SCALE = 0x043
    COMMAND_WITHIN_KD_SCALE = 0x044
    COMMAND_WITHIN_MAX_TORQUE = 0x045
    COMMAND_WITHIN_TIMEOUT = 0x046
    COMMAND_WITHIN_ILIMIT_SCALE = 0x047
    COMMAND_WITHIN_IGNORE_POSITION_BOUNDS = 0x048
    ENCODER_0_POSITION = 0x050
    ENCODER_0_VELOCITY = 0x051
    ENCODER_VALIDITY = 0x058
    MILLISECOND_COUNTER = 0x070
    MODEL_NUMBER = 0x100
    FIRMWARE_VERSION = 0x101
    REGISTER_MAP_VERSION = 0x102
    MULTIPLEX_ID = 0x110
    SERIAL_NUMBER1 = 0x120
    SERIAL_NUMBER2 = 0x121
    SERIAL_NUMBER3 = 0x122
    SET_OUTPUT_NEAREST = 0x130
    SET_OUTPUT_EXACT = 0x131
    REQUIRE_REINDEX = 0x132
    RECAPTURE_POSITION_VELOCITY = 0x133
    DRIVER_FAULT1 = 0x140
    DRIVER_FAULT2 = 0x141
    UUID1 = 0x150
    UUID2 = 0x151
    UUID3 = 0x152
    UUID4 = 0x153
    UUID_MASK1 = 0x154
    UUID_MASK2 = 0x155
    UUID_MASK3 = 0x156
    UUID_MASK4 = 0x157
    UUID_MASK_CAPABLE = 0x158


class Mode(IntEnum):
    """Values of the mode register."""

    STOPPED = 0
    FAULT = 1
    ENABLING = 2
    CALIBRATING = 3
    CALIBRATION_COMPLETE = 4
    PWM = 5
    VOLTAGE = 6
    VOLTAGE_FOC = 7
    VOLTAGE_DQ = 8
    CURRENT = 9
    POSITION = 10
    TIMEOUT = 11
    ZERO_VELOCITY = 12
    STAY_WITHIN = 13
    MEASURE_IND = 14
    BRAKE = 15


LATCHED = (Mode.FAULT, Mode.TIMEOUT)
"""Only a stop leaves these."""
RISING = (Mode.ENABLING, Mode.CALIBRATING, Mode.CALIBRATION_COMPLETE)
"""On the way from stopped to any mode that gives torque."""

_INT: Scale = (1.0, 1.0, 1.0, 1.0)
_POSITION: Scale = (0.01, 0.0001, 0.00001, 1.0)
_VELOCITY: Scale = (0.1, 0.00025, 0.00001, 1.0)
_ACCEL: Scale = (0.05, 0.001, 0.00001, 1.0)
_TORQUE: Scale = (0.5, 0.01, 0.001, 1.0)
_CURRENT: Scale = (1.0, 0.1, 0.001, 1.0)
_VOLTAGE: Scale = (0.5, 0.1, 0.001, 1.0)
_TEMPERATURE: Scale = (1.0, 0.1, 0.001, 1.0)
_TIME: Scale = (0.01, 0.001, 0.000001, 1.0)
_PWM: Scale = (1.0 / 127.0, 1.0 / 32767.0, 1.0 / 2147483647.0, 1.0)
_POWER: Scale = (10.0, 0.05, 0.0001, 1.0)

R = Register
_OF: tuple[tuple[Scale, tuple[Register, ...]], ...] = (
    (
        _POSITION,
        (
            R.POSITION,
            R.ABS_POSITION,
            R.COMMAND_POSITION,
            R.COMMAND_STOP_POSITION,
            R.CONTROL_POSITION,
            R.POSITION_ERROR,
            R.COMMAND_WITHIN_LOWER_BOUND,
            R.COMMAND_WITHIN_UPPER_BOUND,
            R.ENCODER_0_POSITION,
            R.SET_OUTPUT_NEAREST,
            R.SET_OUTPUT_EXACT,
        ),
    ),
    (
        _VELOCITY,
        (
            R.VELOCITY,
            R.COMMAND_VELOCITY,
            R.COMMAND_VELOCITY_LIMIT,
            R.CONTROL_VELOCITY,
            R.VELOCITY_ERROR,
            R.VFOC_THETA_RATE,
            R.ENCODER_0_VELOCITY,
        ),
    ),
    (_ACCEL, (R.COMMAND_ACCEL_LIMIT,)),
    (
        _TORQUE,
        (
            R.TORQUE,
            R.COMMAND_FEEDFORWARD_TORQUE,
            R.COMMAND_POSITION_MAX_TORQUE,
            R.COMMAND_WITHIN_FEEDFORWARD_TORQUE,
            R.COMMAND_WITHIN_MAX_TORQUE,
            R.POSITION_KP,
            R.POSITION_KI,
            R.POSITION_KD,
            R.POSITION_FEEDFORWARD,
            R.POSITION_COMMAND,
            R.CONTROL_TORQUE,
            R.TORQUE_ERROR,
        ),
    ),
    (
        _CURRENT,
        (
            R.Q_CURRENT,
            R.D_CURRENT,
            R.COMMAND_Q_CURRENT,
            R.COMMAND_D_CURRENT,
            R.COMMAND_FIXED_CURRENT_OVERRIDE,
        ),
    ),
    (
        _VOLTAGE,
        (
            R.VOLTAGE,
            R.VOLTAGE_PHASE_A,
            R.VOLTAGE_PHASE_B,
            R.VOLTAGE_PHASE_C,
            R.VFOC_VOLTAGE,
            R.VOLTAGEDQ_D,
            R.VOLTAGEDQ_Q,
            R.COMMAND_FIXED_VOLTAGE_OVERRIDE,
        ),
    ),
    (_TEMPERATURE, (R.TEMPERATURE, R.MOTOR_TEMPERATURE)),
    (_TIME, (R.COMMAND_TIMEOUT, R.COMMAND_WITHIN_TIMEOUT)),
    (
        _PWM,
        (
            R.PWM_PHASE_A,
            R.PWM_PHASE_B,
            R.PWM_PHASE_C,
            R.VFOC_THETA,
            R.COMMAND_KP_SCALE,
            R.COMMAND_KD_SCALE,
            R.COMMAND_ILIMIT_SCALE,
            R.COMMAND_WITHIN_KP_SCALE,
            R.COMMAND_WITHIN_KD_SCALE,
            R.COMMAND_WITHIN_ILIMIT_SCALE,
        ),
    ),
    (_POWER, (R.POWER,)),
)
SCALES: Mapping[int, Scale] = {register: scale for scale, registers in _OF for register in registers}
"""Of the registers that hold a quantity; the others hold integers."""
NAMES: Mapping[str, Register] = {register.name.lower(): register for register in Register}


def scale_of(register: int) -> Scale:
    """What a count of a register is worth."""
    return SCALES.get(register, _INT)


def mode_name(mode: int) -> str:
    """The vendor's word for a mode."""
    return Mode(mode).name.lower().replace("_", " ") if mode in _MODES else f"mode {mode}"


_MODES = frozenset(Mode)
