"""The driver: the host's end of CANSimple, for all ODrives of one bus, of firmware 0.5.x and 0.6.x side by
side.

Rules. No clock, no bus: time and frames are arguments, what is to be sent is returned. `receive` never raises
and learns nothing from a host's frames (ours or another's). `HostAxis` holds what is known of one device,
`OdriveRequest` a request under way; this file dispatches the frames.
"""

from __future__ import annotations

from collections.abc import Sequence

from protocols import messages as msg
from protocols.frames import BusState, CanFrame, Frame
from protocols.messages import SECOND, Command, Event, Nanos, Request
from protocols.odrive_can import messages as m
from protocols.odrive_can import requests
from protocols.odrive_can.codec import (
    BROADCAST,
    EXTENDED,
    MAX_EXTENDED_NODE,
    TABLES,
    cmd_of,
    decode_from_device,
    encode,
    node_of,
    remote_frame,
)
from protocols.odrive_can.dialect import status_of
from protocols.odrive_can.duplicate_address import duplicate_events
from protocols.odrive_can.host_axis import HostAxis
from protocols.odrive_can.requests import DISCOVERY, OdriveRequest
from protocols.plugin import Device, Range, RxCounters
from protocols.toolkit.requests import RejectionFilter, RequestQueue, out_of_range, refusal, subject

PROTOCOL = "odrive_can"
NO_IMPEDANCE = "the device has no impedance control"
DISCOVERY_PERIOD = 5 * SECOND
"""Period in which the serial numbers of all devices are requested, to notice a duplicate node id."""


