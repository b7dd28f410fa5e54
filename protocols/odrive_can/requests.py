"""Requests that wait for a device: what is sent, what counts as carried out, when they expire.

Rules. Every request ends in Done or Refused within its deadline, whatever the device does. A request that is
impossible is refused at once with the reason. What CANSimple does not confirm counts as sent once a heartbeat
shows that the device is alive, and its Done states that.
"""

from __future__ import annotations

from dataclasses import dataclass, field

from protocols import messages as msg
from protocols.frames import CanFrame
from protocols.messages import MILLISECOND, Event, Nanos, Request
from protocols.odrive_can import messages as m
from protocols.odrive_can.codec import BROADCAST, MAX_NODE, TABLES, WRITABLE, cmd_of, encode, remote_frame
from protocols.odrive_can.dialect import status_of
from protocols.odrive_can.faults import names
from protocols.odrive_can.host_axis import HostAxis
from protocols.toolkit.requests import PendingRequest, refusal

TIMEOUT = 600 * MILLISECOND
RETRY_PERIOD = 120 * MILLISECOND
REBOOT_TIMEOUT = 8000 * MILLISECOND
REBOOT_RETRY_PERIOD = 2000 * MILLISECOND
REBOOT_GAP = 400 * MILLISECOND
"""A pause between heartbeats that shows a restart: a late heartbeat is requested after 250 ms."""
SCAN_PERIOD = 600 * MILLISECOND
"""Period in which discovery is repeated (ODriveResources@06dc846 `examples/can_enumerate.py`)."""
SCAN_ROUNDS = 3
SET_ID_TIMEOUT = 1500 * MILLISECOND
ZERO_TOLERANCE = 0.05
"""turns"""
SAVE = "save_configuration"
"""A parameter: written with 1, the device saves its configuration and restarts."""
DISCOVERY = remote_frame(BROADCAST, cmd_of(m.Address))


@dataclass(slots=True)
class OdriveRequest(PendingRequest):
    """A request under way. `next` is when its frames are sent next."""

    axis: HostAxis | None
    """None: it is for all devices on the bus."""
    frames: tuple[CanFrame, ...]
    retry_period: Nanos
    frames_sent: int = 0
    restart_seen: bool = False
    heartbeat_at: Nanos = 0
    found: dict[tuple[int, int | None], str] = field(default_factory=dict)
    """By node and serial number (None: not reported): what is known of a device found by a scan."""


def begin(
    now: Nanos, request: Request, axis: HostAxis, written: dict[str, float]
) -> OdriveRequest | msg.Refused:
    """Begin a request to one device; `written` holds the parameters that were written to it."""
    dialect = axis.dialect
    running = axis.owned or axis.state == m.AxisState.CLOSED_LOOP_CONTROL
    match request:
        case msg.ClearFault():  # its frame follows as soon as the firmware line is known
            axis.on_clear()
            return OdriveRequest(request, axis.name, now, now + TIMEOUT, now, axis, (), RETRY_PERIOD)
        case msg.Estop():
            return _begin(now, request, axis, m.Estop())
        case _ if axis.identity.wrong or not axis.identity.line:
            return refusal(now, request, "its firmware is not known, or not the one in the robot file")
        case msg.ReadParameter(_, parameter):
            return _begin_reading(now, request, axis, parameter)
        case msg.Zero() if running:
            return refusal(now, request, "it is armed and would jump: command idle first")
        case msg.Zero():
            return _begin(now, request, axis, dialect.zero)
        case msg.Reboot() | msg.WriteParameter(_, "save_configuration") if running:
            return refusal(now, request, "it is armed and would drop its load: command idle first")
        case msg.Reboot():
            return _begin(now, request, axis, dialect.reboot, REBOOT_TIMEOUT, REBOOT_RETRY_PERIOD)
        case msg.WriteParameter(_, "save_configuration", value):
            if value != 1:
                return refusal(now, request, f"{SAVE} takes 1")
            return _begin(now, request, axis, dialect.save, REBOOT_TIMEOUT, REBOOT_RETRY_PERIOD)
        case msg.WriteParameter():
            return _begin_writing(now, request, axis, written)
    return refusal(now, request, f"odrive_can has no {type(request).__name__}")


