"""Opens what `gateway watch` listens to: the buses of a robot file, one interface, or all of the machine.

Rules. A bus is opened listen-only, and its source can be read and closed only. A robot file's devices are
expected on its buses; on an interface alone, the devices of every installed protocol are looked for. What
cannot be opened is named and left out, as long as anything can be opened.
"""

from __future__ import annotations

import sys
from argparse import Namespace
from collections.abc import Callable, Sequence
from contextlib import ExitStack
from dataclasses import dataclass
from typing import TYPE_CHECKING, Literal

from gateway.buses import open_bus
from gateway.config import load_robot, with_interfaces
from gateway.core.clock import Clock
from gateway.core.robot import ADAPTERS, TWIN, BusSettings
from gateway.errors import BusError, UserError
from gateway.monitor.candidates import of_plugins, of_robot
from gateway.monitor.decoder import BusMonitor
from protocols.frames import BusState, Packet
from protocols.messages import Nanos
from protocols.plugin import Plugin, load_all
from protocols.sensors import kinds

if TYPE_CHECKING:
    from gateway.buses.netlink import NetLink

DEFAULT_BITRATE = 1_000_000
"""bit/s of a CAN bus whose bit rate neither the command line nor the kernel gives."""
FD_MTU = 72
"""Of a SocketCAN interface that takes CAN FD frames."""


@dataclass(frozen=True, slots=True)
class Source:
    """The only operations of a bus that a listener may use."""

    read: Callable[[Nanos], tuple[Sequence[BusState], Sequence[Packet]]]
    close: Callable[[], None]


@dataclass(slots=True)
class WatchSession:
    """Open buses, and what is known of them."""

    title: str
    monitor: BusMonitor
    sources: dict[str, Source]
    clock: Clock
    began: Nanos
    leaving: str = ""
    """The signal that ends it."""


def open_all(options: Namespace, clock: Clock, stack: ExitStack) -> WatchSession:
    """Open what can be opened. Raises UserError with every reason if nothing can."""
    robot, left_out = None, dict[str, str]()
    if options.what is None or ":" in options.what:
        interfaces = [options.what] if options.what else _machine()
        if options.bus:
            raise UserError("--bus is for the buses of a robot file; here an interface itself is named")
        title, plugins = ", ".join(interfaces), usable_plugins()
        buses = {
            bus.name: bus
            for bus in (
                bus_named(interface, options.bitrate, options.data_bitrate, options.baudrate)
                for interface in interfaces
            )
        }
    else:
        robot = with_interfaces(load_robot(options.what), dict(options.bus))
        title, buses = robot.name, dict(robot.buses)
        left_out = {name: _simulated(bus) for name, bus in buses.items() if bus.interface == TWIN}
    sources: dict[str, Source] = {}
    for name, settings in buses.items():
        if name not in left_out:
            try:
                sources[name] = open_source(settings, clock)
            except BusError as error:
                left_out[name] = str(error)
            else:
                stack.callback(sources[name].close)
    if not sources:
        raise UserError("\n".join(left_out.values()))
    for reason in left_out.values():
        print(f"left out: {reason}", file=sys.stderr)
    if robot is not None:
        variants = of_robot(robot, list(sources))
    else:
        variants = [variant for name in sources for variant in of_plugins(buses[name], plugins)]
    began = clock.now()
    monitor = BusMonitor(buses, variants, began, known=robot is not None)
    for name in left_out:
        monitor.buses[name].left_out = True
    return WatchSession(title, monitor, sources, clock, began)


def open_source(settings: BusSettings, clock: Clock) -> Source:
    """Open a bus listen-only. Raises BusError with what is missing."""
    bus = open_bus(settings, clock, listen_only=True)
    return Source(bus.read, bus.close)


def _simulated(bus: BusSettings) -> str:
    if bus.kind in ("i2c", "camera"):
        return f"bus {bus.name!r} is of kind {bus.kind!r}: nobody can listen on one beside its host"
    example = "serial:PORT" if bus.kind == "serial" else "socketcan:can0"
    return (
        f"bus {bus.name!r} is simulated inside the process that runs it, where nothing else can listen; "
        f"if it is real, give its interface with --bus {bus.name}={example}"
    )


def _machine() -> list[str]:
    """Return every CAN interface of this machine. Raises UserError if there is none."""
    from gateway.buses.usb import can_interfaces

    names = can_interfaces()
    if not names:
        raise UserError(
            "this machine has no CAN interface; name what to watch: a robot file, a recording, or "
            "INTERFACE:CHANNEL such as socketcan:can0, slcan:/dev/ttyACM0, serial:/dev/ttyUSB0"
        )
    return [f"socketcan:{name}" for name in names]


def usable_plugins() -> tuple[Plugin, ...]:
    """Return the installed protocols; those that are broken are named on standard error."""
    plugins, broken = load_all()
    for one in broken:
        print(f"left out: {one.name} of {one.distribution} is broken: {one.reason}", file=sys.stderr)
    for text in kinds().left_out:
        print(text, file=sys.stderr)
    return plugins


def bus_named(interface: str, bitrate: int = 0, data_bitrate: int = 0, baudrate: int = 0) -> BusSettings:
    """Return the bus INTERFACE:CHANNEL, with the rates of a CAN interface as the kernel has them unless they
    are given [bit/s]. Raises UserError."""
    driver, _, channel = interface.partition(":")
    if driver in ADAPTERS:
        raise UserError(f"{interface}: expected {ADAPTERS[driver]}")
    name = channel.removeprefix("/dev/")
    if driver == "serial":
        return BusSettings(name, "serial", interface, baudrate=baudrate)
    link = _link(channel) if driver == "socketcan" else None
    data_bitrate = data_bitrate or (link.data_bitrate if link else 0)
    fd = data_bitrate or (link is not None and link.mtu >= FD_MTU)
    kind: Literal["can", "canfd"] = "canfd" if fd else "can"
    bitrate = bitrate or (link.bitrate if link else 0) or DEFAULT_BITRATE
    return BusSettings(name, kind, interface, bitrate, data_bitrate)


def _link(name: str) -> NetLink | None:
    """Return what the kernel knows of an interface."""
    from gateway.buses.netlink import NetDevice

    try:
        device = NetDevice(name)
    except OSError:
        return None
    try:
        return device.link()
    finally:
        device.close()
