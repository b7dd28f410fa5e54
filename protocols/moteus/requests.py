"""Requests that wait for a device: what is sent, what counts as carried out, when it is given up.

Rules. Every request ends in Done or Refused within its deadline, whatever the device does. A request that is
impossible is refused at once with the reason. What is written is read back in the same frame: the answer to
it tells this register alone, and must hold what was written. Nothing that drops a load or moves a running
shaft is said to a device that is armed. An id is given by the device's console, to the one whose UUID begins
with the serial number.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from math import isclose, isfinite

from protocols import messages as msg
from protocols.messages import MILLISECOND, Event, Nanos, Request
from protocols.moteus.codec import F32, FLOAT_MAX, FLOAT_TINY, INT32, READ_ERROR, WRITE_ERROR, Error
from protocols.moteus.decoder import NOT_WRITEABLE
from protocols.moteus.faults import fault_info_of
from protocols.moteus.messages import DISCOVER, ask, console, masked, set_register
from protocols.moteus.node import Node
from protocols.moteus.options import ADDRESS_MAX, SERIAL_BYTES, serial_of
from protocols.moteus.registers import LATCHED, NAMES, SCALES, Mode, Register
from protocols.moteus.reply import Reply
from protocols.request_queue import PendingRequest, refusal

ANSWER = 600 * MILLISECOND
RESEND = 60 * MILLISECOND
SCAN_STEP = 200 * MILLISECOND
SCAN_STEPS = 4
ASSIGN = 1500 * MILLISECOND
ASSIGN_AGAIN = 150 * MILLISECOND
ZERO_WITHIN = 0.01
"""rev"""
SAVE = "conf_write"
"""Written with 1, the device saves its configuration."""
REGISTER_MAX = 0x7FFF

BINARY32 = 2.0**-23
"""A number and what a binary32 makes of it lie no further apart, relative to it."""

COMMANDED = (range(0x010, 0x030), range(0x040, 0x049))
"""Registers that commands write."""
REFUSED = {
    Register.MODE: "the mode is what commands are for",
    Register.MULTIPLEX_ID: "use SetId with the serial number",
    0x071: "a trimmed clock may end all communication",
}


@dataclass(slots=True)
class Pending(PendingRequest):
    """A request under way."""

    node: Node | None
    """None: all on the bus are asked."""
    data: tuple[bytes, ...]
    """Of the frames that are sent."""
    again: Nanos = RESEND
    """Sent again so long after it was last sent."""
    register: int = -1
    """Which register it is about."""
    sent: int = 0
    taken: bool = False
    """The device has said that it arrived."""
    reads: float | None = None
    """What a register holds in which something else was written."""
    found: dict[tuple[int, bytes], str] = field(default_factory=dict)


def begin(now: Nanos, request: Request, node: Node) -> Pending | msg.Refused:
    """A request to one device."""
    running = node.owned or node.mode not in (None, Mode.STOPPED, *LATCHED)
    match request:
        case msg.ClearFault():
            return _pending(now, request, node, ())
        case msg.Zero() if running:
            return refusal(now, request, "it is armed, and would jump: say idle first")
        case msg.Zero():
            exact = Register.SET_OUTPUT_EXACT  # read back, for the answer that this frame arrived
            return _pending(now, request, node, (set_register(exact, 0.0) + _asks(exact),), exact)
        case msg.ReadParameter(_, parameter):
            return _read(now, request, node, parameter)
        case msg.WriteParameter(_, parameter, value):
            if running and parameter == SAVE:
                return refusal(now, request, "it is armed: say idle first")
            return _write(now, request, node, parameter, value)
    return refusal(now, request, f"a moteus has no {type(request).__name__} on its bus")


def _pending(
    now: Nanos, request: Request, node: Node, data: tuple[bytes, ...], register: int = -1
) -> Pending:
    return Pending(request, node.name, now, now + ANSWER, now, node, data, register=register)


def register_of(parameter: str) -> int | None:
    """A register by the vendor's name (mode, motor_temperature, …) or number (0x058, 88)."""
    known = NAMES.get(parameter.lower())
    if known is not None:
        return known
    try:
        number = int(parameter, 0)
    except ValueError:
        return None
    return number if 0 <= number <= REGISTER_MAX else None


