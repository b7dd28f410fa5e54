"""A robot without its brain (world, motors, sensors) as a process of its own, behind real buses or ptys.

Rules. Simulated devices must not answer where there may be real ones: the robot given has no interface of
its file any more (`without_interfaces`), only those that the command line names, and any other bus gets
pseudo-terminals. The world runs in wall time and keeps pace with it, or stands still and logs it; changes of
the buses and of the motors' states are logged.
"""

from __future__ import annotations

import logging
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, closing, contextmanager
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING

from gateway.buses import Bus, open_bus
from gateway.core.clock import Clock
from gateway.core.robot import TWIN, BusSettings, Robot
from gateway.errors import BusError
from gateway.runtime.device_log import DeviceLog
from gateway.runtime.process import fine_timers, quiet_collector, signals
from gateway.runtime.serve import ServeStats, ServeTick, serve
from protocols.frames import BusState
from protocols.messages import SECOND, Nanos

if TYPE_CHECKING:
    from gateway.buses.virtual.bus import TwinWorld

log = logging.getLogger("gateway")

STILL_PERIOD: Nanos = 10 * SECOND
"""Between two lines that the devices stood still, at least."""


@dataclass(slots=True)
class Devices:
    """The simulated devices of a robot, open on its buses."""

    robot: Robot
    """As another program has to open it: with the interfaces of that program's end."""
    twins: TwinWorld
    buses: dict[str, Bus]
    offered: dict[str, list[str]]
    """By bus without an interface of its own: the ports for other programs ("slcan:/dev/pts/3"), one each."""
    clock: Clock
    device_log: DeviceLog
    age: Nanos
    """Of the simulated world, when serving begins."""
    stats: ServeStats = field(default_factory=ServeStats)
    leaving: str = ""
    """The signal that ends it; "" if none came."""
    _still: Nanos = 0
    """How long the devices stood still, that is not logged yet."""
    _told_at: Nanos = -STILL_PERIOD

    def serve(self, seconds: float | None = None, watch: Callable[[Nanos], None] | None = None) -> None:
        """Serve until a signal comes, or for this time. `watch` is called at every iteration."""
        until = None if seconds is None else self.clock.now() + round(seconds * SECOND)
        served = serve(self.twins.buses, self.buses, self.clock, until=until, stats=self.stats, age=self.age)
        with closing(served):
            for moment in served:
                self._report(moment)
                if watch is not None:
                    watch(moment.now)
                if self.leaving:
                    log.warning("leaving: %s", self.leaving)
                    return

    def _report(self, moment: ServeTick) -> None:
        for level, text in self.device_log.update(moment.sent):
            log.log(level, "%s", text)
        for name, state in moment.states:
            log.warning("%s: %s", name, self._text(name, state))
        self._still += moment.stalled_for
        if self._still and moment.now >= self._told_at + STILL_PERIOD:
            log.warning(
                "the devices stood still for %.1f s, and received nothing meanwhile: this process was "
                "stopped, or the machine is too busy for it (end other processes, or use --realtime)",
                self._still / SECOND,
            )
            self._still, self._told_at = 0, moment.now

    def _text(self, bus: str, state: BusState) -> str:
        text = (_PTY_TEXTS if bus in self.offered else _BUS_TEXTS).get(state, f"is {state}")
        if state is BusState.PASSIVE and bus in self.offered:
            text += f": {self.robot.buses[bus].bitrate} bit/s"
        if state in (BusState.GONE, BusState.OFF) and (left := self.device_log.left_armed(bus)):
            text += f"; {left}"
        return text


_BUS_TEXTS = {
    BusState.PASSIVE: "is error-passive: check the wiring, the termination and the bit rate",
    BusState.OFF: "is bus-off: nothing is sent",
    BusState.FULL: "transmit queue full: frames of the devices were lost",
    BusState.GONE: "is gone: the devices are cut off",
    BusState.BACK: "is back",
}
_PTY_TEXTS = {
    BusState.BACK: "client connected",
    BusState.GONE: "client disconnected",
    BusState.PASSIVE: "the client has set another bit rate, and nothing passes; this bus has",
}


def without_interfaces(robot: Robot) -> Robot:
    """Return the robot with every bus simulated ("twin"), whatever its file has."""
    return replace(robot, buses={name: replace(b, interface=TWIN) for name, b in robot.buses.items()})


@contextmanager
def devices(
    robot: Robot,
    clock: Clock,
    seed: int | None = None,
    adapters: Sequence[str] = ("slcan",),
    link: Path | None = None,
    *,
    echo: bool = False,
) -> Iterator[Devices]:
    """Make the simulated world, then open the buses in front of it.

    `adapters`: the adapter protocol of each port of a CAN bus, for one program each; `link`: a folder in
    which the ports get names that stay the same; `echo`: lines whose devices speak only when asked give back
    what is sent on them, as many adapters do. Raises ConfigError and BusError."""
    from gateway.buses.virtual.bus import open_world

    with ExitStack() as stack:
        twins = open_world(without_interfaces(robot), robot.seed if seed is None else seed)
        for bus in twins.buses.values():
            bus.echoes = echo and bus.prompt
        device_log = DeviceLog(robot)
        age = device_log.warm_up(twins.buses)
        buses: dict[str, Bus] = {}
        offered: dict[str, list[str]] = {}
        outside = dict(robot.buses)
        for name, settings in robot.buses.items():
            buses[name], ports = _open(settings, clock, adapters)
            stack.callback(buses[name].close)
            if ports:
                offered[name] = ports if link is None else _linked(link, name, ports, stack)
                outside[name] = replace(settings, interface=offered[name][0])
        stack.enter_context(quiet_collector())
        fine_timers()
        made = Devices(replace(robot, buses=outside), twins, buses, offered, clock, device_log, age)
        stack.enter_context(signals(lambda name: setattr(made, "leaving", name)))
        yield made


def _open(settings: BusSettings, clock: Clock, adapters: Sequence[str]) -> tuple[Bus, list[str]]:
    """Open a bus on its interface; or on ptys, with the interfaces by which another program opens them."""
    serial, offered = settings.kind == "serial", settings.interface == TWIN
    if serial and offered:
        from gateway.buses.adapters.pty import SerialPty

        line = SerialPty(settings)
        return line, [f"serial:{line.pty.path}"]
    if offered and settings.kind in ("i2c", "camera"):
        text = f"one of kind {settings.kind!r} cannot be offered to another program: leave it in the robot's"
        text += " own process"
        raise BusError(f"bus {settings.name!r}: {text}")
    if offered:
        from gateway.buses.adapters.adapter_pty import AdapterPty

        ports = AdapterPty(settings, adapters)
        return ports, [f"{kind}:{path}" for kind, path in zip(adapters, ports.paths, strict=True)]
    return open_bus(settings, clock), []


def _linked(folder: Path, bus: str, ports: Sequence[str], stack: ExitStack) -> list[str]:
    """Link ptys into a folder as NAME, NAME.2 …; the links are removed when the stack is left."""
    links = []
    for number, port in enumerate(ports, start=1):
        kind, _, path = port.partition(":")
        link = folder / (bus if number == 1 else f"{bus}.{number}")
        try:
            folder.mkdir(parents=True, exist_ok=True)
            if link.is_symlink():  # left by a process that was killed
                link.unlink()
            link.symlink_to(path)
        except OSError as error:
            raise BusError(f"bus {bus!r}: --link {link}: {error.strerror}") from error
        stack.callback(link.unlink, missing_ok=True)
        links.append(f"{kind}:{link}")
    return links
