"""The driver and twins in a for-loop, with what the tests of the driver look at."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

from protocols.cia402 import plugin, sdo
from protocols.cia402.options import Options, Settings
from protocols.conformance.bench import NAMES, START, STEP, Bench, StepResult, make_bench
from protocols.frames import CanFrame, Frame
from protocols.messages import Command, Event, Feedback, Mode, Nanos, Request
from protocols.plugin import Device

PROFILE = Options(modes="profile")
BY_SDO = Options(mapping="keep")
EVENT = Options(feedback="event")
POLLED = Options(feedback="sdo")
ALL = {"sync": Options(), "event": EVENT, "polled": POLLED, "keep": BY_SDO, "profile": PROFILE}


@dataclass(slots=True)
class Stage:
    """Alpha (node 1) and beta (node 2), or alpha alone."""

    stage: Bench
    events: list[Event] = field(default_factory=list)
    """All but Feedback."""
    feedback: list[Feedback] = field(default_factory=list)
    down: list[CanFrame] = field(default_factory=list)
    up: list[CanFrame] = field(default_factory=list)

    @property
    def driver(self) -> Any:
        return self.stage.driver

    @property
    def twin(self) -> Any:
        """Alpha's."""
        return self.stage.twins[0]

    @property
    def drive(self) -> Any:
        """Alpha's record in the driver."""
        return self.driver.drives[1]

    @property
    def ms(self) -> int:
        return (self.stage.now - START) // STEP

    def step(self, *messages: Command | Request, stray: Sequence[Frame] = ()) -> StepResult:
        result = self.stage.step(messages, extra_up=stray)
        self.events += [e for e in result.events if not isinstance(e, Feedback)]
        self.feedback += [e for e in result.events if isinstance(e, Feedback)]
        self.down += [f for f in result.down if isinstance(f, CanFrame)]
        self.up += [f for f in result.up if isinstance(f, CanFrame)]
        return result

    def steps(self, count: int, *messages: Command | Request) -> None:
        for _ in range(count):
            self.step(*messages)

    def until(self, mode: Mode, *messages: Command | Request, most: int = 1500, name: str = NAMES[0]) -> int:
        """Step until the driver reports this mode; return the number of steps."""
        for count in range(most):
            self.step(*messages)
            if self.stage.modes.get(name) is mode:
                return count
        raise AssertionError(f"not {mode} in {most} ms: {self.events[-3:]}")

    def fresh(self) -> None:
        """Replace the driver by a new one."""
        self.stage.driver = plugin.driver(self.stage.devices)
        self.stage.modes.clear()
        self.forget()

    def forget(self) -> None:
        """Forget the events and frames so far."""
        self.events.clear()
        self.feedback.clear()
        self.down.clear()
        self.up.clear()

    def of(self, kind: type[Any]) -> list[Any]:
        """The events of a kind."""
        return [event for event in self.events if isinstance(event, kind)]

    def sent(self, id_: int) -> list[bytes]:
        """Return the data of the driver's frames with this identifier."""
        return [frame.data for frame in self.down if frame.id == id_]

    def writes(self, node: int = 1) -> list[tuple[int, int, int]]:
        """Return (index, subindex, value) of every SDO download to a node."""
        requests = [sdo.decode_request(f.data) for f in self.down if f.id == 0x600 + node]
        return [
            (r.index, r.sub, int.from_bytes(r.data, "little"))
            for r in requests
            if isinstance(r, sdo.Download)
        ]


def stage(
    options: Options | None = None, settings: Settings | None = None, count: int = 1, position: float = 0.0
) -> Stage:
    """Set up devices as delivered, on shafts at a position."""
    made = make_bench(plugin, options or Options(), (1, 2)[:count], NAMES[:count], settings or Settings())
    for shaft in made.shafts.values():
        shaft.position = position
    return Stage(made)


def device(
    name: str = "m", address: int = 5, options: Options | None = None, settings: Settings | None = None
) -> Device:
    return Device(name, address, options or Options(), settings or Settings())


def ms(count: int) -> Nanos:
    return START + count * STEP
