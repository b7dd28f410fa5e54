"""`gateway motor`: what is configured on the motors: read it, compare it, restore it from a dump; give one of
them an address, a zero, its calibration.

Rules. `dump` and `diff` send read-only frames alone; `restore` too, unless --yes is given. What is done to
one motor is told first, and asked for on a terminal unless --yes is given. Exit status: 1 if something
differs, could not be read, or was not done.
"""

from __future__ import annotations

import logging
import os
import sys
from argparse import ArgumentParser, Namespace
from collections.abc import Iterable, Iterator, Sequence
from contextlib import closing, contextmanager
from pathlib import Path

from gateway.cli import arguments
from gateway.cli.terminal.output import typed
from gateway.config import load_robot, with_interfaces
from gateway.core.message_text import escaped
from gateway.core.robot import TWIN, Robot
from gateway.errors import UserError
from gateway.recording.new_file import EXISTS, create_with
from gateway.runtime import configuration, motor_setup
from gateway.runtime.configuration import Interrupted, Motors, ParameterDifference, Readings
from gateway.runtime.motor_setup import Action
from gateway.runtime.session import Session, open_session

log = logging.getLogger("gateway")

ACTIONS = {
    "dump": "read what is configured on the motors, and print it or write it to a file",
    "diff": "compare it with the robot file, or with an earlier dump",
    "restore": "write what differs from a dump, but what is protected",
}
NONE = -1
"""In place of an address: there is none"""
ONE: dict[motor_setup.Kind, str] = {
    "set-id": "give one motor another address, look for it there, and save it",
    "zero": "make the place where the shaft of one motor stands its zero",
    "calibrate": "have one motor calibrate itself, or run its own homing; its shaft turns",
    "save": "have one motor keep what is configured on it when it is switched off",
}
"""What is done to one motor."""


def add_arguments(parser: ArgumentParser) -> None:
    """Add the arguments of the command."""
    what = parser.add_subparsers(dest="what", required=True, metavar=" | ".join((*ACTIONS, *ONE)))
    for name, text in ACTIONS.items():
        one = what.add_parser(name, help=text, description=f"{text.capitalize()}.")
        arguments.add_verbosity(one)
        arguments.add_robot(one)
        if name == "dump":
            one.add_argument("--out", type=Path, metavar="FILE", help="write a dump, as TOML, to a new file")
        else:
            some = "?" if name == "diff" else None
            one.add_argument(
                "dump", type=Path, nargs=some, metavar="DUMP", help="what `dump --out` has written"
            )
        if name == "restore":
            one.add_argument("--yes", action="store_true", help="write; without it nothing is written")
        arguments.add_bus(one, "where a bus is: can0=socketcan:can0")
    for kind, text in ONE.items():
        one = what.add_parser(kind, help=text, description=f"{text.capitalize()}.")
        arguments.add_verbosity(one)
        arguments.add_robot(one)
        one.add_argument("motor", metavar="MOTOR", help="its name in the robot file")
        if kind == "set-id":
            address = arguments.integer("an address", 0)
            one.add_argument(
                "address",
                type=address,
                nargs="?",
                metavar="ADDRESS",
                help="the new one (default: the file's)",
            )
            one.add_argument(
                "--from",
                dest="old",
                type=_address_or_none,
                metavar="N|none",
                help="that it has now (default: the file's); none: it has none yet",
            )
        one.add_argument("--yes", action="store_true", help="do not ask")
        arguments.add_bus(one, "where a bus is: can0=socketcan:can0")


def _address_or_none(text: str) -> int:
    """Return an address, `NONE` for none. Raises ArgumentTypeError."""
    return NONE if text == "none" else arguments.integer("an address", 0)(text)


def run(options: Namespace) -> int:
    """Do what is asked."""
    robot = with_interfaces(load_robot(options.robot), dict(options.bus))
    try:
        if options.what in ONE:
            return _one(robot, options)
        return _dump(robot, options.out) if options.what == "dump" else _compare(robot, options)
    except Interrupted as error:
        print(
            f"{error}; what is not listed as saved is lost when the device is switched off", file=sys.stderr
        )
        return 1


def _compare(robot: Robot, options: Namespace) -> int:
    dump = configuration.read_dump(options.dump, robot) if options.dump is not None else None
    with _open(robot) as motors:
        readings = motors.read()
        if dump is None:
            differences, remarks = configuration.against_robot(robot, readings)
            _print([*map(str, differences), *(f"remark: {each}" for each in remarks)])
            return _summary(robot, readings, differences, "the robot file")
        if wrong := configuration.same_devices(readings, dump):
            raise UserError("\n".join(wrong))
        differences = configuration.against_dump(robot, readings, dump)
        if options.what == "diff":
            _print(map(str, differences))
            return _summary(robot, readings, differences, "the dump")
        return _restore(motors, differences, write=options.yes)


