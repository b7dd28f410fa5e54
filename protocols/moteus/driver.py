"""The driver: our end of the multiplex protocol, for all moteus controllers of one bus.

Rules. No clock, no bus: time and frames are arguments, what is to be sent is returned. `receive` never raises
and never learns from hosts' frames, ours or another's. A device gets one frame a cycle, which commands and
asks at once; nothing waits for an answer, so that one that is lost, late, doubled or out of order holds up
nobody. `Node` holds what is known of one device, `Pending` a request under way; here frames are dealt out.
"""

from __future__ import annotations

import struct
from collections.abc import Mapping, Sequence

from protocols import messages as msg
from protocols.frames import BusState, CanFrame, Frame
from protocols.messages import Command, Event, Nanos, Request
from protocols.moteus import requests
from protocols.moteus.codec import BROADCAST, REPLY_BIT, STANDARD_MAX, command_id, framed
from protocols.moteus.faults import HELD_TWICE
from protocols.moteus.node import IDENTIFY_EVERY, Node
from protocols.moteus.options import Options, serial_of
from protocols.moteus.registers import Register
from protocols.moteus.reply import Reply, decode
from protocols.moteus.requests import Pending
from protocols.plugin import Device, Range, RxCounters
from protocols.request_queue import RejectionFilter, RequestQueue, out_of_range, refusal, subject

PROTOCOL = "moteus"
NO_IMPEDANCE = "the device's gains are scaled, not set: it has no impedance in N·m/rad"
UUIDS = (Register.UUID1, Register.UUID2, Register.UUID3, Register.UUID4)


