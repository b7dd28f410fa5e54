"""`gateway replay`: a recording through the code of today, byte for byte; or another program's, evaluated."""

from __future__ import annotations

import gc
from argparse import ArgumentParser, Namespace
from contextlib import suppress
from dataclasses import replace
from itertools import count
from pathlib import Path

from brain.belief import Belief
from gateway.buses.log_file import is_log, logged, summary
from gateway.cli import arguments
from gateway.cli.live import add_ros, add_view, check_view
from gateway.cli.only import add_only, check_only, only
from gateway.cli.reports import add_report, check_report
from gateway.cli.terminal.progress import progress
from gateway.cli.view import show_recordings
from gateway.config import load_robot
from gateway.core.clock import stopwatch
from gateway.core.message_text import escaped
from gateway.core.robot import Robot
from gateway.core.step import Gateway
from gateway.core.tick import Tick
from gateway.errors import RecordingError, UserError
from gateway.monitor import render
from gateway.monitor.candidates import of_robot
from gateway.monitor.decoder import BusMonitor
from gateway.monitor.heard import Heard, places
from gateway.recording import read_recording
from gateway.recording.layout import MAGIC
from gateway.replay import Observe, replay_recording
from gateway.report import write_report
from gateway.rosbag import is_bag
from gateway.rosbag.evaluate import evaluate_file
from gateway.rosbag.file import first_bytes
from gateway.rosbag.survey import EXPECTED, proposed_robot, survey
from gateway.rosbag.truth import Positions, Relations, read_truth
from gateway.runtime.real_devices import Latencies, real_names
from protocols.messages import SECOND


def add_arguments(parser: ArgumentParser) -> None:
    """Add the arguments of the command."""
    parser.add_argument(
        "file",
        type=Path,
        metavar="FILE",
        help="a recording, a bag of ROS 1 or 2, a CARMEN log, or with --robot a log of CAN",
    )
    add_foreign(parser)
    add_only(parser)
    add_report(parser)
    add_view(parser, steer=False)
    add_ros(parser)


def add_foreign(parser: ArgumentParser) -> None:
    """Add the arguments with which another program's recording is read and judged."""
    parser.add_argument(
        "--robot",
        metavar="ROBOT",
        help="use this robot file instead of the recorded one; for a bag or a log, one with a table [bag] "
        "(without: what `gateway inspect --write` would write)",
    )
    parser.add_argument(
        "--truth",
        type=Path,
        metavar="FILE",
        help="judge a bag or a log by this path (TUM) or these relations between poses",
    )
    parser.add_argument(
        "--at-most",
        type=arguments.number("metres", or_zero=True),
        metavar="M",
        help="largest path error with which a bag or a log passes (RMS; of relations the mean)",
    )


def run(options: Namespace) -> int:
    """Return 1 if a byte differs, or a bag or a log does not pass; 3 if nothing judges it."""
    check_view(options)
    check_only(options, ("view", "ros", "report", "truth", "at_most"))
    if options.only is not None:
        lines, same = only(options.file, options)
        print("\n".join(map(escaped, lines)))
        return 0 if same else 1
    if is_bag(options.file):  # first: a log of CARMEN and a table have names that logs of CAN have
        return _evaluate(options)
    if is_log(options.file):
        return _hear(options)
    for option, value in (("--at-most", options.at_most), ("--truth", options.truth)):
        if value is not None:
            text = f"{options.file} is a recording of this gateway: {option} is for bags and logs only"
            raise UserError(text)
    if options.view is not None or options.ros is not None:
        if options.report is not None:
            raise UserError("--view shows the recording and writes no report: leave --report or --view away")
        at, origins = options.view or "", tuple(options.origin)
        return show_recordings([options.file], at, origins, options.robot, options.ros)
    if options.report is not None:
        check_report(options.report)
    try:
        recording = read_recording(options.file)
    except RecordingError as error:
        if options.file.is_file() and not first_bytes(options.file).startswith(MAGIC):
            raise RecordingError(f"{error}; {EXPECTED}") from error
        raise
    robot = None if options.robot is None else load_robot(options.robot)
    gc.set_threshold(10_000)  # a replay leaves few cycles: to look for them ten times less saves a tenth
    began, latencies = stopwatch(), list[Latencies]()
    with progress("replay, ticks", recording.indexed) as shown:

        def watch(gateway: Gateway) -> Observe:
            ticks = count(1)
            latencies.append(Latencies(gateway.robot, real_names(gateway.robot)))

            def observe(tick: Tick, belief: Belief) -> None:
                latencies[-1].take(tick, belief)
                shown.update(next(ticks))

            return observe

        if options.report is None:
            comparison = replay_recording(recording, robot, watch)
        else:
            comparison = write_report(recording, options.report, robot, watch)
    print(comparison.text())
    for line in [line for one in latencies[-1:] for line in one.lines()]:
        print(line)
    print(f"replayed in {(stopwatch() - began) / SECOND:.1f} s")
    if options.report is not None:
        print(f"report: {options.report}")
    return 0 if comparison.ok else 1


def _hear(options: Namespace) -> int:
    """Hold a log of CAN against a robot file: 0 if nothing is wrong in it."""
    file: Path = options.file
    if options.robot is None:
        raise UserError(f"{file} is a log of CAN: --robot ROBOT says whose devices were on its buses")
    if options.view is not None:
        return show_recordings([file], options.view, tuple(options.origin), options.robot)
    for option in ("ros", "report", "truth", "at_most"):
        if getattr(options, option) is not None:
            name = option.replace("_", "-")
            raise UserError(f"{file} is a log of CAN: --{name} is for recordings with a robot's motion")
    robot, log = load_robot(options.robot), summary(file)
    buses = places(robot, log, file)
    settings = {bus: robot.buses[bus] for bus in buses.values()}
    monitor = BusMonitor(settings, of_robot(robot, list(settings)), log.began, known=True, window=None)
    heard, now = Heard(robot, buses, log.began), log.began
    with suppress(UserError):  # it was told by the summary
        for packet, sent in logged(file):
            if packet.bus in buses:
                now = packet.t
                heard.take(monitor.decode(replace(packet, bus=buses[packet.bus]), sent=sent or None))
    title = f"{file}: {robot.name}, {(now - log.began) / SECOND:.1f} s"
    print("\n".join(map(escaped, [*render.page(monitor, now, title), "", *heard.lines()])))
    if other := [bus for bus in log.fd if bus not in buses]:
        print(escaped(f"left out: {', '.join(other)}, since {robot.name} has no such bus"))
    if log.error:
        print(f"cut short: {log.error}")
    return 0 if heard.sound and not log.error else 1


def _evaluate(options: Namespace) -> int:
    """Evaluate another program's recording."""
    for option, value in (("--view", options.view), ("--ros", options.ros), ("--report", options.report)):
        if value is not None:
            text = f"{options.file} is another program's recording: {option} is for this gateway's"
            raise UserError(text)
    robot, truth = foreign(options.file, options)
    gc.set_threshold(10_000)
    with progress("replay, events", None) as shown:
        evaluation = evaluate_file(options.file, robot, options.at_most, truth, shown.update)
    print(evaluation.text())
    return evaluation.status


def foreign(file: Path, options: Namespace) -> tuple[Robot, Positions | Relations | None]:
    """Return the robot by which another program's recording is read, and the truth of a file."""
    truth = None if options.truth is None else read_truth(options.truth)
    if options.robot is not None:
        return load_robot(options.robot, recorded=True), truth
    robot = proposed_robot(survey(file))
    print(f"no robot file: read as `gateway inspect {file} --write ROBOT` would write it")
    return robot, truth
