"""The command line: its parser, its log, its exit status.

Exit status: 0 the command did what was asked; 1 it ran, and the answer is no (a goal missed, a replay that
differs); 2 it could not begin (a wrong argument, a wrong robot file, a bus that is not there); 130 it was
interrupted while nothing was open.

Rules. A command is a module of this package and a line in `COMMANDS`. Only the module of the command that is
given is imported, so that `gateway --help` is quick.
"""

from __future__ import annotations

import argparse
import errno
import logging
import math
import os
import platform
import re
import sys
from collections.abc import Sequence
from contextlib import ExitStack, redirect_stderr, redirect_stdout
from importlib import import_module
from pathlib import Path
from typing import TextIO, cast

from gateway.cli.arguments import add_verbosity
from gateway.cli.terminal.output import Unblocked, unblocked
from gateway.cli.terminal.screen import Escaping, is_writable
from gateway.core.message_text import escaped
from gateway.errors import GatewayError

NEGATIVE, OPTION = re.compile(r"-[\d.]"), re.compile(r"--[a-z][a-z-]*")
REPEAT, MOST_LINES, MOST_NEWS = 1.0, 64, 10
"""s within which a line of the log is not written again; of how many lines that is known; and how often it is
all the same, where another of its subject came between"""
INTERRUPTED = 130
"""The status that a shell has for SIGINT."""
DESCRIPTION = "One brain, any body, over real buses."
COMMANDS = {
    "demo": "drive a robot through an office; everything is simulated except the bytes on its buses",
    "run": "run a robot on its buses",
    "twin": "simulate the devices of a robot, for another program to drive",
    "replay": "run a recording through the same code and compare every byte; or evaluate another's",
    "judge": "run a folder of recordings as a test suite, each against what is expected of it",
    "scenario": "run scenarios: what happens to a robot when, and what must hold",
    "again": "ask a robot in the simulated world again what a recording asks of it; sweep settings and seeds",
    "trim": "write a stretch of a recording as one of its own, with what leads to its beginning",
    "minimise": "find the fewest inputs of a recording that still do something; write them as a test",
    "diff": "compare two recordings: settings, the first difference, and the signals that part",
    "inspect": "tell what is in another program's recording, and write the robot file to start with",
    "map": "make a map and a path of another program's recording, as files",
    "view": "show a running robot, or recordings, in a browser",
    "recover": "repair a recording, or an MCAP bag, that was cut off or damaged",
    "fixtures": "list, verify and fetch public recordings; print what recordings of a folder cover",
    "watch": "listen to buses or to a recording, without ever sending",
    "scan": "find the devices of every installed protocol, by read-only questions alone",
    "new": "write a robot file for what was found on the buses: asks what it must know, or takes it",
    "doctor": "say why nothing moves, from the interface to the motor; sends questions alone",
    "jog": "turn one motor slowly, as long as a key is held",
    "motor": "read, compare and restore what is configured on the motors",
    "calibrate": "measure wheels, lidars and gyros of a base, from a short drive or a recording",
    "tune": "identify one joint by steps within a travel, or from a recording, and propose its gains",
    "check": "read a robot file and print its meaning, or every mistake in it",
    "schema": "print every key of a robot, world, plant, mission or scenario file, for an editor or to read",
    "layout": "print a layout of a robot for Foxglove or PlotJuggler",
    "schedule": "count how much of its buses a robot takes, and the highest rate that fits",
    "protocols": "list the installed protocols, check one, or start a new one",
    "ask": "send a line to a running robot, as on its terminal",
}
LIVE = ("demo", "run", "scenario", "again", "twin", "jog", "motor", "new", "calibrate", "tune")
"""Those that must not wait for who reads their output: a robot would wait with them."""
LINUX = (*LIVE, "view", "ask", "scan", "doctor")
"""Those that need what Linux alone has: SocketCAN, termios, real-time signals, /proc."""
FULL = (errno.ENOSPC, errno.EDQUOT)
"""Of the disk that the output is redirected to, or that has the temporary files."""


def main(arguments: list[str] | None = None) -> int:
    """Run the `gateway` command and return its exit status."""
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")  # equal bytes ask for one order of sums
    given = _command_first(sys.argv[1:] if arguments is None else arguments)
    with Path(os.devnull).open("w") as nothing, ExitStack() as stack:
        streams: Sequence[TextIO] = [stream or nothing for stream in (sys.stdout, sys.stderr)]
        stack.callback(_forget_unread, *streams)
        if given and given[0] in LIVE:
            streams = cast("Sequence[TextIO]", stack.enter_context(unblocked(*streams)))
        out, err = (cast("TextIO", Escaping(stream)) for stream in streams)
        with redirect_stdout(out), redirect_stderr(err):
            try:
                return _main(given)
            except KeyboardInterrupt:  # outside of a session, where nothing is open
                print("gateway: interrupted", file=sys.stderr)
                return INTERRUPTED


def _command_first(arguments: list[str]) -> list[str]:
    """Return the arguments with the command before what options precede it, as in `gateway -q demo`."""
    at = next((i for i, one in enumerate(arguments) if not one.startswith("-")), 0)
    before = [] if {"-h", "--help"} & {*arguments[:at]} else arguments[:at]
    given = [*arguments[at : at + 1], *before, *arguments[at + 1 :]] if before else arguments
    return _with_values(given)


