"""The driver: our end of CANSimple 0.6, for all ODrives of one bus.

Rules. No clock, no bus: time and frames are arguments, what is to be sent is returned. `receive` never raises
and never learns from host's frames (ours or another's). `Node` holds what is known of one device, `Pending`
a request under way; this file deals out the frames.
"""

from __future__ import annotations

from collections.abc import Sequence
from math import isfinite

from protocols.odrive_can import requests
from protocols.odrive_can.codec import (
    BROADCAST,
    BY_CMD,
    CMD_BITS,
    ask,
    cmd_of,
    decode_from_device,
    encode,
    frame_id,
)
from protocols.odrive_can.faults import DUPLICATE_NODE
from protocols.odrive_can.messages import Address, Heartbeat, Message
from protocols.odrive_can.node import Node
from protocols.odrive_can.requests import Pending
from protocols.plugin import Device, Range, Tally
from protocols.wire import BusState, CanFrame, Wire
from protocols.words import (
    SECOND,
    ClearFault,
    Command,
    Event,
    Fault,
    Found,
    Impedance,
    Nanos,
    Refused,
    Request,
    Scan,
    SetId,
    Stop,
)

PROTOCOL = "odrive_can"
ROLL_CALL = 5 * SECOND
"""Who holds which node id is asked so often, to notice an id held twice."""
WAITING = 32
"""Requests under way at once."""


