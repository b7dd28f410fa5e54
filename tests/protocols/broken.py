"""Plugins that are broken on purpose, one for each promise of the contract.

Rules. Each is the plain plugin with one class of it replaced; what is wrong is said by its name. Some of
the defects are those of drivers in the field.
"""

from __future__ import annotations

import math
from array import array
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Any, ClassVar, Literal

from protocols import messages as msg
from protocols.frames import CanFrame, Frame
from protocols.messages import Command, Event, Message, Nanos, Request
from protocols.odrive_can import RANGES
from protocols.odrive_can import plugin as odrive
from protocols.odrive_can.driver import OdriveDriver
from protocols.plain import codec, plugin
from protocols.plain.decoder import PlainDecoder
from protocols.plain.driver import PlainDriver
from protocols.plain.twin import PlainMotor
from protocols.plugin import Device, Plugin

Sent = tuple[Sequence[Event], Sequence[Frame]]


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


# -- commands ------------------------------------------------------------------------------------------


class RoundsVelocity(PlainDriver):
    """To thousandths, while the spec promises everything."""

    def send(self, now: Nanos, words: Sequence[Command | Request]) -> Sent:
        rounded = [
            replace(w, velocity=round(w.velocity, 3))
            if isinstance(w, msg.Velocity) and math.isfinite(w.velocity)
            else w
            for w in words
        ]
        return super().send(now, rounded)


class WrapsFeedForward(PlainDriver):
    """A feed-forward of int8 thousandths where there is room for more: above 0.127 it wraps."""

    def send(self, now: Nanos, words: Sequence[Command | Request]) -> Sent:
        wrapped = [
            replace(w, torque=((round(w.torque * 1000) + 128) % 256 - 128) / 1000)
            if isinstance(w, msg.Position) and abs(w.torque) <= 1e4
            else w
            for w in words
        ]
        return super().send(now, wrapped)


class MixesUpMotors(PlainDriver):
    """What two motors are told in one step goes out in one order to sorted addresses."""

    def send(self, now: Nanos, words: Sequence[Command | Request]) -> Sent:
        events, frames = super().send(now, words)
        if len(words) == len(frames) == 2 and all(isinstance(w, msg.Velocity) for w in words):
            (one, other) = (codec.Stream().feed(each)[0] for each in _bytes(frames))
            frames = [codec.frame(one[:1] + other[1:]), codec.frame(other[:1] + one[1:])]
        return events, frames


class ForgetsIdle(PlainDriver):
    """Never disarms."""

    def send(self, now: Nanos, words: Sequence[Command | Request]) -> Sent:
        return super().send(now, [w for w in words if not isinstance(w, msg.Idle)])


# -- measurements --------------------------------------------------------------------------------------


class WholeUnits(PlainMotor):
    """The twin measures whole thousandths of a radian (an integer division in the field)."""

    def step(self, now: Nanos, truth: Sequence[Event]) -> tuple[Sequence[msg.Torque], Sequence[Frame]]:
        whole = [
            replace(w, position=math.floor(w.position * 1000) / 1000)
            if isinstance(w, msg.Feedback) and w.position is not None and math.isfinite(w.position)
            else w
            for w in truth
        ]
        return super().step(now, whole)


class FromTheFuture(PlainDriver):
    """Stamps what it hears with a time that has not come."""

    def receive(self, t: Nanos, frame: Frame) -> Sequence[Event]:
        return [
            replace(e, t=e.t + 1) if isinstance(e, msg.Feedback) else e for e in super().receive(t, frame)
        ]


class NamesTheOther(PlainDriver):
    """Tells alpha's measurements as beta's and the other way round."""

    def receive(self, t: Nanos, frame: Frame) -> Sequence[Event]:
        swap = {"alpha": "beta", "beta": "alpha"}
        events = super().receive(t, frame)
        return [
            replace(e, motor=swap.get(e.motor, e.motor)) if isinstance(e, msg.Feedback) else e for e in events
        ]


class SingleRanges(PlainDriver):
    """Ranges of a scan lose what a float32 cannot hold."""

    def receive(self, t: Nanos, frame: Frame) -> Sequence[Event]:
        return [_single(e) if isinstance(e, msg.LaserScan) else e for e in super().receive(t, frame)]


def _single(scan: msg.LaserScan) -> msg.LaserScan:
    return replace(scan, ranges=tuple(array("f", scan.ranges)))


# -- bytes ---------------------------------------------------------------------------------------------


