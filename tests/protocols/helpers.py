"""One driver, its twins, a shaft each, and a bus that can lose frames, stepped in one loop."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Any, Generic, TypeVar

from protocols import messages as msg
from protocols.conformance.bench import Shaft
from protocols.frames import CanFrame
from protocols.messages import MILLISECOND, Command, Event, Feedback, Nanos, Obeyed, Request, State
from protocols.plugin import Device, Driver, Plugin, Twin

DriverKind = TypeVar("DriverKind", bound=Driver)
TwinKind = TypeVar("TwinKind", bound=Twin)
EventKind = TypeVar("EventKind", bound=Event)


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
    """True if a frame of the driver arrives."""
    from_device: Callable[[CanFrame], bool] = lambda frame: True
    """True if a frame of a device arrives."""
    commands: Sequence[Command] = ()

    @property
    def shaft(self) -> Shaft:
        """The first shaft."""
        return self.shafts[0]

    def run(self, milliseconds: int, *commands: Command) -> list[Event]:
        """Give these commands all the time (none: as before); return the events."""
        self.commands = commands or self.commands
        before = len(self.events)
        for _ in range(milliseconds):
            self.tick(self.commands)
        return self.events[before:]

    def ask(self, request: Request, milliseconds: int = 0) -> list[Event]:
        """Make a request once, beside the commands; return the events."""
        before = len(self.events)
        self._send([request, *self.commands])
        self.run(milliseconds)
        return self.events[before:]

    def tick(self, commands: Sequence[Command]) -> None:
        """Advance everything one millisecond."""
        due = self.driver.due()
        if self.now % (5 * MILLISECOND) == 0 or (due is not None and due <= self.now):
            self._send(commands)
        for item, twin, shaft in zip(self.devices, self.twins, self.shafts, strict=True):
            truth = Feedback(item.name, self.now, position=shaft.position, velocity=shaft.velocity)
            torques, frames = twin.step(self.now, [truth])
            shaft.turn(torques[0].torque, MILLISECOND)
            for frame in frames:
                assert isinstance(frame, CanFrame)
                self.received.append((self.now, frame))
                if self.from_device(frame):
                    self.events += self.driver.receive(self.now, frame)
        self.now += MILLISECOND

    def _send(self, messages: Sequence[Command | Request]) -> None:
        events, frames = self.driver.send(self.now, messages)
        self.events += events
        for frame in frames:
            assert isinstance(frame, CanFrame)
            self.sent.append((self.now, frame))
            if self.to_device(frame):
                for twin in self.twins:
                    twin.receive(self.now, frame)


def bench_of(plugin: Plugin, *devices: Device) -> CanBench[Any, Any]:
    """Return a bench with these devices, each on a shaft of 0.01 kg·m²."""
    twins, shafts = [plugin.twin(each, 0) for each in devices], [Shaft(inertia=0.01) for _ in devices]
    return CanBench(devices, plugin.driver(devices), twins, shafts)


def of(kind: type[EventKind], events: Sequence[Event]) -> list[EventKind]:
    """Return the events of one type."""
    return [event for event in events if isinstance(event, kind)]


def modes(events: Sequence[Event], motor: str = "left") -> list[str]:
    """Return the modes that a motor reported, in order."""
    return [state.mode.value for state in of(State, events) if state.motor == motor]


def acts(obeyed: Sequence[Obeyed]) -> list[Obeyed]:
    """Return what a device does now: without what it keeps."""
    return [each for each in obeyed if not isinstance(each, msg.Kept)]
