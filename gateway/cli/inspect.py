"""`gateway inspect`: what is in another program's recording, and the robot file to start with."""

from __future__ import annotations

from argparse import ArgumentParser, Namespace
from pathlib import Path

from gateway.errors import BagError, UserError
from gateway.recording import read_recording
from gateway.recording.layout import MAGIC
from gateway.recording.new_file import create_with
from gateway.recording.reader import is_recording
from gateway.rosbag import is_bag
from gateway.rosbag.file import first_bytes
from gateway.rosbag.survey import EXPECTED, findings, proposed_robot, survey


def add_arguments(parser: ArgumentParser) -> None:
    """Add the arguments of the command."""
    parser.add_argument(
        "file", type=Path, metavar="FILE", help="a bag of ROS 1 or 2, a CARMEN log, or a recording"
    )
    parser.add_argument(
        "--write", type=Path, metavar="ROBOT", help="write the robot file to start with, a new file"
    )


def run(options: Namespace) -> int:
    """Print what is in it; return 1 if no robot file can be made of it."""
    path: Path = options.file
    if not is_bag(path):
        if path.is_file() and is_whole_recording(path):
            return _own(path, options.write)
        if not path.exists():
            raise UserError(f"{path}: there is no such file or folder")
        raise UserError(f"{path}: no recording that is known; {EXPECTED}")
    found = survey(path)
    print(found.text())
    if found.proposal is None:
        print(f"no robot file: {found.lacking}")
        return 1
    try:
        print("\n".join(findings(found, proposed_robot(found))))
    except BagError as error:
        print(f"it cannot be replayed as it is: {error}")
    if options.write is None:
        print(f"\n{found.robot_text()}\n--write ROBOT writes these lines to a file")
    else:
        _write(options.write, found.robot_text())
        print(f"written: {options.write}; next: gateway replay {path} --robot {options.write}")
    return 0


def is_whole_recording(path: Path) -> bool:
    """Whether it is a recording of this gateway."""
    return first_bytes(path).startswith(MAGIC) and is_recording(path)


def _own(path: Path, target: Path | None) -> int:
    """Tell of a recording of this gateway; its robot file is in it."""
    recording = read_recording(path)
    ticks = (
        f"{recording.indexed} ticks" if recording.whole else f"cut off: `gateway recover {path}` repairs it"
    )
    print(f"{path.name}: a recording of this gateway, {ticks}")
    print(f"`gateway replay {path}` compares it with the code of today, byte for byte; --view shows it")
    if target is not None:
        _write(target, recording.robot_text)
        print(f"written: {target}, the robot file that it was made with")
    return 0


def _write(target: Path, text: str) -> None:
    try:
        create_with(target, text.encode())
    except OSError as error:
        raise UserError(f"{target}: cannot be written: {error.strerror or error}") from error
