"""Plugins that are broken on purpose: numbers, checksums, obedience, addresses, replies, vectors, answers."""

from __future__ import annotations

import math
import struct
from collections.abc import Callable, Sequence
from dataclasses import replace

from protocols import messages as msg
from protocols.conformance.bench import Messages
from protocols.frames import CanFrame, Frame
from protocols.message_codec import LAYOUTS, pack_fields
from protocols.messages import MILLISECOND, Command, Event, Message, Mode, Nanos, Obeyed
from protocols.odrive_can import plugin as odrive
from protocols.plain import table
from protocols.plain.twin import PlainDecoder, PlainTwin, Settings
from protocols.plugin import Device
from protocols.toolkit.motor_driver import Rx
from protocols.toolkit.serial import Stream
from protocols.toolkit.table import TINY
from tests.protocols.broken import BROKEN, Sent, alters, found_by, motors
from tests.protocols.odrive_can.parts import OdriveDriver
from tests.protocols.plain.parts import PlainDriver
from tests.protocols.plain.published import framed

# -- normal --------------------------------------------------------------------------------------------


@found_by("normal")
class SendsMinusZero(PlainDriver):
    """Sends a velocity as given, −0.0 and denormals too."""

    def send(self, now: Nanos, messages: Messages) -> Sent:
        events, frames = super().send(now, messages)
        velocities = [m for m in messages if isinstance(m, msg.Velocity)]
        exact = [
            bytes((self.hosts[m.motor].address,)) + pack_fields(LAYOUTS[4], ("", m.velocity, m.torque))
            for m in velocities
            if abs(m.velocity) < TINY and m.torque == 0.0
        ]
        return events, [*frames, *map(framed, exact)]


@alters("normal")
def reports_minus_zero(event: Message) -> Message:
    """Counts current with the other sign: no current is −0.0."""
    if isinstance(event, msg.Feedback) and event.current is not None:
        return replace(event, current=-event.current)
    return event


@found_by("normal")
class ReportsDenormals(OdriveDriver):
    """Reports a velocity as it stands in the frame."""

    def receive(self, t: Nanos, frame: Frame) -> Sequence[Event]:
        events = super().receive(t, frame)
        if not isinstance(frame, CanFrame) or frame.id & 0x1F != 0x09 or len(frame.data) != 8:
            return events
        (turns,) = struct.unpack("<f", frame.data[4:])
        return [replace(e, velocity=turns * math.tau) if isinstance(e, msg.Feedback) else e for e in events]


# -- checksums -----------------------------------------------------------------------------------------


class _Lenient(Stream):
    """Does not check one bit of a checksum."""

    __slots__ = ()

    def feed(self, data: bytes) -> list[bytes | Rx]:
        found: list[bytes | Rx] = []
        for byte in data:
            corrected = self.held + bytes((byte ^ 0x02,))
            received = super().feed(bytes((byte,)))
            if Rx.MALFORMED in received and table.FRAMING.frame(corrected[:-4]) == corrected:
                self.drop()
                received = [corrected[:-4]]
            found += received
        return found

    def messages(self, data: bytes) -> list[bytes]:
        return [each for each in self.feed(data) if isinstance(each, bytes)]


@found_by("checksums")
class ForgivesABit(PlainDriver):
    """Takes 31 bits of the checksum for all of it."""

    def __init__(self, devices: Sequence[Device]) -> None:
        super().__init__(devices)
        self.read_from(_Lenient(table.FRAMING))


@found_by("checksums")
class DecoderForgivesABit(PlainDecoder):
    """The same, in the decoder."""

    def __init__(self, devices: Sequence[Device]) -> None:
        super().__init__(devices)
        self._stream = _Lenient(table.FRAMING)


# -- obeyed --------------------------------------------------------------------------------------------


@found_by("obeyed")
class DecoderMissesClear(PlainDecoder):
    """The decoder does not know a message that the device obeys."""

    def decode(self, t: Nanos, frame: Frame) -> Sequence[Obeyed]:
        return [m for m in super().decode(t, frame) if not isinstance(m, msg.ClearFault)]


@found_by("obeyed")
class DecoderMissesArm(PlainDecoder):
    """The decoder gives the command alone, of a frame that arms too."""

    def decode(self, t: Nanos, frame: Frame) -> Sequence[Obeyed]:
        return [m for m in super().decode(t, frame) if not isinstance(m, msg.Arm)]


@found_by("disarm")
class DecoderArmsByIdle(PlainDecoder):
    """The decoder gives Arm of every command."""

    def decode(self, t: Nanos, frame: Frame) -> Sequence[Obeyed]:
        decoded = super().decode(t, frame)
        idle = [m for m in decoded if isinstance(m, msg.Idle)]
        return [*(msg.Arm(m.motor) for m in idle), *decoded]


@found_by("obeyed")
class PushesTheOtherWay(PlainTwin):
    """The device has the other sign of torque than the decoder."""

    def cycle(self, now: Nanos, dt: float, position: float, velocity: float) -> float:
        torque = super().cycle(now, dt, position, velocity)
        return -torque if isinstance(self.goal, msg.Torque) else torque


# -- duplicates ----------------------------------------------------------------------------------------


@alters("duplicates", base=odrive)
def never_detects_duplicates(event: Message) -> Message | None:
    """Does not report a duplicate address at all."""
    return None if isinstance(event, msg.Found) and event.duplicate_address else event


@alters("duplicates", base=odrive)
def reports_duplicates_in_text_only(event: Message) -> Message:
    """Reports it in the text, where no program finds it."""
    return replace(event, duplicate_address=False) if isinstance(event, msg.Found) else event


@alters("duplicates", base=odrive)
def reports_all_as_duplicates(event: Message) -> Message:
    """Takes each answer to the scan for another device."""
    return replace(event, duplicate_address=True) if isinstance(event, msg.Found) else event


