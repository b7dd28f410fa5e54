"""Requests that wait for a device: what is sent, what counts as carried out.

Rules. A request that is impossible is refused at once with the reason. What CANSimple does not confirm counts
as sent once a heartbeat shows that the device is alive, and its Done states that.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import TypeAlias

from protocols import messages as msg
from protocols.frames import Frame
from protocols.messages import MILLISECOND, Event, Nanos, Request
from protocols.odrive_can.axis import Axis
from protocols.odrive_can.table import DISCOVERY, MAX_NODE, WRITABLE, table_of
from protocols.toolkit.driver import MotorDriver, Pending
from protocols.toolkit.host import Host
from protocols.toolkit.table import FLOAT_MAX, Decoded

USUAL = (600 * MILLISECOND, 120 * MILLISECOND)
"""Timeout, and period in which the frames are sent again."""
RESTART = (8000 * MILLISECOND, 2000 * MILLISECOND)
SET_ID = (1500 * MILLISECOND, 240 * MILLISECOND)
SCAN = (1800 * MILLISECOND, 600 * MILLISECOND)
"""(ODriveResources@06dc846 `examples/can_enumerate.py`)"""
REBOOT_GAP = 400 * MILLISECOND
"""A pause between heartbeats that shows a restart: a late heartbeat is requested after 250 ms."""
SAVE = "save_configuration"
"""A parameter: written with 1, the device saves its configuration and restarts."""
IDLE_FIRST = "command Idle first"

OdriveHost: TypeAlias = Host[Axis]
OdriveDriver: TypeAlias = MotorDriver[Axis]
OdrivePending: TypeAlias = Pending[Axis]


def for_all(
    now: Nanos, request: msg.Scan | msg.SetId, times: tuple[Nanos, Nanos], *frames: Frame
) -> OdrivePending:
    """Begin a request for all devices on the bus."""
    return Pending(request, request.bus, now, now + times[0], now, None, frames, times[1])


def begin_set_id(now: Nanos, request: msg.SetId, driver: OdriveDriver) -> OdrivePending | str:
    """Assign a node id to the device with a serial number, and repeat discovery."""
    if wrong := driver.wrong_id(request, range(MAX_NODE + 1), 48):
        return wrong
    assignment = table_of("0.6").encode("Address", Node_ID=request.address, Serial_Number=request.serial)
    return for_all(now, request, SET_ID, assignment, DISCOVERY)


def begin(now: Nanos, request: Request, host: OdriveHost, driver: OdriveDriver) -> OdrivePending | str:
    """Begin a request to one device."""
    axis, identity = host.own, host.own.identity
    match request:
        case msg.ClearFault():  # its frame follows as soon as the firmware line is known
            if axis.clear(now):
                host.report_again()
            return _pending(now, request, host)
        case msg.Estop():
            return _pending(now, request, host, axis.encode("Estop"))
        case _ if not identity.known:
            return "its firmware is not known, or not the one in the robot file"
        case msg.ReadParameter(_, parameter):
            return _reading(now, request, host, parameter)
        case msg.Zero():
            return _action(now, request, host, "zero")
        case msg.Reboot():
            boards = [each for each in driver.hosts.values() if each.own.identity.dialect.boards]
            beside = next((each.name for each in boards if each.running), "")
            if identity.dialect.boards and beside:
                reason = f"it restarts its whole board, and {beside}, which is armed, may be on it"
                return f"{reason}: {IDLE_FIRST}"
            return _action(now, request, host, "reboot", RESTART)
        case msg.WriteParameter(_, "save_configuration", value):
            if value != 1:
                return f"{SAVE} takes 1"
            if host.running:
                return f"it is armed and would drop its load: {IDLE_FIRST}"
            return _action(now, request, host, "save", RESTART)
        case msg.WriteParameter(_, parameter, value):
            return _writing(now, request, host, parameter, value)
    return f"odrive_can has no {type(request).__name__}"


def _pending(
    now: Nanos, request: Request, host: OdriveHost, *frames: Frame, times: tuple[Nanos, Nanos] = USUAL
) -> OdrivePending:
    return Pending(request, host.name, now, now + times[0], now, host, frames, times[1])


def _action(
    now: Nanos, request: Request, host: OdriveHost, action: str, times: tuple[Nanos, Nanos] = USUAL
) -> OdrivePending | str:
    message = host.own.identity.dialect.messages.get(action)
    if message is None:
        return f"{host.own.identity.text()} cannot do this over CAN: use the vendor's tool"
    return _pending(now, request, host, host.own.encode(message[0], **message[1]), times=times)


def _reading(now: Nanos, request: Request, host: OdriveHost, parameter: str) -> OdrivePending | str:
    """Request the message that carries the parameter, or wait for it where it is only sent cyclically."""
    dialect = host.own.identity.dialect
    readable = dialect.readable()
    if parameter not in readable:
        return f"CANSimple does not report {parameter!r}; it reports {', '.join(readable)}"
    if readable[parameter] == "Heartbeat" and dialect.boards:
        return replace(_pending(now, request, host), sent=1)
    return _pending(now, request, host, host.own.requests[readable[parameter]])


def _writing(
    now: Nanos, request: Request, host: OdriveHost, parameter: str, value: float
) -> OdrivePending | str:
    """Send the message that writes the parameter; the other parameter of that message must be known."""
    message, pair = next((row for row in WRITABLE.items() if parameter in row[1]), ("", ()))
    if not message:
        known = ", ".join([name for pair in WRITABLE.values() for name in pair] + [SAVE])
        return f"CANSimple cannot set {parameter!r}; it can set {known}"
    if not 0.0 <= value <= FLOAT_MAX:
        return f"{value} is not a number of at least 0"
    written = host.own.write(parameter, value)
    missing = [name for name in pair if name not in written]
    if missing:
        reason = f"{message} sets {' and '.join(pair)} together, and the device does not report them over CAN"
        return f"{reason}: write {missing[0]} too; {parameter} is kept for it"
    return _pending(now, request, host, host.own.encode(message, **{name: written[name] for name in pair}))


def frames_of(pending: OdrivePending) -> Sequence[Frame]:
    """Return what is sent for a request now."""
    if not isinstance(pending.request, msg.ClearFault) or pending.host is None:
        return pending.frames
    axis = pending.host.own
    clear = axis.identity.dialect.messages.get("clear") if axis.identity.line else None
    return () if clear is None else (axis.encode(clear[0], **clear[1]),)


def answer(t: Nanos, pending: OdrivePending, axis: Axis, content: Decoded) -> Event | None:
    """Return the answer to a request of one device, if what it sent is one."""
    identity = axis.identity
    beat = content.name == "Heartbeat"
    board = "and every axis of its board" if identity.dialect.boards else ""
    match pending.request:
        case msg.ClearFault() if beat and identity.line and not axis.faulty:
            return pending.done(t, board)
        case msg.Estop() if beat and axis.errors & identity.dialect.estop:
            return pending.done(t, "it stays in fault until cleared")
        case msg.Reboot() | msg.WriteParameter(_, "save_configuration") if beat:
            # After a restart the device is identified anew, and its bits mean nothing before.
            up = bool(identity.line) and not axis.errors & identity.dialect.initializing
            gap = t - pending.notes.get("heartbeat", pending.began)
            seen = pending.notes.get("seen") or not up or gap >= REBOOT_GAP
            pending.notes.update(heartbeat=t, seen=seen)
            text = ", ".join(filter(None, ("it has restarted", board)))
            return pending.done(t, text) if seen and up else None
        case msg.WriteParameter() if beat:
            return pending.done(t, "sent; the device does not confirm it")
        case msg.ReadParameter(_, name) if identity.dialect.readable().get(name) == content.name:
            value = content.values[name]
            if value is None:
                return pending.refuse(t, "the device has no sensor for it")
            return msg.Parameter(pending.name, t, name, float(value))
    return None


def give_up(pending: OdrivePending) -> str:
    """Return why a device that replies did not carry out a request by its deadline; "": see the toolkit."""
    host = pending.host
    if host is None or host.offline or host.received_at is None or host.received_at <= pending.began:
        return ""
    if isinstance(pending.request, msg.ClearFault):
        host.own.report_again()
        return "" if host.own.identity.line else "its firmware is not known"
    restarts = isinstance(pending.request, msg.Reboot | msg.WriteParameter)
    return "it showed no sign of a restart" if restarts else ""
