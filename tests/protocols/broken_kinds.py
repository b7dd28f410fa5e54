"""Plugins that are broken on purpose: what unusual kinds of device get wrong (`tests.protocols.sound`)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

from gateway.cli.templates import plugin as blank
from protocols import messages as msg
from protocols.conformance.bench import TwinWrapper
from protocols.frames import CanFrame, Frame
from protocols.messages import Command, Event, Message, Nanos
from protocols.plain import table
from tests.protocols.broken import BROKEN, alters, motors
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
