"""`gateway new`: a robot file for what is on the buses.

Rules. What is found comes from a scan, now or before (`gateway scan --json`); what it means is stated by
--motor and --set, or asked on the terminal. Nothing that scales a speed or a torque is assumed. Devices are
only read, but for the motor that a person has turned by this program (`jog`), slowly, and one at a time.
Exit status: 0 the file is written, and `gateway check` takes it.
"""

from __future__ import annotations

import json
import os
import sys
from argparse import ArgumentParser, ArgumentTypeError, Namespace
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

from brain.bodies.urdf import MOST_CHARACTERS
from gateway.cli.schema import text_of
from gateway.cli.terminal.output import typed
from gateway.config import json_schema, load_robot
from gateway.config.answers import Answers, Question
from gateway.config.new_robot import Part, Plan
from gateway.config.text import read_text
from gateway.errors import BusError, UserError
from gateway.recording.new_file import EXISTS, create_with
from gateway.runtime import which_motor

SCHEMA = "robot.schema.json"
"""Beside the robot file, whose first line names it: by it an editor completes and checks keys."""


def add_arguments(parser: ArgumentParser) -> None:
    """Add the arguments of the command."""
    parser.add_argument("robot", type=Path, metavar="ROBOT", help="the robot file to write, NAME.toml")
    parser.add_argument(
        "--from",
        dest="scans",
        type=Path,
        action="append",
        default=[],
        metavar="SCAN",
        help="what `gateway scan --json` has printed; repeatable",
    )
    parser.add_argument(
        "--scan",
        action="append",
        default=[],
        metavar="INTERFACE",
        help="look there now, as `gateway scan` does",
    )
    parser.add_argument("--urdf", type=Path, metavar="FILE", help="its links and joints, with their limits")
    parser.add_argument("--body", metavar="KIND", help="what it is: skid_steer, arm, differential …")
    parser.add_argument(
        "--motor",
        type=_motor,
        action="append",
        default=[],
        metavar="NAME=ADDRESS[,KEY=VALUE]",
        help="which device a motor is, and what is so of it alone: front_right=2,sign=-1",
    )
    parser.add_argument(
        "--set",
        dest="stated",
        type=_stated,
        action="append",
        default=[],
        metavar="KEY=VALUE",
        help="what else must be known: gear=8, wheel_radius=0.08; what is missing is listed",
    )
    parser.add_argument(
        "--which",
        choices=("hand", "jog", "ask"),
        default="hand",
        help="how a person shows which motor is which: turn it by hand, see it turn, or type its address",
    )
    parser.add_argument(
        "--read", action="store_true", help="open the buses, and read the limits that the devices have"
    )


def run(options: Namespace) -> int:
    """Ask, and write the file."""
    if os.path.lexists(options.robot):
        raise UserError(f"{options.robot}: {EXISTS}")
    person = _asked if sys.stdin.isatty() else None
    plan = _plan(options, person)
    robot = make(plan, _shown(plan, options.which) if person else None, read=options.read or bool(person))
    try:
        create_with(options.robot, f"#:schema ./{SCHEMA}\n{robot}".encode())
        schema = options.robot.with_name(SCHEMA)
        if not os.path.lexists(schema):  # which may be of other protocols that are installed: it stays
            create_with(schema, text_of(json_schema.robot()).encode())
    except OSError as error:
        raise UserError(f"{options.robot}: cannot be written: {error.strerror or error}") from error
    made = load_robot(options.robot)
    what = f"{made.brain.body.kind}, {len(made.motors)} motors, {len(made.sensors)} sensors"
    print(f"{options.robot}: written: {what}")
    for key, value in plan.answers.proposed.items():
        print(f"  proposed, not stated: {key} = {value}")
    print(f"next: gateway check {options.robot}; gateway jog {next(iter(made.motors))} {options.robot}")
    return 0


def make(plan: Plan, shown: which_motor.Shown | None, *, read: bool) -> str:
    """Return the robot file of a plan. `shown`: how a person shows which motor is which; `read`: whether the
    devices are asked for their limits."""
    plan.assign(shown)
    plan.place()
    if read and plan.motors:
        try:
            plan.allowed = which_motor.allowed(plan)
        except BusError as error:
            print(f"the devices' own limits are not read: {error}")
    return plan.text()


def _plan(options: Namespace, person: Callable[[Question], str] | None) -> Plan:
    stated = dict(options.stated) | ({} if options.body is None else {"body": options.body})
    for name, values in options.motor:
        stated |= {f"{name}.{key}": value for key, value in values.items()}
    parts = [one for path in options.scans for one in parts_in(path)]
    parts += [one for interface in options.scan for one in _found(interface)]
    if not parts:
        raise UserError(
            "nothing was found: give --from SCAN (gateway scan --json > scan.json), or --scan INTERFACE"
        )
    if twice := [str(one) for one in parts if parts.count(one) > 1]:
        raise UserError(
            f"several devices have one address: {twice[0]}; gateway motor set-id gives one another"
        )
    name, text = "", ""
    if options.urdf is not None:
        text = read_text(options.urdf, MOST_CHARACTERS)
        name = os.path.relpath(options.urdf, options.robot.parent)
    return Plan(options.robot.stem, parts, Answers(stated, person), name, text)


def parts_in(path: Path) -> list[Part]:
    """Return the devices of a scan. Raises UserError."""
    try:
        rows = json.loads(path.read_text("utf-8"))
        return [_part(row) for row in rows]
    except (OSError, ValueError, TypeError, KeyError) as error:
        raise UserError(f"{path}: is not what `gateway scan --json` prints: {error}") from error


def _part(row: dict[str, Any]) -> Part:
    """Return the device of one row."""
    if row["duplicate"]:
        raise ValueError(f"two devices have address {row['address']}: gateway motor set-id gives one another")
    return Part(
        str(row["interface"]),
        str(row["protocol"]),
        int(row["address"]),
        int(row["rate"]),
        row["kind"],
        int(row["data_rate"]),
        row["serial"],
        str(row["detail"]),
    )


def _found(interface: str) -> list[Part]:
    """Look on an interface now."""
    from gateway.cli import scan

    return [_part(row) for row in scan.rows(interface)]


def _shown(plan: Plan, how: str) -> which_motor.Shown | None:
    if how == "ask":
        return None
    by_hand = which_motor.by_hand(plan, print)
    show = by_hand if how == "hand" else which_motor.by_jog(plan, print, typed)

    def shown(name: str, left: Sequence[Part]) -> tuple[Part, int] | None:
        try:
            return show(name, left)
        except BusError as error:  # then its address is asked for
            print(error)
            return None

    return shown


def _asked(question: Question) -> str:
    proposal = f" [{question.proposal}]" if question.proposal else ""
    return typed(f"{question.key}: {question.text}{proposal}: ")


def _stated(text: str) -> tuple[str, str]:
    key, equals, value = text.partition("=")
    if not (key and equals and value):
        raise ArgumentTypeError(f"{text!r} is not KEY=VALUE (as in gear=8)")
    return key.strip(), value.strip()


def _motor(text: str) -> tuple[str, dict[str, str]]:
    first, *others = text.split(",")
    name, address = _stated(first)
    return name, {"address": address, **dict(map(_stated, others))}
