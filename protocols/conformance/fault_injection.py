"""Fault injection: cables that are cut, hosts that stop or share a bus, loads on a shaft.

Rules. A `Rig` is a bench that logs what a failure must show: the messages that were given, one of each run
of equal types, and the last frames that a device obeyed. Faults are injected between driver and twin, never
into them. Waiting is polling: a rig is stepped until a condition holds or a bound is reached.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, TypeAlias

from protocols import messages as msg
from protocols.conformance import bench as tools
from protocols.conformance.bench import ALPHA, ARMING, NAMES, STEP, Bench, Messages, StepResult
from protocols.conformance.case import Case, Failure, by_name
from protocols.frames import Frame
from protocols.messages import Command, Event, Message, Mode, Nanos, Request
from protocols.plugin import Driver, FeedbackKind, Range, Spec

Giving: TypeAlias = Callable[[int], Messages]
"""The messages to give, by the number of the step."""
SPEED = 2.0
"""rad/s at which shafts are turned."""
SLACK = 0.01
"""rad that a shaft may give way beside the declared resolution: half a degree."""
UNREPORTED = 100
"""Steps after which a device that reports nothing is ready."""
STILL = 1e-9
"""N·m that count as zero."""


@dataclass(slots=True)
class Cable(tools.TwinWrapper):
    """A twin at the end of a cable, of which either direction can be cut."""

    up: bool = True
    down: bool = True
    sent_at: Nanos = 0
    """When it last sent something that arrived."""

    def receive(self, t: Nanos, frame: Frame) -> None:
        """Pass the frame to the device, unless cut."""
        if self.down:
            self.twin.receive(t, frame)

    def step(self, now: Nanos, truth: Sequence[Event]) -> tuple[Sequence[msg.Torque], Sequence[Frame]]:
        """Step the device; what it sends is lost when cut."""
        torques, frames = self.twin.step(now, truth)
        if frames and self.up:
            self.sent_at = now
        return torques, frames if self.up else ()


@dataclass(slots=True)
class FaultyHost(tools.DriverWrapper):
    """The driver in a host that may stop, be lazy, receive its own frames, or share the bus with another."""

    alive: bool = True
    lazy: bool = False
    """It calls the driver only when there is a message to send, or when the driver is due."""
    echo: bool = False
    """The bus returns what this host has sent."""
    dropping: bool = False
    """The transmit queue is full: what our driver sends is lost."""
    other: Driver | None = None
    """The driver of another host on the bus, ..."""
    others_messages: Messages = ()
    """... and what it is given."""
    sent: tuple[Frame, ...] = ()
    """What our driver sent in the last step, without the other's frames."""

    def receive(self, t: Nanos, frame: Frame) -> Sequence[Event]:
        """Pass the frame to both hosts; return the events of our driver."""
        if self.other is not None:
            self.other.receive(t, frame)
        return self.driver.receive(t, frame) if self.alive else ()

    def send(self, now: Nanos, messages: Messages) -> tuple[Sequence[Event], Sequence[Frame]]:
        """Return the events of our host and the frames of both."""
        events: list[Event] = []
        echoed, self.sent = self.sent if self.echo else (), ()
        if self.alive:
            events += [event for frame in echoed for event in self.driver.receive(now, frame)]
            due = self.driver.due()
            if messages or not self.lazy or (due is not None and now >= due):
                own, frames = self.driver.send(now, messages)
                events += own
                self.sent = () if self.dropping else tuple(frames)
        theirs = self.other.send(now, self.others_messages)[1] if self.other is not None else ()
        return events, (*theirs, *self.sent)


