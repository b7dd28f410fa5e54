"""Our end of the wire: commands down; feedback, states and faults up.

Rules. Nothing is said to a device before its first command other than Idle (or an operator's Stop). Nothing
is said that was not asked for, so that the device's watchdog is fed by commands alone. A fault is told
once, until the device has left it or the bus has come back. A request ends: done, or refused after `ANSWER`.

FILL IN what the real device needs to be armed, polled and asked. The clauses "unclaimed", "disarm", "faults",
"blind", "twice" and "replies" tell.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from protocols.frames import BusState, Frame
from protocols.messages import (
    MILLISECOND,
    SECOND,
    ClearFault,
    Command,
    Done,
    Event,
    Fault,
    Feedback,
    Found,
    Idle,
    Mode,
    Nanos,
    Refused,
    Request,
    State,
    Stop,
    Velocity,
)
from protocols.plugin import Device, Range, RxCounters
from protocols.request_queue import RejectionFilter, out_of_range, subject

from . import codec
from .codec import NAME, DeviceMode, Order
from .faults import FAULTS
from .framing import COMMAND, STATUS, Reader, message

ANSWER: Nanos = 200 * MILLISECOND
"""How long the device may take to answer a request."""
OFFLINE: Nanos = 100 * MILLISECOND
"""Silence after which a device is called offline."""
RANGES = {
    "Velocity.velocity": Range(-codec.MAX_SPEED, codec.MAX_SPEED, codec.TINY, 2.0**-24),
    "Feedback.velocity": Range(-codec.MAX_TOLD, codec.MAX_TOLD, codec.VELOCITY_UNIT / 2),
    "Feedback.position": Range(-codec.MAX_TURNED, codec.MAX_TURNED, codec.TINY, 2.0**-24),
}
"""FILL IN what it can be told and tells, and how finely. The clauses "commands" and "measurements" tell."""
MODES = {
    DeviceMode.READY: Mode.READY,
    DeviceMode.RUNNING: Mode.ARMED,
    DeviceMode.FAULT: Mode.FAULT,
}


@dataclass(frozen=True, slots=True)
class Options:
    """What our driver should do. FILL IN: typed fields with defaults, or none."""


@dataclass(slots=True)
class _DeviceState:
    """What the driver knows of one device."""

    name: str
    address: int
    owned: bool = False
    received: Nanos | None = None
    """When it last spoke, or when we began to listen."""
    mode: Mode | None = None
    """As it was last told."""
    fault: int = 0
    """The code that was told and still stands."""
    since: Nanos | None = None
    """From when its messages are counted, ..."""
    count: int = 0
    """... and how many there were."""
    clearing: Nanos | None = None
    """When our patience with ClearFault ends."""


class MotorDriver:
    """The driver of all devices of this language on one bus."""

    def __init__(self, devices: Sequence[Device]) -> None:
        self._seats = {device.address: _DeviceState(device.name, device.address) for device in devices}
        self._names = {seat.name: seat for seat in self._seats.values()}
        self.counters = RxCounters()
        self._refusals = RejectionFilter()
        self._reader = Reader(STATUS, tuple(self._seats), self.counters)

    def receive(self, t: Nanos, frame: Frame) -> Sequence[Event]:
        """What the wire says of our devices."""
        events: list[Event] = []
        for address, payload in self._reader.read(frame):
            status = codec.read_status(payload)
            if status is None:
                self.counters.malformed += 1
                continue
            self.counters.accepted += 1
            events += self._handle(t, self._seats[address], status)
        return events

    def bus(self, t: Nanos, state: BusState) -> None:  # noqa: ARG002 -- silence is counted from what was heard
        """A bus that was away has lost what stood on it, and its devices may have restarted."""
        if state in (BusState.GONE, BusState.OFF, BusState.BACK):
            self._reader.drop()
            for seat in self._seats.values():
                seat.fault = 0

    def send(self, now: Nanos, words: Sequence[Command | Request]) -> tuple[Sequence[Event], Sequence[Frame]]:
        """Each word that a device takes becomes one message; the others are refused."""
        events: list[Event] = []
        frames: list[Frame] = []
        for word in words:
            if isinstance(word, Stop):
                for seat in self._seats.values():
                    seat.owned = True
                continue
            reason = self._wrong(word)
            events += self._refusals.handle(now, word, reason)
            frames += [] if reason else self._say(now, word)
        return events + self._impatient(now), frames

    def due(self) -> Nanos | None:
        """When a request has waited, or a device been silent, for too long."""
        seats = self._seats.values()
        answers = [seat.clearing for seat in seats if seat.clearing is not None]
        silences = [s.received + OFFLINE for s in seats if s.received is not None and s.mode != Mode.OFFLINE]
        return min(answers + silences, default=None)

    # -- down ------------------------------------------------------------------------------------------

    def _wrong(self, word: Command | Request) -> str:
        """Why a word must not, or cannot, reach the wire; "" if it may."""
        if subject(word) not in self._names:
            return "no such device here"
        if isinstance(word, Idle | Velocity):
            return out_of_range(word, RANGES)
        return "" if isinstance(word, ClearFault) else "the device cannot do that"

    def _say(self, now: Nanos, word: Command | Request) -> list[Frame]:
        """What a word that may reach the wire puts there."""
        seat = self._names[subject(word)]
        if isinstance(word, Idle) and not seat.owned:
            return []
        order = codec.command(Order.STOP)
        if isinstance(word, Velocity):
            seat.owned, order = True, codec.command(Order.RUN, word.velocity)
        elif isinstance(word, ClearFault):
            seat.clearing, order = now + ANSWER, codec.command(Order.CLEAR)
        return [message(COMMAND, seat.address, order)]

    def _impatient(self, now: Nanos) -> list[Event]:
        """What the time has to say: no answer, or silence."""
        events: list[Event] = []
        for seat in self._seats.values():
            if seat.clearing is not None and now >= seat.clearing:
                seat.clearing = None
                events.append(
                    Refused(now, "ClearFault", seat.name, f"no answer in {ANSWER // MILLISECOND} ms")
                )
            seat.received = now if seat.received is None else seat.received
            if seat.mode != Mode.OFFLINE and now - seat.received >= OFFLINE:
                seat.mode = Mode.OFFLINE
                events.append(State(seat.name, now, Mode.OFFLINE, f"silent for {OFFLINE // MILLISECOND} ms"))
        return events

    # -- up --------------------------------------------------------------------------------------------

    def _handle(self, t: Nanos, seat: _DeviceState, status: codec.Status) -> list[Event]:
        events: list[Event] = []
        mode, seat.received = MODES[status.mode], t
        if mode != seat.mode:
            seat.mode = mode
            events.append(State(seat.name, t, mode, status.mode.name.lower()))
        if status.fault and status.fault != seat.fault:
            reported = FAULTS[status.fault]
            events.append(Fault(seat.name, t, status.fault, reported.name, reported.cause, reported.remedy))
        seat.fault = status.fault
        if seat.clearing is not None and not status.fault:
            seat.clearing = None
            events.append(Done(t, "ClearFault", seat.name))
        return [*events, *_twice(t, seat), Feedback(seat.name, t, status.position, status.velocity)]


def _twice(t: Nanos, seat: _DeviceState) -> list[Event]:
    """Twice as many messages as one device sends are two devices'."""
    if seat.since is None or t < seat.since:
        seat.since, seat.count = t, 0
    seat.count += 1
    span = t - seat.since
    if span < SECOND:
        return []
    many = seat.count * codec.STATUS_PERIOD > 1.5 * span
    seat.since, seat.count = t, 0
    said = f"address {seat.address} is held by more than one device: they speak too often for one"
    return [Found(t, NAME, seat.address, None, said, duplicate_address=True)] if many else []
