"""`gateway twin`: the devices of a robot, simulated, for another program to drive."""

from __future__ import annotations

import logging
import shlex
from argparse import ArgumentParser, Namespace
from collections.abc import Callable, Sequence
from contextlib import ExitStack
from functools import partial
from pathlib import Path

from gateway.cli import arguments
from gateway.cli.live import add_ros, add_view, check_view, domain_of, token_for
from gateway.config import load_robot, with_interfaces
from gateway.core.clock import WallClock
from gateway.core.robot import BusSettings
from gateway.runtime.realtime import realtime, wanted_of
from gateway.runtime.twin_process import Devices, devices, without_interfaces
from protocols.messages import MILLISECOND, SECOND, Nanos

log = logging.getLogger("gateway")

ADAPTERS = ("slcan", "fdcanusb", "dm-serial")
"""Adapter protocols of a CAN bus's port (gateway.buses.adapters)."""


def add_arguments(parser: ArgumentParser) -> None:
    """Add the arguments of the command."""
    arguments.add_robot(parser)
    arguments.add_bus(
        parser, "put a bus on an interface, as in can0=socketcan:vcan0 (default: pseudo-terminals)"
    )
    parser.add_argument(
        "--ports",
        type=arguments.integer("a number from 1 to 16", 1, 16),
        default=1,
        metavar="N",
        help="pseudo-terminals for each CAN bus that is not on an interface, one per program (default: 1)",
    )
    parser.add_argument(
        "--adapter",
        action="append",
        choices=ADAPTERS,
        help="protocol of those pseudo-terminals (default: slcan); if given several times, N of each",
    )
    parser.add_argument(
        "--link",
        type=Path,
        metavar="DIR",
        help="give the pseudo-terminals stable names: DIR/can0, DIR/can0.2 …",
    )
    parser.add_argument(
        "--echo",
        action="store_true",
        help="serial lines give back what is sent on them before the answer, as many adapters do",
    )
    arguments.add_seconds(parser)
    arguments.add_seed(parser)
    arguments.add_realtime(parser)
    add_view(parser, steer=False)
    add_ros(parser)


def run(options: Namespace) -> int:
    """Simulate the devices until a signal, on the interfaces that are named here alone."""
    check_view(options)
    robot = with_interfaces(without_interfaces(load_robot(options.robot)), dict(options.bus))
    wanted = wanted_of(options.realtime)
    adapters = (options.adapter or ["slcan"]) * options.ports
    with devices(robot, WallClock(), options.seed, adapters, options.link, echo=options.echo) as made:
        print("\n".join(invitation(made, options.robot)), flush=True)
        with ExitStack() as stack:
            watchers = [one for one in (_view(made, options, stack), _ros(made, options, stack)) if one]
            with realtime(wanted, robot):
                made.serve(options.seconds, partial(_all, watchers) if watchers else None)
    stats = made.stats
    stalled = f"; stood still for {stats.stalled / SECOND:.1f} s in all" if stats.stalled else ""
    sums = {name: bus.overlaps for name, bus in made.twins.buses.items() if bus.overlaps}
    overlaps = "".join(f"; {many} times two sent at once on {name}" for name, many in sums.items())
    print(
        f"{stats.received} packets received, {stats.sent} sent; "
        f"at most {stats.late / MILLISECOND:.0f} ms behind the clock{stalled}{overlaps}"
    )
    return 0


def _view(made: Devices, options: Namespace, stack: ExitStack) -> Callable[[Nanos], None] | None:
    """Open the view that is asked for, and print its address; return what it has to be called with."""
    if options.view is None:
        return None
    from gateway.runtime.twin_view import TwinView
    from gateway.view import place

    view = TwinView(made, *place(options.view, token_for(options.view), options.origin))
    stack.callback(view.close)
    print(f"live view of the simulated world: {view.url}", flush=True)
    return view.watch


def _ros(made: Devices, options: Namespace, stack: ExitStack) -> Callable[[Nanos], None] | None:
    """Enter the graph that is asked for, and print under which name; return what it has to be called with."""
    if options.ros is None:
        return None
    from gateway.ros.network import parse_network
    from gateway.runtime.twin_view import TwinBridge

    bridge = TwinBridge(made, parse_network(options.ros), domain_of(made.robot))
    stack.callback(bridge.close)
    print(f"ROS 2, the simulated world: {bridge.name}", flush=True)
    return bridge.watch


def _all(watchers: Sequence[Callable[[Nanos], None]], now: Nanos) -> None:
    for watch in watchers:
        watch(now)


def invitation(made: Devices, robot: str) -> list[str]:
    """Return what to type to drive these devices; `robot` is the robot file as it was given."""
    command = ["gateway", "run", robot]
    notes = []
    for name, bus in made.robot.buses.items():
        kind, _, channel = bus.interface.partition(":")
        if kind in (*ADAPTERS, "serial") and name not in made.offered:  # a port is for one program alone
            other = "another adapter on the bus of" if kind in ADAPTERS else "the other end of"
            notes.append(f"PORT of {name}: {other} {channel}")
            channel = "PORT"
        command += ["--bus", f"{name}={kind}:{channel}"]
    for name, ports in made.offered.items():
        if ports[1:]:
            notes.append(f"other programs can join {name} by {', '.join(ports[1:])}; for instance:")
            notes.append(f"  {_listener(ports[1], made.robot.buses[name])}")
    head = f"simulating the devices of {made.robot.name}; to run the robot:"
    return [head, "  " + shlex.join(command), *notes]


def _listener(port: str, bus: BusSettings) -> str:
    """Return a command that can listen at a port."""
    kind, _, path = port.partition(":")
    if kind != "slcan":
        return f"gateway watch {port}"
    return f"python -m can.viewer -i slcan -c {path}{' --fd' if bus.kind == 'canfd' else ''}"
