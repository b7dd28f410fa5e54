"""`gateway replay`: a recording through the code of today, byte for byte; or a ROS bag, evaluated."""

from __future__ import annotations

from argparse import ArgumentParser, Namespace
from pathlib import Path

from gateway import config
from gateway.cli import arguments
from gateway.core.clock import stopwatch
from gateway.core.step import Gateway, decoder_of
from gateway.errors import UserError
from gateway.recording import environment, read
from gateway.replay.compare import compare
from gateway.rosbag import evaluate, is_foreign
from protocols.messages import SECOND


def add_arguments(parser: ArgumentParser) -> None:
    """Add the arguments of the command."""
    parser.add_argument("file", type=Path, metavar="FILE", help="a recording, or another program's ROS bag")
    parser.add_argument(
        "--robot",
        metavar="ROBOT",
        help="use this robot file instead of the recorded one; for a bag, a robot file with a table [bag]",
    )
    parser.add_argument(
        "--at-most",
        type=arguments.number("metres", or_zero=True),
        metavar="M",
        help="largest path error (RMS) with which a bag passes",
    )


def run(options: Namespace) -> int:
    """Return 1 if a byte differs, or if the bag does not pass."""
    if is_foreign(options.file):
        if options.robot is None:
            raise UserError(f"{options.file} is another program's bag: name its robot file with --robot")
        return evaluate.replay(options.file, arguments.read_robot(options.robot), options.at_most)
    if options.at_most is not None:
        raise UserError(f"{options.file} is a recording of this gateway: --at-most is for bags only")
    recording = read(options.file)
    if options.robot is None:
        robot = config.parse_robot(recording.robot_text, f"{options.file}: robot.toml")
    else:
        robot = arguments.read_robot(options.robot)
    gateway = Gateway(robot)
    began = stopwatch()
    verdict = compare(
        recording,
        gateway.step,
        gateway.belief,
        lambda bus: decoder_of(robot, bus),
        robot_text=robot.text,
        facts=environment.facts(),
        mounts={name: sensor.mount for name, sensor in robot.sensors.items()},
        buses=robot.buses,
    )
    print(verdict.text())
    print(f"replayed in {(stopwatch() - began) / SECOND:.1f} s")
    return 0 if verdict.ok else 1
