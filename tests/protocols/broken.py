"""Plugins that are broken on purpose, at least one for each clause of the contract.

Rules. Each is the plugin `plain`, or `odrive_can`, with one class of it replaced, or with its events or
messages altered by a function; the name is what is wrong. Some of the defects are those of drivers in the
field.
"""

from __future__ import annotations

import math
from array import array
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Any, ClassVar, Literal, TypeAlias, TypeVar

from protocols import messages as msg
from protocols.conformance.bench import DriverWrapper, Messages, data_of
from protocols.frames import CanFrame, Frame
from protocols.messages import Event, Message, Nanos, Obeyed
from protocols.odrive_can import plugin as odrive
from protocols.plain import plugin, table
from protocols.plain.driver import PlainAdapter
from protocols.plain.twin import PlainDecoder, PlainTwin
from protocols.plugin import Device, Plugin
from protocols.toolkit.host import Phase, Report
from protocols.toolkit.motor_driver import MotorDriver, Rx
from protocols.toolkit.serial import Stream
from tests.protocols.odrive_can.parts import OdriveDriver
from tests.protocols.plain.parts import PlainDriver, messages_in, readdressed

Sent: TypeAlias = tuple[Sequence[Event], Sequence[Frame]]


@dataclass(frozen=True, slots=True)
class MotorOptions:
    """Only motors, so that a defect of motors is looked for once."""

    kind: Literal["motor"] = "motor"


@dataclass(frozen=True, slots=True)
class SensorOptions:
    """Only sensors."""

    kind: Literal["sensor"] = "sensor"


motors = replace(plugin, options=MotorOptions, vectors=("tests.protocols", "motors.json"))
sensors = replace(plugin, options=SensorOptions, vectors=None)


# -- registration --------------------------------------------------------------------------------------

BROKEN: list[tuple[Plugin, tuple[str, ...]]] = []
"""The broken plugins, each named after what is wrong, with all the clauses that find it."""
Part = TypeVar("Part", bound=PlainDriver | PlainDecoder | PlainTwin | OdriveDriver)
Change: TypeAlias = Callable[[Any], Any]
"""Alters an event, a command or a request; None: drops it."""


def found_by(*clauses: str) -> Callable[[type[Part]], type[Part]]:
    """Register a plugin with this class in the place of the right one."""

    def register(part: type[Part]) -> type[Part]:
        wrong: Plugin
        if issubclass(part, OdriveDriver):
            wrong = replace(odrive, driver=part)
        elif issubclass(part, PlainDriver):
            wrong = replace(motors, driver=part)
        elif issubclass(part, PlainDecoder):
            wrong = replace(motors, decoder=part)
        else:
            wrong = replace(motors, twin=part)
        BROKEN.append((replace(wrong, name=part.__name__), clauses))
        return part

    return register


@dataclass(slots=True)
class _Altering(DriverWrapper):
    """A right driver, whose events and messages are altered."""

    change: Change

    def receive(self, t: Nanos, frame: Frame) -> Sequence[Event]:
        return self._altered(self.driver.receive(t, frame))

    def send(self, now: Nanos, messages: Messages) -> Sent:
        events, frames = self.driver.send(now, self._altered(messages))
        return self._altered(events), frames

    def _altered(self, messages: Sequence[Any]) -> list[Any]:
        return [altered for each in messages if (altered := self.change(each)) is not None]


def alters(*clauses: str, base: Plugin = motors) -> Callable[[Change], Change]:
    """Register a plugin whose driver reports events and sends messages as this function alters them."""

    def register(change: Change) -> Change:
        wrong = replace(base, name=change.__name__, driver=lambda each: _Altering(base.driver(each), change))
        BROKEN.append((wrong, clauses))
        return change

    return register


# -- commands ------------------------------------------------------------------------------------------


@alters("commands")
def rounds_velocity(message: Message) -> Message:
    """To thousandths, while the spec promises full resolution."""
    if isinstance(message, msg.Velocity) and math.isfinite(message.velocity):
        return replace(message, velocity=round(message.velocity, 3))
    return message


@alters("commands")
def wraps_feed_forward(message: Message) -> Message:
    """A feed-forward of int8 thousandths where there is room for more: above 0.127 it wraps."""
    if isinstance(message, msg.Position) and abs(message.torque) <= 1e4:
        return replace(message, torque=((round(message.torque * 1000) + 128) % 256 - 128) / 1000)
    return message


@found_by("commands")
class MixesUpMotors(PlainDriver):
    """The commands of two motors in one step are sent in one order to sorted addresses."""

    def send(self, now: Nanos, messages: Messages) -> Sent:
        events, frames = super().send(now, messages)
        if len(messages) == len(frames) == 2 and all(isinstance(m, msg.Velocity) for m in messages):
            (one, other) = (messages_in(each)[0] for each in frames)
            frames = [readdressed(other, one[table.ADDRESS]), readdressed(one, other[table.ADDRESS])]
        return events, frames


