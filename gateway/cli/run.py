"""`gateway run`: a robot on its buses, until a signal, a quit, or the end of its time."""

from __future__ import annotations

import logging
import re
import sys
from argparse import ArgumentParser, ArgumentTypeError, Namespace
from collections.abc import Sequence
from contextlib import closing
from dataclasses import replace
from functools import partial
from pathlib import Path

from brain.belief import BrainState
from gateway.cli import arguments
from gateway.cli.live import add_ros, add_view, check_view, open_ros, open_view, view_on_demand
from gateway.cli.reports import add_report, reported
from gateway.cli.terminal.progress import simulation
from gateway.config import IF_IT_DIES, cannot, if_it_dies, load_mission, load_robot, with_interfaces
from gateway.core.message_text import escaped
from gateway.core.robot import TWIN, Robot
from gateway.core.step import LEFT_ARMED
from gateway.errors import UserError
from gateway.operator import Operator
from gateway.runtime.loop import LEFT
from gateway.runtime.realtime import realtime, wanted_of
from gateway.runtime.rotation import Rotation
from gateway.runtime.schedule import COUNTING, NotCounted, not_armed, refuse_overload
from gateway.runtime.session import Session, open_session
from gateway.runtime.status import doctor_text, status_text, unready
from protocols.messages import MILLISECOND, Goal, Instruction, Mission

log = logging.getLogger("gateway")


def add_arguments(parser: ArgumentParser) -> None:
    """Add the arguments of the command."""
    arguments.add_robot(parser)
    arguments.add_bus(
        parser, "put a bus on another interface: can0=socketcan:vcan0, sensors=serial:/dev/ttyUSB0, can0=twin"
    )
    arguments.add_real(parser)
    arguments.add_map(parser)
    text = "put the world's torques on a real motor by another one on its shaft: left=brake"
    parser.add_argument(
        "--load", type=arguments.pair, action="append", default=[], metavar="MOTOR=BRAKE", help=text
    )
    arguments.add_goal(parser, "where to drive")
    parser.add_argument("--mission", metavar="FILE", help="a mission file, or the name of one that ships")
    parser.add_argument(
        "--record", type=Path, metavar="FILE", help="write a recording (MCAP); FILE must not exist yet"
    )
    parser.add_argument(
        "--rotate",
        type=rotated,
        metavar="TIME|SIZE",
        default=Rotation(),
        help="go on recording in FILE-0002, FILE-0003 … after this time or size: 10min, 1h, 500MB, 2GB",
    )
    parser.add_argument(
        "--keep",
        type=arguments.number("minutes"),
        metavar="MINUTES",
        default=0.0,
        help="of the recording, keep only the last minutes, and those before each fault",
    )
    add_report(parser)
    arguments.add_seconds(parser, "Ctrl-C, or quit")
    parser.add_argument("--dry-run", action="store_true", help="do everything except writing to the buses")
    parser.add_argument(
        "--fast", action="store_true", help="run in simulated time; only if every bus is a twin"
    )
    arguments.add_seed(parser)
    arguments.add_realtime(parser)
    add_view(parser)
    add_ros(parser)


def run(options: Namespace) -> int:
    """Return 1 if a motor was left in fault or armed, something asked for was not done, or the loop hung."""
    check_view(options)
    wanted = wanted_of(options.realtime)
    if options.at is not None and not options.map:
        raise UserError("--at is a place in a map: name its file by --map")
    robot = load_robot(options.robot, real=options.real, saved_map=options.map, start=options.at)
    robot = with_interfaces(robot, dict(options.bus))
    rotation = replace(options.rotate, keep=60.0 * options.keep)
    if rotation != Rotation() and options.record is None:
        raise UserError("--rotate and --keep are of a recording: name its file by --record")
    if options.mission and options.goal:
        raise UserError("--mission and --goal exclude each other: put the goals into the mission")
    goals = goals_of(options, robot)
    if any(bus.interface != TWIN for bus in robot.buses.values()):  # simulated ones show it by themselves
        _check_load(robot)
    mission = load_mission(options.mission, robot) if options.mission else None
    with (
        open_session(robot, simulated=options.fast, record=options.record, seed=options.seed) as session,
        Operator(robot) as operator,
        reported(session, options.report, "run") as ending,
    ):
        if rotation != Rotation():
            session.rotate_recording(rotation)
        for motor, brake in options.load:
            session.load(motor, brake)
        open_view(session, options)
        open_ros(session, options)
        session.submit(*goals, *([mission] if mission else []))
        with realtime(wanted, robot):
            status = _drive(session, operator, options, mission)
        ending.ok = status == 0
    print_recording(session)
    if options.report is not None:
        print(f"report: {options.report}")
    return status


def rotated(text: str) -> Rotation:
    """Return what --rotate asks for. Raises ArgumentTypeError."""
    found = re.fullmatch(r"(\d+(?:\.\d+)?)\s*([A-Za-z]+)", text)
    number, unit = (float(found[1]), found[2]) if found else (0.0, "")
    if number > 0.0 and unit in _SPANS:
        return Rotation(seconds=min(1e7, number * _SPANS[unit]))
    if number > 0.0 and unit in _SIZES:
        return Rotation(size=min(1 << 50, round(number * _SIZES[unit])))
    units = ", ".join((*_SPANS, *_SIZES))
    raise ArgumentTypeError(f"found {text!r}, expected a number and one of {units}, such as 10min or 500MB")


