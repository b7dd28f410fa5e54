"""`gateway check`: what a robot file means, or every mistake in it."""

from __future__ import annotations

from argparse import ArgumentParser, Namespace

from gateway.cli import arguments
from gateway.config import describe, load_robot


def add_arguments(parser: ArgumentParser) -> None:
    """Add the arguments of the command."""
    arguments.add_robot(parser)


def run(options: Namespace) -> int:
    """Print the description of the robot."""
    print(describe(load_robot(options.robot)))
    return 0
