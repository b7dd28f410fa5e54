"""Requests to a device: what is sent, which reply completes them, when they time out.

Rules. Every request ends in Done, Parameter or Refused before its deadline, whatever the device does. A
request that is impossible is refused at once with the reason. What is written is read back in the same frame:
the reply to that holds this register alone, and must hold what was written. Nothing that drops a load or
moves a running shaft is sent to a device that is armed. An id is set over the device's console, at the device
whose UUID begins with the serial number.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from math import isclose, isfinite

from protocols import messages as msg
from protocols.messages import MILLISECOND, Event, Nanos, Request
from protocols.moteus import codec
from protocols.moteus.codec import F32, INT32, Query, encode, write
from protocols.moteus.controller import ControllerState
from protocols.moteus.decoder import ACTIONS, NOT_WRITEABLE
from protocols.moteus.faults import TIMEOUT, fault_info_of
from protocols.moteus.messages import DISCOVER, console, masked
from protocols.moteus.options import ADDRESS_MAX, SERIAL_BYTES, serial_of
from protocols.moteus.registers import LATCHED, NAMES, SCALES, Mode, Register
from protocols.moteus.reply import Reply
from protocols.toolkit.requests import PendingRequest, refusal

ANSWER = 600 * MILLISECOND
"""Timeout of a request to one device, ..."""
RESEND = 60 * MILLISECOND
"""... and the period in which it is sent again."""
SCAN_RESEND = 200 * MILLISECOND
SCAN = 4 * SCAN_RESEND
SET_ID = 1500 * MILLISECOND
SET_ID_RESEND = 150 * MILLISECOND
ZERO_WITHIN = 0.01
"""rev"""
SAVE = "conf_write"
"""Parameter that saves the device's configuration when 1 is written."""
REGISTER_MAX = 0x7FFF
BINARY32 = 2.0**-23
"""Largest relative difference between a number and its binary32."""

COMMANDED = (range(0x010, 0x030), range(0x040, 0x049))
"""Registers that commands write."""
NOT_WRITTEN = {
    Register.MODE: "the mode is what commands are for",
    Register.MULTIPLEX_ID: "use SetId with the serial number",
    0x071: "a trimmed clock may end all communication",
}
ARMED = "it is armed: send Idle first"
WOULD_JUMP = "it is armed, and would jump: send Idle first"


@dataclass(slots=True)
class Pending(PendingRequest):
    """A request that waits for one device, or for all."""

    controller: ControllerState | None
    """None: all on the bus."""
    data: tuple[bytes, ...]
    """The data of its frames."""
    period: Nanos = RESEND
    register: int = -1
    """The register that it is about."""
    sent: int = 0
    taken: bool = False
    """The device has confirmed that the write arrived."""
    reads: float | None = None
    """Content of the register, if it is not what was written."""
    found: dict[tuple[int, bytes], str] = field(default_factory=dict)
    """Devices found by a scan: details by id and UUID."""


def begin(now: Nanos, request: Request, controller: ControllerState) -> Pending | msg.Refused:
    """Begin a request to one device, or refuse it."""
    match request:
        case msg.ClearFault():
            return _pending(now, request, controller, ())
        case msg.Zero():
            if _is_running(controller):
                return refusal(now, request, WOULD_JUMP)
            exact = Register.SET_OUTPUT_EXACT  # read back, so that the reply shows that this frame arrived
            return _pending(now, request, controller, (write(exact, 0.0) + _query(exact),), exact)
        case msg.ReadParameter(_, parameter):
            register = register_of(parameter)
            if register is None:
                return _unknown(now, request, parameter)
            return _pending(now, request, controller, (_query(register),), register)
        case msg.WriteParameter():
            return _write(now, request, controller)
    return refusal(now, request, f"a moteus has no {type(request).__name__} on its bus")


def _is_running(controller: ControllerState) -> bool:
    return controller.owned or controller.mode not in (None, Mode.STOPPED, *LATCHED)


