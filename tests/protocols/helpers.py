"""Two real ends and a for-loop: one driver, its twins, a shaft each, a wire that can be cut. Virtual time."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Generic, TypeVar

from protocols.frames import CanFrame
from protocols.messages import MILLISECOND, Command, Event, Feedback, Nanos, Request, State
from protocols.plugin import Device, Driver, Twin

DriverKind = TypeVar("DriverKind", bound=Driver)
TwinKind = TypeVar("TwinKind", bound=Twin)
EventKind = TypeVar("EventKind", bound=Event)


@dataclass
class Shaft:
    """What turns behind a twin; `load` [N·m] pushes it, `held` clamps it. rad, rad/s."""

    inertia: float
    """kg·m² at the motor"""
    friction: float
    """N·m·s/rad"""
    position: float = 0.0
    velocity: float = 0.0
    load: float = 0.0
    held: bool = False

    def step(self, torque: float) -> None:
        """One millisecond."""
        pushed = self.velocity + (torque + self.load) / self.inertia * 1e-3
        self.velocity = 0.0 if self.held else pushed / (1.0 + self.friction / self.inertia * 1e-3)
        self.position += self.velocity * 1e-3


@dataclass
class CanBench(Generic[DriverKind, TwinKind]):
    """Driver and twins; `run` steps both, the driver every 5 ms and whenever it is due."""

    devices: Sequence[Device]
    driver: DriverKind
    twins: list[TwinKind]
    shafts: list[Shaft]
    now: Nanos = 0
    sent: list[tuple[Nanos, CanFrame]] = field(default_factory=list)
    received: list[tuple[Nanos, CanFrame]] = field(default_factory=list)
    events: list[Event] = field(default_factory=list)
    to_device: Callable[[CanFrame], bool] = lambda frame: True
    """Whether a frame of the driver arrives."""
    from_device: Callable[[CanFrame], bool] = lambda frame: True
    """Whether a frame of a device arrives, ..."""
    arrives: Callable[[CanFrame], Sequence[CanFrame]] = lambda frame: (frame,)
    """... and as what."""
    words: Sequence[Command] = ()

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
            torques, frames = twin.step(self.now, [truth])
            shaft.step(torques[0].torque)
            for frame in frames:
                assert isinstance(frame, CanFrame)
                self.received.append((self.now, frame))
                for arrived in self.arrives(frame) if self.from_device(frame) else ():
                    self.events += self.driver.receive(self.now, arrived)
        self.now += MILLISECOND

    def _send(self, words: Sequence[Command | Request]) -> None:
        events, frames = self.driver.send(self.now, words)
        self.events += events
        for frame in frames:
            assert isinstance(frame, CanFrame)
            self.sent.append((self.now, frame))
            if self.to_device(frame):
                for twin in self.twins:
                    twin.receive(self.now, frame)


def of(kind: type[EventKind], events: Sequence[Event]) -> list[EventKind]:
    """The events of one kind."""
    return [event for event in events if isinstance(event, kind)]


def modes(events: Sequence[Event], motor: str = "left") -> list[str]:
    """The modes that a motor told, in order."""
    return [state.mode.value for state in of(State, events) if state.motor == motor]
