"""What the host does differently by firmware line: one value per line, and no other code tests for the line.

Rules. A `Dialect` is a constant; a `HostAxis` keeps its line's name and looks it up in `DIALECTS`. "" is the
line of a device that is not identified yet: it is sent only requests that both lines answer alike.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

from protocols.odrive_can import faults05
from protocols.odrive_can import messages as m
from protocols.odrive_can.codec import cmd_of
from protocols.odrive_can.faults import ERRORS, Error, Result
from protocols.plugin import FaultInfo

Readable = Mapping[str, tuple[type[Any], str]]
"""The vendor's name of a signal → the message that carries it, and its field there."""


@dataclass(frozen=True, slots=True)
class Status:
    """The content of a heartbeat of either line."""

    error: int
    state: int
    result: int = Result.SUCCESS
    """Of the last procedure (0.6.x)."""
    components: tuple[int, ...] = ()
    """The commands of the components' error words that are not 0 (0.5.x)."""

    @property
    def faulty(self) -> bool:
        """True if the device reports any error."""
        return bool(self.error or self.components)


@dataclass(frozen=True, slots=True)
class Dialect:
    """One firmware line as the host uses it."""

    line: str
    polled: tuple[int, ...] = ()
    """Commands requested every `poll_ms`."""
    heartbeat_on_request: bool = True
    """Whether a heartbeat that is not sent cyclically can be requested."""
    disarm_reasons: tuple[int, ...] = ()
    """Commands that report why an axis disarmed by itself."""
    axis_faults: Mapping[int, FaultInfo] = field(default_factory=dict)
    """The bits of the heartbeat's error word; empty while their meaning is not known."""
    axis_base: int = 0
    """Added to one of them to make its fault's code."""
    component_faults: Mapping[int, tuple[int, Mapping[int, FaultInfo]]] = field(default_factory=dict)
    """Error words of components, by command: what is added to a bit to make its fault's code, and the
    bits."""
    initializing: int = 0
    """Bits of the error word that mean "still starting"."""
    estop: int = 0
    """The bit of the error word that an emergency stop sets."""
    clear: m.Message | None = None
    reboot: m.Message | None = None
    save: m.Message | None = None
    """None: the configuration cannot be saved over CAN."""
    zero: m.Message | None = None
    boards: bool = False
    """Clearing and rebooting affect every axis of a board, not only the addressed one."""
    readable: Readable = field(default_factory=dict)


def status_of(message: m.Message) -> Status | None:
    """Return the content of a heartbeat, of either line or not identified; None for another message."""
    match message:
        case m.Heartbeat(error, state, result, _):
            return Status(error, state, result)
        case m.Heartbeat05(error, state, motor, encoder, controller, _):
            flags = (
                (motor, m.GetMotorError),
                (encoder, m.GetEncoderError),
                (controller, m.GetControllerError),
            )
            components = [cmd_of(kind) for flag, kind in flags if flag]
            if error & faults05.AxisError.SENSORLESS_ESTIMATOR_FAILED:
                components.append(cmd_of(m.GetSensorlessError))
            return Status(error, state, components=tuple(components))
        case m.UnidentifiedHeartbeat(error, state, _, _, _):
            return Status(error, state)
    return None


def _cmds(*kinds: type[Any]) -> tuple[int, ...]:
    return tuple(cmd_of(kind) for kind in kinds)


Signals = dict[type[Any], tuple[str, ...]]
"""The messages that devices send, with the vendor's names of their fields in order."""
COMMON_SIGNALS: Signals = {
    m.GetEncoderEstimates: ("Pos_Estimate", "Vel_Estimate"),
    m.GetIq: ("Iq_Setpoint", "Iq_Measured"),
    m.GetBusVoltageCurrent: ("Bus_Voltage", "Bus_Current"),
}
SIGNALS06: Signals = COMMON_SIGNALS | {
    m.GetVersion: (
        *("Protocol_Version", "Hw_Version_Major", "Hw_Version_Minor", "Hw_Version_Variant"),
        *("Fw_Version_Major", "Fw_Version_Minor", "Fw_Version_Revision", "Fw_Version_Unreleased"),
    ),
    m.Heartbeat: ("Axis_Error", "Axis_State", "Procedure_Result", "Trajectory_Done_Flag"),
    m.GetError: ("Active_Errors", "Disarm_Reason"),
    m.GetTemperature: ("FET_Temperature", "Motor_Temperature"),
    m.GetTorques: ("Torque_Target", "Torque_Estimate"),
    m.GetPowers: ("Electrical_Power", "Mechanical_Power"),
}
SIGNALS05: Signals = COMMON_SIGNALS | {
    m.Heartbeat05: (
        *("Axis_Error", "Axis_State", "Motor_Error_Flag", "Encoder_Error_Flag"),
        *("Controller_Error_Flag", "Trajectory_Done_Flag"),
    ),
    m.GetMotorError: ("Motor_Error",),
    m.GetEncoderError: ("Encoder_Error",),
    m.GetControllerError: ("Controller_Error",),
    m.GetSensorlessError: ("Sensorless_Error",),
    m.GetEncoderCount: ("Shadow_Count", "Count_in_CPR"),
    m.GetSensorlessEstimates: ("Sensorless_Pos_Estimate", "Sensorless_Vel_Estimate"),
}


def _readable(signals: Signals) -> Readable:
    rows = [(kind, zip(names, kind.__slots__, strict=True)) for kind, names in signals.items()]
    return {name: (kind, attribute) for kind, pairs in rows for name, attribute in pairs}


UNIDENTIFIED = Dialect(line="", readable=_readable(COMMON_SIGNALS))
LINE06 = Dialect(
    line="0.6",
    polled=_cmds(m.GetIq, m.GetBusVoltageCurrent, m.GetTemperature, m.GetTorques),
    disarm_reasons=_cmds(m.GetError),
    axis_faults=ERRORS,
    initializing=Error.INITIALIZING,
    estop=Error.ESTOP_REQUESTED,
    clear=m.ClearErrors(),
    reboot=m.Reboot(m.RebootAction.REBOOT),
    save=m.Reboot(m.RebootAction.SAVE),
    zero=m.SetAbsolutePosition(0.0),
    readable=_readable(SIGNALS06),
)
LINE05 = Dialect(
    line="0.5",
    polled=_cmds(m.GetIq, m.GetBusVoltageCurrent),
    heartbeat_on_request=False,
    axis_faults=faults05.AXIS_FAULTS,
    axis_base=faults05.AXIS_BASE,
    component_faults={
        cmd_of(m.GetMotorError): (faults05.MOTOR_BASE, faults05.MOTOR_FAULTS),
        cmd_of(m.GetEncoderError): (faults05.ENCODER_BASE, faults05.ENCODER_FAULTS),
        cmd_of(m.GetControllerError): (faults05.CONTROLLER_BASE, faults05.CONTROLLER_FAULTS),
        cmd_of(m.GetSensorlessError): (faults05.SENSORLESS_BASE, faults05.SENSORLESS_FAULTS),
    },
    estop=faults05.AxisError.ESTOP_REQUESTED,
    clear=m.ClearErrors05(),
    reboot=m.Reboot05(),
    zero=m.SetLinearCount(0),
    boards=True,
    readable=_readable(SIGNALS05),
)
DIALECTS: dict[str, Dialect] = {dialect.line: dialect for dialect in (UNIDENTIFIED, LINE05, LINE06)}
