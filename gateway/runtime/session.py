"""A session: everything that a live run needs, opened in order and closed in the opposite one.

Rules. Buses are opened before anything is armed, and closed after the safe word. The world is made only for
buses whose interface is "twin". What cannot be opened is a sentence (`BusError`), and nothing has moved yet.
"""

from __future__ import annotations

import logging
from collections.abc import Callable, Generator, Iterator, Mapping, Sequence
from contextlib import ExitStack, closing, contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING

from brain.belief import Belief
from gateway.config import cautions
from gateway.core.clock import Clock, SimulatedClock, date
from gateway.core.robot import TWIN, Robot
from gateway.core.step import Gateway
from gateway.core.tick import Tick
from gateway.runtime import loop
from protocols.messages import Asked, Goal, Nanos

if TYPE_CHECKING:
    from gateway.buses import Bus
    from gateway.buses.virtual.bus import TwinWorld
    from gateway.recording import Recorder

log = logging.getLogger("gateway")

MOST_READS = 100
"""Of one bus, before a run begins."""


@dataclass(slots=True)
class Session:
    """What a run consists of, for those who watch it."""

    robot: Robot
    gateway: Gateway
    clock: Clock
    buses: dict[str, Bus]
    twins: TwinWorld | None
    recorder: Recorder | None
    account: loop.LoopStats = field(default_factory=loop.LoopStats)
    leaving: str = ""
    """Why the run is to end before its time: a signal, or an operator's quit."""

    def tour(self) -> list[Goal]:
        """The goals of the world's own tour; none where there is no world."""
        return [Goal(x, y) for x, y in self.twins.world.tour] if self.twins is not None else []

    def _keep(self, tick: Tick, belief: Belief) -> None:
        if self.recorder is not None:
            self.recorder.record(tick, belief, patient=isinstance(self.clock, SimulatedClock))

    def ticks(
        self,
        lasting: Nanos | None = None,
        ask: Callable[[], Sequence[Asked]] = loop.no_questions,
        *,
        dry: bool = False,
    ) -> Generator[Tick]:
        """The live loop, for so long or until something asks it to leave; closing says the safe word."""
        until = None if lasting is None else self.clock.now() + lasting
        ticks = loop.live(
            self.gateway,
            self.buses,
            self.clock,
            ask=ask,
            keep=self._keep,
            until=until,
            account=self.account,
            dry=dry,
        )
        with closing(ticks):
            for tick in ticks:
                yield tick
                if self.leaving:
                    log.warning("leaving: %s", self.leaving)
                    return


@contextmanager
def session(
    robot: Robot, clock: Clock, *, record: Path | None = None, seed: int | None = None
) -> Iterator[Session]:
    """Open everything, in order; on the way out close everything, in the opposite order."""
    with ExitStack() as stack:
        buses, twins = _open_buses(robot, clock, seed, stack)
        recorder = None
        if record is not None:
            from gateway.recording import Recorder

            mounts = {name: sensor.mount for name, sensor in robot.sensors.items()}
            recorder = Recorder(record, robot.text, {"date": date()}, mounts)
            stack.callback(recorder.close)
        gateway = Gateway(robot)
        for caution in cautions(robot):
            log.warning("%s", caution)
        stack.enter_context(loop.quiet_collector())
        _forget(robot, buses, clock)
        made = Session(robot, gateway, clock, buses, twins, recorder)
        stack.enter_context(loop.signals(lambda name: setattr(made, "leaving", name)))
        yield made


def _forget(robot: Robot, buses: Mapping[str, Bus], clock: Clock) -> None:
    """What has come in while all this was opened is of an unknown age: it is left out."""
    for name, bus in buses.items():
        for _ in range(MOST_READS if robot.buses[name].interface != TWIN else 0):
            states, packets = bus.read(clock.now())
            for state in states:
                log.warning("%s: %s", name, state)
            if not packets:
                break


def _open_buses(
    robot: Robot, clock: Clock, seed: int | None, stack: ExitStack
) -> tuple[dict[str, Bus], TwinWorld | None]:
    twins = None
    if any(bus.interface == TWIN for bus in robot.buses.values()):
        from gateway.buses.virtual.bus import open_world

        twins = open_world(robot, robot.seed if seed is None else seed)
    buses: dict[str, Bus] = {}
    for name, settings in robot.buses.items():
        if settings.interface == TWIN and twins is not None:
            buses[name] = twins.buses[name]
        elif settings.kind == "serial":
            from gateway.buses.serial import open_serial

            buses[name] = open_serial(settings, clock)
        else:
            from gateway.buses.can import open_can

            buses[name] = open_can(settings, clock)
        stack.callback(buses[name].close)
    return buses, twins
