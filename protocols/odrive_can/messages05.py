"""The messages of CANSimple that only firmware 0.5.x has, or has with another payload.

Rules as in `messages`. Where both lines have a message of one name with different payloads, the one of this
line ends in 05.

Source: odriverobotics/ODrive@f9b5419 `Firmware/communication/can/can_simple.cpp`; the DBC
`odrive-cansimple-0.5.6.dbc` of package odrive-can 2.1.0, but for its bugs (README, "Trust").
"""

from __future__ import annotations

from typing import TypeAlias

from protocols.odrive_can.messages import value


@value
class Heartbeat05:
    """0x01, device → host, cyclic. It is not told when asked."""

    error: int
    state: int
    motor: int
    """1: Get_Motor_Error is not empty."""
    encoder: int
    controller: int
    trajectory_done: int


@value
class GetMotorError:
    """0x03, device → host: 64 bits, `faults05.MOTOR`."""

    errors: int


@value
class GetEncoderError:
    """0x04, device → host: `faults05.ENCODER`."""

    errors: int


@value
class GetSensorlessError:
    """0x05, device → host: `faults05.SENSORLESS`."""

    errors: int


@value
class SetAxisNodeId:
    """0x06, host → device: taken at once, forgotten at the next restart unless saved over USB."""

    node: int


@value
class GetEncoderCount:
    """0x0A, device → host: counts since power-on, and within one turn. Signed."""

    shadow: int
    in_cpr: int


@value
class StartAnticogging:
    """0x10, host → device: start the calibration that measures the motor's cogging."""


@value
class GetSensorlessEstimates:
    """0x15, device → host: turns, turns/s."""

    position: float
    velocity: float


@value
class Reboot05:
    """0x16, host → device: restart the board with all its axes."""


@value
class ClearErrors05:
    """0x18, host → device: clear the errors of the board with all its axes."""


@value
class SetLinearCount:
    """0x19, host → device: encoder counts that the present position is to be called."""

    count: int


@value
class AskAdcVoltage:
    """0x1C, host → device: tell the voltage of a GPIO (a data frame, no remote one)."""

    gpio: int


@value
class GetAdcVoltage:
    """0x1C, device → host: V."""

    voltage: float


@value
class GetControllerError:
    """0x1D, device → host: `faults05.CONTROLLER`."""

    errors: int


Message05: TypeAlias = (
    Heartbeat05
    | GetMotorError
    | GetEncoderError
    | GetSensorlessError
    | SetAxisNodeId
    | GetEncoderCount
    | StartAnticogging
    | GetSensorlessEstimates
    | Reboot05
    | ClearErrors05
    | SetLinearCount
    | AskAdcVoltage
    | GetAdcVoltage
    | GetControllerError
)
