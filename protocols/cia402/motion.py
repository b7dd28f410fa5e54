"""What a command takes: starting a device, arming it, steering it, disarming it.

Rules. Functions on a `Node`; they return frames, or leave jobs for its SDO client. Nothing but uploads goes
to a device before it is commanded, and no set-point before it is configured. Set-points go out only in answer
to a command of the same step. The first set-point of a sequence is where the shaft is measured to be.
Disarming and quick stops are repeated until the statusword shows them, commanded or not.
"""

from __future__ import annotations

from protocols.cia402 import arming, configuring, homing
from protocols.cia402 import objects as o
from protocols.cia402.client import Job, Purpose
from protocols.cia402.codec import Nmt, NmtCommand, NmtState, encode
from protocols.cia402.node import CONFIRMED, FAULTY, Node
from protocols.cia402.objects import OBJECTS, Key, to_bytes
from protocols.cia402.profile import Control, Demand, PowerState, Status
from protocols.cia402.profile import Mode as Operation
from protocols.cia402.setpoint import TARGET_OF, Values, mode_for, standstill, values_of
from protocols.cia402.startup import Known, mode_name
from protocols.frames import CanFrame
from protocols.messages import MILLISECOND, Command, Hold, Idle, Nanos

START_AGAIN = 100 * MILLISECOND
"""NMT start is repeated so often until the device says that it is operational."""
STARTS = 3
"""So often, where it says nothing of its NMT state."""
INSIST_AGAIN = 50 * MILLISECOND
LATE = 500 * MILLISECOND
"""A device that has not disarmed by then is told DISABLE VOLTAGE."""
PLACED = 2
"""Rounds of set-points that stand before a device is enabled."""
HANDSHAKE = 250 * MILLISECOND
"""A set-point of PP that was not acknowledged by then is given again, the newest, by a new rise of bit 4."""
LOWERED = 50 * MILLISECOND
"""So long bit 4 stays low before that: time enough for a write by SDO."""


def possible(node: Node, command: Command) -> str:
    """Why a device cannot do a command at all; "" if it can, or nobody knows yet."""
    known = node.known
    if known is None or isinstance(command, Idle):
        return ""
    operation = mode_for(command, known, node.options.modes)
    if operation is None:
        return f"its object 6502 ({known.modes:#x}) has no mode for {type(command).__name__}"
    try:
        values = values_of(command, operation, known.units, 0)
    except ValueError as error:
        return str(error)
    lacking = next((key for key, value in values.items() if value and key in node.absent), None)
    return f"it has no object {lacking[0]:04X} ({OBJECTS[lacking].name})" if lacking else ""


def say(node: Node, now: Nanos, command: Command, at_sync: bool) -> list[CanFrame]:
    """What a command takes now; nothing while the device cannot take it.

    `at_sync`: a SYNC follows, or is not ours to wait for."""
    node.commanded_at = now
    node.holding = isinstance(command, Hold)
    if isinstance(command, Idle):
        return release(node, now)
    if node.insist is Demand.SHUTDOWN:
        node.insist = None
    if node.nmt is NmtState.STOPPED and not node.offline:
        return _start(node, now)
    if node.known is None or node.unfit():
        node.values = {}
        return []
    node.owned = True
    if not configuring.configured(node):
        return []
    said = _start(node, now) if not started(node) else []
    if node.outlet.synchronous and not at_sync:
        return said
    return said + _steer(node, now, node.known, command)


# -- starting ------------------------------------------------------------------------------------------------


def started(node: Node) -> bool:
    """Whether it is in NMT operational, as far as it tells."""
    return node.nmt is NmtState.OPERATIONAL or (node.nmt is None and node.starts >= STARTS)


def _start(node: Node, now: Nanos) -> list[CanFrame]:
    if now < node.start_next:
        return []
    node.owned = True
    node.start_next, node.starts = now + START_AGAIN, node.starts + 1
    return [encode(Nmt(NmtCommand.START, node.address))]


# -- steering --------------------------------------------------------------------------------------------


def _steer(node: Node, now: Nanos, known: Known, command: Command) -> list[CanFrame]:
    if node.homing is not None:
        return _send(node, now, homing.set_points(node, now, node.homing), o.CONTROLWORD)
    operation = mode_for(command, known, node.options.modes)
    power, position = node.power, node.position
    if operation is None or position is None or power is None:
        return []
    if not isinstance(command, Hold):
        node.hold = None
    elif node.hold is None:
        node.hold = position
    node.target = TARGET_OF[operation]
    if power is PowerState.OPERATION_ENABLED:
        resting = node.values.get(o.TARGET_POSITION, position) if node.hold is None else node.hold
        values = values_of(command, operation, known.units, resting)
        control = int(Demand.ENABLE_OPERATION)
        if operation is Operation.PP and node.has_mode(operation):
            control = _hand(node, now, values)
        if node.has_mode(operation):
            node.trying_since = None
        else:
            _try(node, now, (power, operation))
    else:
        values = standstill(position)
        demand = _climb(node, now, power, operation)
        if demand is None:
            return []
        control = demand
    values |= {o.CONTROLWORD: control, o.MODE: int(operation)}
    node.rounds += 1
    return _send(node, now, values, node.target)


