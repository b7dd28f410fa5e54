"""`gateway twin`: the whole robot but its brain (world, motors, sensors), as a process behind its buses.

Rules. It speaks only on interfaces that the command line names, never on those that the robot file names:
twins do not answer on a wire where there may be real devices. The world runs in wall time and keeps pace
with it, or says that it does not. What comes and goes on the outer buses, and what the motors say of
themselves, is told. A signal ends it, with exit status 0.
"""

from __future__ import annotations

import logging
import shlex
from argparse import Namespace
from collections.abc import Iterator, Mapping, Sequence
from contextlib import ExitStack, closing, contextmanager
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING

from gateway import config, run, shipped
from gateway.clock import Clock, WallClock
from gateway.robot import TWIN, Robot
from protocols.wire import BusState
from protocols.words import SECOND

if TYPE_CHECKING:
    from gateway.buses import Bus
    from gateway.buses.twin import TwinWorld

log = logging.getLogger("gateway")


@dataclass(slots=True)
class Devices:
    """The devices' end of a robot, open on its buses."""

    robot: Robot
    """Its buses have the interfaces on which the devices speak."""
    twins: TwinWorld
    buses: dict[str, Bus]
    clock: Clock
    account: run.Service = field(default_factory=run.Service)
    leaving: str = ""

    def serve(self, seconds: float | None = None) -> None:
        """Until a signal, or so long."""
        until = None if seconds is None else self.clock.now() + round(seconds * SECOND)
        served = run.serve(self.twins.buses, self.buses, self.clock, until=until, account=self.account)
        with closing(served):
            for moment in served:
                self._tell(moment)
                if self.leaving:
                    log.warning("leaving: %s", self.leaving)
                    return

    def _tell(self, moment: run.Served) -> None:
        for name, state in moment.states:
            log.warning("%s: %s", name, _SENTENCES[state])
        if moment.stood:
            log.warning(
                "the devices stood still for %.1f s, as this process did; they heard nothing meanwhile",
                moment.stood / SECOND,
            )


_SENTENCES = {
    BusState.UP: "is up",
    BusState.PASSIVE: "is error-passive",
    BusState.OFF: "is bus-off: the devices are not heard",
    BusState.FULL: "is full: some of what the devices say is lost",
    BusState.GONE: "is gone: the devices neither hear nor are heard",
    BusState.BACK: "is back",
}


def twin(options: Namespace) -> int:
    """Be the devices of a robot until told to leave."""
    robot = outer(config.load(shipped.find("robots", options.robot)), dict(options.bus))
    with devices(robot, WallClock(), options.seed) as made:
        print("\n".join(invitation(made.robot, options.robot)), flush=True)
        made.serve(options.seconds)
    account = made.account
    print(f"{account.heard} packets heard, {account.said} said")
    return 0


def outer(robot: Robot, interfaces: Mapping[str, str]) -> Robot:
    """The robot with those interfaces; what the robot file itself says is left out.

    Raises ConfigError for buses that there are not, and for what is not INTERFACE:CHANNEL."""
    buses = {name: replace(bus, interface=TWIN) for name, bus in robot.buses.items()}
    return config.with_interfaces(replace(robot, buses=buses), interfaces)


@contextmanager
def devices(robot: Robot, clock: Clock, seed: int | None = None) -> Iterator[Devices]:
    """Open the buses, then make the world behind them. Raises BusError and WorldError with a sentence."""
    from gateway.buses.twin import open_world

    inner = replace(robot, buses={n: replace(bus, interface=TWIN) for n, bus in robot.buses.items()})
    with ExitStack() as stack:
        buses, told = _open(robot, clock, stack, 1)
        twins = open_world(inner, robot.seed if seed is None else seed)
        stack.enter_context(run.quiet_collector())
        made = Devices(told, twins, buses, clock)
        stack.enter_context(run.signals(lambda name: setattr(made, "leaving", name)))
        yield made


def _open(robot: Robot, clock: Clock, stack: ExitStack, ports: int) -> tuple[dict[str, Bus], Robot]:
    """The outer buses, and the robot with what another program opens to meet them."""
    buses: dict[str, Bus] = {}
    told = dict(robot.buses)
    for name, settings in robot.buses.items():
        if settings.kind == "serial" and settings.interface == TWIN:
            from gateway.buses.pty import SerialPty

            line = buses[name] = SerialPty(settings, clock)
            told[name] = replace(settings, interface=f"serial:{line.pty.path}")
        elif settings.kind == "serial":
            from gateway.buses.serial import open_serial

            buses[name] = open_serial(settings, clock)
        elif settings.interface == TWIN:
            from gateway.buses.slcan_pty import SlcanPty

            adapters = buses[name] = SlcanPty(settings, clock, ports)
            told[name] = replace(settings, interface=f"slcan:{adapters.paths[0]}")
        else:
            from gateway.buses.can import open_can

            buses[name] = open_can(settings, clock)
        stack.callback(buses[name].close)
    return buses, replace(robot, buses=told)


def invitation(robot: Robot, name: str) -> Sequence[str]:
    """What to type to meet these devices."""
    lines = [f"the devices of {robot.name} are there; meet them with:"]
    words = ["gateway", "run", name]
    for bus in robot.buses.values():
        words += ["--bus", f"{bus.name}={bus.interface}"]
    return [*lines, "  " + shlex.join(words)]
