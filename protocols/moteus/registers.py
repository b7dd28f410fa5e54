"""The registers of a moteus: numbers, names and scales, and the values of the mode register.

Rules. Tables only. A scale is given for 8, 16 and 32 bit integers; a binary32 holds the quantity itself, in
the vendor's units (revolutions at the output shaft, s, N·m, A, V, °C). Numbers, names and scales:
mjbots/moteus@db1a762 `docs/protocol/registers.md`, checked against moteus 1.1.1 by a test.
"""

from __future__ import annotations

from collections.abc import Mapping
from enum import IntEnum
from typing import Self, TypeAlias

Scale: TypeAlias = tuple[float, float, float, float]
"""The value of one count, by resolution: int8, int16, int32, binary32."""

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


class Register(IntEnum):
    """The registers that driver and twin know: the number, and the scale if it holds a quantity."""

    scale: Scale

    def __new__(cls, number: int, scale: Scale = _INT) -> Self:
        """Make a member whose value is the register number."""
        member = int.__new__(cls, number)
        member._value_ = number
        member.scale = scale
        return member

    MODE = 0x000
    POSITION = 0x001, _POSITION
    VELOCITY = 0x002, _VELOCITY
    TORQUE = 0x003, _TORQUE
    Q_CURRENT = 0x004, _CURRENT
    D_CURRENT = 0x005, _CURRENT
    ABS_POSITION = 0x006, _POSITION
    POWER = 0x007, _POWER
    MOTOR_TEMPERATURE = 0x00A, _TEMPERATURE
    TRAJECTORY_COMPLETE = 0x00B
    HOME_STATE = 0x00C
    VOLTAGE = 0x00D, _VOLTAGE
    TEMPERATURE = 0x00E, _TEMPERATURE
    FAULT = 0x00F
    PWM_PHASE_A = 0x010, _PWM
    PWM_PHASE_B = 0x011, _PWM
    PWM_PHASE_C = 0x012, _PWM
    VOLTAGE_PHASE_A = 0x014, _VOLTAGE
    VOLTAGE_PHASE_B = 0x015, _VOLTAGE
    VOLTAGE_PHASE_C = 0x016, _VOLTAGE
    VFOC_THETA = 0x018, _PWM
    VFOC_VOLTAGE = 0x019, _VOLTAGE
    VOLTAGEDQ_D = 0x01A, _VOLTAGE
    VOLTAGEDQ_Q = 0x01B, _VOLTAGE
    COMMAND_Q_CURRENT = 0x01C, _CURRENT
    COMMAND_D_CURRENT = 0x01D, _CURRENT
    VFOC_THETA_RATE = 0x01E, _VELOCITY
    COMMAND_POSITION = 0x020, _POSITION
    COMMAND_VELOCITY = 0x021, _VELOCITY
    COMMAND_FEEDFORWARD_TORQUE = 0x022, _TORQUE
    COMMAND_KP_SCALE = 0x023, _PWM
    COMMAND_KD_SCALE = 0x024, _PWM
    COMMAND_POSITION_MAX_TORQUE = 0x025, _TORQUE
    COMMAND_STOP_POSITION = 0x026, _POSITION
    COMMAND_TIMEOUT = 0x027, _TIME
    COMMAND_VELOCITY_LIMIT = 0x028, _VELOCITY
    COMMAND_ACCEL_LIMIT = 0x029, _ACCEL
    COMMAND_FIXED_VOLTAGE_OVERRIDE = 0x02A, _VOLTAGE
    COMMAND_ILIMIT_SCALE = 0x02B, _PWM
    COMMAND_FIXED_CURRENT_OVERRIDE = 0x02C, _CURRENT
    COMMAND_IGNORE_POSITION_BOUNDS = 0x02D
    POSITION_KP = 0x030, _TORQUE
    POSITION_KI = 0x031, _TORQUE
    POSITION_KD = 0x032, _TORQUE
    POSITION_FEEDFORWARD = 0x033, _TORQUE
    POSITION_COMMAND = 0x034, _TORQUE
    CONTROL_POSITION = 0x038, _POSITION
    CONTROL_VELOCITY = 0x039, _VELOCITY
    CONTROL_TORQUE = 0x03A, _TORQUE
    POSITION_ERROR = 0x03B, _POSITION
    VELOCITY_ERROR = 0x03C, _VELOCITY
    TORQUE_ERROR = 0x03D, _TORQUE
    COMMAND_WITHIN_LOWER_BOUND = 0x040, _POSITION
    COMMAND_WITHIN_UPPER_BOUND = 0x041, _POSITION
    COMMAND_WITHIN_FEEDFORWARD_TORQUE = 0x042, _TORQUE
    COMMAND_WITHIN_KP_SCALE = 0x043, _PWM
    COMMAND_WITHIN_KD_SCALE = 0x044, _PWM
    COMMAND_WITHIN_MAX_TORQUE = 0x045, _TORQUE
    COMMAND_WITHIN_TIMEOUT = 0x046, _TIME
    COMMAND_WITHIN_ILIMIT_SCALE = 0x047, _PWM
    COMMAND_WITHIN_IGNORE_POSITION_BOUNDS = 0x048
    ENCODER_0_POSITION = 0x050, _POSITION
    ENCODER_0_VELOCITY = 0x051, _VELOCITY
    ENCODER_VALIDITY = 0x058
    MILLISECOND_COUNTER = 0x070
    MODEL_NUMBER = 0x100
    FIRMWARE_VERSION = 0x101
    REGISTER_MAP_VERSION = 0x102
    MULTIPLEX_ID = 0x110
    SERIAL_NUMBER1 = 0x120
    SERIAL_NUMBER2 = 0x121
    SERIAL_NUMBER3 = 0x122
    SET_OUTPUT_NEAREST = 0x130, _POSITION
    SET_OUTPUT_EXACT = 0x131, _POSITION
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
"""Only a stop command leaves these."""
RISING = (Mode.ENABLING, Mode.CALIBRATING, Mode.CALIBRATION_COMPLETE)
"""On the way from stopped to any mode with torque."""

SCALES: Mapping[int, Scale] = {r: r.scale for r in Register if r.scale is not _INT}
"""Scales of the registers that hold a quantity; the others hold integers."""
NAMES: Mapping[str, Register] = {register.name.lower(): register for register in Register}
_MODES = frozenset(Mode)


def scale_of(register: int) -> Scale:
    """Return the value of one count of a register, by resolution."""
    return SCALES.get(register, _INT)


def mode_name(mode: int) -> str:
    """Return the vendor's name of a mode."""
    return Mode(mode).name.lower().replace("_", " ") if mode in _MODES else f"mode {mode}"
