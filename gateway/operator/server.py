"""Where a person speaks to a running robot: a local socket, and lines on the terminal.

Rules. Nothing here waits and there is no thread: the loop polls, and whoever is slow, gone or talks nonsense
hurts nobody. The socket belongs to its owner alone (mode 0600 in a directory of mode 0700). Lines and buffers
are bounded. The end of the terminal's input is not the end of the run; `quit` is. A terminal is read only
while the program is in its foreground: reading from the background would stop the process.

The dialogue: each line is answered by one or more lines; what the robot then says of it (`tell`) follows.
A client that has said all it has to say (shut down its writing side) gets that too, and then it is closed.
"""

from __future__ import annotations

import os
import select
import socket
import stat
import sys
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from types import TracebackType

from gateway.core.robot import Robot
from gateway.errors import OperatorError
from gateway.operator.commands import Mistake, Query, help_text, parse
from gateway.operator.lines import Lines
from protocols.messages import Instruction

MOST_READ = 4096
"""Bytes taken from one client in one poll."""
MOST_UNSENT = 65536
"""Bytes that a client may leave unread before it is dropped."""
MOST_CLIENTS = 16
MOST_PATH = 107
"""Bytes of a socket's path (unix(7): sun_path)."""


@dataclass(slots=True)
class _Client:
    frame: socket.socket
    lines: Lines = field(default_factory=Lines)
    unsent: bytearray = field(default_factory=bytearray)
    ended: bool = False
    """It has said all it has to say."""


class Operator:
    """Open while the robot runs; use it as a context manager, or close it."""

    def __init__(self, robot: Robot, folder: Path | None = None, terminal: int | None = -1) -> None:
        """Open the socket. `terminal` is a file descriptor, None for none, -1 for the standard input.

        Raises OperatorError with a sentence if the socket cannot be made."""
        self._robot = robot
        self._terminal = _standard_input() if terminal == -1 else terminal
        self._typed = Lines()
        self._clients: list[_Client] = []
        self.leaving = False
        """Whether somebody has said quit."""
        self.path = _free_path(folder or socket_folder(), robot.name)
        self._listener = _listen(self.path)

    def __enter__(self) -> Operator:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def poll(self, status: Callable[[], str]) -> list[Instruction]:
        """What has been asked since the last poll, in the order of arrival by speaker. Never waits.

        `status` is called when somebody asks for it."""
        asked: list[Instruction] = []
        self._accept()
        for client in list(self._clients):
            if client.ended:
                self._send(client)
                self._drop(client)
                continue
            for line in self._read(client):
                self._handle(line, partial(_queue, client), status, asked)
            self._send(client)
        for line in self._read_terminal():
            self._handle(line, _print, status, asked)
        return asked

    def report(self, text: str) -> None:
        """Something that the robot says: to every client that is connected. (The terminal has the log.)"""
        for client in list(self._clients):
            _queue(client, text)
            self._send(client)

    def close(self) -> None:
        """Send what is left, close everything, and take the socket away."""
        for client in list(self._clients):
            self._send(client)
            self._drop(client)
        if self._listener.fileno() >= 0:
            self._listener.close()
            self.path.unlink(missing_ok=True)

    def _handle(
        self,
        line: str | Mistake,
        answer: Callable[[str], None],
        status: Callable[[], str],
        asked: list[Instruction],
    ) -> None:
        said = parse(line, self._robot) if isinstance(line, str) else line
        match said:
            case None:
                pass
            case Mistake(sentence):
                answer(sentence)
            case Query("status"):
                answer(status())
            case Query("help"):
                answer(help_text())
            case Query():  # quit
                self.leaving = True
                answer("leaving")
            case word:
                asked.append(word)
                answer(f"asked: {line}")

    # -- clients ------------------------------------------------------------------------------

    def _accept(self) -> None:
        while len(self._clients) < MOST_CLIENTS:
            try:
                frame, _ = self._listener.accept()
            except OSError:  # nobody, or somebody who has gone again
                return
            frame.setblocking(False)
            self._clients.append(_Client(frame))

    def _read(self, client: _Client) -> list[str | Mistake]:
        try:
            data = client.frame.recv(MOST_READ)
        except BlockingIOError:
            return []
        except OSError:
            self._drop(client)
            return []
        if data:
            return client.lines.feed(data)
        client.ended = True
        return client.lines.end()

    def _send(self, client: _Client) -> None:
        try:
            while client.unsent:
                del client.unsent[: client.frame.send(client.unsent)]
        except BlockingIOError:
            if len(client.unsent) > MOST_UNSENT:
                self._drop(client)
        except OSError:
            self._drop(client)

    def _drop(self, client: _Client) -> None:
        client.frame.close()
        client.unsent.clear()
        if client in self._clients:
            self._clients.remove(client)

    # -- the terminal -------------------------------------------------------------------------

    def _read_terminal(self) -> list[str | Mistake]:
        if self._terminal is None:
            return []
        try:
            if not select.select([self._terminal], [], [], 0)[0] or not _in_foreground(self._terminal):
                return []
            data = os.read(self._terminal, MOST_READ)
        except OSError:
            data = b""
        if data:
            return self._typed.feed(data)
        self._terminal = None
        return self._typed.end()