def _with_values(arguments: list[str]) -> list[str]:
    """Return the arguments, a negative value joined to its option: to argparse, -2,0.5 is another option."""
    joined: list[str] = []
    for one in arguments:
        if NEGATIVE.match(one) and joined and OPTION.fullmatch(joined[-1]):
            joined[-1] += f"={one}"
        else:
            joined.append(one)
    return joined


def _main(arguments: list[str]) -> int:
    if arguments and arguments[0] in LINUX and platform.system() != "Linux":
        rest = ", ".join(name for name in COMMANDS if name not in LINUX)
        print(f"gateway {arguments[0]}: runs on Linux only; here do: {rest}", file=sys.stderr)
        return 2
    options = parser(*arguments[:1]).parse_args(arguments)
    _set_log_level(options.verbose - options.quiet)
    try:
        status: int = options.run(options)
        _flush(sys.stdout)
    except ModuleNotFoundError as error:
        if platform.system() == "Linux":
            raise
        print(f"gateway {options.command}: this runs on Linux only ({error})", file=sys.stderr)
        return 2
    except GatewayError as error:
        text = str(error)
        print(f"gateway {options.command}:", text, sep="\n" if "\n" in text else " ", file=sys.stderr)
        return 2
    except OSError as error:
        if error.errno in FULL:
            print(f"gateway {options.command}: {error.strerror}", file=sys.stderr)
        elif error.errno not in (errno.EPIPE, errno.EIO):
            raise
        return 1  # the reader of our output has gone, or its terminal was closed, which is not our error
    else:
        return status
    finally:
        for handler in logging.getLogger().handlers:
            if isinstance(handler, LogHandler):
                handler.settle()


def parser(command: str = "") -> argparse.ArgumentParser:
    """Return the parser of all commands, with the arguments of one of them."""
    result = argparse.ArgumentParser(prog="gateway", description=DESCRIPTION)
    commands = result.add_subparsers(dest="command", required=True, metavar="COMMAND")
    for name, text in COMMANDS.items():
        one = commands.add_parser(name, help=text, description=f"{text[0].upper()}{text[1:]}.")
        if name == command:
            module = import_module(f"gateway.cli.{name}")
            add_verbosity(one)
            module.add_arguments(one)
            one.set_defaults(run=module.run)
    return result


def _set_log_level(verbosity: int) -> None:
    levels = {-2: logging.CRITICAL, -1: logging.ERROR, 0: logging.WARNING, 1: logging.INFO}
    handler = LogHandler(sys.stderr)
    logging.basicConfig(level=logging.WARNING, format="%(levelname)s: %(message)s", handlers=[handler])
    logging.getLogger("gateway").setLevel(levels.get(max(-2, verbosity), logging.DEBUG))


class LogHandler(logging.StreamHandler[TextIO]):
    """Writes to a stream, and never waits for it: neither for a stopped terminal, nor for a full pipe. A line
    that comes again within `REPEAT` of when it was written is counted; the count is written with the next.
    After another of its subject it is news, a few times: "left: armed", "left: ready", "left: armed"."""

    def __init__(self, stream: TextIO) -> None:
        super().__init__(stream)
        self._written: dict[str, tuple[logging.LogRecord, int]] = {}
        """By line: the record that was written, and how often it came since."""
        self._newest: dict[str, tuple[str, int]] = {}
        """By subject: its newest line, and how often that was news within `REPEAT`"""

    def emit(self, record: logging.LogRecord) -> None:
        """Write a record, or leave it out if the stream takes nothing and does not queue it."""
        line = self.format(record)
        self._tell(record.created - REPEAT)
        subject = record.getMessage().partition(":")[0]
        newest, news = self._newest.get(subject, ("", 0))
        if line in self._written and (newest == line or news >= MOST_NEWS):
            first, count = self._written[line]
            self._written[line] = first, count + 1
            return
        if len(self._written) >= MOST_LINES or len(self._newest) >= MOST_LINES:
            self.settle()
        self._newest[subject] = line, news + 1 if line in self._written else 0
        self._written.setdefault(line, (record, 0))
        self._write(record)

    def settle(self) -> None:
        """Write what was only counted, and forget it."""
        self._tell(math.inf)
        self._newest.clear()

    def _tell(self, until: float) -> None:
        """Forget the lines written until a time [s]; write how often each came again."""
        over = [line for line, (first, _) in self._written.items() if first.created <= until]
        for first, count in map(self._written.pop, over):
            if count:
                again = logging.makeLogRecord(first.__dict__)
                again.msg, again.args = f"{first.getMessage()} ({count} times more)", ()
                self._write(again)

    def _write(self, record: logging.LogRecord) -> None:
        stream = getattr(self.stream, "terminal", self.stream)
        if isinstance(stream, Unblocked) or is_writable(stream):
            super().emit(record)

    def format(self, record: logging.LogRecord) -> str:
        """Return a record as one line: no device can write another with its texts."""
        return escaped(super().format(record), keep="\n" if record.exc_info else "")


def _flush(stream: TextIO) -> None:
    """Write out what is buffered. Raises the OSError of a disk that is full: what was printed is lost."""
    try:
        stream.flush()
    except OSError as error:
        if error.errno in FULL:
            raise


def _forget_unread(*streams: TextIO) -> None:
    """Write out what is buffered, or drop it where nothing reads it any more (a pipe or terminal closed)."""
    for stream in streams:
        try:
            stream.flush()
        except OSError:
            os.dup2(os.open(os.devnull, os.O_WRONLY), stream.fileno())
