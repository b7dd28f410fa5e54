"""`gateway replay`: a recording through the code of today, byte for byte; or a ROS bag, evaluated."""

from __future__ import annotations

import gc
from argparse import ArgumentParser, Namespace
from itertools import count
from pathlib import Path

from gateway.cli import arguments
from gateway.cli.live import add_view, check_view
from gateway.cli.reports import add_report, check_report
from gateway.cli.terminal.progress import progress
from gateway.cli.view import show_recordings
from gateway.config import load_robot
from gateway.core.clock import stopwatch
from gateway.core.step import Gateway
from gateway.errors import UserError
from gateway.recording import read_recording
from gateway.replay import Observe, replay_recording
from gateway.report import write_report
from gateway.rosbag import is_bag
from gateway.rosbag.evaluate import evaluate_file
from protocols.messages import SECOND


def add_arguments(parser: ArgumentParser) -> None:
    """Add the arguments of the command."""
    parser.add_argument("file", type=Path, metavar="FILE", help="a recording, or another program's ROS bag")
    parser.add_argument(
        "--robot",
        metavar="ROBOT",
        help="use this robot file instead of the recorded one; for a bag, a robot file with a table [bag]",
    )
    parser.add_argument(
        "--at-most",
        type=arguments.number("metres", or_zero=True),
        metavar="M",
        help="largest path error (RMS) with which a bag passes",
    )
    add_report(parser)
    add_view(parser, steer=False)


def run(options: Namespace) -> int:
    """Return 1 if a byte differs, or if the bag does not pass."""
    check_view(options)
    if is_bag(options.file):
        if options.view is not None:
            raise UserError(f"{options.file} is another program's bag: --view is for recordings")
        if options.report is not None:
            raise UserError(f"{options.file} is another program's bag: --report is for recordings")
        if options.robot is None:
            raise UserError(f"{options.file} is another program's bag: name its robot file with --robot")
        evaluation = evaluate_file(options.file, load_robot(options.robot), options.at_most)
        print(evaluation.text())
        return 0 if evaluation.ok else 1
    if options.at_most is not None:
        raise UserError(f"{options.file} is a recording of this gateway: --at-most is for bags only")
    if options.view is not None:
        if options.report is not None:
            raise UserError("--view shows the recording and writes no report: leave --report or --view away")
        return show_recordings([options.file], options.view, tuple(options.origin), options.robot)
    if options.report is not None:
        check_report(options.report)
    recording = read_recording(options.file)
    robot = None if options.robot is None else load_robot(options.robot)
    gc.set_threshold(10_000)  # a replay leaves few cycles: to look for them ten times less saves a tenth
    began = stopwatch()
    with progress("replay, ticks", recording.indexed) as shown:

        def watch(_: Gateway) -> Observe:
            ticks = count(1)
            return lambda *_: shown.update(next(ticks))

        if options.report is None:
            comparison = replay_recording(recording, robot, watch)
        else:
            comparison = write_report(recording, options.report, robot, watch)
    print(comparison.text())
    print(f"replayed in {(stopwatch() - began) / SECOND:.1f} s")
    if options.report is not None:
        print(f"report: {options.report}")
    return 0 if comparison.ok else 1