_SPANS = {"s": 1.0, "min": 60.0, "h": 3600.0}
_SIZES = {"kB": 1e3, "MB": 1e6, "GB": 1e9}


def _check_load(robot: Robot) -> None:
    """Raise UserError if a bus does not carry the robot; print which motors are not armed even on simulated
    devices, or why nothing was counted."""
    try:
        with simulation(COUNTING) as simulated:
            text = not_armed(refuse_overload(robot, simulated))
    except NotCounted as error:
        text = str(error)
    if text:
        print(text, file=sys.stderr)


def goals_of(options: Namespace, robot: Robot) -> list[Goal]:
    """Return the goals of --goal. Raises UserError if the robot takes none."""
    goals = [Goal(*goal) for goal in options.goal]
    if goals and (wrong := cannot(goals[0], robot)):
        raise UserError(f"--goal: {wrong}")
    return goals


def _drive(session: Session, operator: Operator, options: Namespace, mission: Mission | None) -> int:
    """Carry the operator's instructions to the robot, and its notes to the operator."""
    name = operator.path.stem
    print(f"{session.robot.name} is running; type help here, or: gateway ask {name} help", flush=True)
    if any(bus.interface != TWIN for bus in session.robot.buses.values()) and not options.dry_run:
        print(f"{IF_IT_DIES}:", *if_it_dies(session.robot), sep="\n  ", flush=True)

    def poll() -> Sequence[Instruction]:
        view = partial(view_on_demand, session)
        instructions = operator.poll(
            lambda: status_text(session), view, lambda: unready(session), lambda: doctor_text(session)
        )
        if operator.leaving and not session.reasons:
            session.leave("an operator sent quit")
        return instructions

    faults = why = ""
    try:
        with closing(session.run(options.seconds, poll=poll, dry_run=options.dry_run)) as ticks:
            for tick in ticks:
                operator.see(tick.inputs.instructions)
                for note in tick.outputs.notes:
                    logged = note.level != "info" or log.isEnabledFor(logging.INFO)
                    operator.report(f"{note.source}: {note.text}", logged=logged)
                faults = session.gateway.in_fault()
                if (stopped := session.gateway.why_stopped()) != LEFT:
                    why = stopped or session.belief.reason
                if (
                    options.fast
                    and options.seconds is None
                    and _all_done(session, len(options.goal), mission)
                ):
                    break
    finally:
        left = session.gateway.still_armed()
        for motor in left:
            operator.report(f"{motor}: {LEFT_ARMED}")
    stats = session.stats
    print(
        f"{stats.ticks} ticks, {stats.received} packets in, {stats.sent} out, {stats.missed} ticks missed, "
        f"longest step {stats.longest_step / MILLISECOND:.1f} ms"
    )
    for line in session.latencies.lines():
        print(line)
    view = session.belief.mission
    if view is not None:
        print(f"mission {view.name}: {view.phase}{f': {view.reason}' * bool(view.reason)}")
    wrong = [f"{motor}: {LEFT_ARMED}" for motor in left]
    wrong += [f"left in fault: {faults}"] if faults else []
    wrong += _undone(session, options, mission, why)
    wrong += ["its loop hung, and the watchdog process sent the stop action"] if stats.stalled else []
    for text in wrong:
        print(f"gateway run: exit status 1: {escaped(text)}", file=sys.stderr)
    return 1 if wrong else 0


def _undone(session: Session, options: Namespace, mission: Mission | None, why: str) -> list[str]:
    """Return what was asked for on the command line and not done, and why, as far as that is known."""
    belief, goals = session.belief, len(options.goal)
    because = f" ({why})" if why else ""
    if belief.reached < goals:
        within = f" within {options.seconds:g} s" if options.seconds is not None else ""
        return [f"{belief.reached} of {goals} goals reached{within}{because}"]
    if mission is not None and (belief.mission is None or belief.mission.phase != "done"):
        return [f"mission {mission.name} was not done{because}"]
    return []


def _all_done(session: Session, goals: int, mission: Mission | None) -> bool:
    """True if nothing is left to do: in simulated time, a run without a time limit ends then."""
    belief = session.belief
    if mission is not None and belief.mission is not None:
        return belief.mission.phase != "running"
    stopped = bool(session.gateway.why_stopped()) or belief.state is BrainState.STOPPED
    return stopped or belief.reached >= goals


def print_recording(session: Session) -> None:
    """Print where the recording is, if there is one, and what of it was lost."""
    recorder = session.recorder
    if recorder is None:
        return
    size = recorder.path.stat().st_size / 1e6 if recorder.path.exists() else 0.0
    print(f"recording: {recorder.path} ({size:.1f} MB)")
    if recorder.trouble:
        print(f"recording: {recorder.trouble} ({recorder.lost} ticks lost)", file=sys.stderr)
