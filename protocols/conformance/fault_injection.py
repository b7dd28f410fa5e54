"""What goes wrong on purpose: cables that are cut, hosts that die or share a bus, loads that hang on a shaft.

Rules. A `Scene` is a rehearsal that keeps what a failure must show: the words that were said, one of each
run of a kind, and the last wires that a device obeyed. Trouble is put between driver and twin, never into
them. Everything polls: a scene goes on until a condition holds or a bound is reached. What a clause tries
is tried whole with the plugin's usual options, and in part with each other value of an option (`some`).
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, TypeAlias, TypeVar
from zlib import crc32

from protocols import messages as msg
from protocols.conformance import bench as play
from protocols.conformance.bench import ARMING, NAMES, STEP, Bench, StepResult
from protocols.conformance.case import Case, Failure, by_name
from protocols.frames import BusState, Frame
from protocols.messages import Command, Event, Message, Mode, Nanos, Request
from protocols.plugin import Device, Driver, Range, RxCounters, Spec, Twin

Messages: TypeAlias = Sequence[Command | Request]
Saying: TypeAlias = Callable[[int], Messages]
"""What is said, by the number of the step."""
T = TypeVar("T")
PART = 3
"""With options beside the usual ones, one in so many of the tries is made."""
SPEED = 2.0
"""rad/s at which shafts are turned."""
SLACK = 0.01
"""rad that a shaft may give way beside the declared resolution: half a degree."""
STILL = 1e-9
"""N·m that count as none."""


@dataclass(slots=True)
class Cable:
    """A twin at the end of a cable of which either direction can be cut."""

    twin: Twin
    up: bool = True
    down: bool = True
    spoke: Nanos = 0
    """When it last said something that arrived."""

    def receive(self, t: Nanos, frame: Frame) -> None:
        """To the device, unless cut."""
        if self.down:
            self.twin.receive(t, frame)

    def step(self, now: Nanos, truth: Sequence[Event]) -> tuple[Sequence[msg.Torque], Sequence[Frame]]:
        """The device runs on; what it says is lost when cut."""
        torques, frames = self.twin.step(now, truth)
        if frames and self.up:
            self.spoke = now
        return torques, frames if self.up else ()

    def due(self) -> Nanos | None:
        """The device's."""
        return self.twin.due()

    def provoke(self, code: int) -> None:
        """The device's."""
        self.twin.provoke(code)


@dataclass(slots=True)
class Host:
    """The driver in a host that may die, be lazy, hear itself, or have another host beside it."""

    driver: Driver
    alive: bool = True
    lazy: bool = False
    """It calls the driver only when there is a word to say, or when the driver is due."""
    echo: bool = False
    """The bus gives back what this host has sent."""
    dropping: bool = False
    """What our driver sends finds no room in the transmit queue."""
    other: Driver | None = None
    """Another host on the bus, ..."""
    others_words: Messages = ()
    """... and what it says."""
    sent: tuple[Frame, ...] = ()
    """What our driver sent in the last step, without the other's."""

    @property
    def counters(self) -> RxCounters:
        """The driver's."""
        return self.driver.counters

    @counters.setter
    def counters(self, counters: RxCounters) -> None:
        self.driver.counters = counters

    def receive(self, t: Nanos, frame: Frame) -> Sequence[Event]:
        """Both hosts hear; only ours tells."""
        if self.other is not None:
            self.other.receive(t, frame)
        return self.driver.receive(t, frame) if self.alive else ()

    def bus(self, t: Nanos, state: BusState) -> None:
        """The driver's."""
        self.driver.bus(t, state)

    def send(self, now: Nanos, words: Messages) -> tuple[Sequence[Event], Sequence[Frame]]:
        """What both hosts send; what ours tells."""
        events: list[Event] = []
        back, self.sent = self.sent if self.echo else (), ()
        if self.alive:
            events += [event for frame in back for event in self.driver.receive(now, frame)]
            due = self.driver.due()
            if words or not self.lazy or (due is not None and now >= due):
                own, frames = self.driver.send(now, words)
                events += own
                self.sent = () if self.dropping else tuple(frames)
        theirs = self.other.send(now, self.others_words)[1] if self.other is not None else ()
        return events, (*theirs, *self.sent)

    def due(self) -> Nanos | None:
        """The driver's."""
        return self.driver.due()


