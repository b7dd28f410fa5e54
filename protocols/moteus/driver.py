"""The driver: the host's end of the multiplex protocol, for all moteus controllers of one bus.

Rules. No clock, no bus: time and frames are arguments, what is to be sent is returned. `receive` never raises
and never takes anything from hosts' frames, ours or another's. A device gets one frame a cycle, which
commands and queries at once; nothing waits for a reply, so that one that is lost, late, repeated or out of
order delays nothing. `ControllerState` holds what is known of one device, `Pending` a request; here frames
are distributed to them.
"""

from __future__ import annotations

import struct
from collections.abc import Mapping, Sequence

from protocols import messages as msg
from protocols.frames import BusState, CanFrame, Frame
from protocols.messages import Command, Event, Nanos, Request
from protocols.moteus import requests
from protocols.moteus.codec import BROADCAST, REPLY_BIT, STANDARD_MAX, command_id, make_frame
from protocols.moteus.controller import IDENTIFY_PERIOD, ControllerState
from protocols.moteus.faults import DUPLICATE_ID
from protocols.moteus.options import serial_of
from protocols.moteus.registers import Register
from protocols.moteus.reply import Reply, decode
from protocols.moteus.requests import Pending
from protocols.plugin import Device, Range, RxCounters
from protocols.toolkit.requests import RejectionFilter, RequestQueue, out_of_range, refusal, subject

PROTOCOL = "moteus"
NO_IMPEDANCE = "the device's gains are scaled, not set: it has no impedance in N·m/rad"
UUIDS = (Register.UUID1, Register.UUID2, Register.UUID3, Register.UUID4)


