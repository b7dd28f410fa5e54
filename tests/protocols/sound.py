"""Sound plugins of unusual kinds, each of which keeps the contract.

Rules. Each wraps a plugin at its ends: commands, events and frames are changed between it and the bench, and
its spec says so. What is left out is said with each.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any

from gateway.cli.templates import plugin as blank
from protocols import messages as msg
from protocols.conformance.bench import DriverWrapper, Messages, TwinWrapper
from protocols.frames import EXTENDED_BIT, ID_BITS, CanFrame, Frame, IdMask
from protocols.messages import Command, Event, Nanos, Obeyed
from protocols.plain.driver import PlainAdapter
from protocols.plugin import CommandDecoder, Device, FeedbackKind, Plugin, Range, Spec
from protocols.toolkit.host import Host, Phase
from tests.protocols.broken import Sent, motors
from tests.protocols.plain.parts import PlainDriver, decoded


def with_spec(plugin: Plugin, **changes: Any) -> Callable[[Device], Spec]:
    """Return a function that returns the plugin's spec with these changes."""
    return lambda device: replace(plugin.spec(device), **changes)


# -- commands that are the same to the device ----------------------------------------------------------


def as_impedance(command: Command) -> Command:
    """Return a torque as an impedance without gains and set-points."""
    if isinstance(command, msg.Torque):
        return msg.Impedance(command.motor, 0.0, 0.0, command.torque, 0.0, 0.0)
    return command


class SendsImpedance(DriverWrapper):
    """A driver of a device without a torque mode."""

    def send(self, now: Nanos, messages: Messages) -> Sent:
        """Send torques as impedances."""
        return self.driver.send(now, [as_impedance(m) if isinstance(m, msg.Torque) else m for m in messages])


synonyms = replace(
    motors,
    name="synonyms",
    driver=lambda devices: SendsImpedance(motors.driver(devices)),
    spec=with_spec(motors, canonical=as_impedance),
)


# -- requests hold finite numbers --------------------------------------------------------------------------


class TrustsRequests(DriverWrapper):
    """A driver that relies on the step: it refuses requests with numbers that are not finite."""

    def send(self, now: Nanos, messages: Messages) -> Sent:
        """Raise ValueError for a number that is not finite."""
        for message in messages:
            if isinstance(message, msg.WriteParameter):
                int(message.value)
        return self.driver.send(now, messages)


trusts_requests = replace(
    motors, name="trusts_requests", driver=lambda devices: TrustsRequests(motors.driver(devices))
)


# -- numbers packed into few bits, without a zero ------------------------------------------------------

PACKED = {
    "position": (-12.5, 12.5, 16),
    "velocity": (-45.0, 45.0, 12),
    "torque": (-18.0, 18.0, 12),
    "stiffness": (0.0, 500.0, 12),
    "damping": (0.0, 5.0, 12),
}
"""By quantity: the ends and the bits, as of a motor of MIT type."""
_KINDS = (msg.Hold, msg.Position, msg.Velocity, msg.Torque, msg.Impedance, msg.Feedback)


def packed_range(name: str) -> Range:
    low, high, bits = PACKED[name]
    return Range(low, high, (high - low) / (2**bits - 1) / 2 * 1.001)


def packed(message: Any) -> Any:
    """Return a message with its numbers as a frame would carry them; of feedback, None at their ends."""
    if not isinstance(message, _KINDS):
        return message
    changes: dict[str, Any] = {}
    for name, (low, high, bits) in PACKED.items():
        value = getattr(message, name, None)
        if value is None:
            continue
        step = (high - low) / (2**bits - 1)
        if isinstance(message, msg.Feedback):
            inside = low + step < value < high - step
            changes[name] = low + round((value - low) / step) * step if inside else None
        else:  # the driver refuses what is not finite
            changes[name] = low + round((value - low) / step) * step if low <= value <= high else float("nan")
    return replace(message, **changes)


class Packs(DriverWrapper):
    """A driver with few bits for a number."""

    def receive(self, t: Nanos, frame: Frame) -> Sequence[Event]:
        """Report what few bits leave of a measurement."""
        return [packed(event) for event in self.driver.receive(t, frame)]

    def send(self, now: Nanos, messages: Messages) -> Sent:
        """Send what few bits leave of a command."""
        return self.driver.send(now, [packed(message) for message in messages])


def _packed_spec(device: Device) -> Spec:
    spec = motors.spec(device)
    kept = {key: bounds for key, bounds in spec.ranges.items() if key.split(".")[1] not in PACKED}
    keys = [key for key in spec.ranges if key not in kept]
    return replace(spec, ranges=kept | {key: packed_range(key.split(".")[1]) for key in keys})


twelve_bits = replace(
    motors, name="twelve_bits", driver=lambda devices: Packs(motors.driver(devices)), spec=_packed_spec
)


