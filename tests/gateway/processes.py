"""A command of the gateway as a process of its own, and what it says, for tests on the wall clock."""

from __future__ import annotations

import os
import select
import signal
import subprocess
import sys
import time
from pathlib import Path
from types import TracebackType

PATIENCE = 60.0
"""s; the machine may have other things to do"""


class Process:
    """`gateway WORDS…`, with what it has said so far in `text`."""

    def __init__(self, folder: Path, *words: str) -> None:
        environment = {**os.environ, "XDG_RUNTIME_DIR": str(folder), "PYTHONUNBUFFERED": "1"}
        self._process = subprocess.Popen(
            [sys.executable, "-m", "gateway", *words],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            env=environment,
        )
        self.text = ""

    def __enter__(self) -> Process:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if self._process.poll() is None:
            self._process.kill()
        self._process.communicate()

    def until(self, *texts: str, seconds: float = PATIENCE) -> str:
        """Wait until it has said all of these, in any order; what it has said."""
        end = time.monotonic() + seconds
        while not all(text in self.text for text in texts):
            left = end - time.monotonic()
            if left <= 0.0 or not self._more(left):
                missing = [text for text in texts if text not in self.text]
                raise AssertionError(f"not said: {missing}; said:\n{self.text}")
        return self.text

    def processor_time(self) -> float:
        """s that it has used of the processor so far."""
        fields = Path(f"/proc/{self._process.pid}/stat").read_text().rpartition(")")[2].split()
        return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")  # utime, stime: proc(5)

    def say(self, line: str) -> None:
        """Type a line on its terminal."""
        assert self._process.stdin is not None
        self._process.stdin.write(f"{line}\n".encode())
        self._process.stdin.flush()

    def send(self, number: signal.Signals) -> None:
        self._process.send_signal(number)

    def end(self, number: signal.Signals | None = None) -> tuple[int, str]:
        """Its exit status once it has ended (after a signal, if one is given), and all that it has said."""
        if number is not None:
            self.send(number)
        end = time.monotonic() + PATIENCE
        while time.monotonic() < end and self._more(0.5):
            pass
        return self._process.wait(PATIENCE), self.text

    def _more(self, seconds: float) -> bool:
        """Read what there is, waiting at most so long; False at the end of its output."""
        assert self._process.stdout is not None
        output = self._process.stdout.fileno()
        if not select.select([output], [], [], seconds)[0]:
            return True
        data = os.read(output, 65536)
        self.text += data.decode()
        return bool(data)
