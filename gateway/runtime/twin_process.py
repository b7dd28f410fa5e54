"""`gateway twin`: the whole robot but its brain (world, motors, sensors), as a process behind its buses.

Rules. It speaks only on interfaces that the command line names, never on those that the robot file names:
twins do not answer on a wire where there may be real devices. A bus that is not named gets ptys of its own.
The world runs in wall time and keeps pace with it, or says that it does not. What comes and goes on the
buses, and what the motors say of themselves, is told. A signal ends it, with exit status 0.
"""

from __future__ import annotations

import logging
import shlex
from argparse import Namespace
from collections.abc import Iterator, Mapping, Sequence
from contextlib import ExitStack, closing, contextmanager
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING

from gateway import config
from gateway.config import resources
from gateway.core.clock import Clock, WallClock
from gateway.core.robot import TWIN, BusSettings, Robot
from gateway.errors import BusError
from gateway.runtime.device_log import DeviceLog
from gateway.runtime.process import quiet_collector, request_realtime, signals
from gateway.runtime.serve import ServeStats, ServeTick, serve
from protocols.frames import BusState
from protocols.messages import MILLISECOND, SECOND, Nanos

if TYPE_CHECKING:
    from gateway.buses import Bus
    from gateway.buses.virtual.bus import TwinWorld

log = logging.getLogger("gateway")


@dataclass(slots=True)
class Devices:
    """The devices' end of a robot, open on its buses."""

    robot: Robot
    """As another program meets it: its buses have the interfaces which that program is to open."""
    twins: TwinWorld
    buses: dict[str, Bus]
    offered: dict[str, list[str]]
    """Where programs may meet each bus that has no interface of its own: "slcan:/dev/pts/3", one each."""
    clock: Clock
    device_log: DeviceLog
    age: Nanos
    """Of the world, when serving begins."""
    stats: ServeStats = field(default_factory=ServeStats)
    leaving: str = ""

    def serve(self, seconds: float | None = None) -> None:
        """Until a signal, or so long."""
        until = None if seconds is None else self.clock.now() + round(seconds * SECOND)
        served = serve(
            self.twins.buses, self.buses, self.clock, until=until, stats=self.stats, age=self.age
        )
        with closing(served):
            for moment in served:
                self._report(moment)
                if self.leaving:
                    log.warning("leaving: %s", self.leaving)
                    return

    def _report(self, moment: ServeTick) -> None:
        for level, sentence in self.device_log.handle(moment.said):
            log.log(level, "%s", sentence)
        for name, state in moment.states:
            log.warning("%s: %s", name, self._sentence(name, state))
        if moment.stalled_for:
            stalled_for = moment.stalled_for / SECOND
            log.warning(
                "this process stood still for %.1f s, and so did its devices; they heard nothing", stalled_for
            )

    def _sentence(self, bus: str, state: BusState) -> str:
        sentence = (_OF_PTYS if bus in self.offered else _OF_FRAMES).get(state, f"is {state}")
        if state is BusState.PASSIVE and bus in self.offered:
            sentence += f": {self.robot.buses[bus].bitrate} bit/s"
        if state in (BusState.GONE, BusState.OFF) and (left := self.device_log.left_armed(bus)):
            sentence += f"; {left}"
        return sentence


ADAPTERS = ("slcan", "fdcanusb")
"""What a port of a CAN bus may speak (gateway.buses.adapters.adapter_pty)."""
_OF_FRAMES = {
    BusState.PASSIVE: "is error-passive: check the wiring, the termination and the bit rate",
    BusState.OFF: "is bus-off: the devices are not heard",
    BusState.FULL: "is full: some of what the devices say is lost",
    BusState.GONE: "is gone: the devices neither hear nor are heard",
    BusState.BACK: "is back",
}
_OF_PTYS = {
    BusState.BACK: "somebody is there",
    BusState.GONE: "nobody is there any more",
    BusState.PASSIVE: "somebody has set another bit rate, and nothing passes; this bus has",
}


def twin(options: Namespace) -> int:
    """Be the devices of a robot until told to leave."""
    robot = outer(config.load_robot(resources.find("robots", options.robot)), dict(options.bus))
    if options.realtime is not None and (refused := request_realtime(options.realtime)):
        log.warning("%s", refused)
    adapters = (options.adapter or ["slcan"]) * options.ports
    with devices(robot, WallClock(), options.seed, adapters, options.link) as made:
        print("\n".join(invitation(made, options.robot)), flush=True)
        made.serve(options.seconds)
    stats = made.stats
    print(f"{stats.received} packets heard, {stats.said} said", end="")
    print(f"; at most {stats.late / MILLISECOND:.0f} ms behind the clock", end="")
    print(f"; stood still for {stats.lost / SECOND:.1f} s in all" if stats.lost else "")
    return 0


