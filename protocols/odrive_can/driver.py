"""The driver: our end of CANSimple, for all ODrives of one bus, of firmware 0.5.x and 0.6.x side by side.

Rules. No clock, no bus: time and frames are arguments, what is to be sent is returned. `receive` never raises
and never learns from host's frames (ours or another's). `Node` holds what is known of one device, `Pending`
a request under way; this file deals out the frames.
"""

from __future__ import annotations

from collections.abc import Sequence

from protocols import messages as msg
from protocols.frames import BusState, CanFrame, Frame
from protocols.messages import SECOND, Command, Event, Nanos, Request
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
from protocols.plugin import Device, Range, RxCounters
from protocols.request_queue import RejectionFilter, RequestQueue, out_of_range, refusal, subject

PROTOCOL = "odrive_can"
NO_IMPEDANCE = "the device has no impedance control"
ROLL_CALL = 5 * SECOND
"""Who holds which node id is asked so often, to notice an id held twice."""


class OdriveDriver:
    """All ODrives of one bus. Plain data."""

    def __init__(self, devices: Sequence[Device], ranges: dict[str, Range]) -> None:
        self.counters = RxCounters()
        nodes = [Node(device.name, device.address, device.options) for device in devices]
        self.nodes = {node.address: node for node in nodes}
        self._by_name = {node.name: node for node in self.nodes.values()}
        self._ranges = ranges
        self._waiting: RequestQueue[Pending] = RequestQueue()
        self._refusals = RejectionFilter()
        self._events: list[Event] = []
        """What happened outside `send`, to be told by the next one."""
        self._serials: dict[int, dict[int, Nanos]] = {}
        """Serial numbers heard per node id, and when."""
        self._reported_duplicate: dict[int, bool] = {}
        self._written: dict[str, dict[str, float]] = {}
        self._roll_call: Nanos = 0
        # An axis of 0.5.x would take a remote frame of Address for Set_Axis_Node_ID, were its node id 63.
        self._discovery = any(node.options.firmware != "0.5" for node in nodes)

    # -- hearing ------------------------------------------------------------------------------

    def receive(self, t: Nanos, frame: Frame) -> Sequence[Event]:
        """What a wire says; [] to what is not ours."""
        if not isinstance(frame, CanFrame) or frame.fd or frame.remote or not frame.data:
            self.counters.ignored += 1
            return []
        address = node_of(frame)
        node = self.nodes.get(address)
        line = node.identity.reading if node is not None else ""
        row = TABLES[line].from_device.get(frame.id & 0x1F)
        if row is None or not (node is not None or row.message is Address):
            self.counters.ignored += 1
            self._overhear(t, address, frame)
            return []
        if row.message is Address and frame.data[0] != address:
            # A node id that a host gives out differs from an unaddressed device's answer in its first byte.
            self.counters.ignored += 1
            return []
        message = decode_from_device(frame, line)
        if message is None:
            self.counters.malformed += 1
            return []
        if isinstance(message, Beacon) and node is not None:
            message = decode_from_device(frame, node.identity.on_beacon(message)) or message
        self.counters.accepted += 1
        if isinstance(message, Address):
            return self._on_address(t, message)
        return self._on_node(t, node, message) if node is not None else []

    def _on_node(self, t: Nanos, node: Node, message: AnyMessage) -> list[Event]:
        events = node.handle(t, message)
        if beat_of(message) is not None or node.two:
            events += self._contradiction(t, node)
        for pending in self._waiting:
            ended = requests.handle(pending, t, message) if pending.node is node else []
            if ended:
                self._waiting.end(pending)
                events += ended
        return events

    def _overhear(self, t: Nanos, address: int, frame: CanFrame) -> None:
        """During a scan a heartbeat of an unknown node counts as found: 0.5.x answers no discovery."""
        if frame.id & 0x1F != cmd_of(Beacon) or decode_from_device(frame, "") is None:
            return
        for pending in self._waiting:
            if isinstance(pending.request, msg.Scan):
                pending.found.setdefault((address, None), f"heartbeat heard {t}")

    # -- who holds which node id -------------------------------------------------------------------

    def _on_address(self, t: Nanos, message: Address) -> list[Event]:
        for node, serials in self._serials.items():
            if node != message.node:
                serials.pop(message.serial, None)
        known = self._serials.get(message.node, {})
        held = {serial: at for serial, at in known.items() if t - at <= 2 * ROLL_CALL} | {message.serial: t}
        self._serials[message.node] = held
        if message.node in self.nodes:
            self.nodes[message.node].received_at = t
            self.nodes[message.node].identity.on_roll_call()
        events: list[Event] = self._double(t, message.node, sorted(held)) if len(held) > 1 else []
        for pending in self._waiting:
            if isinstance(pending.request, msg.Scan):
                events += self._found(t, pending, message)
            elif isinstance(pending.request, msg.SetId) and (message.serial, message.node) == (
                pending.request.serial,
                pending.request.address,
            ):
                self._waiting.end(pending)
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
        return [msg.Found(t, PROTOCOL, message.node, message.serial, detail)]

    def _double(self, t: Nanos, node: int, serials: list[int]) -> list[Event]:
        if node == BROADCAST or self._reported_duplicate.get(node):
            return []
        self._reported_duplicate[node] = True
        said = " and ".join(f"{serial:012X}" for serial in serials)
        events: list[Event] = [
            msg.Found(
                t, PROTOCOL, node, serial, f"node id {node} is held twice: by {said}", duplicate_address=True
            )
            for serial in serials
        ]
        return events + self._double_fault(t, node, f"two devices answer to it: serial numbers {said}")

    def _double_fault(self, t: Nanos, node: int, cause: str) -> list[Event]:
        ours = self.nodes.get(node)
        if ours is None:
            return []
        remedy = "take one off the bus, or give it another node id (SetId with its serial number)"
        title = f"node id {node & MAX_EXTENDED_NODE} is held twice"
        return [msg.Fault(ours.name, t, DUPLICATE_NODE, title, cause, remedy)]

    def _contradiction(self, t: Nanos, node: Node) -> list[Event]:
        """Heartbeats that say A B A B while we asked for no change come from two devices."""
        if self._reported_duplicate.get(node.address):
            return []
        if node.two:
            self._reported_duplicate[node.address], self._roll_call = True, t
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
        self._reported_duplicate[node.address] = True
        self._roll_call = t
        return self._contradicted(t, node, "its heartbeats contradict each other in turn")

    def _contradicted(self, t: Nanos, node: Node, cause: str) -> list[Event]:
        found = msg.Found(t, PROTOCOL, node.address & MAX_EXTENDED_NODE, None, cause, duplicate_address=True)
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
            self._events += self._waiting.drop(t, f"the bus is {state}")

    # -- saying -------------------------------------------------------------------------------

    def send(self, now: Nanos, words: Sequence[Command | Request]) -> tuple[Sequence[Event], Sequence[Frame]]:
        """Say the words, then what falls due: requests, set-points, repeated requests, questions."""
        events, self._events = self._events, []
        frames: list[Frame] = []
        for word in words:
            if isinstance(word, msg.Stop):
                for node in self.nodes.values():
                    node.owned = True
            elif not isinstance(word, Command):
                events += self._waiting.add(self._begin(now, word))
        frames += self._resend(now, events)
        for word in words:
            if isinstance(word, Command):
                frames += self._command(now, word, events)
        for node in self.nodes.values():
            reported, asks = node.tend(now)
            events += reported
            frames += [asking(node.address, cmd) for cmd in asks]
        if now >= self._roll_call:
            self._roll_call = now + ROLL_CALL
            frames += [ask(BROADCAST, Address)] if self._discovery else []
        return events, frames

    def _command(self, now: Nanos, command: Command, events: list[Event]) -> list[Frame]:
        node = self._by_name.get(command.motor)
        reason = self._wrong(command) if node is not None else "no such motor on this bus"
        events += self._refusals.handle(now, command, reason)
        if node is None or reason:
            return []
        return [encode(node.address, message) for message in node.say(now, command)]

    def _wrong(self, command: Command) -> str:
        """Why a command must not reach the wire; "" if it may."""
        return NO_IMPEDANCE if isinstance(command, msg.Impedance) else out_of_range(command, self._ranges)

    def _begin(self, now: Nanos, request: Request) -> Pending | msg.Refused:
        if full := self._waiting.full():
            return refusal(now, request, full)
        if isinstance(request, msg.Scan):
            return requests.scan(now, request, self._discovery)
        if isinstance(request, msg.SetId):
            return self._begin_set_id(now, request)
        node = self._by_name.get(subject(request))
        if node is None:
            return refusal(now, request, f"{PROTOCOL} cannot do this, or knows no such motor")
        if isinstance(request, msg.ClearFault):
            self._reported_duplicate.pop(node.address, None)
        running = self._running_beside(node)
        if isinstance(request, msg.Reboot) and node.dialect.boards and running:
            said = f"it restarts its whole board, and {running}, which is armed, may be on it: say idle first"
            return refusal(now, request, said)
        return requests.begin(now, request, node, self._written.setdefault(node.name, {}))

    def _begin_set_id(self, now: Nanos, request: msg.SetId) -> Pending | msg.Refused:
        if self._discovery:
            return requests.set_id(now, request, list(self.nodes.values()), self._serials)
        said = "firmware 0.5.x tells no serial numbers over CAN: set the node id with the vendor's tool"
        return refusal(now, request, said)

    def _running_beside(self, node: Node) -> str:
        """A device of a firmware whose boards have two axes, other than this one, that is armed; or ""."""
        for other in self.nodes.values():
            armed = other.owned or other.armed or other.state == AxisState.CLOSED_LOOP_CONTROL
            if other is not node and other.dialect.boards and armed:
                return other.name
        return ""

    def _resend(self, now: Nanos, events: list[Event]) -> list[Frame]:
        outgoing: list[Frame] = []
        for pending in self._waiting.late(now):
            ended = isinstance(pending.request, msg.Scan)
            events += self._end_scan(now, pending) if ended else [requests.give_up(pending, now)]
        for pending in self._waiting:
            if now >= pending.next:
                frames = requests.frames_of(pending)
                pending.next = now + pending.again
                pending.sent += len(frames)
                outgoing += frames
        return outgoing

    def _end_scan(self, now: Nanos, pending: Pending) -> list[Event]:
        answered = sorted(key for key in pending.found if key[1] is not None)
        nodes = {node for node, _ in answered}
        mute = sorted(node for node, serial in pending.found if serial is None and node not in nodes)
        known = [
            node for node in self.nodes if node not in nodes and self.nodes[node].received_at is not None
        ]
        events: list[Event] = [
            msg.Found(now, PROTOCOL, node & MAX_EXTENDED_NODE, None, self._mute(node))
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
        return min([*times, *self._waiting.due(), self._roll_call])
