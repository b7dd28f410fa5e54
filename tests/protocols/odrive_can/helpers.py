"""Two real ends and a for-loop: one driver, its twins, a shaft each, a wire that can be cut. Virtual time."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import TypeVar

from protocols.odrive_can import RANGES
from protocols.odrive_can import twin as made
from protocols.odrive_can.codec import AnyMessage, decode_to_device, node_of
from protocols.odrive_can.driver import OdriveDriver
from protocols.odrive_can.messages import Ask
from protocols.odrive_can.options import Options, Settings
from protocols.odrive_can.twin import OdriveTwin
from protocols.odrive_can.twin05 import Twin05
from protocols.odrive_can.twin06 import Twin06
from protocols.plugin import Device
from protocols.wire import CanFrame
from protocols.words import MILLISECOND, Command, Event, Feedback, Nanos, Request, State

INERTIA = 2.5 * 0.05**2 / 64 + 2e-5
"""kg·m² at the motor: half of 5 kg on a wheel of 0.05 m behind a gear of 8, and the rotor."""
FRICTION = 1e-4
"""N·m·s/rad"""
Kind = TypeVar("Kind", bound=Event)


def device(
    name: str = "left", address: int = 1, settings: Settings | None = None, options: Options | None = None
) -> Device:
    """A device of the robot file."""
    return Device(name, address, options or Options(), settings or Settings())


@dataclass
class Shaft:
    """What turns behind a twin; `load` [N·m] pushes it, `held` clamps it."""

    position: float = 0.0
    velocity: float = 0.0
    load: float = 0.0
    held: bool = False
    inertia: float = INERTIA

    def step(self, torque: float) -> None:
        """One millisecond."""
        pull = torque + self.load - FRICTION * self.velocity
        self.velocity = 0.0 if self.held else self.velocity + pull / self.inertia * 1e-3
        self.position += self.velocity * 1e-3


@dataclass
class Bench:
    """Driver and twins; `run` steps both, the driver every 5 ms and whenever it is due."""

    devices: Sequence[Device]
    driver: OdriveDriver = field(init=False)
    twins: list[OdriveTwin] = field(init=False)
    shafts: list[Shaft] = field(init=False)
    now: Nanos = 0
    sent: list[tuple[Nanos, CanFrame]] = field(default_factory=list)
    heard: list[tuple[Nanos, CanFrame]] = field(default_factory=list)
    events: list[Event] = field(default_factory=list)
    to_device: Callable[[CanFrame], bool] = lambda frame: True
    """Whether a frame of the driver arrives."""
    from_device: Callable[[CanFrame], bool] = lambda frame: True
    words: Sequence[Command] = ()

    def __post_init__(self) -> None:
        self.driver = OdriveDriver(self.devices, RANGES)
        self.twins = [made(item, seed) for seed, item in enumerate(self.devices)]
        self.shafts = [Shaft() for _ in self.devices]

    @property
    def twin(self) -> Twin06:
        """The first one, of firmware 0.6.x."""
        (first, *_) = self.twins
        assert isinstance(first, Twin06)
        return first

    @property
    def twin05(self) -> Twin05:
        """The first one, of firmware 0.5.x."""
        (first, *_) = self.twins
        assert isinstance(first, Twin05)
        return first

    @property
    def shaft(self) -> Shaft:
        """The first one's."""
        return self.shafts[0]

    def run(self, milliseconds: int, *words: Command) -> list[Event]:
        """Say the words all the time (none: as before); what was told meanwhile."""
        self.words = words or self.words
        before = len(self.events)
        for _ in range(milliseconds):
            self.tick(self.words)
        return self.events[before:]

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
                if self.from_device(wire):
                    self.events += self.driver.receive(self.now, wire)
        self.now += MILLISECOND

    def _send(self, words: Sequence[Command | Request]) -> None:
        events, wires = self.driver.send(self.now, words)
        self.events += events
        for wire in wires:
            assert isinstance(wire, CanFrame)
            self.sent.append((self.now, wire))
            if self.to_device(wire):
                for twin in self.twins:
                    twin.receive(self.now, wire)

    def said(self, node: int = 1, since: Nanos = 0, line: str = "0.6") -> list[AnyMessage]:
        """What the driver told a node (questions left out), as its firmware line has it."""
        frames = [f for t, f in self.sent if t >= since and node_of(f) == node and not f.remote]
        messages = [decode_to_device(frame, line) for frame in frames]
        return [m for m in messages if m is not None and not isinstance(m, Ask)]


def of(kind: type[Kind], events: Sequence[Event]) -> list[Kind]:
    """The events of one kind."""
    return [event for event in events if isinstance(event, kind)]


def modes(events: Sequence[Event]) -> list[str]:
    """The modes told, in order."""
    return [state.mode.value for state in of(State, events)]


def ready(*devices: Device) -> Bench:
    """A bench that has heard its devices."""
    bench = Bench(devices or (device(),))
    bench.run(300)
    return bench
