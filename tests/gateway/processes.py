"""A command of the gateway as a process of its own, for tests on the wall clock."""

from __future__ import annotations

import codecs
import fcntl
import os
import pty
import re
import select
import signal
import subprocess
import sys
import termios
import time
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import Self

PATIENCE = 600.0
"""s that a test waits for anything: against hanging only, the machine may have other things to do."""


def eventually(condition: Callable[[], bool], seconds: float = PATIENCE) -> bool:
    """True as soon as a condition holds, False if it does not within this time."""
    end = time.monotonic() + seconds
    while time.monotonic() < end:
        if condition():
            return True
        time.sleep(0.005)  # the processor is for what is waited for
    return False


def written(terminal: int) -> bytes:
    """Return all that was written to the other end of a pty, now that it is closed: a kernel hands it over in
    any pieces."""
    data = b""
    with suppress(OSError):  # EIO: nothing is left
        while piece := os.read(terminal, 65536):
            data += piece
    return data


def patient(text: str) -> str:
    """Return a robot file with long timeouts, since this machine may do other things for a while."""
    text = re.sub(r"(feedback|command)_timeout_ms = \d+", r"\1_timeout_ms = 2000", text)
    text = re.sub(r"(?m)^timeout_ms = \d+", "timeout_ms = 3000", text)
    text = text.replace('mode = "vel"', 'mode = "vel"\ntimeout_ms = 3000\noffline_ms = 5000')
    return text.replace('watchdog = "acknowledged"', 'watchdog = "acknowledged"\noffline_ms = 5000')


class Process:
    """`gateway ARGUMENTS…` (patient.py), with its output so far in `text`."""

    def __init__(self, folder: Path, *arguments: str, terminal: int | None = None) -> None:
        """`folder` is for its socket; `terminal` is for its input and output, instead of pipes."""
        stream = subprocess.PIPE if terminal is None else terminal
        self._process = subprocess.Popen(
            [sys.executable, "-m", "tests.gateway.patient", *arguments],
            stdin=stream,
            stdout=stream,
            stderr=subprocess.STDOUT,
            env={**os.environ, "XDG_RUNTIME_DIR": str(folder), "PYTHONUNBUFFERED": "1"},
            start_new_session=terminal is not None,
            # So that Ctrl-C and hanging up reach it.
            preexec_fn=None if terminal is None else lambda: fcntl.ioctl(terminal, termios.TIOCSCTTY, 0),
        )
        self.text = ""
        self._decode = codecs.getincrementaldecoder("utf-8")("replace").decode
        self._ended = False

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        if self._process.poll() is None:
            self._process.kill()
        self._process.communicate()

    def _output(self) -> int:
        assert self._process.stdout is not None
        return self._process.stdout.fileno()

    def until(self, *texts: str, keys: bytes = b"", seconds: float = PATIENCE) -> str:
        """Wait until it has printed all of these, in any order, sending keys meanwhile; return its output."""
        end = time.monotonic() + seconds
        while missing := [text for text in texts if text not in self.text]:
            if self._ended or time.monotonic() > end:
                raise AssertionError(f"not printed: {missing}; printed:\n{self.text}")
            if keys:
                self.send_keys(keys)
            self.look()
        return self.text

    def find(self, pattern: str) -> str:
        """Wait until it has printed a line with this, to its end; return the first group."""
        end = time.monotonic() + PATIENCE
        while (found := re.search(f"{pattern}.*\n", self.text)) is None:
            if self._ended or time.monotonic() > end:
                raise AssertionError(f"not printed: {pattern}; printed:\n{self.text}")
            self.look()
        return found[1]

    def look(self) -> None:
        """Read what it prints within a moment."""
        self._read(0.04)

    def processor_time(self) -> float:
        """Return the seconds of processor time that it has used."""
        fields = Path(f"/proc/{self._process.pid}/stat").read_text().rpartition(")")[2].split()
        return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")  # utime, stime: proc(5)

    def send_line(self, line: str) -> None:
        """Type a line on its standard input."""
        self.send_keys(f"{line}\n".encode())

    def send_keys(self, keys: bytes) -> None:
        assert self._process.stdin is not None
        self._process.stdin.write(keys)
        self._process.stdin.flush()

    def send(self, number: signal.Signals) -> None:
        self._process.send_signal(number)

    def end(self, number: signal.Signals | None = None) -> tuple[int, str]:
        """Return its exit status once it has ended (after a signal, if one is given), and all its output."""
        if number is not None:
            self.send(number)
        end = time.monotonic() + PATIENCE
        while not self._ended and self._process.poll() is None and time.monotonic() < end:
            self._read(0.1)
        status = self._process.wait(PATIENCE)
        while self._read(0.0):
            pass
        return status, self.text

    def _read(self, seconds: float) -> bool:
        """Read what there is, waiting at most this time; False if there is nothing."""
        if self._ended or not select.select([self._output()], [], [], seconds)[0]:
            return False
        try:
            data = os.read(self._output(), 65536)
        except OSError:  # the terminal is closed
            data = b""
        self.text += self._decode(data)
        self._ended = not data
        self._got(data)
        return not self._ended

    def _got(self, data: bytes) -> None:
        """See what it has printed."""


class TerminalProcess(Process):
    """The same on a terminal of its own, which answers when it is asked for its state (DSR of ECMA-48)."""

    def __init__(self, folder: Path, *arguments: str) -> None:
        self._master, self.terminal = pty.openpty()
        self.before = termios.tcgetattr(self.terminal)
        super().__init__(folder, *arguments, terminal=self.terminal)

    def __exit__(self, *_: object) -> None:
        super().__exit__()
        self.hang_up()

    def _output(self) -> int:
        return self._master

    def send_keys(self, keys: bytes) -> None:
        os.write(self._master, keys)

    def _got(self, data: bytes) -> None:
        with suppress(OSError):  # it is closed
            os.write(self._master, b"\x1b[0n" * data.count(b"\x1b[5n"))

    def hang_up(self) -> None:
        """Close the terminal."""
        self._ended = True
        for end in (self.terminal, self._master):
            with suppress(OSError):
                os.close(end)
