"""What our end does differently by firmware line: one value per line, and nobody else asks which it is.

Rules. A `Dialect` is a constant; a node keeps its line's name and looks it up in `DIALECTS`. "" is the line
of a device that has not been told apart yet: it is asked what both lines answer alike, and told nothing.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from protocols.odrive_can import messages as m
from protocols.odrive_can import messages05 as m05
from protocols.odrive_can.codec import AnyMessage, cmd_of
from protocols.odrive_can.faults import ERRORS, Error, Result
from protocols.odrive_can.faults05 import (
    AXIS,
    AXIS_BASE,
    CONTROLLER,
    CONTROLLER_BASE,
    ENCODER,
    ENCODER_BASE,
    MOTOR,
    MOTOR_BASE,
    SENSORLESS,
    SENSORLESS_BASE,
    AxisError,
)
from protocols.plugin import FaultInfo

Readable = Mapping[str, tuple[type[Any], str]]
"""The vendor's name of a signal → the message that tells it, and its field there."""


@dataclass(frozen=True, slots=True)
class Beat:
    """What a heartbeat says, of either line."""

    error: int
    state: int
    result: int = Result.SUCCESS
    """Of the last procedure (0.6.x)."""
    parts: tuple[int, ...] = ()
    """The commands of the error words that are not empty (0.5.x)."""


@dataclass(frozen=True, slots=True)
class Dialect:
    """One firmware line as our end speaks it."""

    line: str
    polled: tuple[int, ...]
    """Commands asked for every `poll_ms`."""
    heartbeat_asked: bool
    """Whether a heartbeat that does not come by itself can be asked for."""
    reasons: tuple[int, ...]
    """Commands that tell why an axis disarmed by itself."""
    axis: Mapping[int, FaultInfo]
    """The bits of the heartbeat's error word; none: what they mean is not known."""
    base: int
    """Added to one of them to make its fault's code."""
    parts: Mapping[int, tuple[int, Mapping[int, FaultInfo]]]
    """Error words of their own, by command: what is added to a bit to make its fault's code, and the bits."""
    initializing: int
    """Bits of the error word that say "not up yet"."""
    estop: int
    clear: AnyMessage | None
    reboot: AnyMessage | None
    save: AnyMessage | None
    """None: the configuration cannot be saved over CAN."""
    zero: AnyMessage | None
    boards: bool
    """Clearing and restarting reach every axis of a board, not just the one that was meant."""
    readable: Readable


def beat_of(message: AnyMessage) -> Beat | None:
    """A heartbeat of either line, or what both mean the same by; None if it is another message."""
    match message:
        case m.Heartbeat(error, state, result, _):
            return Beat(error, state, result)
        case m05.Heartbeat05(error, state, motor, encoder, controller, _):
            flags = ((motor, m05.GetMotorError), (encoder, m05.GetEncoderError))
            parts = [cmd_of(kind) for flag, kind in (*flags, (controller, m05.GetControllerError)) if flag]
            if error & AxisError.SENSORLESS_ESTIMATOR_FAILED:
                parts.append(cmd_of(m05.GetSensorlessError))
            return Beat(error, state, parts=tuple(parts))
        case m.Beacon(error, state, _, _, _):
            return Beat(error, state)
    return None


def _cmds(*kinds: type[Any]) -> tuple[int, ...]:
    return tuple(cmd_of(kind) for kind in kinds)


