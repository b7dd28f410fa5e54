"""Requests that wait for a device: what is sent, what counts as carried out, when it is given up.

Rules. Every request ends in Done or Refused within its deadline, whatever the device does. A request that is
impossible is refused at once with the reason. What CANSimple does not confirm is "sent" once a heartbeat
shows that the device is alive, and its Done says so.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import Any

from protocols import messages as msg
from protocols.frames import CanFrame
from protocols.messages import MILLISECOND, Event, Nanos, Request
from protocols.messages import Estop as EstopWord
from protocols.messages import Reboot as RebootWord
from protocols.odrive_can.codec import BROADCAST, MAX_NODE, TABLES, AnyMessage, ask, cmd_of, encode
from protocols.odrive_can.dialect import beat_of
from protocols.odrive_can.faults import names
from protocols.odrive_can.messages import (
    Address,
    AxisState,
    Estop,
    GetEncoderEstimates,
    SetLimits,
    SetPosGain,
    SetTrajAccelLimits,
    SetTrajInertia,
    SetTrajVelLimit,
    SetVelGains,
)
from protocols.odrive_can.node import Node
from protocols.request_queue import PendingRequest, refusal

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
class Pending(PendingRequest):
    """A request under way."""

    node: Node | None
    """None: all on the bus are asked."""
    frames: tuple[CanFrame, ...]
    again: Nanos
    """Sent again so long after it was last sent."""
    sent: int = 0
    stage: int = 0
    beat_at: Nanos = 0
    found: dict[tuple[int, int | None], str] = field(default_factory=dict)


def begin(now: Nanos, request: Request, node: Node, written: dict[str, float]) -> Pending | msg.Refused:
    """A request to one device."""
    dialect = node.dialect
    running = node.owned or node.state == AxisState.CLOSED_LOOP_CONTROL
    match request:
        case msg.ClearFault():  # its frame follows as soon as the firmware line is known
            node.cleared()
            return Pending(request, node.name, now, now + ANSWER, now, node, (), RESEND)
        case EstopWord():
            return _pending(now, request, node, Estop(), ANSWER, RESEND)
        case _ if node.identity.wrong or not node.identity.line:
            return refusal(now, request, "its firmware is not known, or not what the robot file says")
        case msg.ReadParameter(_, parameter):
            return _read(now, request, node, parameter)
        case msg.Zero() if running:
            return refusal(now, request, "it is armed, and would jump: say idle first")
        case msg.Zero():
            return _pending(now, request, node, dialect.zero, ANSWER, RESEND)
        case RebootWord() | msg.WriteParameter(_, "save_configuration") if running:
            return refusal(now, request, "it is armed, and would drop its load: say idle first")
        case RebootWord():
            return _pending(now, request, node, dialect.reboot, REBOOT, REBOOT_RESEND)
        case msg.WriteParameter(_, "save_configuration", value):
            if value != 1:
                return refusal(now, request, f"{SAVE} takes 1")
            return _pending(now, request, node, dialect.save, REBOOT, REBOOT_RESEND)
        case msg.WriteParameter(_, parameter, value):
            message = _write(now, request, parameter, value, written)
            if isinstance(message, msg.Refused):
                return message
            return _pending(now, request, node, message, ANSWER, RESEND)
    return refusal(now, request, f"odrive_can has no {type(request).__name__}")


def _pending(
    now: Nanos, request: Request, node: Node, message: AnyMessage | None, limit: Nanos, again: Nanos
) -> Pending | msg.Refused:
    if message is None:
        return refusal(
            now, request, f"{node.identity.title()} cannot do this over CAN: use the vendor's tool"
        )
    frames = (encode(node.address, message),)
    return Pending(request, node.name, now, now + limit, now, node, frames, again)


def _read(now: Nanos, request: Request, node: Node, parameter: str) -> Pending | msg.Refused:
    """Ask for the message that tells it, or wait for it where it comes by the device's clock only."""
    readable = node.dialect.readable
    if parameter not in readable:
        known = ", ".join(readable)
        return refusal(now, request, f"CANSimple does not tell {parameter!r}; it tells {known}")
    kind = readable[parameter][0]
    askable = cmd_of(kind) in TABLES[node.dialect.line].askable
    frames = (ask(node.address, kind),) if askable else ()
    return Pending(request, node.name, now, now + ANSWER, now, node, frames, RESEND)


def frames_of(pending: Pending) -> tuple[CanFrame, ...]:
    """What is to be sent for a request now."""
    node = pending.node
    if isinstance(pending.request, msg.ClearFault) and not pending.frames and node is not None:
        clear = node.dialect.clear if node.identity.line else None
        pending.frames = () if clear is None else (encode(node.address, clear),)
    return pending.frames


def _write(
    now: Nanos, request: msg.WriteParameter, parameter: str, value: float, written: dict[str, float]
) -> AnyMessage | msg.Refused:
    """The message that sets a parameter; its partner in the same message must be known."""
    row = next((row for row in WRITABLE if parameter in row[1]), None)
    if row is None:
        known = ", ".join([name for _, pair in WRITABLE for name in pair] + [SAVE])
        return refusal(now, request, f"CANSimple cannot set {parameter!r}; it can set {known}")
    if not (math.isfinite(value) and value >= 0):
        return refusal(now, request, f"{value} is not a finite number of at least 0")
    message, names_ = row
    written[parameter] = value
    missing = [name for name in names_ if name not in written]
    if missing:
        return refusal(
            now,
            request,
            f"{message.__name__} sets {' and '.join(names_)} together, and the device does not tell them"
            f" over CAN: write {missing[0]} too; {parameter} is kept for it",
        )
    said: AnyMessage = message(*(written[name] for name in names_))
    return said


