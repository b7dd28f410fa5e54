"""`gateway scan`: what is on the buses of this machine, without a robot file.

Rules. Only read-only frames are sent (`gateway.runtime.scan`). Exit status: 0 if a device was found, 1 if
none was, 2 if nothing could be opened.
"""

from __future__ import annotations

import json
import logging
import sys
from argparse import ArgumentParser, Namespace
from collections.abc import Iterator, Sequence
from contextlib import closing
from dataclasses import asdict
from typing import Any

from gateway.buses import open_bus
from gateway.buses.usb import can_interfaces, port_names
from gateway.cli import arguments
from gateway.core.clock import WallClock
from gateway.core.message_text import escaped
from gateway.core.robot import BusSettings
from gateway.errors import BusError, UserError
from gateway.monitor.sources import bus_named, open_source, usable_plugins
from gateway.runtime import scan
from gateway.runtime.scan import Finding, Heard, Probe
from protocols.frames import EXTENDED_BIT
from protocols.plugin import Plugin

log = logging.getLogger("gateway")

BAUDRATES = (1_000_000, 115_200, 57_600, 38_400, 9_600, 230_400, 500_000, 921_600, 3_000_000)
"""bit/s at which a serial line is tried: those that the devices of our protocols have when they are new, and
common ones."""
RATE_OF_OTHERS = ("socketcan", "virtual", "udp_multicast", "dm-serial")
"""Interfaces whose bit rate is not ours to set."""
_RATE = (
    "at another bit rate: sudo ip link set {0} down; sudo ip link set {0} type can bitrate 500000; "
    "sudo ip link set {0} up"
)
_OTHER_RATE = "errors at every rate: the bus has another one (--bitrate N), or its wiring is wrong"
CAUTION = "no controller may be on it that obeys any byte (a Sabertooth in its simplified mode)"


def add_arguments(parser: ArgumentParser) -> None:
    """Add the arguments of the command."""
    parser.add_argument(
        "interfaces",
        nargs="*",
        metavar="INTERFACE",
        help="can0, /dev/ttyUSB0, or INTERFACE:CHANNEL such as slcan:/dev/ttyACM0 "
        "(default: every CAN interface and serial port of this machine)",
    )
    parser.add_argument(
        "--protocol",
        action="append",
        default=[],
        metavar="NAME",
        help="look for its devices alone; repeatable",
    )
    rate = arguments.integer("a rate in bit/s", 1)
    parser.add_argument(
        "--bitrate",
        type=rate,
        default=0,
        metavar="N",
        help="of a CAN bus (default: the kernel's, or, where it is ours to set, "
        f"{', '.join(map(str, scan.BITRATES))}: it is listened to at each)",
    )
    parser.add_argument("--data-bitrate", type=rate, default=0, metavar="N", help="of CAN FD")
    parser.add_argument(
        "--baudrate",
        type=rate,
        action="append",
        default=[],
        metavar="N",
        help=f"of a serial line; repeatable (default: {', '.join(map(str, BAUDRATES))})",
    )
    parser.add_argument("--json", action="store_true", help="print one JSON array")


def run(options: Namespace) -> int:
    """Look on one interface after the other."""
    plugins = scan.chosen(usable_plugins(), options.protocol)
    interfaces = [_full(one) for one in options.interfaces] or _machine()
    log.addFilter(_is_error)
    try:
        return _scan_all(interfaces, plugins, options)
    finally:
        log.removeFilter(_is_error)


def _is_error(record: logging.LogRecord) -> bool:
    """False for what a placeholder's silence is warned of."""
    return record.levelno >= logging.ERROR


def _scan_all(interfaces: Sequence[str], plugins: Sequence[Plugin], options: Namespace) -> int:
    results, opened = _results(interfaces, plugins, options)
    if options.json:
        print(json.dumps(results, indent=2))
    return 2 if not opened else 0 if results else 1


def _results(
    interfaces: Sequence[str], plugins: Sequence[Plugin], options: Namespace
) -> tuple[list[dict[str, Any]], int]:
    """Return what was found, as --json prints it, and how many buses could be opened."""
    results: list[dict[str, Any]] = []
    opened = 0
    if not options.json and any(one.startswith("serial:") for one in interfaces):
        print(f"serial lines are asked, too: {CAUTION}")
    for interface in interfaces:
        found: list[Finding] = []
        for bus in _buses(interface, options):
            try:
                found, probes, ids = _scan(bus, plugins, quiet=options.json)
            except BusError as error:
                print(error, file=sys.stderr)
                break
            opened += 1
            results += [_row(interface, bus, one) for one in found]
            if not options.json:
                _print(found, probes, ids)
            if found and not (options.baudrate or options.bitrate):
                break  # a bus has one rate
        if not found and not options.json and interface.startswith("socketcan:"):
            print(f"  {_RATE.format(interface.partition(':')[2])}")
    return results, opened


