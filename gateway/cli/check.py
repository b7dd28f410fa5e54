"""`gateway check`: what a robot file means, with the load of its buses, or every mistake in it."""

from __future__ import annotations

from argparse import ArgumentParser, Namespace

from gateway.cli import arguments
from gateway.cli.terminal.progress import simulation
from gateway.config import describe, load_robot
from gateway.runtime.schedule import COUNTING, NotCounted, refuse_overload, table


def add_arguments(parser: ArgumentParser) -> None:
    """Add the arguments of the command."""
    arguments.add_robot(parser)


def run(options: Namespace) -> int:
    """Print the description of the robot."""
    robot = load_robot(options.robot, recorded=True)
    print(describe(robot))
    if robot.recorded:
        return 0
    print()
    try:
        with simulation(COUNTING) as simulated:
            counted = refuse_overload(robot, simulated)
        print(table(counted))
    except NotCounted as error:
        print(error)
    return 0
