"""What each word of the command line does. Imports what is heavy only where it is used.

Each command returns its exit status (see `gateway.__main__`), and raises `Sentence` for whatever a person
got wrong before anything moved.
"""

from __future__ import annotations

import resource
import sys
from argparse import Namespace
from collections.abc import Iterator, Sequence
from contextlib import closing, contextmanager
from pathlib import Path
from typing import TYPE_CHECKING

from brain.belief import BrainState
from gateway.errors import BagError, BusError, ConfigError, OperatorError, RecordingError, UserError
from gateway.operator.status import status_text
from protocols.messages import MILLISECOND, SECOND, Goal, Instruction, Nanos

if TYPE_CHECKING:
    from gateway.cli.demo import Figures, Watcher
    from gateway.core.robot import Robot
    from gateway.operator import Operator
    from gateway.runtime.session import Session
    from protocols.plugin import Broken

PATIENCE: Nanos = 240 * SECOND
"""How long the demo waits for one goal, in the robot's time."""


@contextmanager
def _sentences() -> Iterator[None]:
    """Complaints about files, buses and recordings become a sentence; anything else is our mistake."""

    try:
        yield
    except (BagError, BusError, ConfigError, UserError, OperatorError, RecordingError) as error:
        text = str(error)
        raise UserError(f"\n{text}" if "\n" in text else text) from error


def _read_robot(name: str, interfaces: Sequence[tuple[str, str]] = ()) -> Robot:
    from gateway import config
    from gateway.config import resources

    return config.with_interfaces(config.load_robot(resources.find("robots", name)), dict(interfaces))


def demo(options: Namespace) -> int:
    """Drive a tour through the robot's world; figures, recording and picture."""
    from gateway.cli.demo import Watcher, figures
    from gateway.core.clock import stopwatch
    from gateway.runtime.session import open_session

    with _sentences():
        robot = _read_robot(options.robot)
        _make_folder(options.out)
        recording = options.out / "demo.mcap"
        recording.unlink(missing_ok=True)
        with open_session(robot, simulated=options.fast, record=recording, seed=options.seed) as made:
            tour = [Goal(*goal) for goal in options.goal or ()] or made.tour()
            if not tour:
                raise UserError(f"the world of {robot.name!r} has no tour: say where to go with --goal X,Y")
            watcher = Watcher(made)
            began = stopwatch()
            _drive_tour(made, watcher, tour)
            took = stopwatch() - began
            outlines = watcher.outlines()
        verdict = figures(watcher.log, len(tour))
        _print_figures(made, verdict, took)
        picture = options.out / "demo.png"
        from gateway.cli.picture import draw

        draw(watcher.log, verdict, outlines, picture)
    _print_recording(made)
    print(f"picture: {picture}\nreplay it: gateway replay {recording}")
    return 0 if verdict.reached else 1


def _drive_tour(made: Session, watcher: Watcher, tour: Sequence[Goal]) -> None:
    """One goal after the other, each judged by the true pose when the brain says that it is there."""
    from gateway.cli.demo import progress
    from gateway.core.clock import stopwatch

    asked = 0
    since: Nanos = 0
    shown = stopwatch()

    def ask() -> Sequence[Instruction]:
        nonlocal asked, since
        if asked < len(tour) and len(watcher.log.arrivals) == asked:
            asked += 1
            since = made.clock.now()
            return (tour[asked - 1],)
        return ()

    with closing(made.run(poll=ask)) as ticks:
        for tick in ticks:
            watcher.watch(tick)
            if made.gateway.belief().reached > len(watcher.log.arrivals):
                goal = tour[len(watcher.log.arrivals)]
                watcher.arrived(tick.now, goal.x, goal.y)
            if stopwatch() - shown > SECOND:
                shown = stopwatch()
                print(progress(made, tick.now, len(tour)), flush=True)
            if len(watcher.log.arrivals) == len(tour):
                break
            if tick.now - since > PATIENCE or made.gateway.why_stopped():
                why = made.gateway.why_stopped() or f"not there after {PATIENCE / SECOND:.0f} s"
                print(f"goal {asked} is given up: {why}", file=sys.stderr)
                break