def _one(robot: Robot, options: Namespace) -> int:
    """Tell what is to be done to one motor, ask whether it is to be, and do it."""
    name, old, new = options.motor, getattr(options, "old", None), getattr(options, "address", None)
    stated = motor_setup.alone(robot, name).motors[name].device.address
    address = stated if new is None else new
    robot = motor_setup.alone(robot, name, address if old == NONE else old)
    action = Action(options.what, name, address, first=old == NONE)
    print(motor_setup.told(robot, action), flush=True)
    if not options.yes and not _agreed():
        print("nothing was done")
        return 1
    with _session(robot) as session:
        done = motor_setup.perform(session, action, lambda text: print(escaped(text), flush=True))
    if done and action.kind == "set-id" and action.address != stated:
        print(f"{name}: the robot file has address = {stated}: write {action.address} there")
    return 0 if done else 1


def _agreed() -> bool:
    """Ask whether it is to be done. Raises UserError where nobody can answer."""
    if not sys.stdin.isatty():
        raise UserError("nothing was done: standard input is no terminal that could be asked; give --yes")
    return typed("do it? [y/N] ").lower() in ("y", "yes")


@contextmanager
def _open(robot: Robot) -> Iterator[Motors]:
    """Open a robot's motors alone."""
    with _session(configuration.motors_only(robot)) as session, closing(Motors(session)) as motors:
        yield motors


@contextmanager
def _session(robot: Robot) -> Iterator[Session]:
    """Open a session; in simulated time if all is simulated."""
    simulated = all(bus.interface == TWIN for bus in robot.buses.values())
    log.addFilter(_is_news)
    try:
        with open_session(robot, simulated=simulated) as session:
            yield session
    finally:
        log.removeFilter(_is_news)


def _is_news(record: logging.LogRecord) -> bool:
    """False for refusals, which are printed by parameter, and for a brain that commands nothing."""
    source, text = (*map(str, record.args or ()), "", "")[:2]
    return source != "brain" and ": refused: " not in text


def _dump(robot: Robot, out: Path | None) -> int:
    if out is not None and os.path.lexists(out):
        raise UserError(f"{out}: {EXISTS}")
    with _open(robot) as motors:
        readings = motors.read()
    if out is not None:
        try:
            create_with(out, configuration.dump_text(robot, readings).encode())
        except OSError as error:
            raise UserError(f"{out}: cannot be written: {error.strerror}") from error
    for name, one in readings.items():
        motor = robot.motors[name]
        serial = "" if one.serial is None else f", serial number {one.serial:X}"
        firmware = f", {escaped(one.firmware)}" if one.firmware else ""
        print(f"{name}: {one.protocol} at address {one.address} on {motor.bus}{serial}{firmware}")
        width = max(map(len, motor.spec.configuration), default=0)
        for parameter, setting in motor.spec.configuration.items():
            value = one.values.get(parameter)
            shown = (
                f"not read: {escaped(one.not_read[parameter])}"
                if value is None
                else configuration.shown(value)
            )
            left = f"  (left: {setting.protected})" if setting.protected else ""
            print(f"  {parameter:<{width}}  {shown}{left}")
        if not motor.spec.configuration:
            print(f"  {_NOTHING}")
    return 1 if any(one.not_read for one in readings.values()) else 0


_NOTHING = "nothing: its protocol lists no configuration with these options (see the protocol's README)"


def _restore(motors: Motors, differences: Sequence[ParameterDifference], *, write: bool) -> int:
    to_write = [each for each in differences if not each.left]
    _print(str(each) for each in differences if each.left or not write)
    if not write:
        print(f"{len(to_write)} to be written; nothing was: give --yes for that")
        return 1 if to_write else 0
    good = configuration.restore(motors, differences, print)
    left = len(differences) - len(to_write)
    print(f"{len(to_write)} to be written, {left} left; {'done' if good else 'NOT all was done'}")
    return 0 if good else 1


def _summary(robot: Robot, readings: Readings, differences: Sequence[ParameterDifference], other: str) -> int:
    compared = sum(len(one.values) for one in readings.values())
    print(f"{robot.name}: {compared} parameters read, {len(differences)} differ from {other}")
    for name, motor in robot.motors.items():
        if not motor.spec.configuration:
            print(f"{name}: {_NOTHING}")
    return 1 if differences else 0


def _print(lines: Iterable[str]) -> None:
    for line in lines:
        print(escaped(line))