def scan(now: Nanos, request: msg.Scan, discovery: bool) -> Pending:
    """Discovery: remote frames on the broadcast node (unless every device is known to be 0.5.x, which has
    none), and heartbeats heard meanwhile."""
    frames = (ask(BROADCAST, Address),) if discovery else ()
    return Pending(request, request.bus, now, now + SCAN_STEP * SCAN_STEPS, now, None, frames, SCAN_STEP)


def set_id(
    now: Nanos, request: msg.SetId, nodes: list[Node], serials: dict[int, dict[int, Nanos]]
) -> Pending | msg.Refused:
    """Give the device with a serial number a node id, and ask who is who."""
    if not 0 <= request.address <= MAX_NODE:
        return refusal(now, request, f"{request.address} is not a node id: 0 to {MAX_NODE}")
    if not 0 < request.serial < 1 << 48:
        return refusal(now, request, f"{request.serial} is not a serial number of 48 bits")
    holders = [serial for serial in serials.get(request.address, {}) if serial != request.serial]
    if holders:
        return refusal(now, request, f"node id {request.address} is held by serial number {holders[0]:012X}")
    for node in nodes:
        mine = request.serial in serials.get(node.address, {}) or node.address == request.address
        if mine and (node.owned or node.state == AxisState.CLOSED_LOOP_CONTROL):
            return refusal(now, request, f"{node.name} is armed: say idle first")
    frames = (encode(BROADCAST, Address(request.address, request.serial)), ask(BROADCAST, Address))
    return Pending(request, request.bus, now, now + ASSIGN, now, None, frames, RESEND * 2)


def handle(pending: Pending, t: Nanos, message: AnyMessage) -> list[Event]:
    """Let a request of one device hear what it said; the events that end it, or none."""
    node, beat = pending.node, beat_of(message)
    if node is None:
        return []
    match pending.request:
        case msg.ClearFault():
            cleared = beat is not None and bool(node.identity.line) and not node.faulty()
            return [pending.done(t, _board(node))] if cleared and pending.sent else []
        case EstopWord() if beat is not None and beat.error & (node.dialect.estop or ~0):
            return [pending.done(t, "it stays in fault until cleared")]
        case msg.Zero() if isinstance(message, GetEncoderEstimates) and abs(message.position) < ZERO_WITHIN:
            return [pending.done(t)]
        case RebootWord() | msg.WriteParameter(_, "save_configuration") if beat is not None:
            # Whoever restarts is asked anew what it is, and its bits mean nothing before.
            up = bool(node.identity.line) and not beat.error & node.dialect.initializing
            return _on_reboot(pending, t, node, up)
        case msg.WriteParameter() if beat is not None and pending.frames:
            return [pending.done(t, "sent; the device does not confirm it")]
        case msg.ReadParameter(_, parameter):
            return _on_parameter(pending, node, parameter, t, message)
    return []


def _board(node: Node) -> str:
    return "and every axis of its board" if node.dialect.boards else ""


def _on_reboot(pending: Pending, t: Nanos, node: Node, up: bool) -> list[Event]:
    gap = t - (pending.beat_at or pending.began)
    pending.beat_at = t
    if not up or gap >= REBOOT_GAP:
        pending.stage = 1
    detail = ", ".join(filter(None, ("it has restarted", _board(node))))
    return [pending.done(t, detail)] if pending.stage and up else []


def _on_parameter(pending: Pending, node: Node, parameter: str, t: Nanos, message: AnyMessage) -> list[Event]:
    kind, attribute = node.dialect.readable.get(parameter, (None, ""))
    if kind is None or not isinstance(message, kind):
        return []
    value = getattr(message, attribute)
    if value is None:
        return [pending.refuse(t, "the device has no sensor for it")]
    return [msg.Parameter(pending.name, t, parameter, float(value)), pending.done(t)]


def give_up(pending: Pending, now: Nanos) -> msg.Refused:
    """The deadline has passed."""
    node = pending.node
    if isinstance(pending.request, msg.SetId):
        return pending.refuse(
            now, f"no device with serial number {pending.request.serial:012X} took the node id"
        )
    if node is None or node.received_at is None or node.received_at < pending.began:
        return pending.refuse(now, "no answer of the device")
    if isinstance(pending.request, msg.ClearFault):
        if not node.identity.line:
            return pending.refuse(now, "its firmware is not known")
        node.report_again()
        return pending.refuse(now, f"still in fault: {names(node.beat.error, node.dialect.axis)}")
    if isinstance(pending.request, msg.Zero):
        return pending.refuse(now, "its position did not become zero: is it turning?")
    if isinstance(pending.request, RebootWord | msg.WriteParameter):
        return pending.refuse(now, "it showed no sign of a restart")
    return pending.refuse(now, "the device did not react")