@alters("commands", "jump", "disarm", "dropped")
def forgets_idle(message: Message) -> Message | None:
    """Never disarms."""
    return None if isinstance(message, msg.Idle) else message


# -- measurements --------------------------------------------------------------------------------------


@found_by("measurements")
class WholeUnits(PlainTwin):
    """The twin measures whole thousandths of a radian (an integer division in the field)."""

    def step(self, now: Nanos, truth: Sequence[Event]) -> tuple[Sequence[msg.Torque], Sequence[Frame]]:
        whole = [
            replace(e, position=math.floor(e.position * 1000) / 1000)
            if isinstance(e, msg.Feedback) and e.position is not None and math.isfinite(e.position)
            else e
            for e in truth
        ]
        return super().step(now, whole)


@alters("measurements")
def from_the_future(event: Message) -> Message:
    """Stamps feedback with a time that has not come."""
    return replace(event, t=event.t + 1) if isinstance(event, msg.Feedback) else event


@alters("measurements", "jump", "disarm", "watchdog", "offline", "faults", "attach")
def names_the_other(event: Message) -> Message:
    """Reports alpha's measurements as beta's and the other way round."""
    swap = {"alpha": "beta", "beta": "alpha"}
    return (
        replace(event, motor=swap.get(event.motor, event.motor)) if isinstance(event, msg.Feedback) else event
    )


@alters("measurements", base=sensors)
def single_ranges(event: Message) -> Message:
    """Ranges of a scan lose what a float32 cannot hold."""
    if isinstance(event, msg.LaserScan):
        return replace(event, ranges=tuple(array("f", event.ranges)))
    return event


# -- bytes ---------------------------------------------------------------------------------------------


@found_by("bytes", "streams", "finite")
class Raises(PlainDriver):
    """Takes a certain byte for granted."""

    def receive(self, t: Nanos, frame: Frame) -> Sequence[Event]:
        if isinstance(frame, bytes) and frame[:1] not in (b"\xa5", b""):
            raise IndexError(frame[0])
        return super().receive(t, frame)


@found_by("bytes", "obeyed")
class DecoderRaises(PlainDecoder):
    """The decoder expects bytes and gets a frame."""

    def decode(self, t: Nanos, frame: Frame) -> Sequence[Obeyed]:
        if isinstance(frame, CanFrame):
            raise TypeError("bytes expected")
        return super().decode(t, frame)


@found_by("bytes")
class TakesAWholeHeartbeat(OdriveDriver):
    """Takes a heartbeat with an error of one firmware for whole, before it knows the firmware."""

    def receive(self, t: Nanos, frame: Frame) -> Sequence[Event]:
        host = self.at.get(frame.id >> 5) if isinstance(frame, CanFrame) and frame.id & 0x1F == 1 else None
        if host is not None and not host.own.identity.dialect.line and data_of(frame)[2:3] == b"\4":
            data_of(frame)[7]
        return super().receive(t, frame)


@found_by("bytes")
class DecoderFillsUp(PlainDecoder):
    """The decoder keeps what it does not understand, and has room for twenty."""

    def __init__(self, devices: Sequence[Device]) -> None:
        super().__init__(devices)
        self._kept: list[CanFrame] = []

    def decode(self, t: Nanos, frame: Frame) -> Sequence[Obeyed]:
        if isinstance(frame, CanFrame):
            self._kept.append(frame)
            if len(self._kept) > 20:
                raise OverflowError("no room")
        return super().decode(t, frame)


@found_by("bytes")
class KnowsFivePhases(PlainDriver):
    """Looks up what to do by a device's phase, in a table of those that it was tried in."""

    def receive(self, t: Nanos, frame: Frame) -> Sequence[Event]:
        tried = dict.fromkeys((Phase.FREE, Phase.ARMING, Phase.ARMED, Phase.RELEASING, Phase.FAULT))
        for message in messages_in(frame):
            host = self.at.get(message[table.ADDRESS])
            if host is not None and host.once_commanded:
                tried[host.phase]
        return super().receive(t, frame)


@found_by("bytes")
class TwinRunsInFault(PlainTwin):
    """Takes for granted that what sends commands to the device has seen its fault."""

    def receive(self, t: Nanos, frame: Frame) -> None:
        if self.fault and messages_in(frame):
            raise RuntimeError("a command in fault")
        super().receive(t, frame)


