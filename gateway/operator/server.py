"""The operator's access to a running robot: a local socket, and lines on the terminal.

Rules. Nothing here waits and there is no thread: the loop polls, and a client that is slow, gone or sends
nonsense affects no other. Only its owner may open the socket (mode 0600 in a directory of mode 0700). Lines,
buffers and the lines answered in one poll are bounded; a new client is always let in, in place of the one
that has been idle longest. What is answered cannot control a terminal. The end of the terminal's input does
not end the run; `quit` does. A terminal is read only while the program is in its foreground: reading from the
background would stop the process.

The dialogue: each line is answered by one or more lines; what the robot then reports (`report`) follows.
A client that has shut down its writing side gets that too, and is then closed.
"""

from __future__ import annotations

import os
import select
import socket
import stat
import struct
import sys
from collections import deque
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path

from gateway.core.message_text import escaped
from gateway.core.robot import Robot
from gateway.errors import OperatorError
from gateway.operator.commands import Query, RejectedLine, help_text, parse, safely
from protocols.messages import Instruction, Stop

MAX_READ = 4096
"""Bytes taken from one client in one poll."""
MAX_LINE = 1000
"""Bytes of a line."""
MAX_UNSENT = 65536
"""Bytes that a client may leave unread before it is dropped."""
MAX_LINES = 32
"""Lines that are answered in one poll,"""
MAX_LINES_EACH = 8
"""and of one client."""
MAX_CLIENTS = 64
ENDING = ("stop", "estop", "quit", "idle")
"""Commands for which no line of a pipe waits,"""
STOPPING = ("stop", "estop")
"""and which end what waits after `wait ready`."""
MOST_WAITING = 1000
"""Lines that may wait there: those after them are not read."""
READS_DROPPED = 64
"""Reads of lines that are dropped: what a socket or a pipe holds."""
MAX_PATH = 107
"""Bytes of a socket's path (unix(7): sun_path)."""

_DROPPED = "the robot was stopped: {} lines that waited until it is ready are dropped"
_TOO_LONG = RejectedLine(f"the line is longer than {MAX_LINE} bytes; it is left out")


@dataclass(slots=True)
class LineBuffer:
    """Received bytes, cut into lines; a line that is too long is rejected as a whole."""

    rest: bytearray = field(default_factory=bytearray)
    skipping: bool = False
    """Whether `rest` continues a line that has been rejected."""

    def feed(self, data: bytes) -> list[str | RejectedLine]:
        """Return the lines that these bytes end."""
        self.rest += data
        *complete, self.rest = self.rest.split(b"\n")
        lines: list[str | RejectedLine] = []
        for line in complete:
            if not self.skipping:
                lines.append(_decoded(line))
            self.skipping = False
        if len(self.rest) > MAX_LINE:
            if not self.skipping:
                lines.append(_TOO_LONG)
            self.skipping = True
            self.rest.clear()
        return lines

    def skip(self) -> None:
        """Leave out a line of which the beginning has come."""
        self.skipping = self.skipping or bool(self.rest)
        self.rest.clear()

    def end(self) -> list[str | RejectedLine]:
        """Return what follows the last end of line, when nothing more will come."""
        line, self.rest = self.rest, bytearray()
        return [_decoded(line)] if line and not self.skipping else []


def _decoded(line: bytearray) -> str | RejectedLine:
    return _TOO_LONG if len(line) > MAX_LINE else line.decode("utf-8", "replace").strip()


@dataclass(slots=True)
class _Client:
    socket: socket.socket
    buffer: LineBuffer = field(default_factory=LineBuffer)
    lines: deque[str | RejectedLine] = field(default_factory=deque)
    """Received and not answered yet."""
    unsent: bytearray = field(default_factory=bytearray)
    ended: bool = False
    """Whether it has shut down its writing side."""
    told: bool = False
    """Whether it was told for what its lines wait."""


