"""`gateway layout`: a layout of a robot for Foxglove or PlotJuggler."""

from __future__ import annotations

from argparse import ArgumentParser, Namespace
from pathlib import Path

from gateway.config import load_robot
from gateway.errors import UserError
from gateway.recording.new_file import create_with
from gateway.view.layouts import KINDS


def add_arguments(parser: ArgumentParser) -> None:
    """Add the arguments of the command."""
    parser.add_argument("program", choices=KINDS, help="which program opens it")
    parser.add_argument("robot", metavar="ROBOT", help="a robot file, or the name of one that ships")
    parser.add_argument("--out", type=Path, metavar="FILE", help="write it to a new file")


def run(options: Namespace) -> int:
    """Print a layout, or write it."""
    text = KINDS[options.program](load_robot(options.robot))
    if options.out is None:
        print(text, end="")
        return 0
    try:
        create_with(options.out, text.encode())
    except OSError as error:
        raise UserError(f"{options.out} cannot be written: {error.strerror}") from error
    return 0