def _begin(
    now: Nanos,
    request: Request,
    axis: HostAxis,
    message: m.Message | None,
    timeout: Nanos = TIMEOUT,
    retry_period: Nanos = RETRY_PERIOD,
) -> OdriveRequest | msg.Refused:
    if message is None:
        return refusal(now, request, f"{axis.identity.text()} cannot do this over CAN: use the vendor's tool")
    frames = (encode(axis.node, message),)
    return OdriveRequest(request, axis.name, now, now + timeout, now, axis, frames, retry_period)


def _begin_reading(
    now: Nanos, request: Request, axis: HostAxis, parameter: str
) -> OdriveRequest | msg.Refused:
    """Request the message that carries the parameter, or wait for it where it is only sent cyclically."""
    readable = axis.dialect.readable
    if parameter not in readable:
        known = ", ".join(readable)
        return refusal(now, request, f"CANSimple does not report {parameter!r}; it reports {known}")
    cmd = cmd_of(readable[parameter][0])
    requestable = cmd in TABLES[axis.dialect.line].requestable
    frames = (remote_frame(axis.node, cmd),) if requestable else ()
    return OdriveRequest(request, axis.name, now, now + TIMEOUT, now, axis, frames, RETRY_PERIOD)


def _begin_writing(
    now: Nanos, request: msg.WriteParameter, axis: HostAxis, written: dict[str, float]
) -> OdriveRequest | msg.Refused:
    """Send the message that writes the parameter; the other parameter of that message must be known."""
    parameter, value = request.parameter, request.value
    row = next((row for row in WRITABLE.items() if parameter in row[1]), None)
    if row is None:
        known = ", ".join([name for pair in WRITABLE.values() for name in pair] + [SAVE])
        return refusal(now, request, f"CANSimple cannot set {parameter!r}; it can set {known}")
    if value < 0:
        return refusal(now, request, f"{value} is not a number of at least 0")
    message, pair = row
    written[parameter] = value
    missing = [name for name in pair if name not in written]
    if missing:
        return refusal(
            now,
            request,
            f"{message.__name__} sets {' and '.join(pair)} together, and the device does not report them"
            f" over CAN: write {missing[0]} too; {parameter} is kept for it",
        )
    return _begin(now, request, axis, message(*(written[name] for name in pair)))


def begin_scan(now: Nanos, request: msg.Scan, discovery: bool) -> OdriveRequest:
    """Begin discovery: remote frames on the broadcast node (unless every device is known to be 0.5.x, which
    has none), and the heartbeats received meanwhile."""
    frames = (DISCOVERY,) if discovery else ()
    deadline = now + SCAN_PERIOD * SCAN_ROUNDS
    return OdriveRequest(request, request.bus, now, deadline, now, None, frames, SCAN_PERIOD)


def begin_set_id(
    now: Nanos, request: msg.SetId, axes: list[HostAxis], serials: dict[int, dict[int, Nanos]]
) -> OdriveRequest | msg.Refused:
    """Assign a node id to the device with a serial number, and repeat discovery. `serials`: known, by
    node."""
    if not 0 <= request.address <= MAX_NODE:
        return refusal(now, request, f"{request.address} is not a node id: 0 to {MAX_NODE}")
    if not 0 < request.serial < 1 << 48:
        return refusal(now, request, f"{request.serial} is not a serial number of 48 bits")
    others = [serial for serial in serials.get(request.address, {}) if serial != request.serial]
    if others:
        return refusal(now, request, f"node id {request.address} is held by serial number {others[0]:012X}")
    for axis in axes:
        affected = request.serial in serials.get(axis.node, {}) or axis.node == request.address
        if affected and (axis.owned or axis.state == m.AxisState.CLOSED_LOOP_CONTROL):
            return refusal(now, request, f"{axis.name} is armed: command idle first")
    frames = (encode(BROADCAST, m.Address(request.address, request.serial)), DISCOVERY)
    return OdriveRequest(request, request.bus, now, now + SET_ID_TIMEOUT, now, None, frames, RETRY_PERIOD * 2)