class Operator:
    """Open while the robot runs; use it as a context manager, or close it."""

    def __init__(self, robot: Robot, folder: Path | None = None, terminal: int | None = -1) -> None:
        """Open the socket. `terminal` is a file descriptor, None for none, -1 for the standard input.

        Raises OperatorError if the socket cannot be made."""
        self._robot = robot
        self._terminal = _standard_input() if terminal == -1 else terminal
        self._typed, self._typed_lines = LineBuffer(), deque[str | RejectedLine]()
        self._waits = not _is_terminal(self._terminal)
        """Whether lines of the standard input wait until the robot is ready: nobody sees when it is,"""
        self._told = False
        """and whether that was said."""
        self._clients: list[_Client] = []
        """The one that was answered or accepted longest ago first."""
        self._has_typed = False
        self.leaving = False
        """Whether quit has been received."""
        self._polled: list[Instruction] = []
        """Of the last poll."""
        self.path = _free_path(folder or socket_folder(), robot.name)
        self._listener = _listen(self.path)

    def __enter__(self) -> Operator:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def poll(
        self,
        status: Callable[[], str],
        view: Callable[[str], str] = lambda _: "there is no view here",
        unready: Callable[[], str] = lambda: "",
        doctor: Callable[[], str] = lambda: "there is no doctor here",
    ) -> list[Instruction]:
        """Return the instructions since the last poll, of the client answered longest ago first. Never waits.

        `status`, `doctor`, and `view` with its arguments, are called for each line that asks for it;
        `unready` says for what lines of a pipe must be kept, but for one that ends something."""
        answers: dict[str, Callable[[str], str]] = {
            "status": lambda _: status(),
            "doctor": lambda _: doctor(),
            "view": view,
        }
        instructions: list[Instruction] = []
        for client in list(self._clients):
            self._read(client)
        for client in self._accept():
            self._read(client)
        self._typed_lines.extend(self._read_terminal() if _reads_on(self._typed_lines) else ())
        self._has_typed = self._has_typed or bool(self._typed_lines)
        left = MAX_LINES
        for client in list(self._clients):
            _stop_first(client.lines, unready)
            count = min(left, MAX_LINES_EACH, len(client.lines))
            for _ in range(count):
                client.told = _stays(client.lines, unready, partial(_queue, client), told=client.told)
                if client.told:
                    break
                instructions += self._on_line(client.lines, partial(_queue, client), answers)
            left -= count
            if count:
                self._clients.remove(client)
                self._clients.append(client)
            self._send(client)
        _stop_first(self._typed_lines, unready)
        for _ in range(0 if self._keeps(unready) else min(MAX_LINES_EACH, len(self._typed_lines))):
            self._told = _stays(self._typed_lines, unready, _print, told=self._told)
            if self._told:
                break
            instructions += self._on_line(self._typed_lines, _print, answers)
        self._polled = instructions
        return instructions

    def see(self, instructions: Sequence[Instruction]) -> None:
        """Look at all that a tick was told: a stop that came from elsewhere, the page or a program, ends what
        waits here, too."""
        mine = {id(one) for one in self._polled}
        if any(isinstance(one, Stop) and id(one) not in mine for one in instructions):
            self._drop_waiting()

    def _drop_waiting(self, but: Sequence[str | RejectedLine] | None = None) -> None:
        """Drop what waits until the robot is ready, and say so: it was meant for a robot that nobody had
        stopped. What follows the stop itself, in the lines `but`, is left."""
        for client in self._clients:
            if client.lines is not but and (count := _drop_from_ready(client.lines)):
                for _ in range(READS_DROPPED):  # what was sent with it is meant likewise
                    data = _received(client.socket)
                    if not data:
                        client.ended = client.ended or data == b""
                        break
                    count += len(client.buffer.feed(data))
                client.buffer.skip()
                _queue(client, _DROPPED.format(count))
        typed = self._typed_lines
        if typed is not but and (count := _drop_from_ready(typed, whole=self._waits)):
            for _ in range(READS_DROPPED):
                if not (more := self._read_terminal()):
                    break
                count += len(more)
            self._typed.skip()
            _print(_DROPPED.format(count))

    def report(self, text: str, *, logged: bool = True) -> None:
        """Send a text of the robot to every connected client, and print it where a line was typed, unless it
        is `logged` there."""
        if self._has_typed and not logged:
            _print(text)
        for client in list(self._clients):
            _queue(client, escaped(text))
            self._send(client)

    def close(self) -> None:
        """Send what is left, close everything, and remove the socket."""
        for client in list(self._clients):
            self._send(client)
            self._drop(client)
        if self._listener.fileno() >= 0:
            self._listener.close()
            self.path.unlink(missing_ok=True)

    def _keeps(self, unready: Callable[[], str]) -> bool:
        """Whether lines of a pipe are kept until the robot is ready; say so once."""
        if not self._waits or not self._typed_lines:
            return False
        told = any(_asks_ready(one) for one in self._typed_lines)
        why = "" if told or _contains(self._typed_lines, ENDING) else unready()
        if why and not self._told:
            _print(f"the lines wait: {why}")
        self._told, self._waits = bool(why), bool(why)
        return bool(why)

    def _on_line(
        self,
        lines: deque[str | RejectedLine],
        answer: Callable[[str], None],
        answers: Mapping[str, Callable[[str], str]],
    ) -> list[Instruction]:
        """Answer the next of the lines, and return its instruction if it is one."""
        line = lines.popleft()
        match parse(line, self._robot) if isinstance(line, str) else line:
            case None:
                pass
            case RejectedLine(reason):
                answer(reason)
            case Query("help"):
                answer(help_text())
            case Query(kind, text) if kind in answers:
                told = safely(partial(answers[kind], text))
                answer(told if isinstance(told, str) else told.reason)
            case Query("ready"):
                answer("ready")
            case Query():  # quit
                self.leaving = True
                answer("leaving")
            case instruction:
                answer(f"accepted: {line}")
                if isinstance(instruction, Stop):
                    self._drop_waiting(but=lines)
                return [instruction]
        return []

    # -- clients ------------------------------------------------------------------------------

    def _accept(self) -> Iterator[_Client]:
        for _ in range(MAX_CLIENTS):
            try:
                connection, _address = self._listener.accept()
            except OSError:  # no client waits, or it has gone again
                return
            connection.setblocking(False)
            if len(self._clients) >= MAX_CLIENTS:
                self._drop(min(self._clients, key=lambda one: bool(one.lines or one.unsent)))
            self._clients.append(_Client(connection))
            yield self._clients[-1]

    def _read(self, client: _Client) -> None:
        """Read lines, unless some are left to be answered; drop a client that has ended and was answered."""
        if client.lines and (client.ended or not _reads_on(client.lines)):
            return
        if client.ended:
            self._send(client)
            self._drop(client)
            return
        try:
            data = client.socket.recv(MAX_READ)
        except BlockingIOError:
            return
        except OSError:
            self._drop(client)
            return
        client.ended = not data
        client.lines.extend(client.buffer.feed(data) if data else client.buffer.end())

    def _send(self, client: _Client) -> None:
        try:
            while client.unsent:
                del client.unsent[: client.socket.send(client.unsent)]
        except BlockingIOError:
            if len(client.unsent) > MAX_UNSENT:
                self._drop(client)
        except OSError:
            self._drop(client)

    def _drop(self, client: _Client) -> None:
        client.socket.close()
        client.unsent.clear()
        if client in self._clients:
            self._clients.remove(client)

    # -- the terminal -------------------------------------------------------------------------

    def _read_terminal(self) -> list[str | RejectedLine]:
        if self._terminal is None:
            return []
        try:
            if not select.select([self._terminal], [], [], 0)[0] or not _in_foreground(self._terminal):
                return []
            data = os.read(self._terminal, MAX_READ)
        except OSError:
            data = b""
        if data:
            return self._typed.feed(data)
        self._terminal = None
        return self._typed.end()