# -- reports only in replies ---------------------------------------------------------------------------


@dataclass(slots=True)
class Replies(TwinWrapper):
    """A device that reports only while it is commanded."""

    device: Device
    commanded_at: Nanos | None = None

    def receive(self, t: Nanos, frame: Frame) -> None:
        """Pass it on; note a command to this device."""
        self.twin.receive(t, frame)
        for address, message in decoded(frame):
            if address == self.device.address and isinstance(message, Command):
                self.commanded_at = t

    def step(self, now: Nanos, truth: Sequence[Event]) -> tuple[Sequence[msg.Torque], Sequence[Frame]]:
        """Send reports in reply to a command only."""
        torques, frames = self.twin.step(now, truth)
        return torques, frames if self.commanded_at == now else [f for f in frames if not _reports(f)]


def _reports(frame: Frame) -> bool:
    reports = (msg.Feedback, msg.State, msg.Fault)
    return any(isinstance(message, reports) for _, message in decoded(frame))


class PollsByIdle(PlainAdapter):
    """A device that was commanded, and is not now, replies to Idle."""

    def poll(self, now: Nanos, host: Host[set[int]]) -> Sequence[Frame]:
        """Send Idle at every step."""
        silent = host.once_commanded and host.phase not in (Phase.ARMING, Phase.ARMED)
        return self.release(now, host) if silent else ()


class OnlyReplies(PlainDriver):
    """The driver of such devices."""

    adapted = PollsByIdle


only_replies = replace(
    motors,
    name="only_replies",
    driver=OnlyReplies,
    twin=lambda device, seed: Replies(motors.twin(device, seed), device),
    spec=with_spec(motors, feedback=FeedbackKind.REPLY),
)


# -- ids that carry data -------------------------------------------------------------------------------

DATA_IN_ID = 0x00FF_0000


def moved(frame: Frame) -> Frame:
    """Return a frame of 11 bits with its first byte in an id of 29 bits."""
    assert isinstance(frame, CanFrame)
    return replace(frame, id=frame.id | frame.data[0] << 16, data=frame.data[1:], extended=True)


def moved_back(frame: Frame) -> Frame:
    """Return the frame of 11 bits; of any other frame, one that no plugin of 11 bits knows."""
    if not isinstance(frame, CanFrame):
        return frame
    if not frame.extended or frame.id & ~DATA_IN_ID > 0x7FF or frame.remote:
        return replace(frame, extended=True)
    return replace(frame, id=frame.id & 0x7FF, data=bytes((frame.id >> 16,)) + frame.data, extended=False)


class MovedDriver(DriverWrapper):
    """A driver whose frames carry a byte in their ids."""

    def receive(self, t: Nanos, frame: Frame) -> Sequence[Event]:
        """Receive it with the byte in its place."""
        return self.driver.receive(t, moved_back(frame))

    def send(self, now: Nanos, messages: Messages) -> Sent:
        """Send with the byte in the id."""
        events, frames = self.driver.send(now, messages)
        return events, [moved(frame) for frame in frames]


class MovedTwin(TwinWrapper):
    """A device with the same frames."""

    def receive(self, t: Nanos, frame: Frame) -> None:
        """Receive it with the byte in its place."""
        self.twin.receive(t, moved_back(frame))

    def step(self, now: Nanos, truth: Sequence[Event]) -> tuple[Sequence[msg.Torque], Sequence[Frame]]:
        """Send with the byte in the id."""
        torques, frames = self.twin.step(now, truth)
        return torques, [moved(frame) for frame in frames]


@dataclass(slots=True)
class MovedDecoder:
    """A decoder of the same frames."""

    decoder: CommandDecoder

    def decode(self, t: Nanos, frame: Frame) -> Sequence[Obeyed]:
        """Decode it with the byte in its place."""
        return self.decoder.decode(t, moved_back(frame))


def _moved_spec(device: Device) -> Spec:
    spec = blank.spec(device)
    sends, expects = (tuple(map(_opened, ids)) for ids in (spec.sends, spec.expects))
    return replace(
        spec, sends=sends, expects=expects, read_only=lambda frame: spec.read_only(moved_back(frame))
    )


def _opened(ids: IdMask) -> IdMask:
    return ids[0] | EXTENDED_BIT, ID_BITS & ~DATA_IN_ID


data_in_ids = replace(
    blank,
    name="data_in_ids",
    driver=lambda devices: MovedDriver(blank.driver(devices)),
    decoder=lambda devices: MovedDecoder(blank.decoder(devices)),
    twin=lambda device, seed: MovedTwin(blank.twin(device, seed)),
    spec=_moved_spec,
    messages=lambda frame: blank.messages(moved_back(frame)),
    vectors=("tests.protocols", "data_in_ids.json"),
)

SOUND = (synonyms, trusts_requests, twelve_bits, only_replies, data_in_ids)
