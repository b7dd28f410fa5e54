"""`gateway schedule`: how much of its buses a robot takes, and the highest rate that fits."""

from __future__ import annotations

from argparse import ArgumentParser, Namespace
from dataclasses import replace

from gateway.cli import arguments
from gateway.cli.terminal.progress import simulation
from gateway.config import load_robot
from gateway.config.robot_file import HIGHEST_RATE
from gateway.errors import UserError
from gateway.runtime.schedule import COUNTING, highest_rate, lowest_rate, not_armed, refuse_overload, table
from protocols.messages import SECOND


def add_arguments(parser: ArgumentParser) -> None:
    """Add the arguments of the command."""
    arguments.add_robot(parser)
    text = "steps per second (default: the robot file's)"
    parser.add_argument("--rate", type=arguments.number("steps per second"), metavar="HZ", help=text)
    parser.add_argument("--frames", action="store_true", help="list the frames per second of each identifier")


def run(options: Namespace) -> int:
    """Print the load of each bus; raise UserError if one does not carry the robot."""
    robot = load_robot(options.robot)
    if options.rate is not None:
        lowest = lowest_rate(robot)
        if not lowest <= options.rate <= HIGHEST_RATE:
            raise UserError(f"--rate {options.rate:g} is not from {lowest:g} to {HIGHEST_RATE:g}")
        robot = replace(robot, period=round(SECOND / options.rate))
    rate = SECOND / robot.period
    with simulation(COUNTING) as simulated:
        counted = refuse_overload(robot, simulated)
        highest = 0.0 if not_armed(counted) else highest_rate(robot, rate, simulated)
    print(f"{robot.name} at {rate:g} steps per second, every motor commanded:")
    print(table(counted))
    if options.frames:
        for one in counted:
            print(f"{one.bus}: " + ", ".join(f"{name} {n}" for name, n in sorted(one.frames.items())))
    if highest:
        print(f"highest rate that fits: {highest:g} steps per second")
    return 0
