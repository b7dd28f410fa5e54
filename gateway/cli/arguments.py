"""Arguments that several commands share, and the types of arguments. Cheap to import."""

from __future__ import annotations

import json
import re
from argparse import ArgumentParser, ArgumentTypeError
from collections.abc import Callable
from math import inf, isfinite, radians


def add_verbosity(parser: ArgumentParser) -> None:
    """Add -v and -q, whose difference is the log level."""
    parser.add_argument("-v", "--verbose", action="count", default=0, help="log more; -vv: everything")
    parser.add_argument("-q", "--quiet", action="count", default=0, help="log less")


def add_robot(parser: ArgumentParser) -> None:
    """Add the robot file."""
    parser.add_argument(
        "robot", metavar="ROBOT", help="a robot file, or the name of one that ships with the gateway"
    )


def add_bus(parser: ArgumentParser, text: str) -> None:
    """Add --bus, which puts a bus of the robot file on another interface."""
    parser.add_argument(
        "--bus", type=interface, action="append", default=[], metavar="NAME=INTERFACE:CHANNEL", help=text
    )


def add_real(parser: ArgumentParser) -> None:
    """Add --real, which names the devices that are there."""
    text = "these motors and sensors are there, and all others simulated, in a world that follows real motors"
    parser.add_argument("--real", type=names, default=(), metavar="NAME,NAME", help=text)


def add_map(parser: ArgumentParser) -> None:
    """Add --map and --at."""
    text = "begin in this map: a YAML file of map_server, with its image (PGM) beside it"
    parser.add_argument("--map", default="", metavar="FILE", help=text)
    text = "where the robot is in the map (m, m, degrees; default: it looks for its place by its first scans)"
    parser.add_argument("--at", type=place, metavar="X,Y,YAW", help=text)


def add_seconds(parser: ArgumentParser, default: str = "Ctrl-C") -> None:
    """Add --seconds."""
    text = f"stop after this time (default: {default})"
    parser.add_argument("--seconds", type=number("seconds"), metavar="S", help=text)


def add_goal(parser: ArgumentParser, text: str) -> None:
    """Add --goal, which may be given several times."""
    parser.add_argument(
        "--goal", type=goal, action="append", default=[], metavar="X,Y[,YAW]", help=f"{text} (m, m, degrees)"
    )


def add_settings(parser: ArgumentParser, text: str) -> None:
    """Add --set, which gives settings of the robot file other values."""
    parser.add_argument("--set", type=setting, action="append", default=[], metavar="KEY=VALUE", help=text)


def add_seed(parser: ArgumentParser) -> None:
    """Add --seed, of the simulated world."""
    text = "seed of the simulated world's noise (default: the robot file's)"
    parser.add_argument("--seed", type=integer("a whole number from 0 on", 0, 2**63 - 1), help=text)


def add_realtime(parser: ArgumentParser) -> None:
    """Add --realtime."""
    parser.add_argument(
        "--realtime",
        nargs="?",
        const="",
        metavar="PRIORITY[,cpu=N][,required]",
        help="while it runs, have real-time priority (default: 40), locked memory and the processor that is "
        "named; with 'required' do not begin without them",
    )


# -- types ------------------------------------------------------------------------------------------


def place(text: str) -> tuple[float, float, float]:
    """Return X,Y[,YAW] [m, m, degrees] as m, m, rad."""
    x, y, yaw = goal(text)
    return x, y, yaw or 0.0


def names(text: str) -> tuple[str, ...]:
    """Return the names of NAME,NAME."""
    found = tuple(name.strip() for name in text.split(","))
    if not all(found):
        raise ArgumentTypeError(f"{text!r} is not NAME,NAME (as in left,right)")
    return found


def goal(text: str) -> tuple[float, float, float | None]:
    """Return X,Y or X,Y,YAW [m, m, degrees] as m, m, rad."""
    try:
        numbers = [float(field) for field in text.split(",")]
    except ValueError:
        numbers = []
    if len(numbers) not in (2, 3) or not all(isfinite(n) for n in numbers):
        raise ArgumentTypeError(f"{text!r} is not X,Y or X,Y,YAW in m, m, degrees (as in 2.5,1 or 2.5,1,90)")
    return numbers[0], numbers[1], radians(numbers[2]) if len(numbers) == 3 else None


def pair(text: str) -> tuple[str, str]:
    """Return the names of MOTOR=BRAKE."""
    motor, equals, brake = text.partition("=")
    if not (motor and equals and brake):
        raise ArgumentTypeError(f"{text!r} is not MOTOR=BRAKE (as in left=brake)")
    return motor, brake


def interface(text: str) -> tuple[str, str]:
    """Return the bus and the interface of NAME=INTERFACE:CHANNEL."""
    name, equals, channel = text.partition("=")
    if not (name and equals and channel):
        raise ArgumentTypeError(f"{text!r} is not NAME=INTERFACE:CHANNEL (as in can0=socketcan:vcan0)")
    return name, channel


def number(unit: str, *, or_zero: bool = False) -> Callable[[str], float]:
    """Return the type of finite positive numbers of a unit, zero among them if asked for."""

    def convert(text: str) -> float:
        try:
            value = float(text)
        except ValueError:
            value = -1.0
        if not (isfinite(value) and (value > 0.0 or (or_zero and value == 0.0))):
            raise ArgumentTypeError(f"{text!r} is not a {'' if or_zero else 'positive '}number of {unit}")
        return value

    return convert


def integer(what: str, lowest: int, highest: float = inf) -> Callable[[str], int]:
    """Return the type of the decimal integers in a range, which `what` names in the message."""

    def convert(text: str) -> int:
        try:
            value = int(text) if text.isascii() and text[:1].isdigit() else lowest - 1
        except ValueError:
            value = lowest - 1
        if not lowest <= value <= highest:
            raise ArgumentTypeError(f"{text!r} is not {what}")
        return value

    return convert


def shard(text: str) -> tuple[int, int]:
    """Return the numbers of I/N."""
    found = re.fullmatch("([1-9][0-9]{0,3})/([1-9][0-9]{0,3})", text)
    if found is None or int(found[1]) > int(found[2]):
        raise ArgumentTypeError(f"{text!r} is not I/N, such as 1/4, with I at most N")
    return int(found[1]), int(found[2])


def setting(text: str) -> tuple[str, float | str | bool]:
    """Return the key and the value of KEY=VALUE."""
    key, equals, value = text.partition("=")
    if not (key and equals and value):
        raise ArgumentTypeError(f"{text!r} is not KEY=VALUE (as in brain.pursuit.lookahead_time=0.4)")
    try:
        found = json.loads(value)
    except ValueError:
        found = value
    if not isinstance(found, int | float | str | bool) or (isinstance(found, float) and not isfinite(found)):
        raise ArgumentTypeError(f"{text!r}: expected a finite number, a word, true or false")
    return key.strip(), found