@dataclass(slots=True)
class Scene:
    """A rehearsal in which things go wrong."""

    stage: Bench
    host: Host
    cables: dict[str, Cable]
    said: list[tuple[Command | Request, ...]] = field(default_factory=list)
    """What was said, the last of each run of words of the same kinds."""
    obeyed: list[Frame] = field(default_factory=list)
    """The last wires in which the ear heard a word."""
    passed: list[Frame] = field(default_factory=list)
    """The last wires from the devices, no two alike."""
    obeys: dict[str, Command] = field(default_factory=dict)
    """The last command that each device would obey."""
    faults: list[msg.Fault] = field(default_factory=list)
    """Told since this was last emptied."""
    offline: dict[str, Nanos] = field(default_factory=dict)
    """When each motor was last told to be offline."""
    measured: dict[str, float] = field(default_factory=dict)
    """rad, as last told."""

    @property
    def names(self) -> list[str]:
        """Of the devices."""
        return [device.name for device in self.stage.devices]

    @property
    def spec(self) -> Spec:
        """Alpha's."""
        return self.stage.specs[0]

    @property
    def now(self) -> Nanos:
        """The time of the last step."""
        return self.stage.now

    def mode(self, name: str = NAMES[0]) -> Mode | None:
        """What the driver last told."""
        return self.stage.armed.get(name)

    def step(self, words: Messages = ()) -> StepResult:
        """One step, noted."""
        said = self.stage.step(words)
        if words:
            if self.said and _kinds(self.said[-1]) == _kinds(words):
                self.said.pop()
            self.said.append(tuple(words))
        if said.received:
            self.obeyed = [*self.obeyed, *(w for w in said.down if w not in self.obeyed[-4:])][-4:]
        if said.up:
            self.passed = [*(w for w in self.passed if w not in said.up), *said.up][-4:]
        for word in said.received:
            if isinstance(word, Command):
                self.obeys[word.motor] = word
        for event in said.events:
            self._note(event)
        return said

    def _note(self, event: Event) -> None:
        if isinstance(event, msg.Fault):
            self.faults.append(event)
        elif isinstance(event, msg.State) and event.mode is Mode.OFFLINE:
            self.offline[event.motor] = self.now
        elif isinstance(event, msg.Feedback) and event.position is not None:
            self.measured[event.motor] = event.position

    def until(self, holds: Callable[[StepResult], bool], most: int, saying: Saying | Messages = ()) -> bool:
        """Step until it holds; False if it does not within so many steps."""
        return any(holds(self.step(saying(at) if callable(saying) else saying)) for at in range(most))

    def ready(self) -> bool:
        """Listen until every device is heard to be ready (one that tells no state: a tenth of the bound)."""
        for count in range(ARMING):
            self.step()
            known = [self.mode(name) for name in self.names]
            if all(mode is Mode.READY for mode in known) and set(self.measured) >= self._measuring():
                return True
            if count > ARMING // 10 and not any(known):
                return True
        return False

    def _measuring(self) -> set[str]:
        return set(self.names) if "Feedback.position" in self.spec.ranges else set()

    def arm(self, saying: Saying, watch: Callable[[StepResult], bool] = lambda _: False) -> bool | None:
        """Say this until every commanded device is armed; None if `watch` objects first."""
        for at in range(ARMING):
            words = saying(at)
            if watch(self.step(words)):
                return None
            wanted = [word.motor for word in words if isinstance(word, Command)]
            if all(self.mode(name) is Mode.ARMED for name in wanted):
                return True
            if at > ARMING // 10 and not self.stage.armed:
                return True
        return False

    def disarm(self, most: int = 2000) -> bool:
        """Say Idle until every device is heard to be disarmed, and for a few steps more."""
        idle = [msg.Idle(name) for name in self.names]
        done = self.until(lambda _: not any(self.mode(n) is Mode.ARMED for n in self.names), most, idle)
        for _ in range(20):
            self.step(idle)
        return done

    def turn(self, by: float, count: int = 80) -> None:
        """Turn every shaft by hand by so many rad, and let go of it at rest."""
        for shaft in self.stage.shafts.values():
            shaft.locked, shaft.velocity = True, by / (count * STEP * 1e-9)
        for _ in range(count):
            for shaft in self.stage.shafts.values():
                shaft.position += by / count
            self.step()
        for shaft in self.stage.shafts.values():
            shaft.velocity = 0.0
        self.wait(20 + 3 * (self.spec.feedback_period // STEP))
        for shaft in self.stage.shafts.values():
            shaft.locked = False

    def wait(self, count: int, words: Messages = ()) -> None:
        """So many steps."""
        for _ in range(count):
            self.step(words)

    def failure(self, text: str, frames: Sequence[Frame] = (), words: Sequence[Message] = ()) -> Failure:
        """With the wires that led here (or the last that passed), and what was said until now."""
        shown = tuple(word for words in self.said[-4:] for word in words)
        return Failure(text, tuple(frames or self.obeyed or self.passed), (*shown, *words))


def _kinds(words: Messages) -> list[tuple[type[Message], str]]:
    return [(type(word), getattr(word, "motor", "")) for word in words]


def scene(case: Case, count: int = 1, settings: object = None, position: float = 0.0) -> Scene:
    """The first `count` of alpha and beta with a driver, on shafts that stand at `position` [rad]."""
    stage = play.make_bench(case.plugin, case.options, case.addresses[:count], NAMES[:count], settings)
    cables = {device.name: Cable(twin) for device, twin in zip(stage.devices, stage.twins, strict=True)}
    host = Host(stage.driver)
    stage.driver, stage.twins = host, list(cables.values())
    for shaft in stage.shafts.values():
        shaft.position, shaft.friction = position, 0.01
    return Scene(stage, host, cables)


def takeover(case: Case, before: Scene) -> Scene:
    """The same devices, with a fresh driver that knows nothing of them."""
    stage = replace(before.stage, armed={}, on_the_way=before.stage.on_the_way)
    host = Host(case.plugin.driver(stage.devices))
    stage.driver = host
    return Scene(stage, host, before.cables, said=before.said)


def some(case: Case, items: Sequence[T]) -> list[T]:
    """All of these with the plugin's usual options; with each other value of an option, some of them by the
    seed. (Where the usual options make a device of another kind, all of them too.)"""
    usual = Device(NAMES[0], case.addresses[0], case.plugin.options(), case.plugin.settings())
    if case.usual or case.plugin.spec(usual).kind != case.spec.kind:
        return list(items)
    first = crc32(f"{case.seed} {case.options}".encode()) % PART
    return list(items[first::PART]) or list(items[:1])


# -- words ---------------------------------------------------------------------------------------------


def kinds_of(spec: Spec) -> list[type[Command]]:
    """The commands that a device has, without Idle."""
    return by_name(spec.commands - {msg.Idle})


def resting(kind: type[Command], spec: Spec, motor: str, position: float) -> Command:
    """A command of this kind that leaves a shaft where it is measured to be [rad], at rest."""
    return _build(kind, spec, motor, {"position": position, "stiffness": 1.0, "damping": 0.05})


def moving(kind: type[Command], spec: Spec, motor: str, start: float, step: int) -> Command:
    """A command of this kind that turns a shaft from `start` [rad] at SPEED (Torque: gently; Hold: not)."""
    along = start + SPEED * step * STEP * 1e-9
    values = {"position": along, "velocity": SPEED, "stiffness": 1.0, "damping": 0.05}
    if kind is msg.Torque:
        values = {"torque": 0.02}
    elif kind is msg.Position:
        values["velocity"] = 0.0
    return _build(kind, spec, motor, values)


def _build(kind: type[Command], spec: Spec, motor: str, values: dict[str, float]) -> Command:
    if kind is msg.Hold or kind is msg.Idle:
        return kind(motor)
    bounds = {name: spec.ranges[key] for name, key in play.numbers(kind, spec.ranges)}
    return play.build(kind, motor, {n: play.nearest(b, values.get(n, 0.0)) for n, b in bounds.items()})


def liveliest(spec: Spec) -> type[Command] | None:
    """The command by which a shaft is best turned; None if there is none."""
    kinds = (msg.Velocity, msg.Position, msg.Impedance, msg.Torque)
    return next((kind for kind in kinds if kind in spec.commands), None)


def slack(spec: Spec, position: float) -> float:
    """rad by which a set-point may miss the shaft: what the two ends declare, and a little."""
    none = Range(0.0, 0.0, 0.0)
    both = (spec.ranges.get("Feedback.position", none), spec.ranges.get("Position.position", none))
    return SLACK + sum(b.resolution + b.relative * abs(position) for b in both)


def torque_of(said: StepResult, motor: str = NAMES[0]) -> float:
    """N·m that a device gave in a step."""
    return math.fsum(torque.torque for torque in said.torques if torque.motor == motor)


def named(words: Sequence[Any], motor: str = NAMES[0]) -> list[Any]:
    """The words that are about a motor."""
    return [word for word in words if getattr(word, "motor", None) == motor]