def _received(connection: socket.socket) -> bytes | None:
    """Return what has come; None if nothing has, b"" at the end."""
    try:
        return connection.recv(MAX_READ)
    except OSError:
        return None


def _drop_from_ready(lines: deque[str | RejectedLine], *, whole: bool = False) -> int:
    """Drop the first line that waits until the robot is ready, and all behind it; return how many."""
    first = 0 if whole else next((place for place, one in enumerate(lines) if _asks_ready(one)), len(lines))
    count = len(lines) - first
    for _ in range(count):
        lines.pop()
    return count


def _stop_first(lines: deque[str | RejectedLine], unready: Callable[[], str]) -> None:
    """Drop what waits before a line that stops."""
    if lines and _asks_ready(lines[0]) and _contains(lines, STOPPING) and unready():
        while not _contains([lines[0]], STOPPING):
            lines.popleft()


def _stays(
    lines: Sequence[str | RejectedLine],
    unready: Callable[[], str],
    answer: Callable[[str], None],
    *,
    told: bool,
) -> bool:
    """Whether the next line is `wait ready`, and the robot is not; say so once."""
    why = unready() if _asks_ready(lines[0]) else ""
    if why and not told:
        answer(f"the lines wait: {why}")
    return bool(why)


def _reads_on(lines: Sequence[str | RejectedLine]) -> bool:
    """Whether more lines are read: none is left, or they wait, and one that stops may come."""
    return not lines or (_asks_ready(lines[0]) and len(lines) < MOST_WAITING)


def _asks_ready(line: str | RejectedLine) -> bool:
    words = line.partition("#")[0].lower().split() if isinstance(line, str) else []
    return words in (["ready"], ["wait", "ready"])


def _contains(lines: Sequence[str | RejectedLine], commands: tuple[str, ...]) -> bool:
    return any(isinstance(one, str) and one.lower().startswith(commands) for one in lines)


def _queue(client: _Client, text: str) -> None:
    client.unsent += escaped(text, keep="\n").encode() + b"\n"