@dataclass(slots=True)
class Rig:
    """A bench whose cables and host can fail, with a log."""

    bench: Bench
    host: FaultyHost
    cables: dict[str, Cable]
    given: list[tuple[Command | Request, ...]] = field(default_factory=list)
    """The messages given to the driver: the last of each run of the same types."""
    obeyed: list[Frame] = field(default_factory=list)
    """The last frames in which the decoder decoded a message."""
    replies: list[Frame] = field(default_factory=list)
    """The last frames of the devices, all different."""
    obeys: dict[str, Command] = field(default_factory=dict)
    """The last command that each device would obey."""
    faults: list[msg.Fault] = field(default_factory=list)
    """Reported since this was last emptied."""
    offline: dict[str, Nanos] = field(default_factory=dict)
    """When each motor was last reported offline."""
    measured: dict[str, float] = field(default_factory=dict)
    """rad, as last reported."""

    @property
    def names(self) -> list[str]:
        """Of the devices."""
        return [device.name for device in self.bench.devices]

    @property
    def spec(self) -> Spec:
        """Alpha's."""
        return self.bench.specs[0]

    @property
    def now(self) -> Nanos:
        """The time of the last step."""
        return self.bench.now

    def mode(self, name: str = ALPHA) -> Mode | None:
        """Return the mode that the driver last reported."""
        return self.bench.modes.get(name)

    def step(self, messages: Messages = ()) -> StepResult:
        """Advance one step, and log it."""
        result = self.bench.step(messages)
        if messages:
            if self.given and _types(self.given[-1]) == _types(messages):
                self.given.pop()
            self.given.append(tuple(messages))
        if result.received:
            self.obeyed = [*self.obeyed, *(f for f in result.down if f not in self.obeyed[-4:])][-4:]
        if result.up:
            self.replies = [*(f for f in self.replies if f not in result.up), *result.up][-4:]
        for message in result.received:
            if isinstance(message, Command):
                self.obeys[message.motor] = message
        for event in result.events:
            if isinstance(event, msg.Fault):
                self.faults.append(event)
            elif isinstance(event, msg.State) and event.mode is Mode.OFFLINE:
                self.offline[event.motor] = self.now
            elif isinstance(event, msg.Feedback) and event.position is not None:
                self.measured[event.motor] = event.position
        return result

    def wait(self, count: int, messages: Messages = ()) -> None:
        """Advance this many steps."""
        for _ in range(count):
            self.step(messages)

    def until(self, holds: Callable[[StepResult], bool], most: int, messages: Giving | Messages = ()) -> bool:
        """Step until a condition holds; False if it does not within this many steps."""
        return any(holds(self.step(messages(at) if callable(messages) else messages)) for at in range(most))

    @property
    def only_replies(self) -> bool:
        """True if the devices report nothing without a command."""
        return self.spec.feedback is FeedbackKind.REPLY

    @property
    def prompt(self) -> Messages:
        """What makes the devices report: nothing, but commands at rest to those that only reply."""
        return self.at_rest(liveliest(self.spec), *self.names) if self.only_replies else ()

    def get_ready(self) -> None:
        """Step until every device is reported ready (one that reports no state: a tenth of the bound; one
        that reports nothing without a command: a few steps).

        Raises Failure."""
        if self.only_replies:
            self.wait(UNREPORTED)
            return
        measuring = set(self.names) if "Feedback.position" in self.spec.ranges else set()
        for count in range(ARMING):
            self.step()
            known = [self.mode(name) for name in self.names]
            if all(mode is Mode.READY for mode in known) and set(self.measured) >= measuring:
                return
            if count > ARMING // 10 and not any(known):
                return
        raise self.failure(f"is not reported ready within {ARMING} ms")

    def arm(self, messages: Giving, watch: Callable[[StepResult], bool] = lambda _: False) -> bool | None:
        """Give these until every commanded device is armed; None if `watch` objects first."""
        for at in range(ARMING):
            given = messages(at)
            if watch(self.step(given)):
                return None
            commanded = [message.motor for message in given if isinstance(message, Command)]
            if all(self.mode(name) is Mode.ARMED for name in commanded):
                return True
            if at > ARMING // 10 and not self.bench.modes:
                return True
        return False

    def must_arm(self, messages: Messages, when: str = "") -> None:
        """Arm by these commands. Raises Failure."""
        if not self.arm(lambda _: messages):
            raise self.failure(f"{when}{type(messages[0]).__name__} does not arm within {ARMING} ms")

    def at_rest(self, kind: type[Command], *names: str) -> list[Command]:
        """Return commands of this kind that keep these shafts where they are measured to be."""
        return [resting(kind, self.spec, name, self.place(name)) for name in names or (ALPHA,)]

    def place(self, name: str = ALPHA) -> float:
        """Return where a shaft was measured last; where it is, if nothing is measured without a command."""
        there = self.bench.shafts[name].position
        return there if self.only_replies else self.measured.get(name, there)

    def disarm(self, most: int = 2000) -> bool:
        """Give Idle until every device is reported disarmed, and for a few steps more."""
        idle = [msg.Idle(name) for name in self.names]
        done = self.until(lambda _: not any(self.mode(n) is Mode.ARMED for n in self.names), most, idle)
        self.wait(20, idle)
        return done

    def turn(self, by: float, count: int = 80) -> None:
        """Turn every shaft by hand by this many rad, and release it at rest."""
        shafts = self.bench.shafts.values()
        for shaft in shafts:
            shaft.locked, shaft.velocity = True, by / (count * STEP * 1e-9)
        for _ in range(count):
            for shaft in shafts:
                shaft.position += by / count
            self.step()
        for shaft in shafts:
            shaft.velocity = 0.0
        self.wait(20 + 3 * (self.spec.feedback_period // STEP))
        for shaft in shafts:
            shaft.locked = False

    def failure(self, text: str, frames: Sequence[Frame] = (), messages: Sequence[Message] = ()) -> Failure:
        """Return a failure with the frames that led here (or the last replies), and what was given so far."""
        given = [message for messages in self.given[-4:] for message in messages]
        return Failure(text, frames or self.obeyed or self.replies, (*given, *messages))


def _types(messages: Messages) -> list[tuple[type[Message], str]]:
    return [(type(message), getattr(message, "motor", "")) for message in messages]


def make_rig(case: Case, count: int = 1, settings: object = None, position: float = 0.0) -> Rig:
    """Set up the first `count` of alpha and beta with a driver, on shafts that stand at `position` [rad]."""
    bench = tools.make_bench(case.plugin, case.options, case.addresses[:count], NAMES[:count], settings)
    cables = {device.name: Cable(twin) for device, twin in zip(bench.devices, bench.twins, strict=True)}
    host = FaultyHost(bench.driver)
    bench.driver, bench.twins = host, list(cables.values())
    for shaft in bench.shafts.values():
        shaft.position, shaft.friction = position, 0.01
    return Rig(bench, host, cables)


def takeover(case: Case, before: Rig) -> Rig:
    """Return a rig with the same devices, and a new driver that knows nothing of them."""
    bench = replace(before.bench, modes={})
    host = FaultyHost(tools.make_driver(case.plugin, bench.devices))
    bench.driver = host
    return Rig(bench, host, before.cables, given=before.given)


# -- commands that do not move a shaft, and commands that do ---------------------------------------------


def resting(kind: type[Command], spec: Spec, motor: str, position: float) -> Command:
    """Return a command of this kind that keeps a shaft at the position [rad] where it is, at rest."""
    values = {"position": position, "stiffness": 1.0, "damping": 0.05}
    return tools.build(kind, motor, spec.ranges, values)


def moving(kind: type[Command], spec: Spec, motor: str, start: float, step: int) -> Command:
    """Return a command that turns a shaft from `start` [rad] at SPEED (Torque: gently; Hold: not)."""
    along = start + SPEED * step * STEP * 1e-9
    values = {"position": along, "velocity": SPEED, "stiffness": 1.0, "damping": 0.05}
    if kind is msg.Torque:
        values = {"torque": 0.02}
    elif kind is msg.Position:
        values["velocity"] = 0.0
    return tools.build(kind, motor, spec.ranges, values)


def liveliest(spec: Spec) -> type[Command]:
    """Return the type of command that turns a shaft best. The spec must list one that arms."""
    kinds = (msg.Velocity, msg.Position, msg.Impedance, msg.Torque)
    first = next((kind for kind in kinds if kind in spec.commands), None)
    return first or by_name(spec.commands - {msg.Idle})[0]


def slack(spec: Spec, position: float, kind: type[Command] = msg.Position) -> float:
    """Return by how much [rad] a set-point of a command may miss the shaft: the declared resolutions, and
    SLACK."""
    none = Range(0.0, 0.0, 0.0)
    both = [spec.ranges.get(f"{name}.position", none) for name in ("Feedback", kind.__name__)]
    return SLACK + sum(b.resolution + b.relative * abs(position) for b in both)


def torque_of(result: StepResult, motor: str = ALPHA) -> float:
    """Return the torque [N·m] that a device applied in a step."""
    return math.fsum(torque.torque for torque in result.torques if torque.motor == motor)


def named(messages: Sequence[Any], motor: str = ALPHA) -> list[Any]:
    """Return the messages that are for or from a motor."""
    return [message for message in messages if getattr(message, "motor", None) == motor]
