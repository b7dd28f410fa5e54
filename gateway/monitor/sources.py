"""What `gateway watch` listens to: buses of a robot file, bare interfaces, all that the machine has.

Rules. A bus is opened for listening alone, and what is given out can be read and closed and nothing else. A
robot file's devices are expected on its buses; on a bare interface any device of any installed language is
looked for. What cannot be listened to is named and left out, as long as anything can.
"""

from __future__ import annotations

import sys
from argparse import Namespace
from collections.abc import Callable, Mapping, Sequence
from contextlib import ExitStack
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Literal

from gateway import config
from gateway.buses import Bus
from gateway.config import resources
from gateway.core.clock import Clock
from gateway.core.robot import TWIN, BusSettings
from gateway.errors import BusError, UserError
from gateway.monitor.candidates import Tongue, anybody, of_robot
from gateway.monitor.decoder import Listener
from protocols.frames import BusState, Packet
from protocols.messages import Nanos
from protocols.plugin import load_all

if TYPE_CHECKING:
    from gateway.buses.socketcan.link import Link


BITRATE = 1_000_000
"""bit/s of a CAN bus of which neither the command line nor the kernel says it."""
FD_MTU = 72
"""Of a SocketCAN interface that takes CAN FD frames."""


@dataclass(frozen=True, slots=True)
class Source:
    """All that a listener may do with a bus."""

    read: Callable[[Nanos], tuple[Sequence[BusState], Sequence[Packet]]]
    close: Callable[[], None]


@dataclass(slots=True)
class Watching:
    """Buses that are listened to."""

    title: str
    listener: Listener
    sources: dict[str, Source]
    clock: Clock
    began: Nanos
    leaving: str = ""
    """The signal that ends it."""


@dataclass(slots=True)
class _Wanted:
    """Buses, and who is on them."""

    title: str
    buses: dict[str, BusSettings]
    tongues: Callable[[Mapping[str, BusSettings]], list[Tongue]]
    known: bool
    left_out: dict[str, str] = field(default_factory=dict)


def open_all(options: Namespace, clock: Clock, stack: ExitStack) -> Watching:
    """Open what can be opened. Raises UserError if there is nothing, with every reason."""
    wanted = _wanted(options)
    sources: dict[str, Source] = {}
    for name, settings in wanted.buses.items():
        if name in wanted.left_out:
            continue
        try:
            sources[name] = open_source(settings, clock)
        except BusError as error:
            wanted.left_out[name] = str(error)
            continue
        stack.callback(sources[name].close)
    if not sources:
        raise UserError("\n".join(wanted.left_out.values()) or "there is nothing to listen to")
    for reason in wanted.left_out.values():
        print(f"left out: {reason}", file=sys.stderr)
    tongues = wanted.tongues({name: wanted.buses[name] for name in sources})
    began = clock.now()
    listener = Listener(wanted.buses, tongues, began, known=wanted.known)
    for name in wanted.left_out:
        listener.buses[name].trouble = "left out"
    return Watching(wanted.title, listener, sources, clock, began)


def open_source(settings: BusSettings, clock: Clock) -> Source:
    """A bus for listening alone. Raises BusError with what is missing."""
    bus: Bus
    if settings.kind == "serial":
        from gateway.buses.serial import open_serial

        bus = open_serial(settings, clock)
    else:
        from gateway.buses.can import open_can

        bus = open_can(settings, clock, listen_only=True)
    return Source(bus.read, bus.close)


def _wanted(options: Namespace) -> _Wanted:
    if options.what is None:
        return _machine(options)
    if ":" in options.what:
        return _bare([options.what], options)
    return _robot(options)


def _robot(options: Namespace) -> _Wanted:
    """The buses of a robot file that are real."""
    robot = config.load_robot(resources.find("robots", options.what))
    robot = config.with_interfaces(robot, dict(options.bus))
    left_out = {name: _twin(bus) for name, bus in robot.buses.items() if bus.interface == TWIN}
    buses = dict(robot.buses)
    return _Wanted(robot.name, buses, lambda opened: of_robot(robot, list(opened)), True, left_out)


def _twin(bus: BusSettings) -> str:
    example = "serial:PORT" if bus.kind == "serial" else "socketcan:can0"
    return (
        f"bus {bus.name!r} is a twin inside the process that runs it, where nobody can listen; "
        f"if it is real, say where with --bus {bus.name}={example}"
    )


def _machine(options: Namespace) -> _Wanted:
    """Every CAN interface of this machine."""
    from gateway.buses.can_open import can_interfaces

    names = can_interfaces()
    if not names:
        raise UserError(
            "this machine has no CAN interface; say what to watch: a robot file, a recording, or "
            "INTERFACE:CHANNEL such as socketcan:can0, slcan:/dev/ttyACM0, serial:/dev/ttyUSB0"
        )
    return _bare([f"socketcan:{name}" for name in names], options)


def _bare(interfaces: Sequence[str], options: Namespace) -> _Wanted:
    """Interfaces of which no robot file says who is on them."""
    if options.bus:
        raise UserError("--bus is about the buses of a robot file; here the interface itself is named")
    plugins, broken = load_all()
    for bad in broken:
        print(f"left out: {bad.name} of {bad.distribution} is broken: {bad.reason}", file=sys.stderr)
    buses = {bus.name: bus for bus in (_settings(interface, options) for interface in interfaces)}
    return _Wanted(
        ", ".join(interfaces),
        buses,
        lambda opened: [tongue for bus in opened.values() for tongue in anybody(bus, plugins)],
        known=False,
    )


def _settings(interface: str, options: Namespace) -> BusSettings:
    driver, _, channel = interface.partition(":")
    name = channel.removeprefix("/dev/")
    if driver == "serial":
        return BusSettings(name, "serial", interface, baudrate=options.baudrate)
    link = _link(channel) if driver == "socketcan" else None
    data_bitrate = options.data_bitrate or (link.data_bitrate if link else 0)
    fd = data_bitrate or (link is not None and link.mtu >= FD_MTU)
    kind: Literal["can", "canfd"] = "canfd" if fd else "can"
    bitrate = options.bitrate or (link.bitrate if link else 0) or BITRATE
    return BusSettings(name, kind, interface, bitrate, data_bitrate)


def _link(name: str) -> Link | None:
    """What the kernel knows of an interface."""
    from gateway.buses.socketcan.link import Device

    try:
        device = Device(name)
    except OSError:
        return None
    try:
        return device.link()
    finally:
        device.close()
