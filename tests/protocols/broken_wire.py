"""Plugins that are broken on purpose: numbers, checksums, obedience, addresses, replies, vectors.

Rules. Each is the plain plugin, or ODrive's, with one part of it replaced; what is wrong is said by its name.
"""

from __future__ import annotations

import struct
import zlib
from collections.abc import Sequence
from dataclasses import replace

from protocols import messages as msg
from protocols.frames import CanFrame, Frame
from protocols.message_codec import LAYOUTS, pack_fields
from protocols.messages import MILLISECOND, Command, Event, Nanos, Request
from protocols.odrive_can import RANGES
from protocols.odrive_can import plugin as odrive
from protocols.odrive_can.codec import cmd_of
from protocols.odrive_can.driver import OdriveDriver
from protocols.odrive_can.messages import GetIq, SetAxisState
from protocols.plain import codec
from protocols.plain.decoder import PlainDecoder
from protocols.plain.driver import PlainDriver
from protocols.plain.twin import PlainMotor
from protocols.plugin import Device, Plugin
from tests.protocols.broken import Sent, motors

Messages = Sequence[Command | Request]


# -- normal --------------------------------------------------------------------------------------------


class SaysMinusZero(PlainDriver):
    """Says a velocity as it comes, −0.0 and denormals too."""

    def send(self, now: Nanos, words: Messages) -> Sent:
        events, frames = super().send(now, words)
        exact = [
            w
            for w in words
            if isinstance(w, msg.Velocity) and abs(w.velocity) < codec.TINY and w.torque == 0.0
        ]
        said = [
            codec.frame(
                bytes((self._addresses[w.motor],)) + pack_fields(LAYOUTS[4], ("", w.velocity, w.torque))
            )
            for w in exact
        ]
        return events, [*frames, *said]


class TellsMinusZero(PlainDriver):
    """Counts current the other way round: no current is −0.0."""

    def receive(self, t: Nanos, frame: Frame) -> Sequence[Event]:
        events = super().receive(t, frame)
        return [
            replace(e, current=-e.current) if isinstance(e, msg.Feedback) and e.current is not None else e
            for e in events
        ]


class TellsDenormals(OdriveDriver):
    """Reads a current as it stands in the frame."""

    def receive(self, t: Nanos, frame: Frame) -> Sequence[Event]:
        events = super().receive(t, frame)
        if not isinstance(frame, CanFrame) or frame.id & 0x1F != cmd_of(GetIq) or len(frame.data) != 8:
            return events
        (measured,) = struct.unpack("<f", frame.data[4:])
        return [replace(e, current=measured) if isinstance(e, msg.Feedback) else e for e in events]


# -- checksums -----------------------------------------------------------------------------------------


class _Lenient(codec.Stream):
    """Does not look at one bit of a checksum."""

    __slots__ = ()

    def feed(self, data: bytes) -> list[bytes]:
        bodies = []
        for byte in data:
            held, bad = self._held, self.bad
            bodies += super().feed(bytes((byte,)))
            if self.bad > bad:
                whole = held + bytes((byte,))
                mended = whole[:-1] + bytes((byte ^ 0x02,))
                crc = zlib.crc32(mended[6:-4])
                if mended[:2] == codec.SYNC and mended[-4:] == struct.pack("<I", crc):
                    self.bad, self._held, self._skipping = bad, b"", False
                    bodies.append(mended[6:-4])
        return bodies


class ForgivesABit(PlainDriver):
    """Takes 31 bits of the checksum for all of it."""

    def __init__(self, devices: Sequence[Device]) -> None:
        super().__init__(devices)
        self._stream = _Lenient()


class EarForgivesABit(PlainDecoder):
    """The same, in the ear."""

    def __init__(self, devices: Sequence[Device]) -> None:
        super().__init__(devices)
        self._stream = _Lenient()


# -- obeyed --------------------------------------------------------------------------------------------


class DeafToClear(PlainDecoder):
    """The ear does not know a word that the device obeys."""

    def decode(self, t: Nanos, frame: Frame) -> Messages:
        return [word for word in super().decode(t, frame) if not isinstance(word, msg.ClearFault)]


class PushesTheOtherWay(PlainMotor):
    """The device has another notion of a torque's sign than the ear."""

    def _loop(self, dt: float) -> float:
        torque = super()._loop(dt)
        return -torque if isinstance(self._command, msg.Torque) else torque


# -- twice ---------------------------------------------------------------------------------------------


class NeverCountsDevices(OdriveDriver):
    """Who holds an address is not its business."""

    def receive(self, t: Nanos, frame: Frame) -> Sequence[Event]:
        return [
            e for e in super().receive(t, frame) if not (isinstance(e, msg.Found) and e.duplicate_address)
        ]


