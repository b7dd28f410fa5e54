"""Our end of a plain line: commands and requests down; feedback, states, faults and measurements up.

Rules. A device's measurements are stamped with the packet's time less the age that the device tells.
An unclaimed motor is told nothing but Scan and ReadParameter; any command but Idle claims it, and it
stays claimed. A fault is told once, until the device has left its fault state. Every request ends:
with the device's answer, or refused after `ANSWER`. What is told by itself is only silence: a motor
not heard for `OFFLINE` is offline.
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
from protocols.request_queue import RejectionFilter

ANSWER: Nanos = 200 * MILLISECOND
"""How long a device may take to answer a request, and how long a scan listens."""
OFFLINE: Nanos = 250 * MILLISECOND
"""Silence after which a motor is called offline."""
Measured: TypeAlias = msg.Imu | msg.LaserScan | msg.Fix
Told: TypeAlias = msg.Feedback | msg.State | msg.Fault | msg.Done | msg.Refused | msg.Parameter
"""What a sensor, and what a motor may say; Found comes from either."""


@dataclass(frozen=True, slots=True)
class Options:
    """What the driver should do."""

    kind: Literal["sensor", "motor"] = "sensor"
    """What the device is: it decides which words it is asked for and believed."""


@dataclass(slots=True)
class _DeviceState:
    """What the driver knows of one device."""

    name: str
    motor: bool
    owned: bool = False
    received: Nanos | None = None
    """When it last spoke, or when we began to listen."""
    offline: bool = False
    faults: list[int] = field(default_factory=list)
    """Codes already told, until the device has left its fault state."""
    asked: dict[str, Nanos] = field(default_factory=dict)
    """Requests without an answer yet, by class name: when patience ends."""


class PlainDriver:
    """The driver of all plain devices on one serial line."""

    def __init__(self, devices: Sequence[Device]) -> None:
        self.counters = RxCounters()
        self._stream = codec.Stream()
        self._seats = {d.address: _DeviceState(d.name, d.options.kind == "motor") for d in devices}
        self._addresses = {d.name: d.address for d in devices}
        self._refusals = RejectionFilter()
        self._line: list[tuple[Nanos, msg.Scan | msg.SetId]] = []
        """Requests to the whole line: when they end."""
        self._serials: dict[int, int] = {}
        """Serial numbers found since the last scan, by address."""

    def receive(self, t: Nanos, frame: Frame) -> Sequence[Event]:
        """The events in the messages that are complete with these bytes."""
        if not isinstance(frame, bytes):
            self.counters.ignored += 1
            return []
        stream = self._stream
        bad, noise = stream.bad, stream.noise
        events = [event for body in stream.feed(frame) for event in self._handle(t, body)]
        self.counters.malformed += stream.bad - bad
        self.counters.ignored += stream.noise - noise
        return events

    def bus(self, t: Nanos, state: BusState) -> None:  # noqa: ARG002 -- silence is counted from what was heard
        """A line that was away has lost the rest of a message, and its devices may have restarted."""
        if state in (BusState.GONE, BusState.OFF, BusState.BACK):
            self._stream.drop()
            for seat in self._seats.values():
                seat.faults.clear()

    def send(self, now: Nanos, words: Sequence[Command | Request]) -> tuple[Sequence[Event], Sequence[Frame]]:
        """Each word that its device takes becomes one message; the others are refused."""
        events: list[Event] = []
        frames: list[Frame] = []
        for word in words:
            if isinstance(word, msg.Stop):
                for seat in self._seats.values():
                    seat.owned = seat.motor
                continue
            frame, reason = self._message(now, word)
            events += self._refusals.handle(now, word, reason)
            frames += frame
        return events + self._impatient(now), frames

    def due(self) -> Nanos | None:
        """When a request has waited, or a motor been silent, for too long."""
        moments = [end for end, _ in self._line]
        for seat in self._seats.values():
            moments += seat.asked.values()
            if seat.motor and seat.received is not None and not seat.offline:
                moments.append(seat.received + OFFLINE)
        return min(moments, default=None)

    # -- down ------------------------------------------------------------------------------------------

    def _message(self, now: Nanos, word: Command | Request) -> tuple[list[Frame], str]:
        """What goes out for a word, and why it is refused, "" if it is not."""
        try:
            address = self._address(word)
            frame = codec.message(address, word)
        except ValueError as error:
            return [], str(error)
        return [frame] if self._say(now, address, word) else [], ""

    def _address(self, word: Command | Request) -> int:
        """The address that a word goes to. ValueError: it can go to none."""
        if isinstance(word, codec.LineRequest):
            return codec.EVERYONE
        if not isinstance(word, Command | codec.MotorRequest):
            raise ValueError("a plain device cannot do that")  # noqa: TRY004 -- a right word, wrong device
        address = self._addresses.get(word.motor)
        if address is None or not self._seats[address].motor:
            raise ValueError(f"no motor {word.motor!r} on this line")
        return address

    def _say(self, now: Nanos, address: int, word: Command | Request) -> bool:
        """Whether this word goes out; and remember that it did."""
        if isinstance(word, codec.LineRequest):
            self._line.append((now + ANSWER, word))
            self._serials = {} if isinstance(word, msg.Scan) else self._serials
            return True
        seat = self._seats[address]
        if isinstance(word, msg.Idle):
            return seat.owned
        if isinstance(word, codec.MotorRequest):
            seat.asked[type(word).__name__] = now + ANSWER
        else:
            seat.owned = True
        return True

    def _impatient(self, now: Nanos) -> list[Event]:
        events: list[Event] = []
        for seat in self._seats.values():
            late = [request for request, end in seat.asked.items() if end <= now]
            for request in late:
                del seat.asked[request]
                events.append(
                    msg.Refused(now, request, seat.name, f"no answer in {ANSWER // MILLISECOND} ms")
                )
            seat.received = now if seat.received is None else seat.received
            if seat.motor and not seat.offline and now - seat.received >= OFFLINE:
                seat.offline = True
                events.append(
                    msg.State(seat.name, now, Mode.OFFLINE, f"silent for {OFFLINE // MILLISECOND} ms")
                )
        ended = [word for end, word in self._line if end <= now]
        self._line = [(end, word) for end, word in self._line if end > now]
        for word in ended:
            if isinstance(word, msg.Scan):
                events.append(msg.Done(now, "Scan", word.bus, f"{len(self._serials)} found"))
            else:
                events.append(
                    msg.Refused(now, "SetId", word.bus, f"no device has serial number {word.serial}")
                )
        return events

    # -- up --------------------------------------------------------------------------------------------

    def _handle(self, t: Nanos, body: bytes) -> Sequence[Event]:
        seat = self._seats.get(body[0])
        word = codec.read(body, t, seat.name if seat else "")
        if isinstance(word, msg.Found) and word.protocol == codec.NAME and word.address == body[0]:
            self.counters.accepted += 1
            return self._found(word)
        # A command on the way up is somebody's echo (RS-485), a stranger's message is not for us.
        if seat is None or isinstance(word, Command | Request):
            self.counters.ignored += 1
            return []
        if not isinstance(word, Told if seat.motor else Measured):
            self.counters.malformed += 1
            return []
        self.counters.accepted += 1
        seat.received, seat.offline = t, False
        return [word] if self._news(seat, word) else []

    def _news(self, seat: _DeviceState, word: Event) -> bool:
        """Remember what the device says; whether it says anything new."""
        if isinstance(word, msg.Done | msg.Refused):
            seat.asked.pop(word.request, None)
        elif isinstance(word, msg.Parameter):
            seat.asked.pop("ReadParameter", None)
        elif isinstance(word, msg.State) and word.mode != Mode.FAULT:
            seat.faults.clear()
        elif isinstance(word, msg.Fault):
            if word.code in seat.faults:
                return False
            seat.faults.append(word.code)
        return True

    def _found(self, word: msg.Found) -> Sequence[Event]:
        """A device answered to Scan or SetId. Two serial numbers at one address are told."""
        before = self._serials.get(word.address, word.serial)
        if before != word.serial:
            said = f"{word.detail}; address {word.address} is also held by {before}"
            word = replace(word, detail=said, duplicate_address=True)
        if word.serial is not None:
            self._serials[word.address] = word.serial
        events: list[Event] = [word]
        for end, asked in self._line:
            if isinstance(asked, msg.SetId) and (asked.serial, asked.address) == (word.serial, word.address):
                self._line.remove((end, asked))
                events.append(
                    msg.Done(word.t, "SetId", asked.bus, f"{asked.serial} is now at {asked.address}")
                )
                break
        return events
