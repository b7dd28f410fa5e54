"""`gateway map`: the map and the path of another program's recording, as files."""

from __future__ import annotations

import gc
from argparse import ArgumentParser, Namespace
from pathlib import Path

from gateway.cli.replay import add_foreign, foreign
from gateway.cli.terminal.progress import progress
from gateway.errors import UserError
from gateway.recording.new_file import EXISTS, create_with
from gateway.rosbag import is_bag
from gateway.rosbag.drawn import Drawn, csv, tum
from gateway.rosbag.evaluate import Trace, evaluate_file
from gateway.rosbag.survey import EXPECTED

FILES = ("map.pgm", "map.png", "map.yaml", "path.tum", "path.csv")


def add_arguments(parser: ArgumentParser) -> None:
    """Add the arguments of the command."""
    parser.add_argument("file", type=Path, metavar="FILE", help="a bag of ROS 1 or 2, or a CARMEN log")
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
    if not is_bag(options.file):
        raise UserError(f"{options.file}: no recording of another program; {EXPECTED}")
    if there := next((one for one in map(options.out.joinpath, FILES) if one.exists()), None):
        raise UserError(f"{there}: {EXISTS}; name another folder with --out")
    robot, truth = foreign(options)
    trace = Trace()
    gc.set_threshold(10_000)
    with progress("map, events", None) as shown:
        evaluation = evaluate_file(options.file, robot, options.at_most, truth, shown.update, trace)
    print(evaluation.text())
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
    return evaluation.status
