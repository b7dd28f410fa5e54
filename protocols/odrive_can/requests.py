"""Requests that wait for a device: what is sent, what counts as carried out, when it is given up.

Rules. Every request ends in Done or Refused within its deadline, whatever the device does. A request that is
impossible is refused at once with the reason. What CANSimple does not confirm is "sent" once a heartbeat
shows that the device is alive, and its Done says so.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import Any

from protocols.odrive_can.codec import BROADCAST, MAX_NODE, ask, encode
from protocols.odrive_can.faults import Error, names
from protocols.odrive_can.messages import (
    Address,
    AxisState,
    ClearErrors,
    Estop,
    GetBusVoltageCurrent,
    GetEncoderEstimates,
    GetError,
    GetIq,
    GetPowers,
    GetTemperature,
    GetTorques,
    GetVersion,
    Heartbeat,
    Message,
    Reboot,
    RebootAction,
    SetAbsolutePosition,
    SetLimits,
    SetPosGain,
    SetTrajAccelLimits,
    SetTrajInertia,
    SetTrajVelLimit,
    SetVelGains,
)
from protocols.odrive_can.node import Node
from protocols.wire import CanFrame
from protocols.words import (
    MILLISECOND,
    ClearFault,
    Done,
    Event,
    Nanos,
    Parameter,
    ReadParameter,
    Refused,
    Request,
    Scan,
    SetId,
    WriteParameter,
    Zero,
)
from protocols.words import Estop as EstopWord
from protocols.words import Reboot as RebootWord

ANSWER = 600 * MILLISECOND
RESEND = 120 * MILLISECOND
REBOOT = 8000 * MILLISECOND
REBOOT_RESEND = 2000 * MILLISECOND
REBOOT_GAP = 400 * MILLISECOND
"""A pause between heartbeats that no running device makes: a late one is asked for after 250 ms."""
SCAN_STEP = 600 * MILLISECOND
"""Discovery is repeated so often (ODriveResources@06dc846 `examples/can_enumerate.py`)."""
SCAN_STEPS = 3
ASSIGN = 1500 * MILLISECOND
ZERO_WITHIN = 0.05
"""turns"""

READABLE: dict[str, tuple[type[Any], str]] = {
    "Protocol_Version": (GetVersion, "protocol"),
    "Hw_Version_Major": (GetVersion, "hw_line"),
    "Hw_Version_Minor": (GetVersion, "hw_version"),
    "Hw_Version_Variant": (GetVersion, "hw_variant"),
    "Fw_Version_Major": (GetVersion, "fw_major"),
    "Fw_Version_Minor": (GetVersion, "fw_minor"),
    "Fw_Version_Revision": (GetVersion, "fw_revision"),
    "Fw_Version_Unreleased": (GetVersion, "fw_unreleased"),
    "Axis_Error": (Heartbeat, "error"),
    "Axis_State": (Heartbeat, "state"),
    "Procedure_Result": (Heartbeat, "result"),
    "Trajectory_Done_Flag": (Heartbeat, "trajectory_done"),
    "Active_Errors": (GetError, "active"),
    "Disarm_Reason": (GetError, "disarm_reason"),
    "Pos_Estimate": (GetEncoderEstimates, "position"),
    "Vel_Estimate": (GetEncoderEstimates, "velocity"),
    "Iq_Setpoint": (GetIq, "setpoint"),
    "Iq_Measured": (GetIq, "measured"),
    "FET_Temperature": (GetTemperature, "fet"),
    "Motor_Temperature": (GetTemperature, "motor"),
    "Bus_Voltage": (GetBusVoltageCurrent, "voltage"),
    "Bus_Current": (GetBusVoltageCurrent, "current"),
    "Torque_Target": (GetTorques, "target"),
    "Torque_Estimate": (GetTorques, "estimate"),
    "Electrical_Power": (GetPowers, "electrical"),
    "Mechanical_Power": (GetPowers, "mechanical"),
}
"""What the device's own messages tell, by the vendor's signal names, in the vendor's units."""