def outer(robot: Robot, interfaces: Mapping[str, str]) -> Robot:
    """The robot with those interfaces, and none ("twin") where none is named, whatever its file says.

    Raises ConfigError for buses that there are not, and for what is not INTERFACE:CHANNEL."""
    return config.with_interfaces(_without_interfaces(robot), interfaces)


def _without_interfaces(robot: Robot) -> Robot:
    return replace(robot, buses={name: replace(b, interface=TWIN) for name, b in robot.buses.items()})


@contextmanager
def devices(
    robot: Robot,
    clock: Clock,
    seed: int | None = None,
    adapters: Sequence[str] = ("slcan",),
    link: Path | None = None,
) -> Iterator[Devices]:
    """Make the world, then open the buses in front of it.

    `adapters`: what each port of a CAN bus speaks, for one program each; `link`: a folder in which ptys get
    names that stay the same. Raises WorldError and BusError with a sentence."""
    from gateway.buses.virtual.bus import open_world

    with ExitStack() as stack:
        twins = open_world(_without_interfaces(robot), robot.seed if seed is None else seed)
        device_log = DeviceLog(robot)
        age = device_log.meet(twins.buses)
        buses: dict[str, Bus] = {}
        offered: dict[str, list[str]] = {}
        met = dict(robot.buses)
        for name, settings in robot.buses.items():
            buses[name], ports = _open(settings, clock, adapters)
            stack.callback(buses[name].close)
            if ports:
                offered[name] = ports if link is None else _linked(link, name, ports, stack)
                met[name] = replace(settings, interface=offered[name][0])
        stack.enter_context(quiet_collector())
        made = Devices(replace(robot, buses=met), twins, buses, offered, clock, device_log, age)
        stack.enter_context(signals(lambda name: setattr(made, "leaving", name)))
        yield made


def _open(settings: BusSettings, clock: Clock, adapters: Sequence[str]) -> tuple[Bus, list[str]]:
    """A bus on its interface; or on ptys, and by which interfaces they are met."""
    serial, offered = settings.kind == "serial", settings.interface == TWIN
    if serial and offered:
        from gateway.buses.adapters.pty import SerialPty

        line = SerialPty(settings, clock)
        return line, [f"serial:{line.pty.path}"]
    if serial:
        from gateway.buses.serial import open_serial

        return open_serial(settings, clock), []
    if offered:
        from gateway.buses.adapters.adapter_pty import AdapterPty

        ports = AdapterPty(settings, clock, adapters)
        return ports, [f"{kind}:{path}" for kind, path in zip(adapters, ports.paths, strict=True)]
    from gateway.buses.can import open_can

    return open_can(settings, clock), []


def _linked(folder: Path, bus: str, ports: Sequence[str], stack: ExitStack) -> list[str]:
    """Names for ptys in a folder: the bus's own, then NAME.2 …; gone when the stack is left."""
    links = []
    for number, port in enumerate(ports, start=1):
        kind, _, path = port.partition(":")
        link = folder / (bus if number == 1 else f"{bus}.{number}")
        try:
            folder.mkdir(parents=True, exist_ok=True)
            if link.is_symlink():  # of a process that was killed
                link.unlink()
            link.symlink_to(path)
        except OSError as error:
            raise BusError(f"bus {bus!r}: --link {link}: {error.strerror}") from error
        stack.callback(link.unlink, missing_ok=True)
        links.append(f"{kind}:{link}")
    return links


def invitation(made: Devices, robot: str) -> Sequence[str]:
    """What to type to meet these devices; `robot` is what the robot file was called."""
    words = ["gateway", "run", robot]
    notes = []
    for name, bus in made.robot.buses.items():
        kind, _, channel = bus.interface.partition(":")
        if kind in (*ADAPTERS, "serial") and name not in made.offered:  # a port is for one program alone
            other = "another adapter on the bus of" if kind in ADAPTERS else "the other end of"
            notes.append(f"PORT of {name}: {other} {channel}")
            channel = "PORT"
        words += ["--bus", f"{name}={kind}:{channel}"]
    for name, ports in made.offered.items():
        if ports[1:]:
            notes.append(f"other programs may be on {name} too, by {', '.join(ports[1:])}; for instance:")
            notes.append(f"  {_example(ports[1], made.robot.buses[name])}")
    head = f"the devices of {made.robot.name} are there; to run the robot:"
    return [head, "  " + shlex.join(words), *notes]


def _example(port: str, bus: BusSettings) -> str:
    """What might listen at a port."""
    kind, _, path = port.partition(":")
    if kind != "slcan":
        return f"gateway watch {port}"
    return f"python -m can.viewer -i slcan -c {path}{' --fd' if bus.kind == 'canfd' else ''}"
