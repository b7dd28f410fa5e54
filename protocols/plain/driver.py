"""The host's end of a plain line: commands and requests out; feedback, states, faults and measurements in.

Rules. A measurement is stamped with the packet's time less the age that it carries. A motor that was not
commanded yet is sent nothing but requests; any command but Idle makes it owned, and it stays owned. A fault
is reported once, until the device has left its fault state. Every request ends: with the device's answer, or
refused after `ANSWER`. The driver sends nothing by itself, and reports by itself only timeouts: a motor
without a message for `OFFLINE` is offline.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Literal, TypeAlias

from protocols import messages as msg
from protocols.frames import BusState, Frame
from protocols.messages import MILLISECOND, Command, Event, Mode, Nanos, Request
from protocols.plain import codec
from protocols.plugin import Device, RxCounters
from protocols.toolkit.requests import RejectionFilter

ANSWER: Nanos = 200 * MILLISECOND
"""Timeout of a request, and how long a scan collects answers."""
OFFLINE: Nanos = 250 * MILLISECOND
"""Time without a message after which a motor is offline."""
SensorEvent: TypeAlias = msg.Imu | msg.LaserScan | msg.Fix
MotorEvent: TypeAlias = msg.Feedback | msg.State | msg.Fault | msg.Done | msg.Refused | msg.Parameter
"""What a motor may send, and a sensor above; Found comes from either."""


@dataclass(frozen=True, slots=True)
class Options:
    """Configuration of the driver."""

    kind: Literal["sensor", "motor"] = "sensor"
    """What the device is: it decides which messages are sent to it and accepted from it."""


@dataclass(slots=True)
class _DeviceState:
    """The host's record of one device."""

    name: str
    motor: bool
    owned: bool = False
    received_at: Nanos | None = None
    """Time of its last message, or when we began to listen."""
    offline: bool = False
    faults: list[int] = field(default_factory=list)
    """Codes already reported, until the device has left its fault state."""
    pending: dict[str, Nanos] = field(default_factory=dict)
    """Deadlines of the requests without an answer yet, by class name."""