class OdriveDriver:
    """All ODrives of one bus. Plain data."""

    def __init__(self, devices: Sequence[Device], ranges: dict[str, Range]) -> None:
        self.tally = Tally()
        self.nodes = {device.address: Node(device.name, device.address, device.options) for device in devices}
        self._by_name = {node.name: node for node in self.nodes.values()}
        self._ranges = ranges
        self._pending: list[Pending] = []
        self._events: list[Event] = []
        """What happened outside `send`, to be told by the next one."""
        self._serials: dict[int, dict[int, Nanos]] = {}
        """Serial numbers heard per node id, and when."""
        self._told_double: dict[int, bool] = {}
        self._refused: dict[str, str] = {}
        self._written: dict[str, dict[str, float]] = {}
        self._roll_call: Nanos = 0

    # -- hearing ------------------------------------------------------------------------------

    def receive(self, t: Nanos, wire: Wire) -> Sequence[Event]:
        """What a wire says; [] to what is not ours."""
        if not isinstance(wire, CanFrame) or not self._ours(wire):
            self.tally.foreign += 1
            self._overhear(t, wire)
            return []
        message = decode_from_device(wire)
        if message is None:
            self.tally.bad += 1
            return []
        self.tally.heard += 1
        if isinstance(message, Address):
            return self._hear_address(t, message)
        return self._hear_node(t, self.nodes[wire.id >> CMD_BITS], message)

    def _ours(self, frame: CanFrame) -> bool:
        """Whether it is the data frame of a device: of ours, or anybody's answer to a roll call.

        What a host sends under the same ids is not: a node id given out on the broadcast node differs
        from an unaddressed device's answer in its first byte."""
        node, layout = frame.id >> CMD_BITS, BY_CMD.get(frame.id & 0x1F)
        if layout is None or not layout.told() or not frame.data:
            return False
        if frame.extended or frame.fd or frame.remote:
            return False
        if layout.message is Address:
            return frame.data[0] == node
        return node in self.nodes

    def _hear_node(self, t: Nanos, node: Node, message: Message) -> list[Event]:
        events = node.hear(t, message)
        if isinstance(message, Heartbeat):
            events += self._contradiction(t, node)
        for pending in [p for p in self._pending if p.node is node]:
            ended = requests.hear(pending, t, message)
            if ended:
                self._pending.remove(pending)
                events += ended
        return events

    def _overhear(self, t: Nanos, wire: Wire) -> None:
        """During a scan a heartbeat of an unknown node counts as found: 0.5.x answers no discovery."""
        if not isinstance(wire, CanFrame) or wire.extended or wire.remote or wire.fd:
            return
        if wire.id & 0x1F != cmd_of(Heartbeat) or len(wire.data) < BY_CMD[cmd_of(Heartbeat)].dlc:
            return
        for pending in self._pending:
            if isinstance(pending.request, Scan):
                pending.found.setdefault((wire.id >> CMD_BITS, None), f"heartbeat heard {t}")

    # -- who holds which node id -------------------------------------------------------------------

    def _hear_address(self, t: Nanos, message: Address) -> list[Event]:
        for node, serials in self._serials.items():
            if node != message.node:
                serials.pop(message.serial, None)
        known = self._serials.get(message.node, {})
        held = {serial: at for serial, at in known.items() if t - at <= 2 * ROLL_CALL} | {message.serial: t}
        self._serials[message.node] = held
        if message.node in self.nodes:
            self.nodes[message.node].heard_at = t
        events: list[Event] = self._double(t, message.node, sorted(held)) if len(held) > 1 else []
        for pending in list(self._pending):
            if isinstance(pending.request, Scan):
                events += self._found(t, pending, message)
            elif isinstance(pending.request, SetId) and (message.serial, message.node) == (
                pending.request.serial,
                pending.request.address,
            ):
                self._pending.remove(pending)
                detail = f"not saved yet: write {requests.SAVE} 1 to keep it after power-off"
                events.append(pending.done(t, detail))
        return events

    def _found(self, t: Nanos, pending: Pending, message: Address) -> list[Event]:
        key = (message.node, message.serial)
        if key in pending.found:
            return []
        ours = self.nodes.get(message.node)
        detail = "has no node id yet" if message.node == BROADCAST else ""
        if ours is not None:
            v = ours.version
            detail = f"{ours.name}, firmware {v.fw_major}.{v.fw_minor}.{v.fw_revision}" if v else ours.name
        pending.found[key] = detail
        return [Found(t, PROTOCOL, message.node, message.serial, detail)]

    def _double(self, t: Nanos, node: int, serials: list[int]) -> list[Event]:
        if node == BROADCAST or self._told_double.get(node):
            return []
        self._told_double[node] = True
        said = " and ".join(f"{serial:012X}" for serial in serials)
        events: list[Event] = [
            Found(t, PROTOCOL, node, serial, f"node id {node} is held twice: by {said}") for serial in serials
        ]
        return events + self._double_fault(t, node, f"two devices answer to it: serial numbers {said}")

    def _double_fault(self, t: Nanos, node: int, cause: str) -> list[Event]:
        ours = self.nodes.get(node)
        if ours is None:
            return []
        cure = "take one off the bus, or give it another node id (SetId with its serial number)"
        return [Fault(ours.name, t, DUPLICATE_NODE, f"node id {node} is held twice", cause, cure)]

    def _contradiction(self, t: Nanos, node: Node) -> list[Event]:
        """Heartbeats that say A B A B while we asked for no change come from two devices."""
        if len(node.beats) < 4 or self._told_double.get(node.address):
            return []
        said = [(state, errors) for _, state, errors in node.beats]
        if (
            said[0] != said[2]
            or said[1] != said[3]
            or said[0] == said[1]
            or node.state_sent >= node.beats[0][0]
        ):
            return []
        self._told_double[node.address] = True
        self._roll_call = t
        return self._double_fault(t, node.address, "its heartbeats contradict each other in turn")

    # -- the bus ------------------------------------------------------------------------------

    def bus(self, t: Nanos, state: BusState) -> None:
        """The bus changed: forget who is armed where frames were lost or devices may have restarted."""
        if state is BusState.FULL:
            for node in self.nodes.values():
                node.resend()
        if state not in (BusState.GONE, BusState.OFF, BusState.BACK):
            return
        for node in self.nodes.values():
            node.forget()
        self._roll_call = t
        if state is not BusState.BACK:
            self._events += [p.refuse(t, f"the bus is {state}") for p in self._pending]
            self._pending.clear()

    # -- saying -------------------------------------------------------------------------------

    def send(self, now: Nanos, words: Sequence[Command | Request]) -> tuple[Sequence[Event], Sequence[Wire]]:
        """Say the words, then what falls due: requests, set-points, repeated requests, questions."""
        events, self._events = self._events, []
        wires: list[Wire] = []
        for word in words:
            if isinstance(word, Stop):
                for node in self.nodes.values():
                    node.claimed = True
            elif not isinstance(word, Command):
                events += self._ask_for(now, word)
        wires += self._resend(now, events)
        for word in words:
            if isinstance(word, Command):
                wires += self._command(now, word, events)
        for node in self.nodes.values():
            told, asks = node.tend(now)
            events += told
            wires += [CanFrame(frame_id(node.address, cmd), remote=True) for cmd in asks]
        if now >= self._roll_call:
            self._roll_call = now + ROLL_CALL
            wires.append(ask(BROADCAST, Address))
        return events, wires

    def _command(self, now: Nanos, command: Command, events: list[Event]) -> list[Wire]:
        node = self._by_name.get(command.motor)
        reason = self._wrong(command) if node is not None else "no such motor on this bus"
        if node is None or reason:
            if self._refused.get(command.motor) != reason:
                events.append(Refused(now, type(command).__name__, command.motor, reason))
            self._refused[command.motor] = reason
            return []
        self._refused.pop(command.motor, None)
        return [encode(node.address, message) for message in node.say(now, command)]

    def _wrong(self, command: Command) -> str:
        """Why a command must not reach the wire; "" if it may."""
        if isinstance(command, Impedance):
            return "the device has no impedance control"
        kind = type(command).__name__
        for name in command.__slots__:
            value = getattr(command, name)
            if isinstance(value, str):
                continue
            if not isfinite(value):
                return f"{name} is {value}"
            allowed = self._ranges[f"{kind}.{name}"]
            if not allowed.low <= value <= allowed.high:
                return f"{name} {value:.6g} lies outside {allowed.low:.6g} … {allowed.high:.6g}"
        return ""

    def _ask_for(self, now: Nanos, request: Request) -> list[Event]:
        begun: Pending | Refused
        if len(self._pending) >= WAITING:
            begun = requests.refuse(now, request, "too many requests are under way")
        elif isinstance(request, Scan):
            begun = requests.scan(now, request)
        elif isinstance(request, SetId):
            begun = requests.set_id(now, request, list(self.nodes.values()), self._serials)
        else:
            node = self._by_name.get(getattr(request, "motor", ""))
            if node is None:
                begun = requests.refuse(now, request, f"{PROTOCOL} cannot do this, or knows no such motor")
            else:
                begun = requests.begin(now, request, node, self._written.setdefault(node.name, {}))
                if isinstance(request, ClearFault):
                    self._told_double.pop(node.address, None)
        if isinstance(begun, Refused):
            return [begun]
        self._pending.append(begun)
        return []

    def _resend(self, now: Nanos, events: list[Event]) -> list[Wire]:
        wires: list[Wire] = []
        for pending in list(self._pending):
            if now >= pending.deadline:
                self._pending.remove(pending)
                events += (
                    self._end_scan(now, pending)
                    if isinstance(pending.request, Scan)
                    else [requests.give_up(pending, now)]
                )
            elif now >= pending.next:
                pending.next = now + pending.again
                pending.sent += 1
                wires += pending.frames
        return wires

    def _end_scan(self, now: Nanos, pending: Pending) -> list[Event]:
        answered = sorted(key for key in pending.found if key[1] is not None)
        nodes = {node for node, _ in answered}
        mute = sorted(node for node, serial in pending.found if serial is None and node not in nodes)
        known = [node for node in self.nodes if node not in nodes and self.nodes[node].heard_at is not None]
        events: list[Event] = [
            Found(now, PROTOCOL, node, None, "heard, but it did not answer discovery: firmware 0.5.x?")
            for node in sorted({*mute, *(n for n in known if not self.nodes[n].offline)})
        ]
        return [*events, pending.done(now, f"{len(answered) + len(events)} devices")]

    def due(self) -> Nanos | None:
        """When `send` next has something to do by itself."""
        times = [node.due() for node in self.nodes.values()]
        times += [min(pending.next, pending.deadline) for pending in self._pending]
        times.append(self._roll_call)
        return min(times)