def frames_of(pending: OdriveRequest) -> tuple[CanFrame, ...]:
    """Return what is to be sent for a request now."""
    axis = pending.axis
    if isinstance(pending.request, msg.ClearFault) and not pending.frames and axis is not None:
        clear = axis.dialect.clear if axis.identity.line else None
        pending.frames = () if clear is None else (encode(axis.node, clear),)
    return pending.frames


def on_message(pending: OdriveRequest, t: Nanos, message: m.Message) -> list[Event]:
    """Handle a message of the device that a request is for; return the events that end the request, if
    any."""
    axis, status = pending.axis, status_of(message)
    if axis is None:
        return []
    match pending.request:
        case msg.ClearFault():
            cleared = status is not None and bool(axis.identity.line) and not axis.status.faulty
            return [pending.done(t, _board(axis))] if cleared and pending.frames_sent else []
        case msg.Estop() if status is not None and status.error & (axis.dialect.estop or ~0):
            return [pending.done(t, "it stays in fault until cleared")]
        case msg.Zero() if (
            isinstance(message, m.GetEncoderEstimates) and abs(message.position) < ZERO_TOLERANCE
        ):
            return [pending.done(t)]
        case msg.Reboot() | msg.WriteParameter(_, "save_configuration") if status is not None:
            # After a restart the device is identified anew, and its bits mean nothing before.
            up = bool(axis.identity.line) and not status.error & axis.dialect.initializing
            return _on_reboot(pending, t, axis, up)
        case msg.WriteParameter() if status is not None and pending.frames:
            return [pending.done(t, "sent; the device does not confirm it")]
        case msg.ReadParameter(_, parameter):
            return _on_parameter(pending, axis, parameter, t, message)
    return []


def _board(axis: HostAxis) -> str:
    return "and every axis of its board" if axis.dialect.boards else ""


def _on_reboot(pending: OdriveRequest, t: Nanos, axis: HostAxis, up: bool) -> list[Event]:
    gap = t - (pending.heartbeat_at or pending.began)
    pending.heartbeat_at = t
    if not up or gap >= REBOOT_GAP:
        pending.restart_seen = True
    detail = ", ".join(filter(None, ("it has restarted", _board(axis))))
    return [pending.done(t, detail)] if pending.restart_seen and up else []


def _on_parameter(
    pending: OdriveRequest, axis: HostAxis, parameter: str, t: Nanos, message: m.Message
) -> list[Event]:
    kind, attribute = axis.dialect.readable.get(parameter, (None, ""))
    if kind is None or not isinstance(message, kind):
        return []
    value = getattr(message, attribute)
    if value is None:
        return [pending.refuse(t, "the device has no sensor for it")]
    return [msg.Parameter(pending.name, t, parameter, float(value))]


def expire(pending: OdriveRequest, now: Nanos) -> msg.Refused:
    """Refuse a request whose deadline has passed."""
    axis, request = pending.axis, pending.request
    if isinstance(request, msg.SetId):
        return pending.refuse(now, f"no device with serial number {request.serial:012X} took the node id")
    if axis is None or axis.received_at is None or axis.received_at < pending.began:
        return pending.refuse(now, "no reply from the device")
    if isinstance(request, msg.ClearFault):
        if not axis.identity.line:
            return pending.refuse(now, "its firmware is not known")
        axis.report_again()
        return pending.refuse(now, f"still in fault: {names(axis.status.error, axis.dialect.axis_faults)}")
    if isinstance(request, msg.Zero):
        return pending.refuse(now, "its position did not become zero: is it turning?")
    if isinstance(request, msg.Reboot | msg.WriteParameter):
        return pending.refuse(now, "it showed no sign of a restart")
    return pending.refuse(now, "the device did not react")
