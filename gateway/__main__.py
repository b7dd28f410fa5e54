"""The command line, thin: it parses, and hands over. Imports are lazy, so that `--help` is quick.

Exit status: 0 it did what was asked; 1 it ran and the answer is no (a goal missed, a replay that differs);
2 it could not begin (a wrong argument, a wrong robot file, a bus that is not there).
"""

from __future__ import annotations

import argparse
import logging
import os
import sys
from pathlib import Path
from typing import TypeAlias

from gateway.errors import UserError

Commands: TypeAlias = "argparse._SubParsersAction[argparse.ArgumentParser]"  # noqa: SLF001 -- it has no public name

DESCRIPTION = "One brain, any body, over real wires."


def main(arguments: list[str] | None = None) -> int:
    """The `gateway` command."""
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")  # equal bytes ask for one order of sums
    options = parser().parse_args(arguments)
    _log(options.verbose - options.quiet)
    from gateway.cli import commands

    command = {
        "demo": commands.demo,
        "run": commands.run,
        "twin": commands.twin,
        "replay": commands.replay,
        "recover": commands.recover,
        "watch": commands.watch,
        "jog": commands.jog,
        "check": commands.check,
        "protocols": commands.protocols,
        "bench": commands.bench,
        "ask": commands.ask,
    }[options.command]
    try:
        return command(options)
    except UserError as sentence:
        print(f"gateway {options.command}: {sentence}", file=sys.stderr)
        return 2
    except BrokenPipeError:  # the reader of our output has gone: not our mistake, nothing to say to it
        return 1
    finally:
        _flush()


def _flush() -> None:
    """What is left to say, said; or dropped where nobody reads it any more (a pipe or terminal closed)."""
    for stream in (sys.stdout, sys.stderr):
        try:
            stream.flush()
        except OSError:
            os.dup2(os.open(os.devnull, os.O_WRONLY), stream.fileno())


def parser() -> argparse.ArgumentParser:
    """What the command line understands."""
    made = argparse.ArgumentParser(prog="gateway", description=DESCRIPTION)
    commands = made.add_subparsers(dest="command", required=True, metavar="COMMAND")
    for add in (_demo, _run, _twin, _replay, _recover, _watch, _jog, _check, _protocols, _bench, _ask):
        add(commands)
    return made


def _demo(commands: Commands) -> None:
    demo = _command(
        commands, "demo", "drive a robot through an office, with everything simulated but the bytes"
    )
    demo.add_argument("--fast", action="store_true", help="as fast as the machine can, instead of real time")
    demo.add_argument(
        "--out", type=Path, default=Path("out"), metavar="DIR", help="recording and picture (default: out)"
    )
    demo.add_argument("--robot", default="diffbot", metavar="ROBOT", help="another robot file")
    demo.add_argument("--seed", type=int, help="of the world's noise (default: the robot file's)")
    demo.add_argument(
        "--goal", type=_goal, action="append", metavar="X,Y[,YAW]", help="instead of the world's tour"
    )


def _run(commands: Commands) -> None:
    run = _command(commands, "run", "run a robot on its buses")
    _robot(run)
    _bus(run, "put a bus on another interface: can0=socketcan:vcan0, sensors=serial:/dev/ttyUSB0, can0=twin")
    run.add_argument(
        "--goal", type=_goal, action="append", default=[], metavar="X,Y[,YAW]", help="m, m, degrees"
    )
    run.add_argument("--record", type=Path, metavar="FILE", help="an MCAP file; must not exist yet")
    run.add_argument(
        "--seconds", type=_positive, metavar="S", help="end after so long (default: Ctrl-C, or quit)"
    )
    run.add_argument("--dry-run", action="store_true", help="do everything but write to the buses")
    run.add_argument("--fast", action="store_true", help="in simulated time; only if every bus is a twin")
    run.add_argument("--seed", type=int, help="of the world's noise, where buses are twins")
    _realtime(run)


