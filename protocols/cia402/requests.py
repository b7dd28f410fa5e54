"""Requests under way: what each leaves for the device, what counts as carried out, when it is given up.

Rules. Every request ends in Done or Refused within its deadline, whatever the device does. What cannot be is
refused at once with the reason. Aborts are told in words. Faults are cleared here and nowhere else, by a
rising edge of bit 7 of the controlword.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

from protocols import messages as msg
from protocols.cia402 import homing, objects, startup
from protocols.cia402 import objects as o
from protocols.cia402.client import Job, Outcome, Purpose
from protocols.cia402.codec import Nmt, NmtCommand, encode
from protocols.cia402.fault_reports import HOMING_FAILED
from protocols.cia402.node import FAULTY, Node
from protocols.cia402.objects import OBJECTS, Key, Type, to_bytes
from protocols.cia402.profile import Demand, Mode, PowerState, supports
from protocols.cia402.sdo import NO_OBJECT, abort_text
from protocols.frames import CanFrame
from protocols.messages import MILLISECOND, Event, Nanos, Request
from protocols.request_queue import PendingRequest, refusal

ANSWER = 2000 * MILLISECOND
CLEAR = 3000 * MILLISECOND
CLEAR_AGAIN = 500 * MILLISECOND
REBOOT = 8000 * MILLISECOND
REBOOT_AGAIN = 2000 * MILLISECOND
ZERO_METHODS = (37, 35)
"""Homing methods that take the present position (35 is the older number)."""
OURS = frozenset(
    {o.CONTROLWORD, o.MODE, o.TARGET_POSITION, o.TARGET_VELOCITY, o.TARGET_TORQUE}
    | {o.VELOCITY_OFFSET, o.TORQUE_OFFSET, o.CONSUMER_HEARTBEAT}
)
"""What the driver writes itself, and nobody past it."""
PDO_PARAMETERS = range(o.RPDO_COMMUNICATION, 0x1C00)


@dataclass(slots=True)
class Pending(PendingRequest):
    """A request to one device."""

    token: int
    """Its own: what the device answers to it bears it."""
    node: Node
    key: Key | None = None
    stage: int = 0


def begin(now: Nanos, request: Request, node: Node, token: int, holding: bool) -> Pending | msg.Refused:
    """Begin a request. `holding`: the last command to the device was Hold."""
    pending = Pending(request, node.name, now, now + ANSWER, now, token, node)
    running = node.owned or node.power in (PowerState.OPERATION_ENABLED, PowerState.QUICK_STOP)
    match request:
        case msg.ClearFault():
            node.refused, node.clearing, node.doubled = False, True, False
            node.trying_since = None
            pending.deadline = now + CLEAR
        case msg.Estop():
            node.estopped = True
            node.insist, node.insist_since, node.insist_next = Demand.QUICK_STOP, now, now
            node.disarmed = 0
            node.unarm()
            node.values = {}
        case msg.ReadParameter(_, parameter):
            return _read(now, pending, parameter)
        case msg.WriteParameter(_, parameter, value):
            return _write(now, pending, parameter, value)
        case msg.Reboot() if running:
            return refusal(now, request, "it is armed, and would drop its load: say idle first")
        case msg.Reboot():
            pending.deadline = now + REBOOT
        case msg.Home() | msg.Zero():
            return _home(now, pending, holding)
        case _:
            return refusal(now, request, f"cia402 has no {type(request).__name__}")
    return pending


def _home(now: Nanos, pending: Pending, holding: bool) -> Pending | msg.Refused:
    node, request = pending.node, pending.request
    if node.known is None or not supports(node.known.modes, Mode.HM):
        return refusal(now, request, "it has no homing mode (object 6502), or is not known yet")
    if not node.armed or not holding:
        return refusal(now, request, f"it must be armed and hold: say {msg.Hold.__name__.lower()} first")
    if node.homing is not None:
        return refusal(now, request, "homing is under way")
    pending.deadline = now + node.options.home_timeout_ms * MILLISECOND + ANSWER
    if isinstance(request, msg.Zero):
        pending.key = o.HOMING_METHOD
        node.questions.append(Job(Purpose.ASKED, o.HOMING_METHOD, None, pending.token))
    else:
        homing.begin(node, now, pending.token, zero=False)
    return pending


def _read(now: Nanos, pending: Pending, parameter: str) -> Pending | msg.Refused:
    key = _key(parameter)
    if key is None:
        return refusal(now, pending.request, _unknown(parameter))
    pending.key = key
    pending.node.questions.append(Job(Purpose.ASKED, key, None, pending.token))
    return pending


def _write(now: Nanos, pending: Pending, parameter: str, value: float) -> Pending | msg.Refused:
    key, node = _key(parameter), pending.node
    if key is None:
        return refusal(now, pending.request, _unknown(parameter))
    known = OBJECTS.get(key)
    if known is None or known.type is Type.TEXT:
        return refusal(now, pending.request, f"the type of {objects.title(key)} is not known: not written")
    if key in OURS or key[0] in PDO_PARAMETERS:
        return refusal(now, pending.request, f"{known.name} is the driver's own: commands set it")
    if not math.isfinite(value) or value != int(value):
        return refusal(now, pending.request, f"{value} is not a whole number")
    try:
        data = to_bytes(known.type, int(value))
    except ValueError as error:
        return refusal(now, pending.request, str(error))
    pending.key = key
    node.questions.append(Job(Purpose.ASKED, key, data, pending.token))
    return pending


def _key(parameter: str) -> Key | None:
    """The object of a name or an address; None if it is neither."""
    found = objects.find(parameter)
    return found.key if found is not None else objects.parse(parameter)


def _unknown(parameter: str) -> str:
    return f'{parameter!r} is no object: say its name, or its address like "6081" or "608F:01"'


# -- as it goes on ---------------------------------------------------------------------------------------


def handle(pending: Pending, t: Nanos, outcome: Outcome) -> list[Event]:
    """A transfer of this request has ended; the events that end the request, or none."""
    node, request = pending.node, pending.request
    if outcome.silent:
        return [pending.refuse(t, "no answer of the device")]
    if isinstance(request, msg.Zero):
        return _on_zero(pending, t, outcome)
    if outcome.abort is not None:
        return [pending.refuse(t, abort_text(outcome.abort))]
    if isinstance(request, msg.ReadParameter):
        return _report(pending, t, request, outcome)
    if isinstance(request, msg.WriteParameter):
        changed = outcome.job.key in (*startup.FIRST, *startup.THEN)
        if changed and not node.owned:
            node.forget()  # it counts otherwise now: read it anew
            node.received(t)
        return [pending.done(t)]
    return []


def _report(pending: Pending, t: Nanos, request: msg.ReadParameter, outcome: Outcome) -> list[Event]:
    key = outcome.job.key
    known = OBJECTS.get(key)
    if known is not None and known.type is Type.TEXT:
        return [pending.done(t, outcome.value.decode("ascii", "replace"))]
    value = startup.value_of(key, outcome.value)
    if value is None:
        return [pending.refuse(t, f"{outcome.value.hex()} is no number of its type")]
    unit = known.unit if known is not None else "of unknown type, read as unsigned"
    return [msg.Parameter(pending.node.name, t, request.parameter, float(value)), pending.done(t, unit)]


def _on_zero(pending: Pending, t: Nanos, outcome: Outcome) -> list[Event]:
    """The homing method is read, then written; the next one is tried where the device does not have it."""
    node, job = pending.node, outcome.job
    if job.data is None:
        before = startup.value_of(job.key, outcome.value) if outcome.abort is None else None
        pending.stage = 0
        node.homing_method = before
    elif outcome.abort is None:
        homing.begin(node, t, pending.token, zero=True)
        return []
    else:
        pending.stage += 1
    if outcome.abort == NO_OBJECT or pending.stage >= len(ZERO_METHODS):
        why = abort_text(outcome.abort or 0)
        return [pending.refuse(t, f"it cannot take its present position as zero: {why}")]
    method = to_bytes(Type.I8, ZERO_METHODS[pending.stage])
    node.questions.append(Job(Purpose.ASKED, o.HOMING_METHOD, method, pending.token))
    return []


def tend(pending: Pending, now: Nanos) -> tuple[list[Event], list[CanFrame]]:
    """What falls due of a request: (events, frames). Events end it."""
    node, request = pending.node, pending.request
    ended: list[Event] = []
    frames: list[CanFrame] = []
    match request:
        case msg.ClearFault():
            ended, frames = _clear(pending, now)
        case msg.Estop() if node.insist is None and node.power is not None:
            ended = [pending.done(now, "it stays in fault until cleared")]
        case msg.Reboot() if node.booted_at is not None and node.booted_at > pending.began and pending.stage:
            ended = [pending.done(now, "it has restarted")]
        case msg.Reboot() if now >= pending.next:
            pending.next, pending.stage = now + REBOOT_AGAIN, 1
            frames = [encode(Nmt(NmtCommand.RESET_NODE, node.address))]
        case msg.Home() | msg.Zero():
            ended = _homed(pending, now)
    if not ended and now >= pending.deadline:
        ended = _give_up(pending, now)
    return ended, frames


def _clear(pending: Pending, now: Nanos) -> tuple[list[Event], list[CanFrame]]:
    node = pending.node
    if node.power is None or node.offline:
        return [], []
    if node.power not in FAULTY:
        if (
            node.emergency
        ):  # maybe a fault, maybe a warning: its statusword tells, and nothing drops till then
            return [], []
        if pending.stage and node.urgent:
            return [], []
        node.clearing, node.estopped = False, False
        node.reported_faults.clear()
        if node.insist is Demand.QUICK_STOP:
            node.insist = None
        return [*node.report(now), pending.done(now)], []
    if now < pending.next or now >= pending.deadline:
        return [], []
    pending.next, pending.stage = now + CLEAR_AGAIN, pending.stage + 1
    words = (Demand.DISABLE_VOLTAGE, Demand.FAULT_RESET)
    node.urgent = [Job(Purpose.RELEASE, o.CONTROLWORD, to_bytes(Type.U16, word)) for word in words]
    node.outlet.forget()
    return [], []


def _homed(pending: Pending, now: Nanos) -> list[Event]:
    node = pending.node
    if node.homing is None:
        begun = isinstance(pending.request, msg.Home) or (pending.stage < 0)
        return [pending.refuse(now, "it was disarmed, or commanded otherwise")] if begun else []
    if node.homing.token != pending.token:
        return []
    if isinstance(pending.request, msg.Zero):
        pending.stage = -1
    found = homing.outcome(node, now)
    if found is None:
        return []
    well, why = found
    late = not well and now >= node.homing.since + node.options.home_timeout_ms * MILLISECOND
    homing.end(node)
    if isinstance(pending.request, msg.Zero) and node.homing_method is not None:
        restore = to_bytes(Type.I8, node.homing_method)
        node.questions.append(Job(Purpose.ASKED, o.HOMING_METHOD, restore))
    if well:
        return [pending.done(now, why)]
    faults = node.complain(now, HOMING_FAILED) if late else []
    return [*faults, pending.refuse(now, why)]


def _give_up(pending: Pending, now: Nanos) -> list[Event]:
    node = pending.node
    if node.received_at is None or node.received_at < pending.began:
        reason = "no answer of the device"
    elif isinstance(pending.request, msg.ClearFault):
        code, node.reported_faults = node.error_code, set()
        again = node.complain(now, code or 0x1000)
        node.clearing = False
        return [*again, pending.refuse(now, f"still in fault: error code {code:#06x}")]
    elif isinstance(pending.request, msg.Reboot):
        reason = "it showed no sign of a restart"
    else:
        reason = "the device did not react"
    return [pending.refuse(now, reason)]