def _unknown(now: Nanos, request: Request, parameter: str) -> msg.Refused:
    said = f"no register {parameter!r}: give its number (0x058), or one of {', '.join(NAMES)}"
    return refusal(now, request, said)


def _asks(register: int) -> bytes:
    """Quantities are read as binary32, the rest as int32."""
    return ask(register, F32 if register in SCALES else INT32)


def _read(now: Nanos, request: Request, node: Node, parameter: str) -> Pending | msg.Refused:
    register = register_of(parameter)
    if register is None:
        return _unknown(now, request, parameter)
    return _pending(now, request, node, (_asks(register),), register)


def _write(now: Nanos, request: Request, node: Node, parameter: str, value: float) -> Pending | msg.Refused:
    if parameter == SAVE:
        if value != 1:
            return refusal(now, request, f"{SAVE} takes 1")
        return _pending(now, request, node, (console("conf write") + _asks(Register.MULTIPLEX_ID),), 0x110)
    register = register_of(parameter)
    if register is None:
        return _unknown(now, request, parameter)
    if not (isfinite(value) and abs(value) <= FLOAT_MAX):
        return refusal(now, request, f"{value} is no finite number of 32 bits")
    if register in REFUSED:
        return refusal(now, request, REFUSED[register])
    if any(register in commanded for commanded in COMMANDED):
        return refusal(now, request, "that register is what commands are for")
    if Register.UUID_MASK1 <= register <= Register.UUID_MASK4:
        return refusal(now, request, "a mask of UUIDs is no parameter")
    if register in _MOVING and (node.owned or node.mode not in (Mode.STOPPED, *LATCHED)):
        return refusal(now, request, "it is armed, and would jump: say idle first")
    return _pending(now, request, node, (set_register(register, value) + ask(register, F32),), register)


_MOVING = (
    Register.SET_OUTPUT_NEAREST,
    Register.SET_OUTPUT_EXACT,
    Register.REQUIRE_REINDEX,
    Register.RECAPTURE_POSITION_VELOCITY,
)


def scan(now: Nanos, request: msg.Scan) -> Pending:
    """Discovery: a question to all."""
    end = now + SCAN_STEP * SCAN_STEPS
    return Pending(request, request.bus, now, end, now, None, (DISCOVER,), SCAN_STEP)


def set_id(
    now: Nanos, request: msg.SetId, nodes: list[Node], holders: dict[int, set[int]]
) -> Pending | msg.Refused:
    """Give the device with a serial number an id, and ask it who it is. `holders`: serial numbers by id."""
    if not 1 <= request.address <= ADDRESS_MAX:
        return refusal(now, request, f"{request.address} is not an id: 1 to {ADDRESS_MAX}")
    if not 0 < request.serial < 1 << 8 * SERIAL_BYTES:
        return refusal(now, request, f"{request.serial} is no serial number of 64 bits")
    others = sorted(holders.get(request.address, set()) - {request.serial})
    if others:
        said = f"id {request.address} is held by serial number {others[0]:016X}"
        return refusal(now, request, said)
    for node in nodes:
        mine = request.serial in map(serial_of, node.uuids) or node.address == request.address
        if mine and (node.owned or node.mode not in (None, Mode.STOPPED, *LATCHED)):
            return refusal(now, request, f"{node.name} is armed: say idle first")
    uuid = request.serial.to_bytes(SERIAL_BYTES, "big")
    data = (masked(uuid, console(f"conf set id.id {request.address}")), masked(uuid, DISCOVER))
    return Pending(request, request.bus, now, now + ASSIGN, now, None, data, ASSIGN_AGAIN)


def data_of(pending: Pending, now: Nanos) -> tuple[bytes, ...]:
    """What is to be sent for a request now."""
    if isinstance(pending.request, msg.ClearFault) and pending.node is not None:
        return (pending.node.clearing(now),)
    if isinstance(pending.request, msg.Zero) and pending.node is not None:
        return (pending.data[0] + pending.node.question(now),)
    return pending.data