def _twin(commands: Commands) -> None:
    twin = _command(commands, "twin", "be the devices of a robot, for another program to drive")
    _robot(twin)
    _bus(twin, "let them speak there, as in can0=socketcan:vcan0 (default: ptys of their own)")
    twin.add_argument(
        "--ports",
        type=_count,
        default=1,
        metavar="N",
        help="ptys for each CAN bus that is not on an interface, for so many programs at once (default: 1)",
    )
    twin.add_argument(
        "--adapter",
        action="append",
        choices=("slcan", "fdcanusb"),
        help="what those ptys speak (default: slcan); given twice, N ptys of each",
    )
    twin.add_argument(
        "--link",
        type=Path,
        metavar="DIR",
        help="names for the ptys that stay the same: DIR/can0, DIR/can0.2 …",
    )
    twin.add_argument("--seconds", type=_positive, metavar="S", help="end after so long (default: Ctrl-C)")
    twin.add_argument("--seed", type=int, help="of the world's noise (default: the robot file's)")
    _realtime(twin)


def _replay(commands: Commands) -> None:
    replay = _command(
        commands,
        "replay",
        "run a recording through the same code, and compare every byte; or judge the brain by a ROS bag",
    )
    replay.add_argument("file", type=Path, metavar="FILE", help="a recording, or a bag of somebody else's")
    replay.add_argument(
        "--robot",
        metavar="ROBOT",
        help="another robot file than the one in the recording; a bag needs one that has a table [bag]",
    )
    replay.add_argument(
        "--at-most", type=_metres, metavar="M", help="of a bag: the largest path error (RMS) to pass with"
    )


def _recover(commands: Commands) -> None:
    recover = _command(commands, "recover", "make a recording whole again that was cut off or damaged")
    recover.add_argument("file", type=Path, metavar="FILE")
    recover.add_argument(
        "-o", "--out", type=Path, metavar="OUT", help="the new file (default: FILE with .recovered in it)"
    )


def _watch(commands: Commands) -> None:
    watch = _command(commands, "watch", "listen to buses or to a recording, and never say anything")
    watch.add_argument(
        "what",
        nargs="?",
        metavar="ROBOT|FILE.mcap|INTERFACE:CHANNEL",
        help="a robot file or its name, a recording, or socketcan:can0, slcan:PORT, serial:PORT … "
        "(default: every CAN interface of this machine)",
    )
    _bus(watch, "where a bus of the robot file is: can0=socketcan:vcan0")
    watch.add_argument("--lines", action="store_true", help="a line for every packet, instead of the page")
    watch.add_argument("--seconds", type=_positive, metavar="S", help="end after so long (default: Ctrl-C)")
    watch.add_argument(
        "--bitrate", type=_rate, default=0, metavar="N", help="of INTERFACE:CHANNEL (default: 1000000)"
    )
    watch.add_argument("--data-bitrate", type=_rate, default=0, metavar="N", help="of it, if it is CAN FD")
    watch.add_argument("--baudrate", type=_rate, default=115_200, metavar="N", help="of serial:PORT")


def _jog(commands: Commands) -> None:
    jog = _command(commands, "jog", "turn one motor slowly, as long as a key is held")
    jog.add_argument("motor", metavar="MOTOR", help="its name in the robot file")
    jog.add_argument("robot", nargs="?", default="bench", metavar="ROBOT", help="(default: bench, on twins)")
    _bus(jog, "where the motor's bus is: can0=socketcan:can0")
    jog.add_argument(
        "--speed", type=_speed, metavar="RAD_PER_S", help="(default: 5 %% of the joint's limit of velocity)"
    )


def _check(commands: Commands) -> None:
    check = _command(
        commands, "check", "read a robot file, and say what was understood, or every mistake in it"
    )
    _robot(check)


def _protocols(commands: Commands) -> None:
    protocols = _command(
        commands, "protocols", "the installed device languages; check one, or begin a new one"
    )
    what = protocols.add_subparsers(dest="what", metavar="check | new")
    check = _command(
        what, "check", "run the contract over device languages, and print what each clause finds"
    )
    check.add_argument(
        "names", nargs="*", metavar="NAME", help="which (default: every one that is installed)"
    )
    check.add_argument(
        "--seed", type=_seed, default=0, metavar="N", help="of the contract's samples (default: 0)"
    )
    new = _command(what, "new", "write a folder with a whole plugin for an invented device, to be filled in")
    new.add_argument("name", metavar="NAME", help="of the language, as robot files will say it: my_motor")
    new.add_argument("--bus", required=True, choices=("can", "canfd", "serial"), help="what it is spoken on")
    new.add_argument(
        "--into",
        type=Path,
        default=Path(),
        metavar="DIR",
        help="where the folder NAME is made (default: here)",
    )