def _full(text: str) -> str:
    """Return INTERFACE:CHANNEL of what a person types."""
    if ":" in text:
        return text
    return f"serial:{text}" if text.startswith("/") else f"socketcan:{text}"


def _machine() -> list[str]:
    """Return every interface of this machine. Raises UserError if there is none."""
    ports = port_names()
    for port, usb in ports.items():
        print(f"{port}: {usb or 'no USB name'}", file=sys.stderr)
    found = [*(f"socketcan:{name}" for name in can_interfaces()), *(f"serial:{port}" for port in ports)]
    if not found:
        text = "this machine has no CAN interface and no serial port: is the adapter plugged in?"
        raise UserError(f"{text} Or name one: can0, /dev/ttyUSB0, slcan:/dev/ttyACM0")
    return found


def _buses(interface: str, options: Namespace) -> Iterator[BusSettings]:
    """Yield the bus with each rate at which devices are looked for."""
    data, kind = options.data_bitrate, interface.partition(":")[0]
    if kind == "serial":
        for baudrate in options.baudrate or BAUDRATES:
            yield bus_named(interface, 0, 0, baudrate)
    elif options.bitrate or kind in RATE_OF_OTHERS:
        yield bus_named(interface, options.bitrate, data)
    else:
        heard: dict[int, Heard] = {}
        for rate in scan.BITRATES:
            try:
                source = open_source(bus_named(interface, rate, data), clock := WallClock())
            except BusError as error:
                print(error, file=sys.stderr)
                return
            with closing(source):
                heard[rate] = one = scan.listened(source.read, clock)
            if not options.json:
                what = f"{one.frames} frames" if one.frames else "errors" if one.errors else "silent"
                print(f"{interface} at {rate:,} bit/s: {what}", flush=True)
        rates = scan.likely(heard)
        if not rates:
            print(f"{interface}: {_OTHER_RATE}", file=sys.stderr)
        yield from (bus_named(interface, rate, data) for rate in rates)


def _row(interface: str, bus: BusSettings, found: Finding) -> dict[str, Any]:
    """Return one finding with its bus, as --json prints it."""
    rates = {"rate": _rate(bus), "kind": bus.kind, "data_rate": bus.data_bitrate}
    return {"interface": interface, **rates} | asdict(found)


def rows(interface: str) -> list[dict[str, Any]]:
    """Look on one interface, and return what --json prints of it."""
    parser = ArgumentParser()
    add_arguments(parser)
    options = parser.parse_args([interface])
    plugins, interfaces = usable_plugins(), [_full(interface)]
    return _results(interfaces, plugins, options)[0]


def _rate(bus: BusSettings) -> int:
    return bus.baudrate or bus.bitrate


def _scan(
    bus: BusSettings, plugins: Sequence[Plugin], *, quiet: bool
) -> tuple[list[Finding], list[Probe], dict[int, int]]:
    """Look on one bus at one rate. Raises BusError."""
    clock = WallClock()
    probes = [one for plugin in plugins if (one := scan.probe(plugin, bus)) is not None]
    if not quiet:
        names = ", ".join(one.name for one in probes)
        print(f"{bus.interface} at {_rate(bus):,} bit/s: {names or 'no protocol fits'}", flush=True)
    open_bus(bus, clock).close()  # what cannot be opened is told before the questions are prepared
    ids: dict[int, int] = {}
    found = scan.scan(
        probes,
        lambda settings: open_bus(settings, clock),
        clock,
        lambda text: print(f"  {text}", file=sys.stderr),
        ids,
    )
    return found, probes, ids


def _print(found: Sequence[Finding], probes: Sequence[Probe], ids: dict[int, int]) -> None:
    for one in found:
        serial = "" if one.serial is None else f"  serial {one.serial:X}"
        heard = "  heard only" if one.how == "heard" else ""
        double = "  TWO DEVICES have this address" if one.duplicate else ""
        detail = f"  {escaped(one.detail)}" if one.detail else ""
        print(f"  {one.protocol:12} address {one.address:<4}{serial}{detail}{heard}{double}")
    if not found:
        print("  nothing answers")
    for number, count in sorted(scan.unexplained(ids, found, probes).items()):
        name = f"{number & ~EXTENDED_BIT:08X}" if number & EXTENDED_BIT else f"{number:03X}"
        print(f"  id {name}: {count} frames that no device found here sends")
