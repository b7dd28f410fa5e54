"""`gateway map`: the map and the path of a recording, this gateway's or another program's, as files."""

from __future__ import annotations

import gc
from argparse import ArgumentParser, Namespace
from itertools import count
from pathlib import Path

from brain.belief import Belief
from gateway.cli.replay import add_foreign, foreign
from gateway.cli.terminal.progress import progress
from gateway.config import load_robot
from gateway.core.step import Gateway
from gateway.core.tick import Tick
from gateway.errors import RecordingError, UserError
from gateway.recording import read_recording
from gateway.recording.new_file import EXISTS, create_with
from gateway.replay import Observe, replay_recording
from gateway.rosbag import is_bag
from gateway.rosbag.drawn import Drawn, csv, tum
from gateway.rosbag.evaluate import Trace, evaluate_file
from gateway.rosbag.survey import EXPECTED

FILES = ("map.pgm", "map.png", "map.yaml", "path.tum", "path.csv")


def add_arguments(parser: ArgumentParser) -> None:
    """Add the arguments of the command."""
    parser.add_argument(
        "file", type=Path, metavar="FILE", help="a recording, a bag of ROS 1 or 2, or a CARMEN log"
    )
    add_foreign(parser)
    parser.add_argument(
        "--out",
        type=Path,
        default=Path(),
        metavar="DIR",
        help="a folder for the files, made if it is not there",
    )


def run(options: Namespace) -> int:
    """Return as `gateway replay` does; the files are written in any case."""
    if not options.file.exists():
        raise UserError(f"{options.file}: there is no such file or folder")
    if there := next((one for one in map(options.out.joinpath, FILES) if one.exists()), None):
        raise UserError(f"{there}: {EXISTS}; name another folder with --out")
    gc.set_threshold(10_000)
    trace = Trace()
    status, text = (_evaluated if is_bag(options.file) else _replayed)(options, trace)
    print(text)
    if trace.map is None or not trace.path:
        raise UserError(f"{options.file}: nothing was estimated: there is no map, and no path")
    try:
        drawn = Drawn(trace.map, trace.path)
    except ValueError as error:
        raise UserError(f"{options.file}: {error}") from error
    texts = drawn.yaml(), tum(trace.path), csv(trace.path)
    files = dict(zip(FILES, (drawn.pgm(), drawn.png(), *map(str.encode, texts)), strict=True))
    folder: Path = options.out
    try:
        folder.mkdir(parents=True, exist_ok=True)
        for name, data in files.items():
            create_with(folder / name, data)
    except OSError as error:
        raise UserError(
            f"{error.filename or folder}: cannot be written: {error.strerror or error}"
        ) from error
    height, width = drawn.pixels.shape
    size = f"{width * drawn.resolution:.1f} m x {height * drawn.resolution:.1f} m"
    print(f"written to {folder}: {', '.join(files)} ({size}, {len(trace.path)} poses)")
    return status


def _evaluated(options: Namespace, trace: Trace) -> tuple[int, str]:
    """Fill the trace by another program's recording; return the status and what there is to say."""
    robot, truth = foreign(options)
    with progress("map, events", None) as shown:
        evaluation = evaluate_file(options.file, robot, options.at_most, truth, shown.update, trace)
    return evaluation.status, evaluation.text()


def _replayed(options: Namespace, trace: Trace) -> tuple[int, str]:
    """Fill the trace by a recording of this gateway, the path as it was believed at the time; likewise."""
    try:
        recording = read_recording(options.file)
    except RecordingError as error:
        raise RecordingError(f"{error}; {EXPECTED}") from error
    robot = None if options.robot is None else load_robot(options.robot)
    with progress("map, ticks", recording.indexed) as shown:

        def watch(_: Gateway) -> Observe:
            ticks = count(1)

            def observe(_: Tick, belief: Belief) -> None:
                trace.map = belief.map or trace.map
                if (now := belief.estimate) is not None and trace.is_due(now.t):
                    trace.path.append((now.t, now.pose))
                shown.update(next(ticks))

            return observe

        comparison = replay_recording(recording, robot, watch)
    return 0 if comparison.ok else 1, comparison.text()
