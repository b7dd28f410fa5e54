"""Our driver and twins in a for-loop, with names for what the tests of the driver look at."""

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
    """Alpha (node 1) and beta (node 2), as many as asked for."""

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
        """Alpha, as the driver knows it."""
        return self.driver.drives[1]

    @property
    def ms(self) -> int:
        return (self.stage.now - START) // STEP

    def step(self, *words: Command | Request, stray: Sequence[Frame] = ()) -> StepResult:
        said = self.stage.step(words, extra_up=stray)
        self.events += [e for e in said.events if not isinstance(e, Feedback)]
        self.feedback += [e for e in said.events if isinstance(e, Feedback)]
        self.down += [w for w in said.down if isinstance(w, CanFrame)]
        self.up += [w for w in said.up if isinstance(w, CanFrame)]
        return said

    def steps(self, count: int, *words: Command | Request) -> None:
        for _ in range(count):
            self.step(*words)

    def until(self, mode: Mode, *words: Command | Request, most: int = 1500, name: str = NAMES[0]) -> int:
        """Step until the driver tells this mode; how many steps it took."""
        for count in range(most):
            self.step(*words)
            if self.stage.modes.get(name) is mode:
                return count
        raise AssertionError(f"not {mode} in {most} ms: {self.events[-3:]}")

    def fresh(self) -> None:
        """Another driver, that knows nothing."""
        self.stage.driver = plugin.driver(self.stage.devices)
        self.stage.modes.clear()
        self.forget()

    def forget(self) -> None:
        """What was said so far."""
        self.events.clear()
        self.feedback.clear()
        self.down.clear()
        self.up.clear()

    def of(self, kind: type[Any]) -> list[Any]:
        """The events of a kind."""
        return [event for event in self.events if isinstance(event, kind)]

    def said(self, id_: int) -> list[bytes]:
        """The data of the frames that the driver said with this identifier."""
        return [frame.data for frame in self.down if frame.id == id_]

    def writes(self, node: int = 1) -> list[tuple[int, int, int]]:
        """(index, subindex, value) of every SDO download to a node."""
        requests = [sdo.decode_request(f.data) for f in self.down if f.id == 0x600 + node]
        return [
            (r.index, r.sub, int.from_bytes(r.data, "little"))
            for r in requests
            if isinstance(r, sdo.Download)
        ]


def stage(
    options: Options | None = None, settings: Settings | None = None, count: int = 1, position: float = 0.0
) -> Stage:
    """Devices as they come, on shafts at a position."""
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