def _queue(client: _Client, text: str) -> None:
    client.unsent += text.encode() + b"\n"


def _print(text: str) -> None:
    with suppress(OSError):  # nobody reads the standard output any more
        print(text, flush=True)


def _standard_input() -> int | None:
    try:
        return sys.stdin.fileno()
    except (AttributeError, OSError, ValueError):  # there is none, or it is no file
        return None


def _in_foreground(terminal: int) -> bool:
    try:
        return not os.isatty(terminal) or os.tcgetpgrp(terminal) == os.getpgrp()
    except OSError:  # a terminal, but not the one that controls this process: reading it stops nobody
        return True


# -- the socket --------------------------------------------------------------------------------


def socket_folder() -> Path:
    """Where sockets stand: in $XDG_RUNTIME_DIR, or in a directory of ours below the temporary one."""
    runtime = os.environ.get("XDG_RUNTIME_DIR")
    if runtime and Path(runtime).is_dir():
        return Path(runtime) / "motor-gateway"
    return Path(os.environ.get("TMPDIR", "/tmp")) / f"motor-gateway-{os.getuid()}"  # noqa: S108 -- checked to be ours


def socket_path(name: str, folder: Path | None = None) -> Path:
    """The socket of the robot of this name."""
    return (folder or socket_folder()) / f"{name}.sock"


def _free_path(folder: Path, name: str) -> Path:
    """The robot's own path; if another gateway runs a robot of this name, one with our process's number."""
    _make_private(folder)
    path = socket_path(name, folder)
    if path.exists() and _answers(path):
        path = socket_path(f"{name}.{os.getpid()}", folder)
    if len(os.fsencode(path)) > MOST_PATH:
        raise OperatorError(f"{path} is too long for a socket: set XDG_RUNTIME_DIR to a shorter directory")
    return path


def _make_private(folder: Path) -> None:
    """A directory that is ours alone; raises OperatorError if somebody else has a hand in it."""
    try:
        folder.mkdir(mode=0o700, parents=True, exist_ok=True)
        status = folder.lstat()
    except OSError as error:
        raise OperatorError(f"the operator's socket needs {folder}: {error.strerror}") from error
    if not stat.S_ISDIR(status.st_mode) or status.st_uid != os.getuid() or status.st_mode & 0o077:
        raise OperatorError(f"{folder} must be a directory that belongs to you alone (mode 0700)")


def _answers(path: Path) -> bool:
    """Whether somebody listens there. A socket that a dead process has left does not answer."""
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
        listener.listen(MOST_CLIENTS)
        listener.setblocking(False)
    except OSError as error:
        listener.close()
        raise OperatorError(f"the operator's socket {path} cannot be made: {error.strerror}") from error
    return listener


def ask(path: Path, line: str, patience: float = 2.0) -> str:
    """Say a line to a running robot and return its answer. Raises OperatorError with a sentence.

    `patience` is how many seconds the robot may take."""
    with socket.socket(socket.AF_UNIX, socket.SOCK_STREAM) as frame:
        frame.settimeout(patience)
        answer = bytearray()
        try:
            frame.connect(os.fspath(path))
            frame.sendall(line.encode() + b"\n")
            frame.shutdown(socket.SHUT_WR)
            while data := frame.recv(MOST_READ):
                answer += data
        except TimeoutError as error:
            raise OperatorError(f"{path}: the robot does not answer") from error
        except OSError as error:
            running = ", ".join(sorted(p.stem for p in path.parent.glob("*.sock"))) or "none"
            raise OperatorError(f"no robot runs at {path} ({error.strerror}); running: {running}") from error
    return answer.decode("utf-8", "replace").rstrip("\n")