class PlainDriver:
    """The driver of all plain devices on one serial line."""

    def __init__(self, devices: Sequence[Device]) -> None:
        self.counters = RxCounters()
        self._stream = codec.Stream()
        self._devices = {d.address: _DeviceState(d.name, d.options.kind == "motor") for d in devices}
        self._addresses = {d.name: d.address for d in devices}
        self._rejections = RejectionFilter()
        self._broadcasts: list[tuple[Nanos, codec.BroadcastRequest]] = []
        """Deadlines of the requests to all devices."""
        self._serials: dict[int, int] = {}
        """Serial numbers found since the last scan, by address."""

    def receive(self, t: Nanos, frame: Frame) -> Sequence[Event]:
        """Return the events in the messages that these bytes complete."""
        if not isinstance(frame, bytes):
            self.counters.ignored += 1
            return []
        stream = self._stream
        bad, noise = stream.bad, stream.noise
        events = [event for body in stream.feed(frame) for event in self._handle(t, body)]
        self.counters.malformed += stream.bad - bad
        self.counters.ignored += stream.noise - noise
        return events

    def bus(self, t: Nanos, state: BusState) -> None:  # noqa: ARG002 -- timeouts run from the last message
        """Discard a partial message and report faults anew: devices may have restarted with the line."""
        if state in (BusState.GONE, BusState.OFF, BusState.BACK):
            self._stream.drop()
            for device in self._devices.values():
                device.faults.clear()

    def send(
        self, now: Nanos, messages: Sequence[Command | Request]
    ) -> tuple[Sequence[Event], Sequence[Frame]]:
        """Encode each command or request that its device takes; refuse the others."""
        events: list[Event] = []
        frames: list[Frame] = []
        for message in messages:
            if isinstance(message, msg.Stop):
                for device in self._devices.values():
                    device.owned = device.motor
                continue
            reason = ""
            try:
                address = self._address(message)
                frame = codec.encode(address, message)
            except ValueError as error:
                reason = str(error)
            else:
                frames += [frame] if self._note(now, address, message) else []
            events += self._rejections.filter(now, message, reason)
        return events + self._expired(now), frames

    def due(self) -> Nanos | None:
        """Return when the next request times out, or the next motor is offline."""
        times = [deadline for deadline, _ in self._broadcasts]
        for device in self._devices.values():
            times += device.pending.values()
            if device.motor and device.received_at is not None and not device.offline:
                times.append(device.received_at + OFFLINE)
        return min(times, default=None)

    # -- sending ---------------------------------------------------------------------------------------

    def _address(self, message: Command | Request) -> int:
        """Return the address that a message goes to. Raises ValueError if it can go to none."""
        if isinstance(message, codec.BroadcastRequest):
            return codec.BROADCAST
        if not isinstance(message, Command | codec.MotorRequest):
            raise ValueError("a plain device cannot do that")  # noqa: TRY004 -- a valid message, wrong device
        address = self._addresses.get(message.motor)
        if address is None or not self._devices[address].motor:
            raise ValueError(f"no motor {message.motor!r} on this line")
        return address

    def _note(self, now: Nanos, address: int, message: Command | Request) -> bool:
        """Record that a message goes out. Returns False for Idle to a motor that is not owned."""
        if isinstance(message, codec.BroadcastRequest):
            self._broadcasts.append((now + ANSWER, message))
            self._serials = {} if isinstance(message, msg.Scan) else self._serials
            return True
        device = self._devices[address]
        if isinstance(message, msg.Idle):
            return device.owned
        if isinstance(message, codec.MotorRequest):
            device.pending[type(message).__name__] = now + ANSWER
        else:
            device.owned = True
        return True

    def _expired(self, now: Nanos) -> list[Event]:
        """Return the events of timeouts: requests without an answer, motors offline, the end of a scan."""
        events: list[Event] = []
        for device in self._devices.values():
            for kind in [kind for kind, deadline in device.pending.items() if deadline <= now]:
                del device.pending[kind]
                reason = f"no answer in {ANSWER // MILLISECOND} ms"
                events.append(msg.Refused(now, kind, device.name, reason))
            device.received_at = now if device.received_at is None else device.received_at
            if device.motor and not device.offline and now - device.received_at >= OFFLINE:
                device.offline = True
                detail = f"no message for {OFFLINE // MILLISECOND} ms"
                events.append(msg.State(device.name, now, Mode.OFFLINE, detail))
        ended = [request for deadline, request in self._broadcasts if deadline <= now]
        self._broadcasts = [each for each in self._broadcasts if each[0] > now]
        for request in ended:
            if isinstance(request, msg.Scan):
                events.append(msg.Done(now, "Scan", request.bus, f"{len(self._serials)} found"))
            else:
                reason = f"no device has serial number {request.serial}"
                events.append(msg.Refused(now, "SetId", request.bus, reason))
        return events

    # -- receiving -------------------------------------------------------------------------------------

    def _handle(self, t: Nanos, body: bytes) -> Sequence[Event]:
        """Decode and count the body of one message."""
        device = self._devices.get(body[0])
        message = codec.decode(body, t, device.name if device else "")
        if isinstance(message, msg.Found) and message.protocol == codec.NAME and message.address == body[0]:
            self.counters.accepted += 1
            return self._found(message)
        # A command towards the host is an echo (RS-485); an unknown address is not ours.
        if device is None or isinstance(message, Command | Request):
            self.counters.ignored += 1
            return []
        if not isinstance(message, MotorEvent if device.motor else SensorEvent):
            self.counters.malformed += 1
            return []
        self.counters.accepted += 1
        device.received_at, device.offline = t, False
        return [message] if self._is_new(device, message) else []

    def _is_new(self, device: _DeviceState, event: Event) -> bool:
        """Record what a device sent. Returns False for a fault that is reported already."""
        if isinstance(event, msg.Done | msg.Refused):
            device.pending.pop(event.request, None)
        elif isinstance(event, msg.Parameter):
            device.pending.pop("ReadParameter", None)
        elif isinstance(event, msg.State) and event.mode != Mode.FAULT:
            device.faults.clear()
        elif isinstance(event, msg.Fault):
            if event.code in device.faults:
                return False
            device.faults.append(event.code)
        return True

    def _found(self, found: msg.Found) -> Sequence[Event]:
        """Report a device that answered Scan or SetId, and a second serial number at one address."""
        before = self._serials.get(found.address, found.serial)
        if before != found.serial:
            detail = f"{found.detail}; address {found.address} is also held by {before}"
            found = replace(found, detail=detail, duplicate_address=True)
        if found.serial is not None:
            self._serials[found.address] = found.serial
        for deadline, request in self._broadcasts:
            if isinstance(request, msg.SetId) and (request.serial, request.address) == (
                found.serial,
                found.address,
            ):
                self._broadcasts.remove((deadline, request))
                detail = f"{request.serial} is now at {request.address}"
                return [found, msg.Done(found.t, "SetId", request.bus, detail)]
        return [found]