def _bench(commands: Commands) -> None:
    bench = _command(commands, "bench", "measure what this program costs here, beside what else there is")
    bench.add_argument("--json", type=Path, metavar="FILE", help="write the figures there, too")
    bench.add_argument("--quick", action="store_true", help="a few seconds, for rough figures")


def _ask(commands: Commands) -> None:
    ask = _command(commands, "ask", "say something to a robot that is running, as on its terminal")
    _robot(ask)
    ask.add_argument(
        "line", nargs="+", metavar="LINE", help="goal 2 1 | drive 0.2 0 | stop | release | status | help …"
    )


def _command(commands: Commands, name: str, text: str) -> argparse.ArgumentParser:
    command = commands.add_parser(name, help=text, description=text[0].upper() + text[1:] + ".")
    command.add_argument("-v", "--verbose", action="count", default=0, help="more; twice: everything")
    command.add_argument("-q", "--quiet", action="count", default=0, help="less")
    return command


def _robot(command: argparse.ArgumentParser) -> None:
    command.add_argument(
        "robot", metavar="ROBOT", help="a robot file, or the name of one that ships with the gateway"
    )


def _bus(command: argparse.ArgumentParser, text: str) -> None:
    command.add_argument(
        "--bus", type=_interface, action="append", default=[], metavar="NAME=INTERFACE:CHANNEL", help=text
    )


def _realtime(command: argparse.ArgumentParser) -> None:
    command.add_argument(
        "--realtime", type=int, metavar="PRIORITY", help="ask for SCHED_FIFO with this priority"
    )


def _log(verbosity: int) -> None:
    levels = {-2: logging.CRITICAL, -1: logging.ERROR, 0: logging.WARNING, 1: logging.INFO}
    level = levels.get(max(-2, verbosity), logging.DEBUG)
    logging.basicConfig(level=logging.WARNING, format="%(levelname)s: %(message)s", stream=sys.stderr)
    logging.getLogger("gateway").setLevel(level)


def _goal(text: str) -> tuple[float, float, float | None]:
    from math import isfinite, radians

    try:
        numbers = [float(part) for part in text.split(",")]
    except ValueError:
        numbers = []
    if len(numbers) not in (2, 3) or not all(isfinite(n) for n in numbers):
        raise argparse.ArgumentTypeError(
            f"{text!r} is not X,Y or X,Y,YAW in m, m, degrees (as in 2.5,1 or 2.5,1,90)"
        )
    return numbers[0], numbers[1], radians(numbers[2]) if len(numbers) == 3 else None


def _interface(text: str) -> tuple[str, str]:
    name, equals, interface = text.partition("=")
    if not (name and equals and interface):
        raise argparse.ArgumentTypeError(
            f"{text!r} is not NAME=INTERFACE:CHANNEL (as in can0=socketcan:vcan0)"
        )
    return name, interface


def _count(text: str) -> int:
    if not (text.isascii() and text.isdigit() and 1 <= int(text) <= 16):
        raise argparse.ArgumentTypeError(f"{text!r} is not a number from 1 to 16")
    return int(text)


def _seed(text: str) -> int:
    if not (text.isascii() and text.isdigit() and int(text) < 2**63):
        raise argparse.ArgumentTypeError(f"{text!r} is not a number from 0 to 2**63 - 1")
    return int(text)


def _rate(text: str) -> int:
    if not (text.isascii() and text.replace("_", "").isdigit() and int(text) > 0):
        raise argparse.ArgumentTypeError(f"{text!r} is not a rate in bit/s")
    return int(text)


def _positive(text: str, unit: str = "seconds") -> float:
    from math import isfinite

    try:
        value = float(text)
    except ValueError:
        value = 0.0
    if not (isfinite(value) and value > 0.0):
        raise argparse.ArgumentTypeError(f"{text!r} is not a positive number of {unit}")
    return value


def _speed(text: str) -> float:
    return _positive(text, "rad/s")


def _metres(text: str) -> float:
    from math import isfinite

    try:
        value = float(text)
    except ValueError:
        value = -1.0
    if not (isfinite(value) and value >= 0.0):
        raise argparse.ArgumentTypeError(f"{text!r} is not a number of metres")
    return value


if __name__ == "__main__":
    sys.exit(main())