class MoteusDriver:
    """The driver of all moteus controllers of one bus. Plain data."""

    def __init__(self, devices: Sequence[Device], ranges: dict[str, Range]) -> None:
        self.counters = RxCounters()
        controllers = [ControllerState(device.name, device.address, device.options) for device in devices]
        self.controllers = {controller.reply_id: controller for controller in controllers}
        self._by_name = {controller.name: controller for controller in controllers}
        self._ranges = ranges
        self._queue: RequestQueue[Pending] = RequestQueue()
        self._rejections = RejectionFilter()
        self._events: list[Event] = []
        """Events outside `send`, to be reported by the next one."""
        self._reported_duplicate: set[int] = set()
        self._hosts = sorted({(c.options.host_id, c.options.can_prefix) for c in controllers})
        """Our ids and prefixes, for queries to all."""

    # -- receiving ----------------------------------------------------------------------------

    def receive(self, t: Nanos, frame: Frame) -> Sequence[Event]:
        """Return the events in a reply; [] to what is not ours."""
        if not isinstance(frame, CanFrame) or not frame.fd or frame.remote:
            self.counters.ignored += 1
            return []
        if frame.extended != (frame.id > STANDARD_MAX):
            self.counters.ignored += 1
            return []
        controller = self.controllers.get(frame.id)
        if controller is None:
            self.counters.ignored += 1
            return self._unknown_device(t, frame)
        reply = decode(frame.data)
        if reply is None:
            self.counters.malformed += 1
            return []
        self.counters.accepted += 1
        events = controller.handle(t, reply)
        uuid = _uuid(reply.values)
        if uuid is not None:
            events += self._identified(t, controller, uuid)
        events += self._discovered(t, controller.address, reply)
        for pending in self._queue:
            ended = requests.handle(pending, t, reply) if pending.controller is controller else []
            if ended:
                self._queue.end(pending)
                events += ended
        return events

    def _unknown_device(self, t: Nanos, frame: CanFrame) -> list[Event]:
        """Return what a device that the robot file does not know replies to a scan."""
        host = (frame.id & 0x7F, frame.id >> 16)
        if not self._is_searching() or frame.id & (REPLY_BIT | 0x80) or host not in self._hosts:
            return []
        reply = decode(frame.data)
        if reply is None or Register.MODEL_NUMBER in reply.values:  # it replies to another host's query
            return []
        return self._discovered(t, frame.id >> 8 & 0x7F, reply)

    def _is_searching(self) -> bool:
        return any(pending.controller is None for pending in self._queue)

    def _discovered(self, t: Nanos, address: int, reply: Reply) -> list[Event]:
        """Handle a reply to discovery: with a UUID, or with the error that there is none."""
        if not self._is_searching():
            return []
        uuid = _uuid(reply.values) or b""
        if not uuid and not any(error.register in UUIDS for error in reply.errors):
            return []
        events: list[Event] = []
        for pending in self._queue:
            if isinstance(pending.request, msg.Scan):
                events += self._found(t, pending, address, uuid)
            elif uuid and pending.request == msg.SetId(pending.name, serial_of(uuid), address):
                self._queue.end(pending)
                detail = f"not saved yet: write {requests.SAVE} 1 to keep it after power-off"
                events.append(pending.done(t, detail))
        return events

    def _found(self, t: Nanos, pending: Pending, address: int, uuid: bytes) -> list[Event]:
        """Report a device that a scan has not reported yet."""
        if (address, uuid) in pending.found:
            return []
        ours = next((each for each in self.controllers.values() if each.address == address), None)
        parts = [] if ours is None else [f"{ours.name}, {ours.title()}"]
        parts += [f"UUID {_printed(uuid)}"] if uuid else ["it has no UUID: older firmware"]
        duplicate = any(other == address for other, _ in pending.found)
        parts += [f"duplicate id {address}"] if duplicate else []
        detail = pending.found[address, uuid] = "; ".join(parts)
        serial = serial_of(uuid) if uuid else None
        return [msg.Found(t, PROTOCOL, address, serial, detail, duplicate)]

    def _identified(self, t: Nanos, controller: ControllerState, uuid: bytes) -> list[Event]:
        """Record the UUID of a device; report a duplicate id once, until ClearFault."""
        for other in self.controllers.values():  # it may have been given another id
            if other is not controller:
                other.uuids.pop(uuid, None)
        recent = {known: at for known, at in controller.uuids.items() if t - at <= 2 * IDENTIFY_PERIOD}
        controller.uuids = recent | {uuid: t}
        address = controller.address
        if len(controller.uuids) < 2 or address in self._reported_duplicate:
            return []
        self._reported_duplicate.add(address)
        uuids = sorted(controller.uuids)
        printed = " and ".join(map(_printed, uuids))
        detail = f"duplicate id {address}: UUIDs {printed}"
        events: list[Event] = [
            msg.Found(t, PROTOCOL, address, serial_of(each), detail, duplicate_address=True) for each in uuids
        ]
        cause = f"two devices reply to it: UUIDs {printed}"
        remedy = "take one off the bus, or give it another id (SetId with its serial number)"
        name = f"duplicate id {address}"
        return [*events, msg.Fault(controller.name, t, DUPLICATE_ID, name, cause, remedy)]

    # -- the bus ------------------------------------------------------------------------------

    def bus(self, t: Nanos, state: BusState) -> None:
        """Forget what is armed where frames were lost or devices may have restarted."""
        if state is BusState.FULL:
            for controller in self.controllers.values():
                controller.resend()
        if state not in (BusState.GONE, BusState.OFF, BusState.BACK):
            return
        for controller in self.controllers.values():
            controller.forget()
        if state is not BusState.BACK:
            self._events += self._queue.refuse_all(t, f"the bus is {state}")

    # -- sending ------------------------------------------------------------------------------

    def send(
        self, now: Nanos, messages: Sequence[Command | Request]
    ) -> tuple[Sequence[Event], Sequence[Frame]]:
        """Send requests, then commands, then the queries that are due."""
        events, self._events = self._events, []
        frames: list[Frame] = []
        for message in messages:
            if isinstance(message, msg.Stop):
                for controller in self.controllers.values():
                    controller.owned = True
            elif not isinstance(message, Command):
                events += self._queue.add(self._begin(now, message))
        frames += self._send_pending(now, events)
        for message in messages:
            if isinstance(message, Command):
                frames += self._command(now, message, events)
        for controller in self.controllers.values():
            reported, queries = controller.poll(now)
            events += reported
            frames += [make_frame(controller.command_id, data) for data in queries]
        return events, frames

    def _command(self, now: Nanos, command: Command, events: list[Event]) -> list[Frame]:
        controller = self._by_name.get(command.motor)
        if controller is None:
            reason = "no such motor on this bus"
        elif isinstance(command, msg.Impedance):
            reason = NO_IMPEDANCE
        else:
            reason = out_of_range(command, self._ranges)
        events += self._rejections.filter(now, command, reason)
        if controller is None or reason:
            return []
        reported, data = controller.command(now, command)
        events += reported
        return [make_frame(controller.command_id, each) for each in data]

    def _begin(self, now: Nanos, request: Request) -> Pending | msg.Refused:
        if full := self._queue.full():
            return refusal(now, request, full)
        if isinstance(request, msg.Scan):
            return requests.scan(now, request)
        if isinstance(request, msg.SetId):
            controllers = list(self.controllers.values())
            holders = {each.address: set(map(serial_of, each.uuids)) for each in controllers}
            return requests.set_id(now, request, controllers, holders)
        controller = self._by_name.get(subject(request))
        if controller is None:
            return refusal(now, request, f"{PROTOCOL} cannot do this, or knows no such motor")
        if isinstance(request, msg.ClearFault):
            self._reported_duplicate.discard(controller.address)
            controller.uuids.clear()
            controller.identify_at = now
        return requests.begin(now, request, controller)

    def _send_pending(self, now: Nanos, events: list[Event]) -> list[Frame]:
        """End the requests whose deadline has passed; send the others when they are due."""
        frames: list[Frame] = []
        for pending in self._queue.expired(now):
            if isinstance(pending.request, msg.Scan):
                count = len(pending.found)
                events.append(pending.done(now, f"{count} device{'' if count == 1 else 's'}"))
            else:
                events.append(requests.give_up(pending, now))
        for pending in self._queue:
            if now >= pending.next:
                pending.next = now + pending.period
                pending.sent += 1
                for data in requests.data_of(pending, now):
                    frames += [make_frame(identifier, data) for identifier in self._identifiers(pending)]
        return frames

    def _identifiers(self, pending: Pending) -> list[int]:
        """Return whom a request goes to: one device, or all, once for each prefix in use."""
        if pending.controller is not None:
            return [pending.controller.command_id]
        return [command_id(BROADCAST, host, prefix) for host, prefix in self._hosts]

    def due(self) -> Nanos | None:
        """Return when `send` next has something to do by itself."""
        times = [controller.due() for controller in self.controllers.values()]
        return min(times + self._queue.due(), default=None)


def _uuid(values: Mapping[int, float | None]) -> bytes | None:
    """Return the UUID in a reply, if all of it is there and the device is addressable by it."""
    numbers = [values.get(register) for register in UUIDS]
    if any(number is None for number in numbers) or not values.get(Register.UUID_MASK_CAPABLE, 1):
        return None
    return struct.pack("<4I", *(int(number or 0) & 0xFFFFFFFF for number in numbers))


def _printed(uuid: bytes) -> str:
    """Return a UUID as it is printed on the packaging."""
    digits = uuid.hex()
    return "-".join((digits[:8], digits[8:12], digits[12:16], digits[16:20], digits[20:]))