# -- replies -------------------------------------------------------------------------------------------


@found_by("replies")
class OneAfterTheOther(PlainDriver):
    """Sends no command while a reply is awaited: one silent device stops all."""

    def send(self, now: Nanos, messages: Messages) -> Sent:
        waiting = len(self.queue)
        requests = [m for m in messages if not isinstance(m, Command)]
        late = [m for m in messages if isinstance(m, Command)]
        return super().send(now, requests if waiting else [*requests, *late])


@found_by("replies")
class ArmsInTurn(PlainDriver):
    """Commands a motor only when those before it have sent something."""

    def __init__(self, devices: Sequence[Device]) -> None:
        super().__init__(devices)
        self.order = [device.name for device in devices]

    def send(self, now: Nanos, messages: Messages) -> Sent:
        last = {name: host.received_at for name, host in self.hosts.items()}
        silent = [name for name, at in last.items() if at is None or now - at > 40 * MILLISECOND]
        first = min((self.order.index(name) for name in silent), default=len(self.order))
        held = self.order[first + 1 :] if any(host.owned for host in self.hosts.values()) else []
        passed = [m for m in messages if isinstance(m, msg.Idle) or getattr(m, "motor", "") not in held]
        return super().send(now, passed)


# -- vectors -------------------------------------------------------------------------------------------


@found_by("vectors")
class SendsAnUnsetFrame(OdriveDriver):
    """When asked for a parameter, sends a frame whose data is never set."""

    def send(self, now: Nanos, messages: Messages) -> Sent:
        events, frames = super().send(now, messages)
        asked = any(isinstance(message, msg.ReadParameter) for message in messages)
        unset = CanFrame(min(self.nodes) << 5 | 0x07, b"\0\0")
        return events, [*frames, unset] if asked else frames


@found_by("vectors")
class SendsLongIds(OdriveDriver):
    """Clears faults in a frame with an id of 29 bits, which no device obeys."""

    def send(self, now: Nanos, messages: Messages) -> Sent:
        events, frames = super().send(now, messages)
        asked = any(isinstance(message, msg.ReadParameter) for message in messages)
        long = CanFrame(min(self.nodes) << 5 | 0x18, b"\0", extended=True)
        return events, [*frames, long] if asked else frames


BROKEN.append((replace(motors, name="WithoutVectors", vectors=None), ("vectors",)))
BROKEN.append((replace(motors, name="WithoutMessageNames", messages=lambda _: ()), ("vectors",)))


# -- answers -------------------------------------------------------------------------------------------


@found_by("once")
class AnswersTwice(PlainDriver):
    """Reports the value of a parameter, and then that the request is done."""

    def receive(self, t: Nanos, frame: Frame) -> Sequence[Event]:
        events = super().receive(t, frame)
        read = [event for event in events if isinstance(event, msg.Parameter)]
        return [*events, *(msg.Done(event.t, "ReadParameter", event.motor) for event in read)]


@found_by("settings")
class ForgetsWhatIsWritten(PlainTwin):
    """Confirms that a setting is written, and keeps the one before."""

    def configure(self, settings: Settings) -> None:
        if self.now is None:
            super().configure(settings)


@alters("answers")
def refuses_without_reason(event: Message) -> Message:
    """Refuses, and gives no reason."""
    return replace(event, reason=" ") if isinstance(event, msg.Refused) else event


@alters("answers")
def does_not_refuse(event: Message) -> Message | None:
    """Ignores the request for an unknown parameter."""
    return None if isinstance(event, msg.Refused) and event.request == "ReadParameter" else event


@alters("answers")
def answers_without_name(event: Message) -> Message:
    """Does not name the motor whose request was done."""
    return replace(event, name="") if isinstance(event, msg.Done) and event.request == "Zero" else event


@alters("answers")
def reports_text(event: Message) -> Message:
    """The value of a parameter as a text."""
    value: Callable[[float], float] = str  # type: ignore[assignment]  # what an untyped plugin may do
    return replace(event, value=value(event.value)) if isinstance(event, msg.Parameter) else event


@found_by("answers")
class ReportsDoneUnsent(PlainDriver):
    """What is to be written is never sent, and yet done."""

    def send(self, now: Nanos, messages: Messages) -> Sent:
        events, frames = super().send(now, [m for m in messages if not isinstance(m, msg.WriteParameter)])
        written = [m for m in messages if isinstance(m, msg.WriteParameter)]
        return [*events, *(msg.Done(now, "WriteParameter", m.motor) for m in written)], frames


@alters("answers")
def never_gives_up(event: Message) -> Message | None:
    """Waits for ever for the answer of a silent device."""
    return None if isinstance(event, msg.Refused) and "no reply" in event.reason else event


@found_by("answers")
class DueLongAgo(PlainDriver):
    """A driver that is due when a second of silence began."""

    def due(self) -> Nanos | None:
        due = super().due()
        return None if due is None else due - 1000 * MILLISECOND


@alters("answers", "offline")
def offline_without_time(event: Message) -> Message:
    """Does not report when a device fell silent."""
    missing: Nanos = None  # type: ignore[assignment]  # what an untyped plugin may do
    return replace(event, t=missing) if isinstance(event, msg.State) and event.mode is Mode.OFFLINE else event


@found_by("answers")
class NoParameterName(PlainDecoder):
    """The decoder leaves out the name of a parameter."""

    def decode(self, t: Nanos, frame: Frame) -> Sequence[Obeyed]:
        missing: str = None  # type: ignore[assignment]  # as above
        decoded = super().decode(t, frame)
        return [replace(m, parameter=missing) if isinstance(m, msg.WriteParameter) else m for m in decoded]
