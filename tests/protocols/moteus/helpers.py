"""Two real ends and a for-loop: one driver, its twins, a shaft each, a wire that can be cut. Virtual time."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from math import tau
from typing import TypeVar

from protocols.moteus import RANGES
from protocols.moteus.codec import Subframe, parse
from protocols.moteus.driver import MoteusDriver
from protocols.moteus.ear import MoteusEar
from protocols.moteus.messages import names, written
from protocols.moteus.node import Node
from protocols.moteus.options import Options, Settings
from protocols.moteus.twin import MoteusTwin
from protocols.plugin import Device
from protocols.wire import CanFrame
from protocols.words import MILLISECOND, Command, Event, Feedback, Nanos, Request, State

INERTIA = 1.2e-4
"""kg·m² at the motor."""
FRICTION = 1e-3
"""N·m·s/rad"""
Kind = TypeVar("Kind", bound=Event)


def device(
    name: str = "left", address: int = 1, settings: Settings | None = None, options: Options | None = None
) -> Device:
    """A device of the robot file."""
    return Device(name, address, options or Options(), settings or Settings())


@dataclass
class Shaft:
    """What turns behind a twin; `load` [N·m] pushes it, `held` clamps it. rad, rad/s."""

    position: float = 0.0
    velocity: float = 0.0
    load: float = 0.0
    held: bool = False
    inertia: float = INERTIA

    def step(self, torque: float) -> None:
        """One millisecond."""
        pushed = self.velocity + (torque + self.load) / self.inertia * 1e-3
        self.velocity = 0.0 if self.held else pushed / (1.0 + FRICTION / self.inertia * 1e-3)
        self.position += self.velocity * 1e-3


@dataclass
class Bench:
    """Driver and twins; `run` steps both, the driver every 5 ms and whenever it is due."""

    devices: Sequence[Device]
    driver: MoteusDriver = field(init=False)
    ear: MoteusEar = field(init=False)
    twins: list[MoteusTwin] = field(init=False)
    shafts: list[Shaft] = field(init=False)
    now: Nanos = 1_000_000 * MILLISECOND
    sent: list[tuple[Nanos, CanFrame]] = field(default_factory=list)
    heard: list[tuple[Nanos, CanFrame]] = field(default_factory=list)
    events: list[Event] = field(default_factory=list)
    obeyed: list[tuple[Nanos, Command | Request]] = field(default_factory=list)
    to_device: Callable[[CanFrame], bool] = lambda frame: True
    """Whether a frame of the driver arrives."""
    from_device: Callable[[CanFrame], Sequence[CanFrame]] = lambda frame: (frame,)
    """What arrives of a frame of a device."""
    words: Sequence[Command] = ()

    def __post_init__(self) -> None:
        self.driver = MoteusDriver(self.devices, RANGES)
        self.ear = MoteusEar(self.devices)
        self.twins = [MoteusTwin(item, seed) for seed, item in enumerate(self.devices)]
        self.shafts = [Shaft() for _ in self.devices]

    @property
    def twin(self) -> MoteusTwin:
        """The first one."""
        return self.twins[0]

    @property
    def shaft(self) -> Shaft:
        """The first one's."""
        return self.shafts[0]

    @property
    def node(self) -> Node:
        """What the driver knows of the first one."""
        return next(iter(self.driver.nodes.values()))

    def run(self, milliseconds: int, *words: Command) -> list[Event]:
        """Say the words all the time (none: as before); what was told meanwhile."""
        self.words = words or self.words
        before = len(self.events)
        for _ in range(milliseconds):
            self.tick(self.words)
        return self.events[before:]

    def quiet(self, milliseconds: int) -> list[Event]:
        """Say nothing."""
        self.words = ()
        return self.run(milliseconds)

    def ask(self, request: Request, milliseconds: int = 0) -> list[Event]:
        """Say a request once, beside the words; what was told since."""
        before = len(self.events)
        self._send([request, *self.words])
        self.run(milliseconds)
        return self.events[before:]

    def tick(self, words: Sequence[Command]) -> None:
        """One millisecond of everything."""
        due = self.driver.due()
        if self.now % (5 * MILLISECOND) == 0 or (due is not None and due <= self.now):
            self._send(words)
        for item, twin, shaft in zip(self.devices, self.twins, self.shafts, strict=True):
            truth = Feedback(item.name, self.now, position=shaft.position, velocity=shaft.velocity)
            torques, wires = twin.step(self.now, [truth])
            shaft.step(torques[0].torque)
            for wire in wires:
                assert isinstance(wire, CanFrame)
                self.heard.append((self.now, wire))
                for arrived in self.from_device(wire):
                    self.events += self.driver.receive(self.now, arrived)
        self.now += MILLISECOND

    def _send(self, words: Sequence[Command | Request]) -> None:
        events, wires = self.driver.send(self.now, words)
        self.events += events
        for wire in wires:
            assert isinstance(wire, CanFrame)
            self.sent.append((self.now, wire))
            if self.to_device(wire):
                self.obeyed += [(self.now, word) for word in self.ear.hear(self.now, wire)]
                for twin in self.twins:
                    twin.receive(self.now, wire)

    def said(self, since: Nanos = 0, address: int = 1) -> list[str]:
        """The names of the messages to a device, without questions."""
        frames = [f for t, f in self.sent if t >= since and f.id & 0x7F == address]
        return [name for f in frames for name in names(f) if name != "read"]

    def commanded(self, since: Nanos = 0, address: int = 1) -> list[dict[int, float | None]]:
        """The registers that were written to a device, frame by frame."""
        frames = [f for t, f in self.sent if t >= since and f.id & 0x7F == address]
        return [w for w in (written(parse(f.data)[0]) for f in frames) if w]


def subframes(frame: CanFrame) -> list[Subframe]:
    """Of a sound frame."""
    found, sound = parse(frame.data)
    assert sound
    return found


def of(kind: type[Kind], events: Sequence[Event]) -> list[Kind]:
    """The events of one kind."""
    return [event for event in events if isinstance(event, kind)]


def modes(events: Sequence[Event], motor: str = "left") -> list[str]:
    """The modes told, in order."""
    return [state.mode.value for state in of(State, events) if state.motor == motor]


def ready(*devices: Device) -> Bench:
    """A bench whose driver has heard its devices."""
    bench = Bench(devices or [device()])
    bench.run(60)
    return bench


def rev(revolutions: float) -> float:
    """In radians."""
    return revolutions * tau