def _print(text: str) -> None:
    with suppress(OSError):  # the standard output has no reader any more
        print(escaped(text, keep="\n"), flush=True)


def _standard_input() -> int | None:
    try:
        return sys.stdin.fileno()
    except (AttributeError, OSError, ValueError):  # there is none, or it is no file
        return None


def _is_terminal(number: int | None) -> bool:
    try:
        return number is not None and os.isatty(number)
    except OSError:
        return False


def _in_foreground(terminal: int) -> bool:
    try:
        return not os.isatty(terminal) or os.tcgetpgrp(terminal) == os.getpgrp()
    except OSError:  # not the terminal that controls this process: reading it does not stop the process
        return True


# -- the socket --------------------------------------------------------------------------------


def socket_folder() -> Path:
    """Return the directory of the sockets: in $XDG_RUNTIME_DIR, or our own below the temporary one."""
    runtime = os.environ.get("XDG_RUNTIME_DIR")
    if runtime and Path(runtime).is_dir():
        return Path(runtime) / "motor-gateway"
    return Path(os.environ.get("TMPDIR", "/tmp")) / f"motor-gateway-{os.getuid()}"  # noqa: S108 -- checked to be ours


def socket_path(name: str, folder: Path | None = None) -> Path:
    """Return the socket of the robot of this name."""
    return (folder or socket_folder()) / f"{name}.sock"


def _free_path(folder: Path, name: str) -> Path:
    """Return the robot's own path; with our process id if another gateway runs a robot of this name."""
    _make_private(folder)
    path = socket_path(name, folder)
    if path.exists() and _answers(path):
        path = socket_path(f"{name}.{os.getpid()}", folder)
    if len(os.fsencode(path)) > MAX_PATH:
        raise OperatorError(f"{path} is too long for a socket: set XDG_RUNTIME_DIR to a shorter directory")
    return path


def _make_private(folder: Path) -> None:
    """Make a directory that only we can enter; raise OperatorError if others can, too."""
    try:
        folder.mkdir(mode=0o700, parents=True, exist_ok=True)
        status = folder.lstat()
    except OSError as error:
        raise OperatorError(f"the operator's socket needs {folder}: {error.strerror}") from error
    if not stat.S_ISDIR(status.st_mode) or status.st_uid != os.getuid() or status.st_mode & 0o077:
        raise OperatorError(f"{folder} must be a directory that belongs to you alone (mode 0700)")


def _answers(path: Path) -> bool:
    """True if a process listens there. A socket left over by a dead process does not answer."""
    with socket.socket(socket.AF_UNIX, socket.SOCK_STREAM) as probe:
        probe.setblocking(False)
        try:
            probe.connect(os.fspath(path))
        except BlockingIOError:
            return True
        except OSError:
            return False
    return True


def _listen(path: Path) -> socket.socket:
    path.unlink(missing_ok=True)
    listener = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM)
    try:
        listener.bind(os.fspath(path))
        path.chmod(0o600)  # until here its directory keeps others out
        listener.listen(MAX_CLIENTS)
        listener.setblocking(False)
    except OSError as error:
        listener.close()
        raise OperatorError(f"the operator's socket {path} cannot be made: {error.strerror}") from error
    return listener


def ask(path: Path, line: str, timeout: float = 10.0) -> str:
    """Send a line to a running robot, as `gateway ask` does.

    Args:
        path: its socket: `gateway.operator.socket_path(NAME)`.
        line: "goal 2 1", "stop", "status", "help" …
        timeout: how long to wait for the answer [s].

    Returns:
        str: the answer, one or more lines.

    Raises:
        OperatorError: no robot runs there, or it does not answer in time.
    """
    with socket.socket(socket.AF_UNIX, socket.SOCK_STREAM) as connection:
        # A connect with a time-out of Python's does not wait for a place in a full queue; the kernel's does.
        wait = struct.pack("@ll", int(timeout), int(timeout % 1 * 1e6))
        connection.setsockopt(socket.SOL_SOCKET, socket.SO_SNDTIMEO, wait)
        answer = bytearray()
        try:
            connection.connect(os.fspath(path))
            connection.settimeout(timeout)
            connection.sendall(line.encode() + b"\n")
            connection.shutdown(socket.SHUT_WR)
            while data := connection.recv(MAX_READ):
                answer += data
        except (TimeoutError, BlockingIOError) as error:
            raise OperatorError(f"{path}: the robot does not answer") from error
        except OSError as error:
            running = ", ".join(sorted(p.stem for p in path.parent.glob("*.sock"))) or "none"
            raise OperatorError(f"no robot runs at {path} ({error.strerror}); running: {running}") from error
    return answer.decode("utf-8", "replace").rstrip("\n")