class OdriveDriver:
    """All ODrives of one bus. Plain data."""

    def __init__(self, devices: Sequence[Device], ranges: dict[str, Range]) -> None:
        self.counters = RxCounters()
        axes = [HostAxis(device.name, device.address, device.options) for device in devices]
        self.axes = {axis.node: axis for axis in axes}
        self._by_name = {axis.name: axis for axis in self.axes.values()}
        self._ranges = ranges
        self._requests: RequestQueue[OdriveRequest] = RequestQueue()
        self._rejections = RejectionFilter()
        self._events: list[Event] = []
        """Events from outside `send`, to be returned by the next one."""
        self._serials: dict[int, dict[int, Nanos]] = {}
        """Serial numbers by node id, and when each was received."""
        self._duplicates: set[int] = set()
        """Nodes reported as duplicate, until their fault is cleared."""
        self._written: dict[str, dict[str, float]] = {}
        """Parameters written to each motor."""
        self._next_discovery: Nanos = 0
        # An axis of 0.5.x would take a remote frame of Address for Set_Axis_Node_ID, were its node id 63.
        self._discovery = any(axis.options.firmware != "0.5" for axis in axes)

    # -- received frames ----------------------------------------------------------------------

    def receive(self, t: Nanos, frame: Frame) -> Sequence[Event]:
        """Decode a frame; [] for foreign frames."""
        if not isinstance(frame, CanFrame) or frame.fd or frame.remote or not frame.data:
            self.counters.ignored += 1
            return []
        node = node_of(frame)
        axis = self.axes.get(node)
        line = axis.identity.decoded_as if axis is not None else ""
        row = TABLES[line].from_device.get(frame.id & 0x1F)
        if row is None or not (axis is not None or row.message is m.Address):
            self.counters.ignored += 1
            self._on_unknown_node(t, node, frame)
            return []
        if row.message is m.Address and frame.data[0] != node:
            # A node id assigned by a host differs in its first byte from the reply of a device without one.
            self.counters.ignored += 1
            return []
        message = decode_from_device(frame, line)
        if message is None:
            self.counters.malformed += 1
            return []
        if isinstance(message, m.UnidentifiedHeartbeat) and axis is not None:
            line = axis.identity.on_unidentified_heartbeat(message)
            message = decode_from_device(frame, line) or message
        self.counters.accepted += 1
        if isinstance(message, m.Address):
            return self._on_address(t, message)
        return self._on_message(t, axis, message) if axis is not None else []

    def _on_message(self, t: Nanos, axis: HostAxis, message: m.Message) -> list[Event]:
        events = axis.on_message(t, message)
        if axis.two_positions or (status_of(message) is not None and axis.alternating()):
            signal = "positions" if axis.two_positions else "heartbeats"
            events += self._on_contradiction(t, axis, f"its {signal} contradict each other in turn")
        for pending in self._requests:
            ended = requests.on_message(pending, t, message) if pending.axis is axis else []
            if ended:
                self._requests.end(pending)
                events += ended
        return events

    def _on_contradiction(self, t: Nanos, axis: HostAxis, cause: str) -> list[Event]:
        if axis.node in self._duplicates:
            return []
        self._duplicates.add(axis.node)
        self._next_discovery = t
        return duplicate_events(t, PROTOCOL, axis.node, axis.name, cause)

    def _on_unknown_node(self, t: Nanos, node: int, frame: CanFrame) -> None:
        """During a scan a heartbeat of an unknown node counts as found: 0.5.x answers no discovery."""
        if frame.id & 0x1F != cmd_of(m.UnidentifiedHeartbeat) or decode_from_device(frame, "") is None:
            return
        for pending in self._requests:
            if isinstance(pending.request, msg.Scan):
                pending.found.setdefault((node, None), f"heartbeat received {t}")

    def _on_address(self, t: Nanos, message: m.Address) -> list[Event]:
        """Handle a reply to discovery. A serial number counts for two rounds, at its latest node id."""
        for node, serials in self._serials.items():
            if node != message.node:
                serials.pop(message.serial, None)
        known = self._serials.get(message.node, {})
        current = {serial: at for serial, at in known.items() if t - at <= 2 * DISCOVERY_PERIOD}
        current |= {message.serial: t}
        self._serials[message.node] = current
        axis = self.axes.get(message.node)
        if axis is not None:
            axis.received_at = t
            axis.identity.on_discovery_reply()
        events: list[Event] = []
        if len(current) > 1 and message.node != BROADCAST and message.node not in self._duplicates:
            self._duplicates.add(message.node)
            holders = " and ".join(f"{serial:012X}" for serial in sorted(current))
            cause, motor = f"serial numbers {holders} answer to it", axis.name if axis is not None else ""
            events += duplicate_events(t, PROTOCOL, message.node, motor, cause, sorted(current))
        for pending in self._requests:
            if isinstance(pending.request, msg.Scan):
                events += self._on_found(t, pending, message)
            elif isinstance(pending.request, msg.SetId) and (message.serial, message.node) == (
                pending.request.serial,
                pending.request.address,
            ):
                self._requests.end(pending)
                detail = f"not saved yet: write {requests.SAVE} 1 to keep it after power-off"
                events.append(pending.done(t, detail))
        return events

    def _on_found(self, t: Nanos, pending: OdriveRequest, message: m.Address) -> list[Event]:
        key = (message.node, message.serial)
        if key in pending.found:
            return []
        axis = self.axes.get(message.node)
        detail = "has no node id yet" if message.node == BROADCAST else ""
        if axis is not None:
            detail = f"{axis.name}, {axis.identity.text()}"
        pending.found[key] = detail
        return [msg.Found(t, PROTOCOL, message.node, message.serial, detail)]

    # -- the bus ------------------------------------------------------------------------------

    def bus(self, t: Nanos, state: BusState) -> None:
        """Forget which devices are armed if frames were lost or devices may have restarted."""
        if state is BusState.FULL:
            for axis in self.axes.values():
                axis.resend()
        if state not in (BusState.GONE, BusState.OFF, BusState.BACK):
            return
        for axis in self.axes.values():
            axis.forget()
        self._next_discovery = t
        if state is not BusState.BACK:
            self._events += self._requests.refuse_all(t, f"the bus is {state}")

    # -- sent frames --------------------------------------------------------------------------

    def send(
        self, now: Nanos, messages: Sequence[Command | Request]
    ) -> tuple[Sequence[Event], Sequence[Frame]]:
        """Encode, in this order: requests new and repeated, commands, and the polling that is due."""
        events, self._events = self._events, []
        frames: list[Frame] = []
        for message in messages:
            if isinstance(message, msg.Stop):
                for axis in self.axes.values():
                    axis.owned = True
            elif not isinstance(message, Command):
                events += self._requests.add(self._begin(now, message))
        frames += self._send_requests(now, events)
        for message in messages:
            if isinstance(message, Command):
                frames += self._send_command(now, message, events)
        for axis in self.axes.values():
            reported, cmds = axis.poll(now)
            events += reported
            frames += [remote_frame(axis.node, cmd) for cmd in cmds]
        if now >= self._next_discovery:
            self._next_discovery = now + DISCOVERY_PERIOD
            frames += [DISCOVERY] if self._discovery else []
        return events, frames

    def _send_command(self, now: Nanos, command: Command, events: list[Event]) -> list[Frame]:
        axis = self._by_name.get(command.motor)
        reason = "no such motor on this bus"
        if axis is not None:
            impedance = isinstance(command, msg.Impedance)
            reason = NO_IMPEDANCE if impedance else out_of_range(command, self._ranges)
        events += self._rejections.filter(now, command, reason)
        if axis is None or reason:
            return []
        return [encode(axis.node, message) for message in axis.on_command(now, command)]

    def _begin(self, now: Nanos, request: Request) -> OdriveRequest | msg.Refused:
        if full := self._requests.full():
            return refusal(now, request, full)
        if isinstance(request, msg.Scan):
            return requests.begin_scan(now, request, self._discovery)
        if isinstance(request, msg.SetId):
            if self._discovery:
                return requests.begin_set_id(now, request, list(self.axes.values()), self._serials)
            reason = "firmware 0.5.x reports no serial numbers over CAN"
            return refusal(now, request, f"{reason}: set the node id with the vendor's tool")
        axis = self._by_name.get(subject(request))
        if axis is None:
            return refusal(now, request, f"{PROTOCOL} cannot do this, or knows no such motor")
        if isinstance(request, msg.ClearFault):
            self._duplicates.discard(axis.node)
        running = self._running_beside(axis)
        if isinstance(request, msg.Reboot) and axis.dialect.boards and running:
            reason = f"it restarts its whole board, and {running}, which is armed, may be on it"
            return refusal(now, request, f"{reason}: command idle first")
        return requests.begin(now, request, axis, self._written.setdefault(axis.name, {}))

    def _running_beside(self, axis: HostAxis) -> str:
        """Return another device that is armed and of a firmware whose boards have two axes; or ""."""
        for other in self.axes.values():
            armed = other.owned or other.armed or other.state == m.AxisState.CLOSED_LOOP_CONTROL
            if other is not axis and other.dialect.boards and armed:
                return other.name
        return ""

    def _send_requests(self, now: Nanos, events: list[Event]) -> list[Frame]:
        outgoing: list[Frame] = []
        for pending in self._requests.expired(now):
            scan = isinstance(pending.request, msg.Scan)
            events += self._end_scan(now, pending) if scan else [requests.expire(pending, now)]
        for pending in self._requests:
            if now >= pending.next:
                frames = requests.frames_of(pending)
                pending.next = now + pending.retry_period
                pending.frames_sent += len(frames)
                outgoing += frames
        return outgoing

    def _end_scan(self, now: Nanos, pending: OdriveRequest) -> list[Event]:
        """Report the devices that are online and did not answer discovery."""
        answered = [node for node, serial in pending.found if serial is not None]
        silent = {node for node, serial in pending.found if serial is None}
        silent |= {
            node for node, axis in self.axes.items() if axis.received_at is not None and not axis.offline
        }
        events: list[Event] = [
            msg.Found(now, PROTOCOL, node & MAX_EXTENDED_NODE, None, self._without_reply(node))
            for node in sorted(silent - set(answered))
        ]
        return [*events, pending.done(now, f"{len(answered) + len(events)} devices")]

    def _without_reply(self, node: int) -> str:
        """Return what is known of a node that did not answer discovery."""
        axis = self.axes.get(node)
        if axis is not None and axis.identity.line:
            return f"{axis.name}, {axis.identity.text()}"
        ids = ", extended identifiers" if node >= EXTENDED else ""
        return f"sends heartbeats, but did not answer discovery: firmware 0.5.x?{ids}"

    def due(self) -> Nanos | None:
        """Return when `send` must next be called without a message."""
        times = [axis.due() for axis in self.axes.values()]
        return min([*times, *self._requests.due(), self._next_discovery])