def handle(pending: Pending, t: Nanos, reply: Reply) -> list[Event]:
    """Let a request of one device hear its answer; the events that end it, or none."""
    node = pending.node
    if node is None or not pending.sent:
        return []
    match pending.request:
        case msg.ClearFault() if Register.MODE in reply.values and node.mode not in LATCHED:
            return [*node.cleared(t), pending.done(t)]
        case msg.Zero():
            return _on_zero(pending, t, reply)
        case msg.ReadParameter(_, parameter):
            return _on_read(pending, t, reply, parameter)
        case msg.WriteParameter(_, parameter, value):
            return _on_written(pending, t, reply, None if parameter == SAVE else value)
    return []


def _on_zero(pending: Pending, t: Nanos, reply: Reply) -> list[Event]:
    """Taken, as its answer says, and then measured: a position near zero alone may be from before."""
    if not_taken := _not_taken(reply, pending.register):
        return [pending.refuse(t, not_taken)]
    if pending.register in _about(reply):
        pending.taken = True
        return []
    position = reply.values.get(Register.POSITION)
    near = position is not None and abs(position) < ZERO_WITHIN
    return [pending.done(t)] if pending.taken and near else []


def _wrong(reply: Reply, code: int, register: int) -> Error | None:
    return next((e for e in reply.errors if e.code == code and e.register == register), None)


def _on_read(pending: Pending, t: Nanos, reply: Reply, parameter: str) -> list[Event]:
    if _wrong(reply, READ_ERROR, pending.register):
        return [pending.refuse(t, "the device has no such register, or cannot read it so")]
    if pending.register not in reply.values:
        return []
    value = reply.values[pending.register]
    if value is None:
        return [pending.refuse(t, "the device says that it is not given")]
    return [msg.Parameter(pending.name, t, parameter, float(value))]


def _about(reply: Reply) -> set[int]:
    """The registers that an answer tells, or cannot tell."""
    return {*reply.values, *(error.register for error in reply.errors)}


def _not_taken(reply: Reply, register: int) -> str:
    """Why a device does not take what was written; "" if it does not say so."""
    wrong = _wrong(reply, WRITE_ERROR, register)
    if wrong is None:
        return ""
    why = "read only" if wrong.number == NOT_WRITEABLE else f"error {wrong.number}: no such register?"
    return f"the device does not take it ({why})"


def _on_written(pending: Pending, t: Nanos, reply: Reply, value: float | None) -> list[Event]:
    """`value`: what the register must hold then, if it can be read at all.

    Many answers tell a register beside others, and may have been under way when it was written."""
    if not_taken := _not_taken(reply, pending.register):
        return [pending.refuse(t, not_taken)]
    if _about(reply) != {pending.register}:
        return []
    reads = reply.values.get(pending.register)
    if value is None or reads is None or isclose(reads, value, rel_tol=BINARY32, abs_tol=FLOAT_TINY):
        return [pending.done(t)]
    pending.reads = reads
    return []


def give_up(pending: Pending, now: Nanos) -> list[Event]:
    """The deadline has passed."""
    node = pending.node
    if isinstance(pending.request, msg.SetId):
        said = f"no device with serial number {pending.request.serial:016X} took the id"
        return [pending.refuse(now, said)]
    if node is None or node.received_at is None or node.received_at < pending.began:
        return [pending.refuse(now, "no answer of the device")]
    if isinstance(pending.request, msg.ClearFault):
        node.report_again()
        code = int(Mode.TIMEOUT) if node.mode == Mode.TIMEOUT else node.fault
        return [pending.refuse(now, f"still in fault: {fault_info_of(code).name}")]
    if isinstance(pending.request, msg.Zero):
        return [pending.refuse(now, "its position did not become zero: is it turning?")]
    if isinstance(pending.request, msg.WriteParameter) and pending.reads is not None:
        said = f"the device holds {pending.reads:.6g} there, not {pending.request.value:.6g}"
        return [pending.refuse(now, said)]
    return [pending.refuse(now, "the device did not answer this")]
