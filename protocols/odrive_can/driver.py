"""The driver: our end of CANSimple, for all ODrives of one bus, of firmware 0.5.x and 0.6.x side by side.

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
    EXTENDED,
    MAX_EXTENDED_NODE,
    TABLES,
    AnyMessage,
    ask,
    asking,
    cmd_of,
    decode_from_device,
    encode,
    node_of,
)
from protocols.odrive_can.dialect import beat_of
from protocols.odrive_can.faults import DUPLICATE_NODE
from protocols.odrive_can.messages import Address, AxisState, Beacon
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
    Reboot,
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
        nodes = [Node(device.name, device.address, device.options) for device in devices]
        self.nodes = {node.address: node for node in nodes}
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
        # An axis of 0.5.x would take a remote frame of Address for Set_Axis_Node_ID, were its node id 63.
        self._discovery = any(node.options.firmware != "0.5" for node in nodes)

    # -- hearing ------------------------------------------------------------------------------

    def receive(self, t: Nanos, wire: Wire) -> Sequence[Event]:
        """What a wire says; [] to what is not ours."""
        if not isinstance(wire, CanFrame) or wire.fd or wire.remote or not wire.data:
            self.tally.foreign += 1
            return []
        address = node_of(wire)
        node = self.nodes.get(address)
        line = node.identity.reading if node is not None else ""
        row = TABLES[line].from_device.get(wire.id & 0x1F)
        if row is None or not (node is not None or row.message is Address):
            self.tally.foreign += 1
            self._overhear(t, address, wire)
            return []
        if row.message is Address and wire.data[0] != address:
            # A node id that a host gives out differs from an unaddressed device's answer in its first byte.
            self.tally.foreign += 1
            return []
        message = decode_from_device(wire, line)
        if message is None:
            self.tally.bad += 1
            return []
        if isinstance(message, Beacon) and node is not None:
            message = decode_from_device(wire, node.identity.hear_beacon(message)) or message
        self.tally.heard += 1
        if isinstance(message, Address):
            return self._hear_address(t, message)
        return self._hear_node(t, node, message) if node is not None else []

    def _hear_node(self, t: Nanos, node: Node, message: AnyMessage) -> list[Event]:
        events = node.hear(t, message)
        if beat_of(message) is not None or node.two:
            events += self._contradiction(t, node)
        for pending in [p for p in self._pending if p.node is node]:
            ended = requests.hear(pending, t, message)
            if ended:
                self._pending.remove(pending)
                events += ended
        return events

    def _overhear(self, t: Nanos, address: int, frame: CanFrame) -> None:
        """During a scan a heartbeat of an unknown node counts as found: 0.5.x answers no discovery."""
        if frame.id & 0x1F != cmd_of(Beacon) or decode_from_device(frame, "") is None:
            return
        for pending in self._pending:
            if isinstance(pending.request, Scan):
                pending.found.setdefault((address, None), f"heartbeat heard {t}")

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
            self.nodes[message.node].identity.hear_roll_call()
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
            detail = f"{ours.name}, {ours.identity.title()}"
        pending.found[key] = detail
        return [Found(t, PROTOCOL, message.node, message.serial, detail)]

    def _double(self, t: Nanos, node: int, serials: list[int]) -> list[Event]:
        if node == BROADCAST or self._told_double.get(node):
            return []
        self._told_double[node] = True
        said = " and ".join(f"{serial:012X}" for serial in serials)
        events: list[Event] = [
            Found(t, PROTOCOL, node, serial, f"node id {node} is held twice: by {said}", twice=True)
            for serial in serials
        ]
        return events + self._double_fault(t, node, f"two devices answer to it: serial numbers {said}")

    def _double_fault(self, t: Nanos, node: int, cause: str) -> list[Event]:
        ours = self.nodes.get(node)
        if ours is None:
            return []
        cure = "take one off the bus, or give it another node id (SetId with its serial number)"
        title = f"node id {node & MAX_EXTENDED_NODE} is held twice"
        return [Fault(ours.name, t, DUPLICATE_NODE, title, cause, cure)]

    def _contradiction(self, t: Nanos, node: Node) -> list[Event]:
        """Heartbeats that say A B A B while we asked for no change come from two devices."""
        if self._told_double.get(node.address):
            return []
        if node.two:
            self._told_double[node.address], self._roll_call = True, t
            return self._contradicted(t, node, "its positions contradict each other in turn")
        if len(node.beats) < 4:
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
        return self._contradicted(t, node, "its heartbeats contradict each other in turn")

    def _contradicted(self, t: Nanos, node: Node, cause: str) -> list[Event]:
        found = Found(t, PROTOCOL, node.address & MAX_EXTENDED_NODE, None, cause, twice=True)
        return [found, *self._double_fault(t, node.address, cause)]

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
            wires += [asking(node.address, cmd) for cmd in asks]
        if now >= self._roll_call:
            self._roll_call = now + ROLL_CALL
            wires += [ask(BROADCAST, Address)] if self._discovery else []
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
            begun = requests.scan(now, request, self._discovery)
        elif isinstance(request, SetId) and not self._discovery:
            said = "firmware 0.5.x tells no serial numbers over CAN: set the node id with the vendor's tool"
            begun = requests.refuse(now, request, said)
        elif isinstance(request, SetId):
            begun = requests.set_id(now, request, list(self.nodes.values()), self._serials)
        else:
            node = self._by_name.get(getattr(request, "motor", ""))
            if node is None:
                begun = requests.refuse(now, request, f"{PROTOCOL} cannot do this, or knows no such motor")
            else:
                begun = self._begin(now, request, node)
                if isinstance(request, ClearFault):
                    self._told_double.pop(node.address, None)
        if isinstance(begun, Refused):
            return [begun]
        self._pending.append(begun)
        return []

    def _begin(self, now: Nanos, request: Request, node: Node) -> Pending | Refused:
        others = [other for other in self.nodes.values() if other is not node and other.dialect.boards]
        running = [
            other.name
            for other in others
            if other.claimed or other.armed or other.state == AxisState.CLOSED_LOOP_CONTROL
        ]
        if isinstance(request, Reboot) and node.dialect.boards and running:
            said = (
                f"it restarts its whole board, and {running[0]}, which is armed, may be on it: say idle first"
            )
            return requests.refuse(now, request, said)
        return requests.begin(now, request, node, self._written.setdefault(node.name, {}))

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
                frames = requests.frames_of(pending)
                pending.next = now + pending.again
                pending.sent += len(frames)
                wires += frames
        return wires

    def _end_scan(self, now: Nanos, pending: Pending) -> list[Event]:
        answered = sorted(key for key in pending.found if key[1] is not None)
        nodes = {node for node, _ in answered}
        mute = sorted(node for node, serial in pending.found if serial is None and node not in nodes)
        known = [node for node in self.nodes if node not in nodes and self.nodes[node].heard_at is not None]
        events: list[Event] = [
            Found(now, PROTOCOL, node & MAX_EXTENDED_NODE, None, self._mute(node))
            for node in sorted({*mute, *(n for n in known if not self.nodes[n].offline)})
        ]
        return [*events, pending.done(now, f"{len(answered) + len(events)} devices")]

    def _mute(self, address: int) -> str:
        """What is known of a node that did not answer discovery."""
        ours = self.nodes.get(address)
        if ours is not None and ours.identity.line:
            return f"{ours.name}, {ours.identity.title()}"
        ids = ", extended identifiers" if address >= EXTENDED else ""
        return f"heard, but it did not answer discovery: firmware 0.5.x?{ids}"

    def due(self) -> Nanos | None:
        """When `send` next has something to do by itself."""
        times = [node.due() for node in self.nodes.values()]
        times += [min(pending.next, pending.deadline) for pending in self._pending]
        times.append(self._roll_call)
        return min(times)
