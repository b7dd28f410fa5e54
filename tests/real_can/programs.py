"""Commands of the gateway as processes of their own, started quickly where importing is slow.

Rules. Each is a process with its own memory, signals and output; it is forked from a server that has the
slow modules loaded (`multiprocessing`'s forkserver), and then does what `gateway WORDS…` does, or springs.py.
"""

from __future__ import annotations

import os
import re
import signal
import sys
import time
from collections.abc import Callable
from multiprocessing import get_context
from pathlib import Path
from types import TracebackType
from typing import TypeVar

from gateway.errors import OperatorError
from gateway.operator import ask

T = TypeVar("T")
PATIENCE = 60.0
"""s of the clock that the processes run on, against hanging."""
_CONTEXT = get_context("forkserver")
_CONTEXT.set_forkserver_preload(["tests.real_can.loaded", "tests.real_can.programs"])


def _become(arguments: tuple[str, ...], folder: Path, output: Path) -> None:
    """Run the command in this process, with its output in a file."""
    from gateway.cli.main import main
    from tests.gateway.patient import be_patient
    from tests.real_can import springs

    be_patient()

    log = os.open(output, os.O_WRONLY | os.O_CREAT | os.O_APPEND)
    for stream in (sys.stdout, sys.stderr):
        os.dup2(log, stream.fileno())
    sys.stdout.reconfigure(line_buffering=True)  # type: ignore[union-attr]  # a TextIOWrapper in a new process
    os.environ["XDG_RUNTIME_DIR"] = str(folder)
    sys.exit(springs.main(arguments[1:]) if arguments[0] == "springs" else main(list(arguments)))


class Program:
    """`gateway ARGUMENTS…`, running; ended with the block at the latest."""

    def __init__(self, folder: Path, *arguments: str) -> None:
        self.arguments = arguments
        self._folder = folder
        self._output = folder / f"{'-'.join(arguments[:2]).replace('/', '-')}-{time.monotonic_ns()}.txt"
        self._process = _CONTEXT.Process(target=_become, args=(arguments, folder, self._output))

    def __enter__(self) -> Program:
        self._process.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._process.kill()
        self._process.join()

    @property
    def text(self) -> str:
        """Its output so far."""
        return self._output.read_text() if self._output.exists() else ""

    @property
    def pid(self) -> int | None:
        """Its process id; None before it is started."""
        return self._process.pid

    @property
    def alive(self) -> bool:
        """Whether it has not ended."""
        return self._process.is_alive()

    def until(self, *texts: str, after: int = 0) -> int:
        """Wait until its output beyond `after` characters has all of these; return its length."""
        self._wait(lambda: all(text in self.text[after:] for text in texts), ", ".join(texts))
        return len(self.text)

    def find(self, pattern: str) -> str:
        """Wait until its output has a line with this, to its end; return the first group."""
        return self._wait(lambda: re.search(f"{pattern}.*\n", self.text), pattern)[1]

    def _wait(self, seen: Callable[[], T | None], what: str) -> T:
        end = time.monotonic() + PATIENCE
        while True:
            over = time.monotonic() > end or not self.alive  # before it is looked at what it has printed
            if found := seen():
                return found
            command = " ".join(self.arguments)
            assert not over, f"gateway {command}: not in its output: {what}; output:\n{self.text}"
            time.sleep(0.02)

    def ask(self, robot: str, line: str) -> str:
        """Return its reply to a line, as `gateway ask` would print it."""
        path = self._folder / "motor-gateway" / f"{robot}.sock"
        try:
            return ask(path, line, timeout=PATIENCE)
        except OperatorError as error:
            raise AssertionError(f"{error}; output:\n{self.text}") from error

    def end(self, number: signal.Signals | None = signal.SIGINT) -> int:
        """Return its exit status, after a signal unless it ends by itself."""
        if number is not None and self._process.pid is not None:
            os.kill(self._process.pid, number)
        self._process.join(PATIENCE)
        assert self._process.exitcode is not None, f"it does not end; output:\n{self.text}"
        return self._process.exitcode