@found_by("counts")
class CountsDouble(PlainDriver):
    """A message with a wrong CRC is counted as malformed, and its bytes once more as ignored."""

    def receive(self, t: Nanos, frame: Frame) -> Sequence[Event]:
        before = self.counters.malformed
        events = super().receive(t, frame)
        self.counters.ignored += self.counters.malformed - before
        return events


class _Credulous(PlainAdapter):
    def __init__(self) -> None:
        sized = table.FRAMING.body
        whole = replace(table.FRAMING, body=lambda head: (sized(head) or -4) + 4 or None, checksum_size=0)
        self._stream = Stream(replace(whole, checksum=lambda _: 0))

    def _report(self, t: Nanos, message: bytes, driver: MotorDriver[set[int]]) -> Report[set[int]] | Rx:
        return super()._report(t, message[:-4], driver)


@found_by("counts")
class BelievesBadBytes(PlainDriver):
    """Does not check the CRC."""

    adapted = _Credulous


@found_by("counts", "streams")
class LosesTheNext(PlainDriver):
    """After a malformed message it discards all it has."""

    def receive(self, t: Nanos, frame: Frame) -> Sequence[Event]:
        before = self.counters.malformed
        events = super().receive(t, frame)
        if self.counters.malformed > before:
            self.adapter.interrupted()
            events = list(events)[: len(events) // 2]
        return events


@found_by("streams")
class NeedsWholeMessages(PlainDriver):
    """Reads each piece of the stream as if it began with a message."""

    def receive(self, t: Nanos, frame: Frame) -> Sequence[Event]:
        events = super().receive(t, frame)
        self.adapter.interrupted()
        return events


@found_by("streams")
class DecoderNeedsWholeMessages(PlainDecoder):
    """The same, in the decoder."""

    def decode(self, t: Nanos, frame: Frame) -> Sequence[Obeyed]:
        messages = super().decode(t, frame)
        self._stream.drop()
        return messages


# -- passivity -----------------------------------------------------------------------------------------


class _Hospitable(PlainAdapter):
    def _report(self, t: Nanos, message: bytes, driver: MotorDriver[set[int]]) -> Report[set[int]] | Rx:
        if message[table.ADDRESS] not in driver.at and len(message) > 26:
            message = readdressed(message, min(driver.at))[:-4]
        return super()._report(t, message, driver)


@found_by("foreign")
class AcceptsForeignFeedback(PlainDriver):
    """Takes any device's feedback for its first motor's."""

    adapted = _Hospitable


@found_by("foreign")
class ObeysForeignCommands(PlainTwin):
    """The device does not check the address."""

    def receive(self, t: Nanos, frame: Frame) -> None:
        super().receive(t, frame)
        for message in messages_in(frame):
            if message[table.ADDRESS] > 2:
                super().receive(t, readdressed(message, self.address))


@found_by("passive", "faults", "scan")
class ClearsFaultsUnasked(PlainDriver):
    """Begins with clearing faults, so that they are never reported."""

    def __init__(self, devices: Sequence[Device]) -> None:
        super().__init__(devices)
        self.begun = False

    def send(self, now: Nanos, messages: Messages) -> Sent:
        begun, self.begun = self.begun, True
        clear = [] if begun else [msg.ClearFault(name) for name in self.hosts]
        return super().send(now, [*clear, *messages])


@found_by("passive", "scan")
class AlwaysIdles(PlainDriver):
    """Sends Idle to devices that it never armed: a running device drops its load."""

    def send(self, now: Nanos, messages: Messages) -> Sent:
        for host in self.hosts.values():
            if not host.once_commanded:
                host.own_unasked()
                host.on_idle(now)
        return super().send(now, messages)


@found_by("declared")
class SendsEmptyFrames(PlainDriver):
    """Sends frames without bytes: harmless, and not in the spec."""

    def send(self, now: Nanos, messages: Messages) -> Sent:
        events, frames = super().send(now, messages)
        return events, [*frames, b""]


@found_by("declared")
class TwinSendsCan(PlainTwin):
    """A device on a serial bus that also sends CAN frames."""

    def step(self, now: Nanos, truth: Sequence[Event]) -> tuple[Sequence[msg.Torque], Sequence[Frame]]:
        torques, frames = super().step(now, truth)
        return torques, [*frames, CanFrame(1)] if len(frames) > 1 else frames


@alters("finite")
def clamps_nan(message: Message) -> Message:
    """Clamps instead of refusing, and so makes full speed of NaN: max(-5, min(5, nan)) is 5."""
    if isinstance(message, msg.Velocity):
        return replace(message, velocity=max(-1e5, min(1e5, message.velocity)))
    return message


@alters("finite")
def reports_nan(event: Message) -> Message:
    """Reports something that is not finite for what was not measured."""
    return replace(event, temperature=math.nan) if isinstance(event, msg.Feedback) else event


# -- state ---------------------------------------------------------------------------------------------


@found_by("repeatable")
class SharesState(PlainDriver):
    """Keeps its part of the stream in a place that all drivers share."""

    shared = Stream(table.FRAMING)

    def __init__(self, devices: Sequence[Device]) -> None:
        super().__init__(devices)
        self.read_from(self.shared)


@found_by("counts", "foreign", "repeatable", "copies")
class CountsDrivers(PlainDriver):
    """Every second driver that is made reports another current."""

    made = 0

    def __init__(self, devices: Sequence[Device]) -> None:
        super().__init__(devices)
        type(self).made += 1
        self.odd = type(self).made % 2

    def receive(self, t: Nanos, frame: Frame) -> Sequence[Event]:
        events = super().receive(t, frame)
        return [replace(e, current=1.0) if self.odd and isinstance(e, msg.Feedback) else e for e in events]


@found_by("copies")
class HoldsAGenerator(PlainDriver):
    """Its state is a generator, which nothing can copy."""

    def __init__(self, devices: Sequence[Device]) -> None:
        super().__init__(devices)
        self.numbers = iter(_ones())


def _ones() -> Iterator[int]:
    while True:
        yield 1


@found_by("copies")
class HidesState(PlainDriver):
    """Its state hides in a closure, which a copy shares with the original."""

    def __init__(self, devices: Sequence[Device]) -> None:
        super().__init__(devices)
        hidden = [0]

        def number() -> float:
            hidden[0] += 1
            return float(hidden[0])

        self.number = number

    def send(self, now: Nanos, messages: Messages) -> Sent:
        """Add a request to every hundredth call."""
        ask = [msg.ReadParameter("alpha", "supply")] if self.number() % 100 == 0 else []
        return super().send(now, [*messages, *ask])


@found_by("copies")
class TwinSharesState(PlainTwin):
    """All devices share one list of pending answers."""

    shared: ClassVar[list[tuple[Nanos, Frame]]] = []

    def receive(self, t: Nanos, frame: Frame) -> None:
        super().receive(t, frame)
        self.share()

    def step(self, now: Nanos, truth: Sequence[Event]) -> tuple[Sequence[msg.Torque], Sequence[Frame]]:
        self._replies, type(self).shared = list(type(self).shared), []
        stepped = super().step(now, truth)
        self.share()
        return stepped

    def share(self) -> None:
        type(self).shared += self._replies
        self._replies = []


# -- on CAN --------------------------------------------------------------------------------------------


@found_by("counts", "foreign")
class IgnoresFormat(OdriveDriver):
    """Takes a 29-bit id for the 11-bit id of the same number."""

    def receive(self, t: Nanos, frame: Frame) -> Sequence[Event]:
        return super().receive(t, replace(frame, extended=False) if isinstance(frame, CanFrame) else frame)


@found_by("counts")
class PadsShortFrames(OdriveDriver):
    """Reads on where a frame has ended."""

    def receive(self, t: Nanos, frame: Frame) -> Sequence[Event]:
        if isinstance(frame, CanFrame) and frame.data:
            frame = replace(frame, data=frame.data.ljust(8, b"\0"))
        return super().receive(t, frame)


@found_by("counts", "foreign")
class IgnoresWithoutCounting(OdriveDriver):
    """Drops foreign frames and does not count them."""

    def receive(self, t: Nanos, frame: Frame) -> Sequence[Event]:
        ignored = self.counters.ignored
        events = super().receive(t, frame)
        self.counters.ignored = ignored
        return events


@found_by("counts")
class LearnsFromBadFrames(OdriveDriver):
    """A frame of a wrong length reports nothing, but changes what is known of its device."""

    def receive(self, t: Nanos, frame: Frame) -> Sequence[Event]:
        malformed = self.counters.malformed
        events = super().receive(t, frame)
        if self.counters.malformed > malformed:
            for host in self.hosts.values():
                host.forget(t)
        return events


@found_by("passive", "declared", "scan")
class SendsUndeclaredId(OdriveDriver):
    """Sends a frame of an id that the spec does not have."""

    def send(self, now: Nanos, messages: Messages) -> Sent:
        events, frames = super().send(now, messages)
        return events, [*frames, CanFrame(0x7FF, b"hello")] if frames else frames


@found_by("passive", "scan")
class FindsByArming(OdriveDriver):
    """Searches devices by setting their state, as a test in the field does."""

    def send(self, now: Nanos, messages: Messages) -> Sent:
        events, frames = super().send(now, messages)
        arm = CanFrame(min(self.nodes) << 5 | 0x07, b"\1\0\0\0")
        return events, frames if messages or now % 64_000_000 else [*frames, arm]
