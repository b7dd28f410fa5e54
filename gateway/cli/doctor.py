"""`gateway doctor`: why nothing moves, from the interface to the motor; only questions are sent. And why a
base does not drive as it should: of a gateway that is running, or of a recording.

Exit status: 0 nothing was found; 1 something was; 2 no bus could be opened, or the file could not be read.
"""

from __future__ import annotations

import json
import logging
from argparse import ArgumentParser, Namespace
from collections.abc import Mapping, Sequence
from contextlib import ExitStack
from dataclasses import asdict
from pathlib import Path

from gateway.bench.diagnosis import recorded
from gateway.bench.driven import is_recording
from gateway.buses import Bus, open_bus
from gateway.cli import arguments
from gateway.config import load_robot, with_interfaces
from gateway.core.clock import Clock, SimulatedClock, WallClock
from gateway.core.robot import TWIN, Robot
from gateway.errors import BusError, OperatorError
from gateway.operator import ask, socket_path
from gateway.runtime import doctor
from gateway.runtime.doctor import Finding
from gateway.runtime.drive_doctor import from_file
from gateway.runtime.scan import Overhearing
from gateway.runtime.status import NOTHING, finding_lines

log = logging.getLogger("gateway")


def add_arguments(parser: ArgumentParser) -> None:
    """Add the arguments of the command."""
    parser.add_argument(
        "robot", metavar="ROBOT|FILE", help="a robot file or its name; or a recording, a bag, a log"
    )
    parser.add_argument("--robot", dest="of_bag", metavar="ROBOT", help="the robot file of a bag or a log")
    arguments.add_bus(parser, "where a bus is: can0=socketcan:can0")
    parser.add_argument("--explain", action="store_true", help="say of each finding why it matters")
    parser.add_argument("--json", action="store_true", help="print one JSON array")


def run(options: Namespace) -> int:
    """Examine a robot, or a recording, and print what was found."""
    path = Path(options.robot)
    if is_recording(path):
        return _told(recorded(path, options.of_bag), options)
    robot = with_interfaces(load_robot(options.robot), dict(options.bus))
    if (running := _running(robot.name)) is not None:
        print(f"{robot.name} is running; what it has seen so far:\n{running}")
        return 0 if running.endswith(NOTHING) else 1
    twins = all(bus.interface == TWIN for bus in robot.buses.values())
    clock: Clock = SimulatedClock() if twins else WallClock()
    log.addFilter(_is_told_otherwise)
    try:
        with ExitStack() as stack:
            buses, failed = _open(robot, clock, stack)
            if not options.json:
                _head(robot, buses)
            seen = _examined(robot, buses, clock) if buses else None
            if seen is not None and not options.json:
                print("\n".join(_traffic(seen, buses)), flush=True)
            wires = _findings(seen, buses) if seen is not None else []
            findings = [*failed, *wires, *doctor.of_machine(robot), *from_file(robot)]
    finally:
        log.removeFilter(_is_told_otherwise)
    return _told(findings, options) if buses else _told(findings, options) and 2


def _told(findings: Sequence[Finding], options: Namespace) -> int:
    """Print what was found; return 1 if that is anything."""
    if options.json:
        print(json.dumps([asdict(one) for one in findings], indent=2))
    else:
        print("\n".join(finding_lines(findings, explain=options.explain)))
    return 1 if findings else 0


def _running(name: str) -> str | None:
    """Return what a running gateway of this robot has found; None if none runs."""
    path = socket_path(name)
    if not path.exists():
        return None
    try:
        return ask(path, "doctor")
    except OperatorError:  # its socket is left over
        return None


def _is_told_otherwise(record: logging.LogRecord) -> bool:
    """False for what a finding says."""
    return record.levelno > logging.ERROR


def _examined(robot: Robot, buses: Mapping[str, Bus], clock: Clock) -> doctor.Examination:
    """Look at a robot where its buses are open; on the others nothing is heard."""
    closed = {name: Overhearing(None, {}) for name in robot.buses if name not in buses}
    return doctor.examine(robot, {**buses, **closed}, clock)


def _findings(seen: doctor.Examination, buses: Mapping[str, Bus]) -> list[Finding]:
    """Return what is found where buses are open."""
    mute = {one.name for one in seen.robot.devices() if one.bus not in buses}
    return [one for one in seen.findings() if one.about not in mute]


def _traffic(seen: doctor.Examination, buses: Mapping[str, Bus]) -> list[str]:
    """Return what went to and came from each device, a line each."""
    width = max(map(len, seen.traffic), default=0)
    on = {one.name: one.bus for one in seen.robot.devices()}
    return [f"  {name:<{width}}  {one}" for name, one in seen.traffic.items() if on[name] in buses]


def _open(robot: Robot, clock: Clock, stack: ExitStack) -> tuple[dict[str, Bus], list[Finding]]:
    """Open what can be opened; return the buses, and a finding for each that cannot."""
    buses: dict[str, Bus] = {}
    failed: list[Finding] = []
    if any(bus.interface == TWIN for bus in robot.buses.values()):
        from gateway.buses.virtual import open_world

        buses |= {
            n: b for n, b in open_world(robot, robot.seed).buses.items() if robot.buses[n].interface == TWIN
        }
    for name, settings in robot.buses.items():
        if name in buses:
            continue
        try:
            buses[name] = open_bus(settings, clock)
        except BusError as error:
            failed.append(doctor.of_opening(name, error))
        else:
            stack.callback(buses[name].close)
    return buses, failed


def _head(robot: Robot, buses: dict[str, Bus]) -> None:
    count = len(robot.devices())
    where = ", ".join(f"{name} ({robot.buses[name].interface})" for name in buses) or "no bus"
    print(f"{robot.name}: {count} devices; looking at {where} for {doctor.EXAMINED / 1e9:g} s", flush=True)