WRITABLE: tuple[tuple[type[Any], tuple[str, ...]], ...] = (
    (SetLimits, ("Velocity_Limit", "Current_Limit")),
    (SetTrajVelLimit, ("Traj_Vel_Limit",)),
    (SetTrajAccelLimits, ("Traj_Accel_Limit", "Traj_Decel_Limit")),
    (SetTrajInertia, ("Traj_Inertia",)),
    (SetPosGain, ("Pos_Gain",)),
    (SetVelGains, ("Vel_Gain", "Vel_Integrator_Gain")),
)
SAVE = "save_configuration"
"""Written with 1, the device saves its configuration and restarts."""


@dataclass(slots=True)
class Pending:
    """A request under way."""

    request: Request
    name: str
    node: Node | None
    frames: tuple[CanFrame, ...]
    deadline: Nanos
    again: Nanos
    """Sent again so long after it was last sent; 0: never."""
    next: Nanos
    began: Nanos
    sent: int = 0
    stage: int = 0
    beat_at: Nanos = 0
    found: dict[tuple[int, int | None], str] = field(default_factory=dict)

    def title(self) -> str:
        """The request's name."""
        return type(self.request).__name__

    def done(self, t: Nanos, detail: str = "") -> Done:
        """It was carried out."""
        return Done(t, self.title(), self.name, detail)

    def refuse(self, t: Nanos, reason: str) -> Refused:
        """It was not."""
        return Refused(t, self.title(), self.name, reason)


def refuse(t: Nanos, request: Request, reason: str) -> Refused:
    """A request that is not even begun."""
    name: str = getattr(request, "motor", "") or getattr(request, "bus", "")
    return Refused(t, type(request).__name__, name, reason)


def begin(now: Nanos, request: Request, node: Node, written: dict[str, float]) -> Pending | Refused:
    """A request to one device."""
    send: tuple[Message, ...] = ()
    running = node.claimed or node.state == AxisState.CLOSED_LOOP_CONTROL
    match request:
        case ClearFault():
            node.cleared()
            send = (ClearErrors(),)
        case EstopWord():
            send = (Estop(),)
        case Zero() if running:
            return refuse(now, request, "it is armed, and would jump: say idle first")
        case Zero():
            send = (SetAbsolutePosition(0.0),)
        case RebootWord() | WriteParameter(_, "save_configuration") if running:
            return refuse(now, request, "it is armed, and would drop its load: say idle first")
        case RebootWord():
            return _pending(now, request, node, (Reboot(RebootAction.REBOOT),), REBOOT, REBOOT_RESEND)
        case WriteParameter(_, "save_configuration", value):
            if value != 1:
                return refuse(now, request, f"{SAVE} takes 1")
            return _pending(now, request, node, (Reboot(RebootAction.SAVE),), REBOOT, REBOOT_RESEND)
        case WriteParameter(_, parameter, value):
            message = _write(now, request, parameter, value, written)
            if isinstance(message, Refused):
                return message
            send = (message,)
        case ReadParameter(_, parameter):
            if parameter not in READABLE:
                known = ", ".join(READABLE)
                return refuse(now, request, f"CANSimple does not tell {parameter!r}; it tells {known}")
            frames = (ask(node.address, READABLE[parameter][0]),)
            return Pending(request, node.name, node, frames, now + ANSWER, RESEND, now, now)
        case _:
            return refuse(now, request, f"odrive_can has no {type(request).__name__}")
    return _pending(now, request, node, send, ANSWER, RESEND)


def _pending(
    now: Nanos, request: Request, node: Node, messages: tuple[Message, ...], limit: Nanos, again: Nanos
) -> Pending:
    frames = tuple(encode(node.address, message) for message in messages)
    return Pending(request, node.name, node, frames, now + limit, again, now, now)


def _write(
    now: Nanos, request: WriteParameter, parameter: str, value: float, written: dict[str, float]
) -> Message | Refused:
    """The message that sets a parameter; its partner in the same message must be known."""
    row = next((row for row in WRITABLE if parameter in row[1]), None)
    if row is None:
        known = ", ".join([name for _, pair in WRITABLE for name in pair] + [SAVE])
        return refuse(now, request, f"CANSimple cannot set {parameter!r}; it can set {known}")
    if not (math.isfinite(value) and value >= 0):
        return refuse(now, request, f"{value} is not a finite number of at least 0")
    message, names_ = row
    written[parameter] = value
    missing = [name for name in names_ if name not in written]
    if missing:
        return refuse(
            now,
            request,
            f"{message.__name__} sets {' and '.join(names_)} together, and the device does not tell them"
            f" over CAN: write {missing[0]} too; {parameter} is kept for it",
        )
    said: Message = message(*(written[name] for name in names_))
    return said