class Raises(PlainDriver):
    """Takes a certain byte for granted."""

    def receive(self, t: Nanos, frame: Frame) -> Sequence[Event]:
        if isinstance(frame, bytes) and frame[:1] not in (b"\xa5", b""):
            raise IndexError(frame[0])
        return super().receive(t, frame)


class EarRaises(PlainDecoder):
    """The ear expects bytes and gets a frame."""

    def decode(self, t: Nanos, frame: Frame) -> Sequence[Command | Request]:
        if isinstance(frame, CanFrame):
            raise TypeError("bytes expected")
        return super().decode(t, frame)


class EarFillsUp(PlainDecoder):
    """The ear keeps what it does not understand, and has room for twenty."""

    def __init__(self, devices: Sequence[Device]) -> None:
        super().__init__(devices)
        self._kept: list[CanFrame] = []

    def decode(self, t: Nanos, frame: Frame) -> Sequence[Command | Request]:
        if isinstance(frame, CanFrame):
            self._kept.append(frame)
            if len(self._kept) > 20:
                raise OverflowError("no room")
        return super().decode(t, frame)


class CountsTwice(PlainDriver):
    """A message with a wrong CRC is counted as bad, and its bytes once more as noise."""

    def receive(self, t: Nanos, frame: Frame) -> Sequence[Event]:
        before = self.counters.malformed
        events = super().receive(t, frame)
        self.counters.ignored += self.counters.malformed - before
        return events


class BelievesBadBytes(PlainDriver):
    """Does not look at the CRC."""

    def __init__(self, devices: Sequence[Device]) -> None:
        super().__init__(devices)
        self._stream = _Credulous()


class _Credulous(codec.Stream):
    __slots__ = ()

    def feed(self, data: bytes) -> list[bytes]:
        bodies: list[bytes] = []
        self._held += data
        while True:
            start = self._find(self._held, 0)
            self._held = self._held[start:]
            size = 10 + int.from_bytes(self._held[2:4], "little")
            if len(self._held) < 10 or len(self._held) < size:
                return bodies
            bodies.append(self._held[6 : size - 4])
            self._held = self._held[size:]