def _print_figures(made: Session, verdict: Figures, took: Nanos) -> None:
    print("\n".join(verdict.lines()))
    account = made.stats
    ratio = verdict.seconds * SECOND / took
    print(f"{account.ticks} ticks in {took / SECOND:.1f} s: {ratio:.1f} times real time")
    if account.missed:
        print(f"ticks missed: {account.missed}")
    print(f"memory: {resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024:.0f} MB at the most")


def _print_recording(made: Session) -> None:
    recorder = made.recorder
    if recorder is None:
        return
    size = recorder.path.stat().st_size / 1e6 if recorder.path.exists() else 0.0
    print(f"recording: {recorder.path} ({size:.1f} MB)")
    if recorder.trouble:
        print(f"recording: {recorder.trouble} ({recorder.lost} ticks lost)", file=sys.stderr)


def _make_folder(folder: Path) -> None:
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise UserError(f"--out {folder}: {error.strerror}") from error


def run(options: Namespace) -> int:
    """Run a robot on its buses until it is told to leave."""
    from gateway.core.robot import TWIN
    from gateway.operator import Operator
    from gateway.runtime.process import request_realtime
    from gateway.runtime.session import open_session

    with _sentences():
        robot = _read_robot(options.robot, options.bus)
        real = [bus.name for bus in robot.buses.values() if bus.interface != TWIN]
        if options.fast and real:
            raise UserError(
                f"--fast needs a world: {', '.join(real)} is on a real interface; leave out --fast"
            )
        if options.record is not None and options.record.exists():
            raise UserError(f"--record {options.record}: there is such a file already; it is not overwritten")
        if options.realtime is not None and (refused := request_realtime(options.realtime)):
            print(refused, file=sys.stderr)
        with (
            open_session(robot, simulated=options.fast, record=options.record, seed=options.seed) as made,
            Operator(robot) as operator,
        ):
            goals = [Goal(*goal) for goal in options.goal]
            lasting = options.seconds
            status = _run_loop(made, operator, goals, lasting, options)
    _print_recording(made)
    return status


def _run_loop(
    made: Session, operator: Operator, goals: list[Goal], lasting: float | None, options: Namespace
) -> int:
    """The loop of `run`: what a person asks goes in, what the robot says comes out."""
    print(
        f"{made.robot.name} runs; say help, here or with: gateway ask {operator.path.stem} help", flush=True
    )
    waiting: list[Instruction] = list(goals)

    def status() -> str:
        return status_text(made)

    def ask() -> Sequence[Instruction]:
        asked = [*waiting, *operator.poll(status)]
        waiting.clear()
        if operator.leaving and not made.leaving:
            made.leaving = "an operator said quit"
        return asked

    faults = ""
    with closing(made.run(lasting, poll=ask, dry_run=options.dry_run)) as ticks:
        for tick in ticks:
            for note in tick.outputs.notes:
                operator.report(f"{note.source}: {note.text}")
            faults = made.gateway.in_fault()
            if options.fast and lasting is None and _all_done(made, len(goals)):
                break
    account = made.stats
    print(f"{account.ticks} ticks, {account.received} packets in, {account.sent} out", end="")
    print(f", {account.missed} ticks missed, longest step {account.longest_step / MILLISECOND:.1f} ms")
    if faults:
        print(f"left in fault: {faults}", file=sys.stderr)
    return 1 if faults or made.gateway.belief().reached < len(goals) else 0


def _all_done(made: Session, goals: int) -> bool:
    """In simulated time a run without an end ends when there is nothing left to do."""
    belief = made.gateway.belief()
    stopped = bool(made.gateway.why_stopped()) or belief.state is BrainState.STOPPED
    return stopped or belief.reached >= goals


def twin(options: Namespace) -> int:
    """Be the devices of a robot until told to leave."""
    from gateway.runtime.twin_process import twin as serve

    with _sentences():
        return serve(options)