def _pending(
    now: Nanos, request: Request, controller: ControllerState, data: tuple[bytes, ...], register: int = -1
) -> Pending:
    return Pending(request, controller.name, now, now + ANSWER, now, controller, data, register=register)


def register_of(parameter: str) -> int | None:
    """Return a register by the vendor's name (mode, motor_temperature, …) or number (0x058, 88); or None."""
    known = NAMES.get(parameter.lower())
    if known is not None:
        return known
    try:
        number = int(parameter, 0)
    except ValueError:
        return None
    return number if 0 <= number <= REGISTER_MAX else None


def _unknown(now: Nanos, request: Request, parameter: str) -> msg.Refused:
    reason = f"no register {parameter!r}: give its number (0x058), or one of {', '.join(NAMES)}"
    return refusal(now, request, reason)


def _query(register: int) -> bytes:
    """Encode a query for one register: quantities are read as binary32, the rest as int32."""
    return encode(Query(register, F32 if register in SCALES else INT32, 1))


def _write(now: Nanos, request: msg.WriteParameter, controller: ControllerState) -> Pending | msg.Refused:
    parameter, value = request.parameter, request.value
    if parameter == SAVE:
        if _is_running(controller):
            return refusal(now, request, ARMED)
        if value != 1:
            return refusal(now, request, f"{SAVE} takes 1")
        data = console("conf write") + _query(Register.MULTIPLEX_ID)
        return _pending(now, request, controller, (data,), Register.MULTIPLEX_ID)
    register = register_of(parameter)
    if register is None:
        return _unknown(now, request, parameter)
    reason = ""
    if not (isfinite(value) and abs(value) <= codec.FLOAT_MAX):
        reason = f"{value} is no finite number of 32 bits"
    elif register in NOT_WRITTEN:
        reason = NOT_WRITTEN[register]
    elif any(register in commanded for commanded in COMMANDED):
        reason = "that register is what commands are for"
    elif Register.UUID_MASK1 <= register <= Register.UUID_MASK4:
        reason = "a mask of UUIDs is no parameter"
    elif register in ACTIONS and (_is_running(controller) or controller.mode is None):
        reason = WOULD_JUMP
    if reason:
        return refusal(now, request, reason)
    data = write(register, value) + encode(Query(register, F32, 1))
    return _pending(now, request, controller, (data,), register)


def scan(now: Nanos, request: msg.Scan) -> Pending:
    """Begin discovery: a query to all devices."""
    return Pending(request, request.bus, now, now + SCAN, now, None, (DISCOVER,), SCAN_RESEND)


def set_id(
    now: Nanos, request: msg.SetId, controllers: list[ControllerState], holders: dict[int, set[int]]
) -> Pending | msg.Refused:
    """Begin to set the id of the device with a serial number. `holders`: known serial numbers by id."""
    if not 1 <= request.address <= ADDRESS_MAX:
        return refusal(now, request, f"{request.address} is not an id: 1 to {ADDRESS_MAX}")
    if not 0 < request.serial < 1 << 8 * SERIAL_BYTES:
        return refusal(now, request, f"{request.serial} is no serial number of 64 bits")
    others = sorted(holders.get(request.address, set()) - {request.serial})
    if others:
        reason = f"id {request.address} is held by serial number {others[0]:016X}"
        return refusal(now, request, reason)
    for each in controllers:
        concerned = request.serial in map(serial_of, each.uuids) or each.address == request.address
        if concerned and _is_running(each):
            return refusal(now, request, f"{each.name} is armed: send Idle first")
    uuid = request.serial.to_bytes(SERIAL_BYTES, "big")
    data = (masked(uuid, console(f"conf set id.id {request.address}")), masked(uuid, DISCOVER))
    return Pending(request, request.bus, now, now + SET_ID, now, None, data, SET_ID_RESEND)


def data_of(pending: Pending, now: Nanos) -> tuple[bytes, ...]:
    """Return the data of the frames that a request sends now."""
    if pending.controller is not None and isinstance(pending.request, msg.ClearFault):
        return (pending.controller.clear_command(now),)
    if pending.controller is not None and isinstance(pending.request, msg.Zero):
        return (pending.data[0] + pending.controller.query(now),)
    return pending.data


