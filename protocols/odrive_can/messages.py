"""The messages of CANSimple as values in the device's own units, and its enums.

Rules. Names and order of fields as in the vendor's DBC; units turns, turns/s, N·m, A, V, °C, W. Nothing here
knows a byte: that is the table of `codec`. Each docstring gives the command number and the direction. Where
both firmware lines have a message of one name with different payloads, the one of 0.5.x ends in 05.

Source: odriverobotics/ODriveArduino@f52eef5 `src/can_simple_messages.hpp` and `src/ODriveEnums.h`; the DBC
`odrive-cansimple-0.6.10.dbc` of package odrive-can 2.1.0; for 0.5.x odriverobotics/ODrive@f9b5419
`Firmware/communication/can/can_simple.cpp` and the DBC `odrive-cansimple-0.5.6.dbc` of the same package, but
for its bugs (README, "Trust").
"""

from __future__ import annotations

from dataclasses import dataclass
from enum import IntEnum
from typing import TypeVar, dataclass_transform

T = TypeVar("T")


@dataclass_transform(frozen_default=True)
def value(kind: type[T]) -> type[T]:
    """Make a class a message: a value that is never changed.

    The type checker enforces that; a dataclass frozen at run time takes three times as long to create, and a
    message is created for every frame."""
    return dataclass(slots=True, unsafe_hash=True)(kind)


class Message:
    """Any message of CANSimple, of either firmware line."""

    __slots__: tuple[str, ...] = ()


class AxisState(IntEnum):
    """`ODrive.Axis.AxisState` (ODriveArduino `src/ODriveEnums.h`)."""

    UNDEFINED = 0
    IDLE = 1
    STARTUP_SEQUENCE = 2
    FULL_CALIBRATION_SEQUENCE = 3
    MOTOR_CALIBRATION = 4
    ENCODER_INDEX_SEARCH = 6
    ENCODER_OFFSET_CALIBRATION = 7
    CLOSED_LOOP_CONTROL = 8
    LOCKIN_SPIN = 9
    ENCODER_DIR_FIND = 10
    HOMING = 11
    ENCODER_HALL_POLARITY_CALIBRATION = 12
    ENCODER_HALL_PHASE_CALIBRATION = 13
    ANTICOGGING_CALIBRATION = 14
    HARMONIC_CALIBRATION = 15
    HARMONIC_CALIBRATION_COMMUTATION = 16


class ControlMode(IntEnum):
    """`ODrive.Controller.ControlMode`: which of the cascaded loops is outermost."""

    VOLTAGE = 0
    TORQUE = 1
    VELOCITY = 2
    POSITION = 3


class InputMode(IntEnum):
    """`ODrive.Controller.InputMode`: how an input value becomes a set-point."""

    INACTIVE = 0
    PASSTHROUGH = 1
    VEL_RAMP = 2
    POS_FILTER = 3
    MIX_CHANNELS = 4
    TRAP_TRAJ = 5
    TORQUE_RAMP = 6
    MIRROR = 7
    TUNING = 8


class RebootAction(IntEnum):
    """What Reboot does besides restarting."""

    REBOOT = 0
    SAVE = 1
    ERASE = 2


# -- messages of both lines, and those of 0.6.x alone ----------------------------------------------


@value
class UnidentifiedHeartbeat(Message):
    """0x01, device → host: a heartbeat of a device whose firmware line is not known. The first two fields are
    the same in both lines; the rest are bytes."""

    error: int
    state: int
    fifth: int
    sixth: int
    seventh: int


@value
class GetVersion(Message):
    """0x00, device → host."""

    protocol: int
    hw_line: int
    hw_version: int
    hw_variant: int
    fw_major: int
    fw_minor: int
    fw_revision: int
    fw_unreleased: int


@value
class Heartbeat(Message):
    """0x01, device → host, cyclic."""

    error: int
    state: int
    result: int
    """`faults.RESULTS`"""
    trajectory_done: int


@value
class Estop(Message):
    """0x02, host → device: disarm with error ESTOP_REQUESTED."""


@value
class GetError(Message):
    """0x03, device → host: the active errors, and why the axis last disarmed."""

    active: int
    disarm_reason: int


@value
class RxSdo(Message):
    """0x04, host → device: read (opcode 0) or write (1) any parameter by its endpoint number."""

    opcode: int
    endpoint: int
    reserved: int
    value: int
    """Raw 32 bits; their type is the endpoint's."""


@value
class TxSdo(Message):
    """0x05, device → host: the reply to RxSdo."""

    reserved: int
    endpoint: int
    reserved2: int
    value: int


@value
class Address(Message):
    """0x06, both ways: a device reports, or (on the broadcast node) is assigned, its node id."""

    node: int
    serial: int
    connection: int | None = None
    """Connection id of firmware ≥ 0.6.11; None leaves the byte out (DLC 7)."""