READABLE_COMMON: Readable = {
    "Pos_Estimate": (m.GetEncoderEstimates, "position"),
    "Vel_Estimate": (m.GetEncoderEstimates, "velocity"),
    "Iq_Setpoint": (m.GetIq, "setpoint"),
    "Iq_Measured": (m.GetIq, "measured"),
    "Bus_Voltage": (m.GetBusVoltageCurrent, "voltage"),
    "Bus_Current": (m.GetBusVoltageCurrent, "current"),
}
READABLE06: Readable = {
    **READABLE_COMMON,
    "Protocol_Version": (m.GetVersion, "protocol"),
    "Hw_Version_Major": (m.GetVersion, "hw_line"),
    "Hw_Version_Minor": (m.GetVersion, "hw_version"),
    "Hw_Version_Variant": (m.GetVersion, "hw_variant"),
    "Fw_Version_Major": (m.GetVersion, "fw_major"),
    "Fw_Version_Minor": (m.GetVersion, "fw_minor"),
    "Fw_Version_Revision": (m.GetVersion, "fw_revision"),
    "Fw_Version_Unreleased": (m.GetVersion, "fw_unreleased"),
    "Axis_Error": (m.Heartbeat, "error"),
    "Axis_State": (m.Heartbeat, "state"),
    "Procedure_Result": (m.Heartbeat, "result"),
    "Trajectory_Done_Flag": (m.Heartbeat, "trajectory_done"),
    "Active_Errors": (m.GetError, "active"),
    "Disarm_Reason": (m.GetError, "disarm_reason"),
    "FET_Temperature": (m.GetTemperature, "fet"),
    "Motor_Temperature": (m.GetTemperature, "motor"),
    "Torque_Target": (m.GetTorques, "target"),
    "Torque_Estimate": (m.GetTorques, "estimate"),
    "Electrical_Power": (m.GetPowers, "electrical"),
    "Mechanical_Power": (m.GetPowers, "mechanical"),
}
READABLE05: Readable = {
    **READABLE_COMMON,
    "Axis_Error": (m05.Heartbeat05, "error"),
    "Axis_State": (m05.Heartbeat05, "state"),
    "Motor_Error_Flag": (m05.Heartbeat05, "motor"),
    "Encoder_Error_Flag": (m05.Heartbeat05, "encoder"),
    "Controller_Error_Flag": (m05.Heartbeat05, "controller"),
    "Trajectory_Done_Flag": (m05.Heartbeat05, "trajectory_done"),
    "Motor_Error": (m05.GetMotorError, "errors"),
    "Encoder_Error": (m05.GetEncoderError, "errors"),
    "Controller_Error": (m05.GetControllerError, "errors"),
    "Sensorless_Error": (m05.GetSensorlessError, "errors"),
    "Shadow_Count": (m05.GetEncoderCount, "shadow"),
    "Count_in_CPR": (m05.GetEncoderCount, "in_cpr"),
    "Sensorless_Pos_Estimate": (m05.GetSensorlessEstimates, "position"),
    "Sensorless_Vel_Estimate": (m05.GetSensorlessEstimates, "velocity"),
}

UNREPORTED = Dialect(
    line="",
    polled=(),
    heartbeat_asked=True,
    reasons=(),
    axis={},
    base=0,
    parts={},
    initializing=0,
    estop=0,
    clear=None,
    reboot=None,
    save=None,
    zero=None,
    boards=False,
    readable=READABLE_COMMON,
)
LINE06 = Dialect(
    line="0.6",
    polled=_cmds(m.GetIq, m.GetBusVoltageCurrent, m.GetTemperature, m.GetTorques),
    heartbeat_asked=True,
    reasons=_cmds(m.GetError),
    axis=ERRORS,
    base=0,
    parts={},
    initializing=Error.INITIALIZING,
    estop=Error.ESTOP_REQUESTED,
    clear=m.ClearErrors(),
    reboot=m.Reboot(m.RebootAction.REBOOT),
    save=m.Reboot(m.RebootAction.SAVE),
    zero=m.SetAbsolutePosition(0.0),
    boards=False,
    readable=READABLE06,
)
LINE05 = Dialect(
    line="0.5",
    polled=_cmds(m.GetIq, m.GetBusVoltageCurrent),
    heartbeat_asked=False,
    reasons=(),
    axis=AXIS,
    base=AXIS_BASE,
    parts={
        cmd_of(m05.GetMotorError): (MOTOR_BASE, MOTOR),
        cmd_of(m05.GetEncoderError): (ENCODER_BASE, ENCODER),
        cmd_of(m05.GetControllerError): (CONTROLLER_BASE, CONTROLLER),
        cmd_of(m05.GetSensorlessError): (SENSORLESS_BASE, SENSORLESS),
    },
    initializing=0,
    estop=AxisError.ESTOP_REQUESTED,
    clear=m05.ClearErrors05(),
    reboot=m05.Reboot05(),
    save=None,
    zero=m05.SetLinearCount(0),
    boards=True,
    readable=READABLE05,
)
DIALECTS: dict[str, Dialect] = {dialect.line: dialect for dialect in (UNREPORTED, LINE05, LINE06)}