def replay(options: Namespace) -> int:
    """Run a recording's inputs through the code of today, and compare every byte; or judge a foreign bag."""
    from gateway import config
    from gateway.config import resources
    from gateway.core.clock import stopwatch
    from gateway.core.step import Gateway, decoder_of
    from gateway.recording import environment, read
    from gateway.replay.compare import compare
    from gateway.rosbag import evaluate, is_foreign

    with _sentences():
        if is_foreign(options.file):
            if options.robot is None:
                raise UserError(f"{options.file} is a bag of somebody else's: say of which --robot")
            return evaluate.replay(options.file, _read_robot(options.robot), options.at_most)
        if options.at_most is not None:
            raise UserError(f"{options.file} is no foreign bag: --at-most judges those alone")
        recording = read(options.file)
        if options.robot is None:
            robot = config.parse_robot(recording.robot_text, f"{options.file}: robot.toml")
        else:
            robot = config.load_robot(resources.find("robots", options.robot))
        gateway = Gateway(robot)
    began = stopwatch()
    verdict = compare(
        recording,
        gateway.step,
        gateway.belief,
        lambda bus: decoder_of(robot, bus),
        robot_text=robot.text,
        facts=environment.facts(),
        mounts={name: sensor.mount for name, sensor in robot.sensors.items()},
        buses=robot.buses,
    )
    print(verdict.text())
    print(f"replayed in {(stopwatch() - began) / SECOND:.1f} s")
    return 0 if verdict.ok else 1


def recover(options: Namespace) -> int:
    """Give back what can be read of a recording that was cut off or damaged."""
    from gateway.cli.recover import recover as make_whole

    with _sentences():
        return make_whole(options)


def watch(options: Namespace) -> int:
    """Listen to buses or to a recording, and say what is heard."""
    from gateway.cli.watch import watch as listen

    with _sentences():
        try:
            return listen(options)
        except UserError as error:
            raise UserError(str(error)) from error


def jog(options: Namespace) -> int:
    """Turn one motor from the keyboard."""
    from gateway.cli.jog import jog as turn

    with _sentences():
        try:
            return turn(options)
        except UserError as error:
            raise UserError(str(error)) from error


def check(options: Namespace) -> int:
    """Read a robot file; every mistake in it, or what was understood."""
    from gateway.config import describe

    with _sentences():
        print(describe(_read_robot(options.robot)))
    return 0


def protocols(options: Namespace) -> int:
    """The installed device languages; the contract over them; or a new one."""
    if options.what == "check":
        return _check_protocols(options)
    if options.what == "new":
        return _new_protocol(options)
    from gateway.cli.listing import listing
    from protocols.plugin import load_all

    plugins, broken = load_all()
    print("\n".join(listing(plugins)))
    _report_broken(broken)
    return 1 if broken else 0


def _check_protocols(options: Namespace) -> int:
    """The contract over the plugins of these names, or over all; those that are broken are left out."""
    from gateway.cli.verdicts import verdict
    from protocols.plugin import UnknownProtocol, load, load_all

    broken: tuple[Broken, ...] = ()
    try:
        plugins = tuple(load(name) for name in dict.fromkeys(options.names))
    except UnknownProtocol as error:
        raise UserError(str(error)) from error
    if not plugins:
        plugins, broken = load_all()
    passed = [verdict(plugin, options.seed, failures_only=options.quiet > 0) for plugin in plugins]
    if len(plugins) + len(broken) > 1:
        print(f"{sum(passed)} of {len(plugins) + len(broken)} keep the contract")
    _report_broken(broken)
    return 0 if all(passed) and not broken else 1


def _new_protocol(options: Namespace) -> int:
    from gateway.cli import scaffold

    try:
        made = scaffold.new(options.name, options.bus, options.into)
    except UserError as error:
        raise UserError(str(error)) from error
    print(scaffold.next_steps(made))
    return 0


def _report_broken(broken: Sequence[Broken]) -> None:
    for bad in broken:
        print(f"{bad.name}: left out: {bad.distribution} is broken: {bad.reason}", file=sys.stderr)


def bench(options: Namespace) -> int:
    """Measure steps, codecs, brain, replay, recording, start-up and memory."""
    from benchmarks import bench as measure
    from benchmarks.measure import NotMeasured

    try:
        return measure(options)
    except (NotMeasured, OSError) as error:
        raise UserError(str(error)) from error


def ask(options: Namespace) -> int:
    """Say a line to a robot that runs, and print its answer."""
    from gateway.operator import ask as say
    from gateway.operator import socket_path

    name = options.robot
    path = Path(name) if name.endswith(".sock") else socket_path(Path(name).stem)
    with _sentences():
        print(say(path, " ".join(options.line)))
    return 0