class SaysItInWordsOnly(OdriveDriver):
    """Tells it in the text, where no program finds it."""

    def receive(self, t: Nanos, frame: Frame) -> Sequence[Event]:
        return [
            replace(e, duplicate_address=False) if isinstance(e, msg.Found) else e
            for e in super().receive(t, frame)
        ]


class AccusesEverybody(OdriveDriver):
    """Takes each answer to the roll call for another device."""

    def receive(self, t: Nanos, frame: Frame) -> Sequence[Event]:
        return [
            replace(e, duplicate_address=True) if isinstance(e, msg.Found) else e
            for e in super().receive(t, frame)
        ]


# -- replies -------------------------------------------------------------------------------------------


class OneAfterTheOther(PlainDriver):
    """Says nothing to anybody while an answer is out: who does not answer stops all."""

    def send(self, now: Nanos, words: Messages) -> Sent:
        waiting = any(seat.pending for seat in self._devices.values())
        questions = [w for w in words if not isinstance(w, Command)]
        late = [w for w in words if isinstance(w, Command)]
        return super().send(now, questions if waiting else [*questions, *late])


class ArmsInTurn(PlainDriver):
    """Commands a motor only when those before it are heard."""

    def __init__(self, devices: Sequence[Device]) -> None:
        super().__init__(devices)
        self.order = [device.name for device in devices]

    def send(self, now: Nanos, words: Messages) -> Sent:
        silent = [
            s.name for s in self._devices.values() if s.received_at is None or now - s.received_at > 40 * MILLISECOND
        ]
        first = min((self.order.index(name) for name in silent), default=len(self.order))
        held = self.order[first + 1 :] if any(seat.owned for seat in self._devices.values()) else []
        return super().send(
            now, [w for w in words if isinstance(w, msg.Idle) or getattr(w, "motor", "") not in held]
        )


# -- vectors -------------------------------------------------------------------------------------------


class SaysAnUnsetFrame(OdriveDriver):
    """When asked for a parameter, sends a frame whose data nobody has set."""

    def send(self, now: Nanos, words: Messages) -> Sent:
        events, frames = super().send(now, words)
        asked = any(isinstance(word, msg.ReadParameter) for word in words)
        unset = CanFrame(min(self.axes) << 5 | cmd_of(SetAxisState), b"\0\0")
        return events, [*frames, unset] if asked else frames


class SpeaksInLongIds(OdriveDriver):
    """Clears faults in a frame with an id of 29 bits, which nobody obeys."""

    def send(self, now: Nanos, words: Messages) -> Sent:
        events, frames = super().send(now, words)
        asked = any(isinstance(word, msg.ReadParameter) for word in words)
        long = CanFrame(min(self.axes) << 5 | 0x18, b"\0", extended=True)
        return events, [*frames, long] if asked else frames


def _driver(kind: type[PlainDriver]) -> Plugin:
    return replace(motors, name=kind.__name__, driver=kind)


def _decoder(kind: type[PlainDecoder]) -> Plugin:
    return replace(motors, name=kind.__name__, decoder=kind)


def _twin(kind: type[PlainMotor]) -> Plugin:
    return replace(motors, name=kind.__name__, twin=lambda device, _: kind(device))


def _can(kind: type[OdriveDriver]) -> Plugin:
    return replace(odrive, name=kind.__name__, driver=lambda devices: kind(devices, RANGES))


UNVOUCHED = replace(motors, name="Unvouched", vectors=None)
"""Nobody else has ever seen its bytes."""
UNNAMED = replace(motors, name="Unnamed", messages=lambda _: ())
"""Has no names for what it says."""

BROKEN_WIRE: tuple[tuple[Plugin, tuple[str, ...]], ...] = (
    (_driver(SaysMinusZero), ("normal",)),
    (_driver(TellsMinusZero), ("normal",)),
    (_can(TellsDenormals), ("normal",)),
    (_driver(ForgivesABit), ("checksums",)),
    (_decoder(EarForgivesABit), ("checksums",)),
    (_decoder(DeafToClear), ("obeyed",)),
    (_twin(PushesTheOtherWay), ("obeyed",)),
    (_can(NeverCountsDevices), ("twice",)),
    (_can(SaysItInWordsOnly), ("twice",)),
    (_can(AccusesEverybody), ("twice",)),
    (_driver(OneAfterTheOther), ("replies",)),
    (_driver(ArmsInTurn), ("replies",)),
    (_can(SaysAnUnsetFrame), ("vectors",)),
    (_can(SpeaksInLongIds), ("vectors",)),
    (UNVOUCHED, ("vectors",)),
    (UNNAMED, ("vectors",)),
)
"""Each with all the clauses that find it."""
