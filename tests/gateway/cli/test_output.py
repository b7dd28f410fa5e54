"""Output whose reader does not read: it delays neither the loop, nor the way out, nor the end."""

from __future__ import annotations

import io
import os
import signal
import subprocess
import sys
import termios
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

import pytest

from gateway.cli.terminal.output import Unblocked, unblocked
from gateway.errors import OperatorError
from gateway.operator import ask, socket_path
from gateway.recording import Recorder
from tests.gateway.bag_helpers import ROBOT
from tests.gateway.processes import PATIENCE, TerminalProcess, eventually

RUN = ("run", "bench")


@pytest.fixture
def pipe() -> Iterator[tuple[int, int]]:
    ends = os.pipe()
    yield ends
    for end in ends:
        with suppress(OSError):
            os.close(end)


def fill(end: int) -> int:
    """Write to a pipe until it is full; return how many bytes that were."""
    os.set_blocking(end, False)
    written = 0
    with suppress(BlockingIOError):
        while True:
            written += os.write(end, b"-")
    os.set_blocking(end, True)
    return written


def test_what_nobody_reads_is_queued_up_to_a_bound_and_then_left_out(pipe: tuple[int, int]) -> None:
    read, write = pipe
    filled = fill(write)
    with os.fdopen(os.dup(write), "w") as stream:
        output = Unblocked(stream, room=1000)
        assert [output.write(f"{number:09}\n") for number in range(200)] == [10] * 200
        assert (output.left_out, output.idle) == (1000, False)
        assert os.read(read, filled) == b"-" * filled
        assert eventually(lambda: output.idle)
        output.write("the last\n")
        output.close(PATIENCE)
    text = os.read(read, 1 << 16).decode()
    assert text == "".join(f"{number:09}\n" for number in range(100)) + "the last\n"
    assert output.left_out == 1000


def test_the_end_waits_for_a_bounded_time_and_tells_what_was_left_out(
    pipe: tuple[int, int], monkeypatch: pytest.MonkeyPatch
) -> None:
    fill(pipe[1])
    monkeypatch.setattr("gateway.cli.terminal.output.PATIENCE", 0.0)
    monkeypatch.setattr("gateway.cli.terminal.output.TOLD", PATIENCE)  # its thread waits for its turn
    errors = io.StringIO()
    with os.fdopen(os.dup(pipe[1]), "w") as stream:
        with unblocked(stream, errors) as (out, _):
            out.write("abc")
        assert eventually(lambda: errors.getvalue() != "")
        os.read(pipe[0], 1 << 16)  # the thread goes on with it, and ends
        assert eventually(lambda: not out._thread.is_alive())
    assert errors.getvalue() == "3 characters of the output were left out: nobody read them\n"


def test_a_reader_that_has_gone_is_an_error_of_the_next_write(pipe: tuple[int, int]) -> None:
    read, write = pipe
    os.close(read)
    with os.fdopen(os.dup(write), "w") as stream:
        output = Unblocked(stream)
        output.write("abc")
        assert eventually(lambda: output._error is not None)
        with pytest.raises(BrokenPipeError):
            output.write("def")
        with pytest.raises(BrokenPipeError):
            output.flush()
        output.close(PATIENCE)


@contextmanager
def unread(folder: Path, *arguments: str) -> Iterator[subprocess.Popen[bytes]]:
    """Start a command whose output goes into a pipe that is full."""
    read, write = os.pipe()
    fill(write)
    process = subprocess.Popen(
        [sys.executable, "-m", "gateway", *arguments],
        stdin=subprocess.DEVNULL,
        stdout=write,
        stderr=write,
        env={**os.environ, "XDG_RUNTIME_DIR": str(folder)},
    )
    try:
        yield process
    finally:
        process.kill()
        process.wait()
        os.close(read)
        os.close(write)


def answer(folder: Path, line: str) -> str:
    """Return the answer of the robot; "" if it does not."""
    try:
        return ask(socket_path("bench", folder / "motor-gateway"), line, PATIENCE)
    except OperatorError:
        return ""


@pytest.mark.timeout(240)
def test_a_robot_runs_and_ends_although_nobody_reads_its_output(tmp_path: Path) -> None:
    with unread(tmp_path, *RUN, "-vv") as process:
        assert eventually(lambda: "left: ready" in answer(tmp_path, "status"))
        assert "accepted" in answer(tmp_path, "velocity left 3")
        assert eventually(lambda: "left: armed" in answer(tmp_path, "status"))
        process.send_signal(signal.SIGTERM)
        assert process.wait(PATIENCE) == 0


@pytest.mark.timeout(240)
def test_a_robot_ends_although_its_terminal_is_stopped(tmp_path: Path) -> None:
    with TerminalProcess(tmp_path, *RUN, "-v") as process:
        process.until("left: ready")
        termios.tcflow(process.terminal, termios.TCOOFF)
        assert "accepted" in answer(tmp_path, "velocity left 3")
        assert eventually(lambda: "left: armed" in answer(tmp_path, "status"))
        process.send(signal.SIGTERM)
        assert process._process.wait(PATIENCE) == 0


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="there is no device that is always full")
@pytest.mark.parametrize("command", ["schema world", "inspect a.mcap"], ids=["much", "buffered"])
def test_a_full_disk_under_the_output_is_told_in_a_sentence(command: str, tmp_path: Path) -> None:
    """`gateway schema world > FILE`, as a person or a service redirects it."""
    Recorder(tmp_path / "a.mcap", ROBOT, {}).close()
    with Path("/dev/full").open("w") as full:
        done = subprocess.run(
            [sys.executable, "-m", "gateway", *command.split()],
            cwd=tmp_path,
            stdout=full,
            stderr=subprocess.PIPE,
            text=True,
            check=False,
        )
    sentence = f"gateway {command.split()[0]}: No space left on device\n"
    assert (done.returncode, done.stderr) == (1, sentence)
