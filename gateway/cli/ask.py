"""`gateway ask`: lines to a running robot, and its answers."""

from __future__ import annotations

from argparse import ArgumentParser, Namespace
from collections.abc import Sequence
from pathlib import Path

from gateway.cli import arguments
from gateway.operator import ask, socket_path
from gateway.operator.commands import COMMANDS


def add_arguments(parser: ArgumentParser) -> None:
    """Add the arguments of the command."""
    arguments.add_robot(parser)
    parser.add_argument(
        "line",
        nargs="+",
        metavar="LINE",
        help="a line, or several in quotes: goal 2 1 | drive 0.2 0 | stop | release | status | help …",
    )


def run(options: Namespace) -> int:
    """Print the robot's answer."""
    name = options.robot
    path = Path(name) if name.endswith(".sock") else socket_path(Path(name).stem)
    for line in lines(options.line):
        print(ask(path, line))
    return 0


def lines(words: Sequence[str]) -> list[str]:
    """Return the lines that are meant: each argument is one if all begin with a command, and one has more;
    else they are the words of one line."""
    whole = any(len(word.split()) > 1 for word in words) and all(
        (word.split() or [""])[0].lower() in COMMANDS for word in words
    )
    return list(words) if whole else [" ".join(words)]
