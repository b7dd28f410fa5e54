"""The messages of CANSimple as values in the device's own units, and its enums.

Rules. Names and order of fields as in the vendor's DBC; units turns, turns/s, N·m, A, V, °C, W. Nothing here
knows a byte: that is `codec`'s table. Here stands what both firmware lines share, and what is of 0.6.x alone;
`messages05` has what is of 0.5.x alone.

Source: odriverobotics/ODriveArduino@f52eef5 `src/can_simple_messages.hpp` and `src/ODriveEnums.h`; the DBC
`odrive-cansimple-0.6.10.dbc` of package odrive-can 2.1.0.
"""

from __future__ import annotations

from dataclasses import dataclass
from enum import IntEnum
from typing import TypeAlias, TypeVar, dataclass_transform

T = TypeVar("T")


@dataclass_transform(frozen_default=True)
def value(kind: type[T]) -> type[T]:
    """A message: a value that is never changed. The type checker sees to that; a dataclass that is frozen at
    run time takes three times as long to make, and messages are made for every frame."""
    return dataclass(slots=True, unsafe_hash=True)(kind)


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
    """`ODrive.Controller.InputMode`: how an input becomes a set-point."""

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


# -- messages -------------------------------------------------------------------------------------


@value
class Beacon:
    """0x01, device → host: a heartbeat of a device whose firmware line is not known. Both lines mean the same
    by the first two fields; the rest are bytes."""

    error: int
    state: int
    fifth: int
    sixth: int
    seventh: int


@value
class GetVersion:
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
class Heartbeat:
    """0x01, device → host, cyclic."""

    error: int
    state: int
    result: int
    """`faults.RESULTS`"""
    trajectory_done: int


@value
class Estop:
    """0x02, host → device: disarm with error ESTOP_REQUESTED."""


@value
class GetError:
    """0x03, device → host: what is wrong now, and why the axis last disarmed."""

    active: int
    disarm_reason: int


@value
class RxSdo:
    """0x04, host → device: read (opcode 0) or write (1) any parameter by its endpoint number."""

    opcode: int
    endpoint: int
    reserved: int
    value: int
    """Raw 32 bits; their type is the endpoint's."""


@value
class TxSdo:
    """0x05, device → host: the answer to RxSdo."""

    reserved: int
    endpoint: int
    reserved2: int
    value: int


@value
class Address:
    """0x06, both ways: a device tells, or (on the broadcast node) is given, its node id."""

    node: int
    serial: int
    connection: int | None = None
    """Connection id of firmware ≥ 0.6.11; None leaves the byte out (DLC 7)."""


@value
class SetAxisState:
    """0x07, host → device."""

    state: int


@value
class GetEncoderEstimates:
    """0x09, device → host, cyclic: turns, turns/s."""

    position: float
    velocity: float


@value
class SetControllerMode:
    """0x0B, host → device."""

    control_mode: int
    input_mode: int


@value
class SetInputPos:
    """0x0C, host → device: turns; feed-forward of turns/s and N·m, each int16 × 0.001."""

    position: float
    velocity: float
    torque: float


@value
class SetInputVel:
    """0x0D, host → device: turns/s, N·m."""

    velocity: float
    torque: float


@value
class SetInputTorque:
    """0x0E, host → device: N·m."""

    torque: float


@value
class SetLimits:
    """0x0F, host → device: turns/s, A."""

    velocity: float
    current: float


@value
class SetTrajVelLimit:
    """0x11, host → device: turns/s."""

    velocity: float


@value
class SetTrajAccelLimits:
    """0x12, host → device: turns/s²."""

    acceleration: float
    deceleration: float


@value
class SetTrajInertia:
    """0x13, host → device: N·m/(turn/s²)."""

    inertia: float


@value
class GetIq:
    """0x14, device → host: A."""

    setpoint: float
    measured: float


@value
class GetTemperature:
    """0x15, device → host: °C. NaN is the device's own word for "no thermistor fitted": None here."""

    fet: float | None
    motor: float | None


@value
class Reboot:
    """0x16, host → device."""

    action: int


@value
class GetBusVoltageCurrent:
    """0x17, device → host: V, A (positive: consumed)."""

    voltage: float
    current: float


@value
class ClearErrors:
    """0x18, host → device; identify 1 lets the LED blink."""

    identify: int = 0


@value
class SetAbsolutePosition:
    """0x19, host → device: turns that the present position is to be called."""

    position: float


@value
class SetPosGain:
    """0x1A, host → device: (turn/s)/turn."""

    gain: float


@value
class SetVelGains:
    """0x1B, host → device: N·m/(turn/s), N·m/turn."""

    gain: float
    integrator: float


@value
class GetTorques:
    """0x1C, device → host: N·m."""

    target: float
    estimate: float


@value
class GetPowers:
    """0x1D, device → host: W."""

    electrical: float
    mechanical: float


@value
class EnterDfuMode:
    """0x1F, host → device: leave for the boot loader."""


@value
class Ask:
    """A remote frame (or, to the device, an empty data frame): tell me your message `cmd`."""

    cmd: int


Message: TypeAlias = (
    Beacon
    | GetVersion
    | Heartbeat
    | Estop
    | GetError
    | RxSdo
    | TxSdo
    | Address
    | SetAxisState
    | GetEncoderEstimates
    | SetControllerMode
    | SetInputPos
    | SetInputVel
    | SetInputTorque
    | SetLimits
    | SetTrajVelLimit
    | SetTrajAccelLimits
    | SetTrajInertia
    | GetIq
    | GetTemperature
    | Reboot
    | GetBusVoltageCurrent
    | ClearErrors
    | SetAbsolutePosition
    | SetPosGain
    | SetVelGains
    | GetTorques
    | GetPowers
    | EnterDfuMode
)
