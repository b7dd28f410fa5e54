"""The host's end: commands and requests out; feedback, states and faults in.

Rules. A device is sent nothing before its first command other than Idle (or an operator's Stop). The driver
sends nothing by itself, so that the device's watchdog is fed by commands alone. A fault is reported once,
until the device has left it or the bus has come back. A request ends: done, or refused after `ANSWER`.

FILL IN what arms the real device, what is polled, which requests it has. The clauses "passive", "disarm",
"faults", "offline", "duplicates" and "replies" check it.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from protocols import messages as msg
from protocols.frames import BusState, Frame
from protocols.messages import MILLISECOND, SECOND, Command, Event, Mode, Nanos, Request
from protocols.plugin import Device, Range, RxCounters
from protocols.toolkit.requests import RejectionFilter, out_of_range, subject

from . import codec
from .codec import NAME, DeviceMode, Order
from .faults import FAULTS
from .framing import COMMAND, STATUS, Reader, make_frame

ANSWER: Nanos = 200 * MILLISECOND
"""Timeout of a request."""
OFFLINE: Nanos = 100 * MILLISECOND
"""Time without a message after which a device is offline."""
RANGES = {
    "Velocity.velocity": Range(-codec.MAX_SPEED, codec.MAX_SPEED, codec.TINY, 2.0**-24),
    "Feedback.velocity": Range(-codec.MAX_MEASURED_SPEED, codec.MAX_MEASURED_SPEED, codec.VELOCITY_UNIT / 2),
    "Feedback.position": Range(-codec.MAX_POSITION, codec.MAX_POSITION, codec.TINY, 2.0**-24),
}
"""FILL IN the ranges and resolutions of commands and feedback. The clauses "commands" and "measurements"
check them."""
FASTEST = codec.MAX_MEASURED_SPEED - codec.VELOCITY_UNIT / 2
"""rad/s: what is not below it is the end of the range."""
MODES = {
    DeviceMode.READY: Mode.READY,
    DeviceMode.RUNNING: Mode.ARMED,
    DeviceMode.FAULT: Mode.FAULT,
}


@dataclass(frozen=True, slots=True)
class Options:
    """Configuration of the driver. FILL IN: typed fields with defaults, or none."""


@dataclass(slots=True)
class _DeviceState:
    """The host's record of one device."""

    name: str
    address: int
    owned: bool = False
    received_at: Nanos | None = None
    """Time of its last message, or when we began to listen."""
    mode: Mode | None = None
    """The mode last reported."""
    fault: int = 0
    """The code that was reported and is still active."""
    count: int = 0
    """How many messages it sent ..."""
    counted_from: Nanos | None = None
    """... since then."""
    clear_deadline: Nanos | None = None
    """Deadline of a pending ClearFault."""