class MoteusDriver:
    """All moteus controllers of one bus. Plain data."""

    def __init__(self, devices: Sequence[Device], ranges: dict[str, Range]) -> None:
        self.counters = RxCounters()
        nodes = [Node(device.name, device.address, device.options) for device in devices]
        self.nodes = {node.tells_at: node for node in nodes}
        self._by_name = {node.name: node for node in nodes}
        self._ranges = ranges
        self._waiting: RequestQueue[Pending] = RequestQueue()
        self._refusals = RejectionFilter()
        self._events: list[Event] = []
        """What happened outside `send`, to be told by the next one."""
        self._reported_duplicate: dict[int, bool] = {}
        options = (device.options for device in devices)
        self._hosts = sorted({(o.host_id, o.can_prefix) for o in options if isinstance(o, Options)})
        """As whom we ask all: (our id, prefix)."""

    # -- hearing ------------------------------------------------------------------------------

    def receive(self, t: Nanos, frame: Frame) -> Sequence[Event]:
        """What a wire says; [] to what is not ours."""
        if not isinstance(frame, CanFrame) or not frame.fd or frame.remote:
            self.counters.ignored += 1
            return []
        if frame.extended != (frame.id > STANDARD_MAX):
            self.counters.ignored += 1
            return []
        node = self.nodes.get(frame.id)
        if node is None:
            self.counters.ignored += 1
            return self._overhear(t, frame)
        reply = decode(frame.data)
        if reply is None:
            self.counters.malformed += 1
            return []
        self.counters.accepted += 1
        events = node.handle(t, reply)
        uuid = _uuid(reply.values)
        if uuid is not None:
            events += self._seen(t, node, uuid)
        events += self._discovered(t, node.address, reply)
        for pending in self._waiting:
            ended = requests.handle(pending, t, reply) if pending.node is node else []
            if ended:
                self._waiting.end(pending)
                events += ended
        return events

    def _overhear(self, t: Nanos, frame: CanFrame) -> list[Event]:
        """During a scan, answers of devices that the robot file does not know."""
        host = (frame.id & 0x7F, frame.id >> 16)
        if not self._searching() or frame.id & (REPLY_BIT | 0x80) or host not in self._hosts:
            return []
        reply = decode(frame.data)
        if reply is None or Register.MODEL_NUMBER in reply.values:  # another host asked it who it is
            return []
        return self._discovered(t, frame.id >> 8 & 0x7F, reply)

    def _searching(self) -> bool:
        return any(pending.node is None for pending in self._waiting)

    def _discovered(self, t: Nanos, address: int, reply: Reply) -> list[Event]:
        """An answer to discovery: with a UUID, or with the complaint that it has none."""
        if not self._searching():
            return []
        uuid = _uuid(reply.values) or b""
        if not uuid and not any(error.register in UUIDS for error in reply.errors):
            return []
        events: list[Event] = []
        for pending in self._waiting:
            if isinstance(pending.request, msg.Scan):
                events += self._found(t, pending, address, uuid)
            elif uuid and pending.request == msg.SetId(pending.name, serial_of(uuid), address):
                self._waiting.end(pending)
                said = f"not saved yet: write {requests.SAVE} 1 to keep it after power-off"
                events.append(pending.done(t, said))
        return events

    def _found(self, t: Nanos, pending: Pending, address: int, uuid: bytes) -> list[Event]:
        if (address, uuid) in pending.found:
            return []
        ours = next((node for node in self.nodes.values() if node.address == address), None)
        said = [] if ours is None else [f"{ours.name}, {ours.title()}"]
        said += [f"UUID {_printed(uuid)}"] if uuid else ["it has no UUID: older firmware"]
        twice = any(other == address for other, _ in pending.found)
        said += [f"id {address} is held twice"] if twice else []
        pending.found[address, uuid] = "; ".join(said)
        serial = serial_of(uuid) if uuid else None
        return [msg.Found(t, PROTOCOL, address, serial, pending.found[address, uuid], twice)]

    def _seen(self, t: Nanos, node: Node, uuid: bytes) -> list[Event]:
        """Who answers as one of our devices; two of them cannot both be it."""
        for other in self.nodes.values():  # it may have been given another id
            if other is not node:
                other.uuids.pop(uuid, None)
        recent = {known: at for known, at in node.uuids.items() if t - at <= 2 * IDENTIFY_EVERY}
        node.uuids = recent | {uuid: t}
        if len(node.uuids) < 2 or self._reported_duplicate.get(node.address):
            return []
        self._reported_duplicate[node.address] = True
        held = sorted(node.uuids)
        said = f"id {node.address} is held twice: by {' and '.join(map(_printed, held))}"
        events: list[Event] = [
            msg.Found(t, PROTOCOL, node.address, serial_of(each), said, True) for each in held
        ]
        cause = f"two devices answer to it: UUIDs {' and '.join(map(_printed, held))}"
        remedy = "take one off the bus, or give it another id (SetId with its serial number)"
        return [
            *events,
            msg.Fault(node.name, t, HELD_TWICE, f"id {node.address} is held twice", cause, remedy),
        ]

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
        if state is not BusState.BACK:
            self._events += self._waiting.drop(t, f"the bus is {state}")

    # -- saying -------------------------------------------------------------------------------

    def send(self, now: Nanos, words: Sequence[Command | Request]) -> tuple[Sequence[Event], Sequence[Frame]]:
        """Say the words, then what falls due: requests, commands, questions."""
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
            reply, asks = node.tend(now)
            events += reply
            frames += [framed(node.asks_at, data) for data in asks]
        return events, frames

    def _command(self, now: Nanos, command: Command, events: list[Event]) -> list[Frame]:
        node = self._by_name.get(command.motor)
        reason = self._wrong(command) if node is not None else "no such motor on this bus"
        events += self._refusals.handle(now, command, reason)
        if node is None or reason:
            return []
        reply, said = node.say(now, command)
        events += reply
        return [framed(node.asks_at, data) for data in said]

    def _wrong(self, command: Command) -> str:
        """Why a command must not reach the wire; "" if it may."""
        return NO_IMPEDANCE if isinstance(command, msg.Impedance) else out_of_range(command, self._ranges)

    def _begin(self, now: Nanos, request: Request) -> Pending | msg.Refused:
        if full := self._waiting.full():
            return refusal(now, request, full)
        if isinstance(request, msg.Scan):
            return requests.scan(now, request)
        if isinstance(request, msg.SetId):
            holders = {n.address: set(map(serial_of, n.uuids)) for n in self.nodes.values()}
            return requests.set_id(now, request, list(self.nodes.values()), holders)
        node = self._by_name.get(subject(request))
        if node is None:
            return refusal(now, request, f"{PROTOCOL} cannot do this, or knows no such motor")
        if isinstance(request, msg.ClearFault):
            self._reported_duplicate.pop(node.address, None)
            node.uuids.clear()
            node.identify_at = now
        return requests.begin(now, request, node)

    def _resend(self, now: Nanos, events: list[Event]) -> list[Frame]:
        frames: list[Frame] = []
        for pending in self._waiting.late(now):
            ended = isinstance(pending.request, msg.Scan)
            events += [self._end_scan(now, pending)] if ended else requests.give_up(pending, now)
        for pending in self._waiting:
            if now >= pending.next:
                pending.next = now + pending.again
                pending.sent += 1
                for data in requests.data_of(pending, now):
                    frames += [framed(identifier, data) for identifier in self._to(pending)]
        return frames

    def _to(self, pending: Pending) -> list[int]:
        """To whom: one device, or all, once for each prefix in use."""
        if pending.node is not None:
            return [pending.node.asks_at]
        return [command_id(BROADCAST, host, prefix) for host, prefix in self._hosts]

    def _end_scan(self, now: Nanos, pending: Pending) -> Event:
        count = len(pending.found)
        return pending.done(now, f"{count} device{'' if count == 1 else 's'}")

    def due(self) -> Nanos | None:
        """When `send` next has something to do by itself."""
        times = [node.due() for node in self.nodes.values()]
        return min(times + self._waiting.due(), default=None)


def _uuid(values: Mapping[int, float | None]) -> bytes | None:
    """The UUID in an answer, if all of it is there and devices can be told apart by it."""
    words = [values.get(register) for register in UUIDS]
    if any(word is None for word in words) or not values.get(Register.UUID_MASK_CAPABLE, 1):
        return None
    return struct.pack("<4I", *(int(word or 0) & 0xFFFFFFFF for word in words))


def _printed(uuid: bytes) -> str:
    """As on the packaging."""
    digits = uuid.hex()
    return "-".join((digits[:8], digits[8:12], digits[12:16], digits[16:20], digits[20:]))