def scan(now: Nanos, request: Scan) -> Pending:
    """Discovery: remote frames on the broadcast node, and heartbeats heard meanwhile."""
    frames = (ask(BROADCAST, Address),)
    return Pending(request, request.bus, None, frames, now + SCAN_STEP * SCAN_STEPS, SCAN_STEP, now, now)


def set_id(
    now: Nanos, request: SetId, nodes: list[Node], serials: dict[int, dict[int, Nanos]]
) -> Pending | Refused:
    """Give the device with a serial number a node id, and ask who is who."""
    if not 0 <= request.address <= MAX_NODE:
        return refuse(now, request, f"{request.address} is not a node id: 0 to {MAX_NODE}")
    if not 0 < request.serial < 1 << 48:
        return refuse(now, request, f"{request.serial} is not a serial number of 48 bits")
    holders = [serial for serial in serials.get(request.address, {}) if serial != request.serial]
    if holders:
        return refuse(now, request, f"node id {request.address} is held by serial number {holders[0]:012X}")
    for node in nodes:
        mine = request.serial in serials.get(node.address, {}) or node.address == request.address
        if mine and (node.claimed or node.state == AxisState.CLOSED_LOOP_CONTROL):
            return refuse(now, request, f"{node.name} is armed: say idle first")
    frames = (encode(BROADCAST, Address(request.address, request.serial)), ask(BROADCAST, Address))
    return Pending(request, request.bus, None, frames, now + ASSIGN, RESEND * 2, now, now)


def hear(pending: Pending, t: Nanos, message: Message) -> list[Event]:
    """Let a request of one device hear what it said; the events that end it, or none."""
    match pending.request:
        case ClearFault():
            if isinstance(message, Heartbeat) and not message.error:
                return [pending.done(t)]
        case EstopWord():
            if isinstance(message, Heartbeat) and message.error & Error.ESTOP_REQUESTED:
                return [pending.done(t, "it stays in fault until cleared")]
        case Zero():
            if isinstance(message, GetEncoderEstimates) and abs(message.position) < ZERO_WITHIN:
                return [pending.done(t)]
        case RebootWord() | WriteParameter(_, "save_configuration"):
            return _hear_reboot(pending, t, message)
        case WriteParameter():
            if isinstance(message, Heartbeat):
                return [pending.done(t, "sent; the device does not confirm it")]
        case ReadParameter():
            return _hear_parameter(pending, t, message)
    return []


def _hear_reboot(pending: Pending, t: Nanos, message: Message) -> list[Event]:
    if not isinstance(message, Heartbeat):
        return []
    gap = t - (pending.beat_at or pending.began)
    pending.beat_at = t
    if message.error & Error.INITIALIZING or gap >= REBOOT_GAP:
        pending.stage = 1
    if not pending.stage or message.error & Error.INITIALIZING:
        return []
    return [pending.done(t, "it has restarted")]


def _hear_parameter(pending: Pending, t: Nanos, message: Message) -> list[Event]:
    request = pending.request
    if not isinstance(request, ReadParameter):
        return []
    kind, attribute = READABLE[request.parameter]
    if not isinstance(message, kind):
        return []
    value = getattr(message, attribute)
    if value is None:
        return [pending.refuse(t, "the device has no sensor for it")]
    return [Parameter(pending.name, t, request.parameter, float(value)), pending.done(t)]


def give_up(pending: Pending, now: Nanos) -> Refused:
    """The deadline has passed."""
    node = pending.node
    if isinstance(pending.request, SetId):
        return pending.refuse(
            now, f"no device with serial number {pending.request.serial:012X} took the node id"
        )
    if node is None or node.heard_at is None or node.heard_at < pending.began:
        return pending.refuse(now, "no answer of the device")
    if isinstance(pending.request, ClearFault):
        node.told_errors = 0  # what stays is told again
        return pending.refuse(now, f"still in fault: {names(node.errors)}")
    if isinstance(pending.request, Zero):
        return pending.refuse(now, "its position did not become zero: is it turning?")
    if isinstance(pending.request, RebootWord | WriteParameter):
        return pending.refuse(now, "it showed no sign of a restart")
    return pending.refuse(now, "the device did not react")
