"""`gateway ask`: one line to a running robot, and its answer."""

from __future__ import annotations

from argparse import ArgumentParser, Namespace
from pathlib import Path

from gateway.cli import arguments
from gateway.operator import ask, socket_path


def add_arguments(parser: ArgumentParser) -> None:
    """Add the arguments of the command."""
    arguments.add_robot(parser)
    parser.add_argument(
        "line", nargs="+", metavar="LINE", help="goal 2 1 | drive 0.2 0 | stop | release | status | help …"
    )


def run(options: Namespace) -> int:
    """Print the robot's answer."""
    name = options.robot
    path = Path(name) if name.endswith(".sock") else socket_path(Path(name).stem)
    print(ask(path, " ".join(options.line)))
    return 0
