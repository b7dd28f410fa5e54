"""A real `gateway run`, many times over, each with a witness of what it handed to its recorder.

Run as a program: it imports everything once, and then, for each line on its input, forks a process that
becomes `gateway run ROBOT --record FILE` with a line typed on its terminal. The times of the first and the
last tick that were handed over are on a board: a file mapped into memory, written before the hand-over, so
that no more ticks can have been handed over than it shows. The board is all that differs from the command.

Run from the tests: `Runs` starts that program and controls it.
"""

from __future__ import annotations

import mmap
import os
import signal
import struct
import subprocess
import sys
import time
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Self

from protocols.messages import SECOND, Nanos
from tests.gateway.processes import PATIENCE

NOTHING = -1
"""On the board before the first tick."""


def board(path: Path) -> memoryview:
    """Return the times of the first and the newest tick handed over, seen by both processes."""
    with path.open("r+b") as file:
        return memoryview(mmap.mmap(file.fileno(), 16)).cast("q")


# -- the program -------------------------------------------------------------------------------


def _serve() -> None:
    """One process at a time, for each line `ROBOT FILE BOARD TYPED` (separated by tabs)."""
    from gateway import config  # all that a run imports, once
    from gateway.recording import environment
    from gateway.recording.ros_views import Views

    config.load_robot("bench")
    Views().prepare()
    environment.facts()
    print("ready", flush=True)
    for line in sys.stdin:
        robot, file, at, typed = line.rstrip("\n").split("\t")
        read_end, write_end = os.pipe()
        pid = os.fork()
        if pid == 0:
            os.dup2(read_end, 0)
            _become_run(robot, file, at, write_end, typed)
        os.close(read_end)
        print(pid, flush=True)
        _, status = os.waitpid(pid, 0)
        os.close(write_end)
        print(os.waitstatus_to_exitcode(status), flush=True)


def _become_run(robot: str, file: str, at: str, terminal: int, typed: str) -> None:
    """Become `gateway run`, never to return; at tick 20 a line is typed on its terminal."""
    from gateway.cli.main import main
    from gateway.recording import Recorder

    os.dup2(os.open(os.devnull, os.O_WRONLY), 1)
    cells = board(Path(at))
    record = Recorder.record

    def witnessed(self: Recorder, tick: Any, belief: Any, *, patient: bool = False) -> None:
        if tick.number == 0:
            cells[0] = tick.now
        cells[1] = tick.now
        if tick.number == 20:
            os.write(terminal, f"{typed}\n".encode())
        record(self, tick, belief, patient=patient)

    Recorder.record = witnessed  # type: ignore[method-assign]  # the witness
    os._exit(main(["run", robot, "--record", file]))


# -- from the tests ----------------------------------------------------------------------------


@dataclass(frozen=True, slots=True)
class Killed:
    """A process that was killed."""

    first: Nanos
    """When it handed over its first tick,"""
    last: Nanos
    """and its last."""
    queued: Nanos
    """How long, in its last 150 ms, its threads were ready to run and the machine did not let them, one of
    which may have had what others waited for, or the machine itself did not run: a busy machine's doing, and
    its host's, as the kernel accounts them."""


def _watch(pid: int, span: float) -> Nanos:
    """Let a process run for `span` s; return how long its threads queued in the last 150 ms."""
    end = time.monotonic() + span
    samples: list[tuple[float, int]] = []
    while True:
        now = time.monotonic()
        samples.append((now, _queued(pid) + _stolen()))
        if now >= end:
            break
        time.sleep(min(0.01, end - now))
    before = [queued for t, queued in samples if t <= now - 0.15]
    return samples[-1][1] - (before[-1] if before else 0)


def _stolen() -> Nanos:
    """Return how long the processors of a virtual machine were ready to run and did not (proc_stat(5))."""
    fields = Path("/proc/stat").read_text().split("\n", 1)[0].split()
    return int(fields[8]) * SECOND // os.sysconf("SC_CLK_TCK") if len(fields) > 8 else 0


def _queued(pid: int) -> Nanos:
    """Return how long a process's threads were ready to run and did not (sched-stats.rst)."""
    total = 0
    for task in Path(f"/proc/{pid}/task").iterdir():
        with suppress(OSError):  # it has just ended
            total += int((task / "schedstat").read_text().split()[1])
    return total


class Runs:
    """The program, as the tests control it."""

    def __init__(self) -> None:
        self._server = subprocess.Popen(
            [sys.executable, "-m", "tests.gateway.witness"],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            text=True,
            env={**os.environ, "OPENBLAS_NUM_THREADS": "1"},
        )
        assert self._received() == "ready"

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self._server.kill()
        self._server.communicate()

    def kill(self, robot: str, file: Path, after: float, typed: str) -> Killed:
        """Run a robot, and kill it `after` s after its first tick.

        In wall time, because a kill in simulated time proves nothing."""
        path = file.with_suffix(".board")
        path.write_bytes(struct.pack("qq", NOTHING, NOTHING))
        with board(path) as cells:
            assert self._server.stdin
            self._server.stdin.write(f"{robot}\t{file}\t{path}\t{typed}\n")
            self._server.stdin.flush()
            pid = int(self._received())
            for _ in range(round(PATIENCE / 0.001)):
                if cells[1] != NOTHING:
                    break
                time.sleep(0.001)
            queued = _watch(pid, after)
            os.kill(pid, signal.SIGKILL)
            assert self._received() == str(-signal.SIGKILL), "it did not live until it was killed"
            first, last = cells
        path.unlink()
        assert last != NOTHING
        return Killed(first, last, queued)

    def _received(self) -> str:
        assert self._server.stdout
        return self._server.stdout.readline().rstrip("\n")


if __name__ == "__main__":
    _serve()