def _climb(node: Node, now: Nanos, power: PowerState, operation: Operation) -> int | None:
    """The next controlword on the way to OPERATION ENABLED."""
    _try(node, now, (power, node.operation == operation))
    node.setpoint, node.handing = None, False
    # By SDO, one transfer after the other: each is confirmed before the next begins.
    placed = node.has_mode(operation) and node.rounds >= PLACED
    return arming.upward(power, node.read.get(o.QUICK_STOP_OPTION, 2), placed=placed)


def _try(node: Node, now: Nanos, seen: object) -> None:
    """Note that it is not there yet; it is given up when nothing changes for too long."""
    if node.trying_since is None or node.trying != seen:
        node.trying_since, node.trying = now, seen


def _hand(node: Node, now: Nanos, values: Values) -> int:
    """PP: the handshake, with the target that it is about."""
    acknowledged = bool((node.status or 0) & Status.SETPOINT_ACKNOWLEDGED)
    if node.handing and not acknowledged and now > node.handed_at + HANDSHAKE:
        node.handing, node.setpoint, node.lowered_until = False, None, now + LOWERED
    if now < node.lowered_until:
        return int(Demand.ENABLE_OPERATION | Control.CHANGE_IMMEDIATELY)
    before = node.handing
    target = values[o.TARGET_POSITION]
    control, given, node.handing = arming.handshake(acknowledged, node.handing, target, node.setpoint)
    if node.handing:
        values[o.TARGET_POSITION] = node.setpoint = given
        node.handed_at = node.handed_at if before else now
    return control


def _send(node: Node, now: Nanos, values: Values, moving: Key) -> list[CanFrame]:
    node.values = {key: value for key, value in values.items() if key not in node.absent}
    return node.outlet.frames(now, node.values, moving)


# -- disarming -------------------------------------------------------------------------------------------


def release(node: Node, now: Nanos) -> list[CanFrame]:
    """Idle: only to what we commanded, or after an operator's stop."""
    if node.owned and node.insist is None:
        node.insist, node.insist_since, node.insist_next = Demand.SHUTDOWN, now, now
        node.disarmed = 0
        node.refused = False
        node.unarm()
        node.values = {}
    return []


def insist(node: Node, now: Nanos) -> list[CanFrame]:
    """Disarming or a quick stop under way: said again until the statusword shows it."""
    if node.insist is None:
        return []
    gone = node.power in FAULTY and node.power is not PowerState.FAULT_REACTION
    if node.disarmed >= CONFIRMED or (gone and node.disarmed):
        _disarmed(node)
        return []
    if now < node.insist_next:
        return []
    node.insist_next = now + INSIST_AGAIN
    late = now - node.insist_since >= LATE
    demand = arming.downward(late=late) if node.insist is Demand.SHUTDOWN else node.insist
    return command_power(node, now, demand, by_sdo=now > node.insist_since)


def command_power(node: Node, now: Nanos, demand: Demand, by_sdo: bool) -> list[CanFrame]:
    """A controlword, by RPDO where there is one, and by SDO where there is none or it did not help."""
    frames = []
    if o.CONTROLWORD in node.outlet.mapped and started(node):
        values = dict.fromkeys(node.outlet.mapped, 0)
        values |= {o.TARGET_POSITION: node.position or 0, o.MODE: node.operation or 0}
        frames = node.outlet.frames(now, values | {o.CONTROLWORD: int(demand)}, o.CONTROLWORD)
    if by_sdo or not frames:
        node.urgent = [Job(Purpose.RELEASE, o.CONTROLWORD, to_bytes(OBJECTS[o.CONTROLWORD].type, demand))]
    node.outlet.reported.pop(o.CONTROLWORD, None)
    return frames


def _disarmed(node: Node) -> None:
    if node.insist is Demand.SHUTDOWN:
        if node.watched:  # a host that leaves is not a host that died
            node.setup = [Job(Purpose.SETUP, o.CONSUMER_HEARTBEAT, bytes(4))]
            node.watched = False
            return
        if node.setup or (node.client.job is not None and node.client.job.purpose is Purpose.SETUP):
            return
        node.owned, node.setup, node.configured = False, None, False
    node.insist = None


def stuck(node: Node, now: Nanos) -> str:
    """Why arming is given up now; "" if it is not."""
    since = node.trying_since
    if since is None or node.refused or now < since + node.options.state_timeout_ms * MILLISECOND:
        return ""
    power = "nothing" if node.power is None else node.power.value
    shown = "no mode" if node.operation is None else mode_name(node.operation)
    return f"it stayed in {power} with {shown} shown"
