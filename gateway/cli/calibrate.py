"""`gateway calibrate base`: how far wheels roll, how a base turns, where its lidars are, what is late.

Of a recording, or of a short drive. Exit status: 0 all is as the robot file says; 1 something is not; 2 it
could not be seen.
"""

from __future__ import annotations

import logging
import sys
from argparse import ArgumentParser, Namespace
from pathlib import Path

from gateway.bench import drive, verdict
from gateway.bench.calibrate import Calibration, calibrate
from gateway.bench.driven import Driven, is_recording, of_events, of_file
from gateway.cli import arguments
from gateway.cli.terminal.consent import ask_consent
from gateway.config import load_robot, with_interfaces
from gateway.core.message_text import escaped
from gateway.core.robot import TWIN, Robot
from gateway.runtime.session import open_session

log = logging.getLogger("gateway")


def add_arguments(parser: ArgumentParser) -> None:
    """Add the arguments of the command."""
    what = parser.add_subparsers(dest="what", required=True, metavar="base")
    one = what.add_parser("base", help="wheels, lidars and gyros of a base")
    arguments.add_verbosity(one)
    one.add_argument(
        "source",
        metavar="FILE|ROBOT",
        help="a recording, a bag, a log; or a robot, which drives a few metres",
    )
    one.add_argument("--robot", metavar="ROBOT", help="the robot file of a bag or a log (with a table [bag])")
    one.add_argument("--yes", action="store_true", help="drive without asking first")
    one.add_argument(
        "--length",
        type=arguments.number("metres"),
        default=drive.LENGTH,
        metavar="M",
        help="how far it drives away from where it stands (default: %(default)s)",
    )
    one.add_argument(
        "--rounds",
        type=arguments.integer("a number of rounds from 1 to 50", 1, 50),
        default=drive.ROUNDS,
        metavar="N",
        help="how often the legs are driven (default: %(default)s); more make it more certain",
    )
    arguments.add_bus(one, "where a bus is: can0=socketcan:can0")
    arguments.add_seed(one)


def run(options: Namespace) -> int:
    """Calibrate, and print what was found."""
    path = Path(options.source)
    if is_recording(path):
        driven = of_file(path, options.robot)
        if driven.remark:
            print(f"{path.name}: {driven.remark}", file=sys.stderr)
        return _print(calibrate(driven))
    robot = with_interfaces(load_robot(options.source), dict(options.bus))
    log.addFilter(_is_news)
    try:
        driven = _driven(robot, options)
    finally:
        log.removeFilter(_is_news)
    return _print(calibrate(driven))


def _is_news(record: logging.LogRecord) -> bool:
    """False for what is meant here: the wheels are bare joints, and the drive itself looks at the lidar."""
    return "bare joints use no sensor" not in str(record.args or "") + record.msg


def _driven(robot: Robot, options: Namespace) -> Driven:
    """Drive, and return what was seen."""
    body = of_events(robot, tuple).body
    plan = drive.legs(body, options.length, options.rounds)
    made = drive.PatternDrive(body, plan)
    reach = options.length + body.radius + drive.MARGIN
    fastest = max(abs(leg.linear) for leg in plan)
    ask_consent(
        f"{robot.name} will drive for {made.span:.0f} s at up to {fastest:.2f} m/s, there and back "
        "and in turns, "
        f"within {reach:.1f} m of where it stands; obstacles are watched for by the lidar alone.",
        options.yes,
    )
    simulated = all(bus.interface == TWIN for bus in robot.buses.values())
    with open_session(drive.bare_robot(robot), simulated=simulated, seed=options.seed) as session:
        drive.drive(session, made)
    if made.ended:
        print(f"ended before its time: {escaped(made.ended)}", file=sys.stderr)
    return of_events(robot, lambda: made.events)


def _print(made: Calibration) -> int:
    fit = made.lidars[0]
    print(
        f"{made.driven.robot.name}: {made.way:.1f} m and {made.turned:.1f} rad in {made.seconds:.0f} s; "
        f"{fit.comparisons} motions compared with the scans of {fit.sensor}"
    )
    found, wrong = verdict.figures(made), verdict.named(made)
    print("found, ± one standard deviation:")
    print("\n".join(verdict.table(found)))
    for text in wrong:
        print(f"!! {text}")
    if lines := verdict.lines(made):
        print("\nput into the robot file:")
        print("\n".join(lines))
    return 1 if wrong or any(one.differs for one in found) else 0