class LosesTheNext(PlainDriver):
    """After a bad message it throws away all it has."""

    def receive(self, t: Nanos, frame: Frame) -> Sequence[Event]:
        before = self.counters.malformed
        events = super().receive(t, frame)
        if self.counters.malformed > before:
            self._stream.drop()
            events = list(events)[: len(events) // 2]
        return events


class NeedsWholeMessages(PlainDriver):
    """Reads each piece of the stream as if it began with a message."""

    def receive(self, t: Nanos, frame: Frame) -> Sequence[Event]:
        events = super().receive(t, frame)
        self._stream.drop()
        return events


class EarNeedsWholeMessages(PlainDecoder):
    """The same, in the ear."""

    def decode(self, t: Nanos, frame: Frame) -> Sequence[Command | Request]:
        words = super().decode(t, frame)
        self._stream.drop()
        return words


# -- manners -------------------------------------------------------------------------------------------


class HearsStrangers(PlainDriver):
    """Takes any device's feedback for its first motor's."""

    def _handle(self, t: Nanos, body: bytes) -> Sequence[Event]:
        if body[0] not in self._devices and len(body) > 20:
            body = bytes((min(self._devices),)) + body[1:]
        return super()._handle(t, body)


class ObeysStrangers(PlainMotor):
    """The device does not look at the address."""

    def receive(self, t: Nanos, frame: Frame) -> None:
        bodies = codec.Stream().feed(frame) if isinstance(frame, bytes) else []
        super().receive(t, frame)
        for body in bodies:
            if body[0] > 2:
                super().receive(t, codec.frame(bytes((self._device.address,)) + body[1:]))


class ClearsFaultsUnasked(PlainDriver):
    """Begins with clearing faults, so that nobody learns of them."""

    def __init__(self, devices: Sequence[Device]) -> None:
        super().__init__(devices)
        self.begun = False

    def send(self, now: Nanos, words: Sequence[Command | Request]) -> Sent:
        begun, self.begun = self.begun, True
        clear = [] if begun else [msg.ClearFault(name) for name in self._addresses]
        return super().send(now, [*clear, *words])


class AlwaysIdles(PlainDriver):
    """Sends Idle to whom it never armed: a running device drops its load."""

    def send(self, now: Nanos, words: Sequence[Command | Request]) -> Sent:
        for seat in self._devices.values():
            seat.owned = True
        return super().send(now, words)


class SaysNothing(PlainDriver):
    """Puts wires without bytes on the line: harmless, and not what the spec says."""

    def send(self, now: Nanos, words: Sequence[Command | Request]) -> Sent:
        events, frames = super().send(now, words)
        return events, [*frames, b""]


class TwinSpeaksCan(PlainMotor):
    """A device on a serial line that puts out CAN frames besides."""

    def step(self, now: Nanos, truth: Sequence[Event]) -> tuple[Sequence[msg.Torque], Sequence[Frame]]:
        torques, frames = super().step(now, truth)
        return torques, [*frames, CanFrame(1)] if len(frames) > 1 else frames


def clamps(word: Message) -> Any:
    """NaN is full speed: max(-5, min(5, nan)) is 5."""
    if not isinstance(word, msg.Velocity):
        return word
    return replace(word, velocity=max(-1e5, min(1e5, word.velocity)))


class ClampsNan(PlainDriver):
    """Clamps instead of refusing, and so makes full speed of NaN."""

    def send(self, now: Nanos, words: Sequence[Command | Request]) -> Sent:
        return super().send(now, [clamps(word) for word in words])


class TellsNan(PlainDriver):
    """Tells something that is not finite for what was not measured."""

    def receive(self, t: Nanos, frame: Frame) -> Sequence[Event]:
        events = super().receive(t, frame)
        return [replace(e, temperature=math.nan) if isinstance(e, msg.Feedback) else e for e in events]


# -- state ---------------------------------------------------------------------------------------------


class SharesState(PlainDriver):
    """Keeps what it has heard of the stream where all drivers keep it."""

    shared = codec.Stream()

    def __init__(self, devices: Sequence[Device]) -> None:
        super().__init__(devices)
        self._stream = type(self).shared


class CountsDrivers(PlainDriver):
    """Every second driver that is made tells the current with another sign."""

    made = 0

    def __init__(self, devices: Sequence[Device]) -> None:
        super().__init__(devices)
        type(self).made += 1
        self.odd = type(self).made % 2

    def receive(self, t: Nanos, frame: Frame) -> Sequence[Event]:
        events = super().receive(t, frame)
        return [replace(e, current=1.0) if self.odd and isinstance(e, msg.Feedback) else e for e in events]


class HoldsAGenerator(PlainDriver):
    """Its state is a generator, which nothing can copy."""

    def __init__(self, devices: Sequence[Device]) -> None:
        super().__init__(devices)
        self.numbers = iter(_count())


def _count() -> Iterator[int]:
    while True:
        yield 1


class HidesState(PlainDriver):
    """Its state hides in a closure, which a copy shares with the original."""

    def __init__(self, devices: Sequence[Device]) -> None:
        super().__init__(devices)
        hidden = [0]

        def number() -> float:
            hidden[0] += 1
            return float(hidden[0])

        self.number = number

    def send(self, now: Nanos, words: Sequence[Command | Request]) -> Sent:
        """Every hundredth word of its own is a question."""
        ask = [msg.ReadParameter("alpha", "supply")] if self.number() % 100 == 0 else []
        return super().send(now, [*words, *ask])


class TwinSharesState(PlainMotor):
    """All devices have one set of answers in the making."""

    shared: ClassVar[list[Event]] = []

    def receive(self, t: Nanos, frame: Frame) -> None:
        super().receive(t, frame)
        type(self).shared += self._answers
        self._answers = []

    def step(self, now: Nanos, truth: Sequence[Event]) -> tuple[Sequence[msg.Torque], Sequence[Frame]]:
        self._answers, type(self).shared = list(type(self).shared), []
        return super().step(now, truth)


def _bytes(frames: Sequence[Frame]) -> Iterator[bytes]:
    for frame in frames:
        assert isinstance(frame, bytes)
        yield frame


# -- on CAN --------------------------------------------------------------------------------------------


class IgnoresFormat(OdriveDriver):
    """Takes a 29-bit id for the 11-bit id of the same number."""

    def receive(self, t: Nanos, frame: Frame) -> Sequence[Event]:
        return super().receive(t, replace(frame, extended=False) if isinstance(frame, CanFrame) else frame)


class PadsShortFrames(OdriveDriver):
    """Reads on where a frame has ended."""

    def receive(self, t: Nanos, frame: Frame) -> Sequence[Event]:
        if isinstance(frame, CanFrame) and frame.data:
            frame = replace(frame, data=frame.data.ljust(8, b"\0"))
        return super().receive(t, frame)


class DoesNotCountStrangers(OdriveDriver):
    """Drops what is not its own without a word."""

    def receive(self, t: Nanos, frame: Frame) -> Sequence[Event]:
        foreign = self.counters.ignored
        events = super().receive(t, frame)
        self.counters.ignored = foreign
        return events


class LearnsFromBadFrames(OdriveDriver):
    """A frame of a wrong length tells nothing, but its device counts as heard."""

    def receive(self, t: Nanos, frame: Frame) -> Sequence[Event]:
        bad = self.counters.malformed
        events = super().receive(t, frame)
        if self.counters.malformed > bad:
            for node in self.axes.values():
                node.forget()
        return events


class SaysWhatItDoesNotList(OdriveDriver):
    """A frame of an id that the spec does not have."""

    def send(self, now: Nanos, words: Sequence[Command | Request]) -> Sent:
        events, frames = super().send(now, words)
        return events, [*frames, CanFrame(0x7FF, b"hello")] if frames else frames


class FindsByArming(OdriveDriver):
    """Looks for devices by setting their state, as a test in the field does."""

    def send(self, now: Nanos, words: Sequence[Command | Request]) -> Sent:
        events, frames = super().send(now, words)
        arm = CanFrame(min(self.axes) << 5 | 0x07, b"\1\0\0\0")
        return events, frames if words or now % 64_000_000 else [*frames, arm]


def _can(kind: type[OdriveDriver]) -> Plugin:
    return replace(odrive, name=kind.__name__, driver=lambda devices: kind(devices, RANGES))


def _driver(kind: type[PlainDriver], base: Plugin = motors) -> Plugin:
    return replace(base, name=kind.__name__, driver=kind)


def _decoder(kind: type[PlainDecoder]) -> Plugin:
    return replace(motors, name=kind.__name__, decoder=kind)


def _twin(kind: type[PlainMotor]) -> Plugin:
    return replace(motors, name=kind.__name__, twin=lambda device, _: kind(device))


BROKEN: tuple[tuple[Plugin, tuple[str, ...]], ...] = (
    (_driver(RoundsVelocity), ("commands",)),
    (_driver(WrapsFeedForward), ("commands",)),
    (_driver(MixesUpMotors), ("commands",)),
    (_driver(ForgetsIdle), ("commands", "jump", "disarm", "dropped")),
    (_twin(WholeUnits), ("measurements",)),
    (_driver(FromTheFuture), ("measurements",)),
    (_driver(NamesTheOther), ("measurements", "jump", "disarm", "watchdog", "blind", "faults", "attach")),
    (_driver(SingleRanges, sensors), ("measurements",)),
    (_driver(Raises), ("bytes", "streams", "finite")),
    (_decoder(EarRaises), ("bytes", "obeyed")),
    (_decoder(EarFillsUp), ("bytes",)),
    (_driver(CountsTwice), ("counts",)),
    (_driver(BelievesBadBytes), ("counts",)),
    (_driver(LosesTheNext), ("counts", "streams")),
    (_driver(NeedsWholeMessages), ("streams",)),
    (_decoder(EarNeedsWholeMessages), ("streams",)),
    (_driver(HearsStrangers), ("strangers",)),
    (_twin(ObeysStrangers), ("strangers",)),
    (_driver(ClearsFaultsUnasked), ("unclaimed", "faults", "scan")),
    (_driver(AlwaysIdles), ("unclaimed", "attach")),
    (_driver(SaysNothing), ("declared",)),
    (_twin(TwinSpeaksCan), ("declared",)),
    (_driver(ClampsNan), ("finite",)),
    (_driver(TellsNan), ("finite",)),
    (_driver(SharesState), ("repeatable",)),
    (_driver(CountsDrivers), ("counts", "strangers", "repeatable", "copies")),
    (_driver(HoldsAGenerator), ("copies",)),
    (_driver(HidesState), ("copies",)),
    (_twin(TwinSharesState), ("copies",)),
    (_can(IgnoresFormat), ("counts", "strangers")),
    (_can(PadsShortFrames), ("counts",)),
    (_can(DoesNotCountStrangers), ("counts", "strangers")),
    (_can(LearnsFromBadFrames), ("counts",)),
    (_can(SaysWhatItDoesNotList), ("unclaimed", "declared", "scan")),
    (_can(FindsByArming), ("unclaimed", "scan")),
)
"""Each with all the clauses that find it."""