@value
class SetAxisState(Message):
    """0x07, host → device: request an `AxisState`."""

    state: int


@value
class GetEncoderEstimates(Message):
    """0x09, device → host, cyclic: turns, turns/s."""

    position: float
    velocity: float


@value
class SetControllerMode(Message):
    """0x0B, host → device: a `ControlMode` and an `InputMode`."""

    control_mode: int
    input_mode: int


@value
class SetInputPos(Message):
    """0x0C, host → device: turns; feed-forward of turns/s and N·m, each int16 × 0.001."""

    position: float
    velocity: float
    torque: float


@value
class SetInputVel(Message):
    """0x0D, host → device: turns/s, N·m."""

    velocity: float
    torque: float


@value
class SetInputTorque(Message):
    """0x0E, host → device: N·m."""

    torque: float


@value
class SetLimits(Message):
    """0x0F, host → device: turns/s, A."""

    velocity: float
    current: float


@value
class SetTrajVelLimit(Message):
    """0x11, host → device: turns/s."""

    velocity: float


@value
class SetTrajAccelLimits(Message):
    """0x12, host → device: turns/s²."""

    acceleration: float
    deceleration: float


@value
class SetTrajInertia(Message):
    """0x13, host → device: N·m/(turn/s²)."""

    inertia: float


@value
class GetIq(Message):
    """0x14, device → host: A."""

    setpoint: float
    measured: float


@value
class GetTemperature(Message):
    """0x15, device → host: °C. NaN means "no thermistor fitted" and is None here."""

    fet: float | None
    motor: float | None


@value
class Reboot(Message):
    """0x16, host → device: a `RebootAction`."""

    action: int


@value
class GetBusVoltageCurrent(Message):
    """0x17, device → host: V, A (positive: consumed)."""

    voltage: float
    current: float


@value
class ClearErrors(Message):
    """0x18, host → device; identify 1 makes the LED blink."""

    identify: int = 0


@value
class SetAbsolutePosition(Message):
    """0x19, host → device: the new value of the present position, turns."""

    position: float


@value
class SetPosGain(Message):
    """0x1A, host → device: (turn/s)/turn."""

    gain: float


@value
class SetVelGains(Message):
    """0x1B, host → device: N·m/(turn/s), N·m/turn."""

    gain: float
    integrator: float


@value
class GetTorques(Message):
    """0x1C, device → host: N·m."""

    target: float
    estimate: float


@value
class GetPowers(Message):
    """0x1D, device → host: W."""

    electrical: float
    mechanical: float


@value
class EnterDfuMode(Message):
    """0x1F, host → device: enter the boot loader."""


# -- messages that only 0.5.x has, or has with another payload -------------------------------------


@value
class Heartbeat05(Message):
    """0x01, device → host, cyclic. It is not sent on request."""

    error: int
    state: int
    motor: int
    """1 if Get_Motor_Error is not 0; the next two likewise."""
    encoder: int
    controller: int
    trajectory_done: int


@value
class GetMotorError(Message):
    """0x03, device → host: 64 bits of `faults05.MotorError`."""

    errors: int


@value
class GetEncoderError(Message):
    """0x04, device → host: bits of `faults05.EncoderError`."""

    errors: int


@value
class GetSensorlessError(Message):
    """0x05, device → host: bits of `faults05.SensorlessError`."""

    errors: int


@value
class SetAxisNodeId(Message):
    """0x06, host → device: effective at once, lost at the next restart unless saved over USB."""

    node: int


@value
class GetEncoderCount(Message):
    """0x0A, device → host: counts since power-on, and within one turn. Signed."""

    shadow: int
    in_cpr: int


@value
class StartAnticogging(Message):
    """0x10, host → device: start the calibration that measures the motor's cogging."""


@value
class GetSensorlessEstimates(Message):
    """0x15, device → host: turns, turns/s."""

    position: float
    velocity: float


@value
class Reboot05(Message):
    """0x16, host → device: restart the board with all its axes."""


@value
class ClearErrors05(Message):
    """0x18, host → device: clear the errors of the board with all its axes."""


@value
class SetLinearCount(Message):
    """0x19, host → device: the new value of the present position, encoder counts."""

    count: int


@value
class RequestAdcVoltage(Message):
    """0x1C, host → device: request the voltage of a GPIO (a data frame, not a remote one)."""

    gpio: int


@value
class GetAdcVoltage(Message):
    """0x1C, device → host: V."""

    voltage: float


@value
class GetControllerError(Message):
    """0x1D, device → host: bits of `faults05.ControllerError`."""

    errors: int


@value
class RemoteRequest:
    """A remote frame (or, to the device, an empty data frame): a request for the device's message `cmd`."""

    cmd: int
