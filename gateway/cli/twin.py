"""`gateway twin`: the devices of a robot, simulated, for another program to drive."""

from __future__ import annotations

from argparse import ArgumentParser, Namespace
from pathlib import Path

from gateway.cli import arguments
from gateway.runtime.twin_process import ADAPTERS, twin


def add_arguments(parser: ArgumentParser) -> None:
    """Add the arguments of the command."""
    arguments.add_robot(parser)
    arguments.add_bus(
        parser, "put a bus on an interface, as in can0=socketcan:vcan0 (default: pseudo-terminals)"
    )
    parser.add_argument(
        "--ports",
        type=arguments.integer("a number from 1 to 16", 1, 16),
        default=1,
        metavar="N",
        help="pseudo-terminals for each CAN bus that is not on an interface, one per program (default: 1)",
    )
    parser.add_argument(
        "--adapter",
        action="append",
        choices=ADAPTERS,
        help="protocol of those pseudo-terminals (default: slcan); if given several times, N of each",
    )
    parser.add_argument(
        "--link",
        type=Path,
        metavar="DIR",
        help="give the pseudo-terminals stable names: DIR/can0, DIR/can0.2 …",
    )
    arguments.add_seconds(parser)
    arguments.add_seed(parser)
    arguments.add_realtime(parser)


def run(options: Namespace) -> int:
    """Simulate the devices until a signal."""
    return twin(options)