def handle(pending: Pending, t: Nanos, reply: Reply) -> list[Event]:
    """Give a reply to a request of its device. Returns the events that complete the request, or none."""
    controller = pending.controller
    if controller is None or not pending.sent:
        return []
    match pending.request:
        case msg.ClearFault() if Register.MODE in reply.values and controller.mode not in LATCHED:
            return [*controller.cleared(t), pending.done(t)]
        case msg.Zero():
            return _on_zero(pending, t, reply)
        case msg.ReadParameter(_, parameter):
            return _on_read(pending, t, reply, parameter)
        case msg.WriteParameter(_, parameter, value):
            return _on_written(pending, t, reply, None if parameter == SAVE else value)
    return []


def _on_zero(pending: Pending, t: Nanos, reply: Reply) -> list[Event]:
    """Require the confirmed write, and a position after it: one near zero alone may be from before."""
    if reason := _write_error(reply, pending.register):
        return [pending.refuse(t, reason)]
    if pending.register in _registers_in(reply):
        pending.taken = True
        return []
    position = reply.values.get(Register.POSITION)
    near = position is not None and abs(position) < ZERO_WITHIN
    return [pending.done(t)] if pending.taken and near else []


def _on_read(pending: Pending, t: Nanos, reply: Reply, parameter: str) -> list[Event]:
    if any(e.code == codec.READ_ERROR and e.register == pending.register for e in reply.errors):
        return [pending.refuse(t, "the device has no such register, or cannot read it so")]
    if pending.register not in reply.values:
        return []
    value = reply.values[pending.register]
    if value is None:
        return [pending.refuse(t, "the device replies that it is not given")]
    return [msg.Parameter(pending.name, t, parameter, float(value))]


def _on_written(pending: Pending, t: Nanos, reply: Reply, value: float | None) -> list[Event]:
    """Require a reply with this register alone; `value`: its content then, if it can be read at all.

    Replies that hold other registers too may have been on their way when it was written."""
    if reason := _write_error(reply, pending.register):
        return [pending.refuse(t, reason)]
    if _registers_in(reply) != {pending.register}:
        return []
    reads = reply.values.get(pending.register)
    if value is None or reads is None or isclose(reads, value, rel_tol=BINARY32, abs_tol=codec.FLOAT_TINY):
        return [pending.done(t)]
    pending.reads = reads
    return []


def _registers_in(reply: Reply) -> set[int]:
    """Return the registers in a reply, with a value or an error."""
    return {*reply.values, *(error.register for error in reply.errors)}


def _write_error(reply: Reply, register: int) -> str:
    """Return why a device does not accept what was written; "" if it reports no error."""
    for error in reply.errors:
        if error.code == codec.WRITE_ERROR and error.register == register:
            read_only = error.number == NOT_WRITEABLE
            why = "read only" if read_only else f"error {error.number}: no such register?"
            return f"the device does not accept it ({why})"
    return ""


def give_up(pending: Pending, now: Nanos) -> msg.Refused:
    """Refuse a request whose deadline has passed, with what is known."""
    request, controller = pending.request, pending.controller
    reason = "no reply to this request"
    if isinstance(request, msg.SetId):
        reason = f"no device with serial number {request.serial:016X} took the id"
    elif controller is None or controller.received_at is None or controller.received_at < pending.began:
        reason = "no reply of the device"
    elif isinstance(request, msg.ClearFault):
        controller.report_again()
        code = TIMEOUT if controller.mode == Mode.TIMEOUT else controller.fault
        reason = f"still in fault: {fault_info_of(code).name}"
    elif isinstance(request, msg.Zero):
        reason = "its position did not become zero: is it turning?"
    elif isinstance(request, msg.WriteParameter) and pending.reads is not None:
        reason = f"the device holds {pending.reads:.6g} there, not {request.value:.6g}"
    return pending.refuse(now, reason)