class MotorDriver:
    """The driver of all devices of this protocol on one bus."""

    def __init__(self, devices: Sequence[Device]) -> None:
        self._devices = {device.address: _DeviceState(device.name, device.address) for device in devices}
        self._by_name = {device.name: device for device in self._devices.values()}
        self.counters = RxCounters()
        self._rejections = RejectionFilter()
        self._reader = Reader(STATUS, tuple(self._devices), self.counters)

    def receive(self, t: Nanos, frame: Frame) -> Sequence[Event]:
        """Return the events of our devices in this frame."""
        events: list[Event] = []
        for address, payload in self._reader.read(frame):
            status = codec.decode_status(payload)
            if status is None:
                self.counters.malformed += 1
                continue
            self.counters.accepted += 1
            events += self._on_status(t, self._devices[address], status)
        return events

    def bus(self, t: Nanos, state: BusState) -> None:  # noqa: ARG002 -- timeouts run from the last message
        """Discard a partial message and report faults anew: devices may have restarted with the bus."""
        if state in (BusState.GONE, BusState.OFF, BusState.BACK):
            self._reader.drop()
            for device in self._devices.values():
                device.fault = 0

    def send(
        self, now: Nanos, messages: Sequence[Command | Request]
    ) -> tuple[Sequence[Event], Sequence[Frame]]:
        """Encode each command or request that a device takes; refuse the others."""
        events: list[Event] = []
        frames: list[Frame] = []
        for message in messages:
            if isinstance(message, msg.Stop):
                for device in self._devices.values():
                    device.owned = True
                continue
            reason = self._rejection(message)
            events += self._rejections.filter(now, message, reason)
            frames += [] if reason else self._frames(now, message)
        return events + self._expired(now), frames

    def due(self) -> Nanos | None:
        """Return when the next request times out, or the next device is offline."""
        devices = self._devices.values()
        deadlines = [d.clear_deadline for d in devices if d.clear_deadline is not None]
        received = [d.received_at for d in devices if d.received_at is not None and d.mode != Mode.OFFLINE]
        return min([*deadlines, *(t + OFFLINE for t in received)], default=None)

    # -- sending ---------------------------------------------------------------------------------------

    def _rejection(self, message: Command | Request) -> str:
        """Return why a message must not, or cannot, be sent; "" if it may."""
        if subject(message) not in self._by_name:
            return "no such device here"
        if isinstance(message, msg.Idle | msg.Velocity):
            return out_of_range(message, RANGES)
        return "" if isinstance(message, msg.ClearFault) else "the device cannot do that"

    def _frames(self, now: Nanos, message: Command | Request) -> list[Frame]:
        """Return the frames of a message that may be sent."""
        device = self._by_name[subject(message)]
        if isinstance(message, msg.Idle) and not device.owned:
            return []
        payload = codec.encode_command(Order.STOP)
        if isinstance(message, msg.Velocity):
            device.owned, payload = True, codec.encode_command(Order.RUN, message.velocity)
        elif isinstance(message, msg.ClearFault):
            device.clear_deadline, payload = now + ANSWER, codec.encode_command(Order.CLEAR)
        return [make_frame(COMMAND, device.address, payload)]

    def _expired(self, now: Nanos) -> list[Event]:
        """Return the events of timeouts: a request without an answer, a device offline."""
        events: list[Event] = []
        for device in self._devices.values():
            if device.clear_deadline is not None and now >= device.clear_deadline:
                device.clear_deadline = None
                reason = f"no answer in {ANSWER // MILLISECOND} ms"
                events.append(msg.Refused(now, "ClearFault", device.name, reason))
            device.received_at = now if device.received_at is None else device.received_at
            if device.mode != Mode.OFFLINE and now - device.received_at >= OFFLINE:
                device.mode = Mode.OFFLINE
                detail = f"no message for {OFFLINE // MILLISECOND} ms"
                events.append(msg.State(device.name, now, Mode.OFFLINE, detail))
        return events

    # -- receiving -------------------------------------------------------------------------------------

    def _on_status(self, t: Nanos, device: _DeviceState, status: codec.Status) -> list[Event]:
        events: list[Event] = []
        mode, device.received_at = MODES[status.mode], t
        if mode != device.mode:
            device.mode = mode
            events.append(msg.State(device.name, t, mode, status.mode.name.lower()))
        if status.fault and status.fault != device.fault:
            info = FAULTS[status.fault]
            events.append(msg.Fault(device.name, t, status.fault, info.name, info.cause, info.remedy))
        device.fault = status.fault
        if device.clear_deadline is not None and not status.fault:
            device.clear_deadline = None
            events.append(msg.Done(t, "ClearFault", device.name))
        events += _duplicate_address(t, device)
        # FILL IN (clause "saturated"): at the end of its range a value may as well be beyond it.
        position = status.position if abs(status.position) < codec.MAX_POSITION else None
        velocity = status.velocity if abs(status.velocity) < FASTEST else None
        return [*events, msg.Feedback(device.name, t, position, velocity)]


def _duplicate_address(t: Nanos, device: _DeviceState) -> list[Event]:
    """Detect two devices at one address, which send twice as many messages as one."""
    if device.counted_from is None or t < device.counted_from:
        device.counted_from, device.count = t, 0
    device.count += 1
    span = t - device.counted_from
    if span < SECOND:
        return []
    too_many = device.count * codec.STATUS_PERIOD > 1.5 * span
    device.counted_from, device.count = t, 0
    detail = f"duplicate address {device.address}: more messages than one device sends"
    return [msg.Found(t, NAME, device.address, None, detail, duplicate_address=True)] if too_many else []
