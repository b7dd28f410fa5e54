"""Plugins that are broken on purpose: what unusual kinds of device get wrong (`tests.protocols.sound`)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

from gateway.cli.templates import plugin as blank
from protocols import messages as msg
from protocols.conformance.bench import Messages, TwinWrapper
from protocols.frames import CanFrame, Frame
from protocols.messages import Command, Event, Message, Nanos
from protocols.plain import table
from protocols.plugin import Device
from protocols.vesc import plugin as vesc
from tests.protocols.broken import BROKEN, Sent, alters, found_by, motors
from tests.protocols.broken_safety import Knowing
from tests.protocols.plain.parts import decoded
from tests.protocols.sound import MovedDriver, data_in_ids, only_replies, with_spec

# -- ids that carry data -------------------------------------------------------------------------------


class IgnoresTheType(MovedDriver):
    """Compares the device's number alone, and not the rest of the id."""

    def receive(self, t: Nanos, frame: Frame) -> Sequence[Event]:
        if isinstance(frame, CanFrame) and frame.extended:
            frame = replace(frame, id=frame.id & 0x00FF_FFFF)
        return super().receive(t, frame)


_careless = replace(data_in_ids, driver=lambda devices: IgnoresTheType(blank.driver(devices)))
BROKEN.append((replace(_careless, name="IgnoresTheType"), ("foreign",)))

# -- synonyms ------------------------------------------------------------------------------------------


def without_feed_forward(command: Command) -> Command:
    """Return a velocity without its torque, which the device obeys all the same."""
    return replace(command, torque=0.0) if isinstance(command, msg.Velocity) else command


BROKEN.append(
    (
        replace(motors, name="SynonymsThatAreNone", spec=with_spec(motors, canonical=without_feed_forward)),
        ("commands",),
    )
)

# -- scales --------------------------------------------------------------------------------------------

BROKEN.append((replace(vesc, name="AssumesItsScales", spec=with_spec(vesc, scales={})), ("scales",)))

# -- serial numbers ------------------------------------------------------------------------------------

for _plugin, _told in ((vesc, True), (motors, False)):  # a VESC has none in its answer, these have
    _named = replace(_plugin, name=f"TellsASerialNumber{_told}", spec=with_spec(_plugin, tells_serial=_told))
    BROKEN.append((_named, ("scan",)))

# -- replies -------------------------------------------------------------------------------------------


@alters("faults", base=only_replies)
def ignores_the_fault_in_a_reply(event: Message) -> Message | None:
    """The mode is read from a reply, the fault is not."""
    return None if isinstance(event, msg.Fault) else event


# -- ends of a range -----------------------------------------------------------------------------------


class Saturates(TwinWrapper):
    """A device that counts no further than its frames can hold, and sends the end."""

    def step(self, now: Nanos, truth: Sequence[Event]) -> tuple[Sequence[msg.Torque], Sequence[Frame]]:
        low, high = table.LIMITS["position"]
        clamped = [
            replace(event, position=max(low, min(high, event.position)))
            if isinstance(event, msg.Feedback) and event.position is not None
            else event
            for event in truth
        ]
        return self.twin.step(now, clamped)


BROKEN.append(
    (
        replace(motors, name="Saturates", twin=lambda device, seed: Saturates(motors.twin(device, seed))),
        ("saturated",),
    )
)


# -- two hosts -----------------------------------------------------------------------------------------


@found_by("scan")
class MisreadsAnotherHostsAnswer(Knowing):
    """What a device answers to another host's scan is taken for its position, at the end of the range."""

    def __init__(self, devices: Sequence[Device]) -> None:
        super().__init__(devices)
        self.scans = self.misread = False

    def receive(self, t: Nanos, frame: Frame) -> Sequence[Event]:
        answers = [message for _, message in decoded(frame, t) if isinstance(message, msg.Found)]
        self.misread |= bool(answers) and not self.scans
        return super().receive(t, frame)

    def send(self, now: Nanos, messages: Messages) -> Sent:
        self.scans |= any(isinstance(message, msg.Scan | msg.SetId) for message in messages)
        held = [msg.Position(m.motor, -12.5) if isinstance(m, msg.Hold) else m for m in messages]
        return super().send(now, held if self.misread else messages)
