"""Progress: its text, and that a replay shows it on a terminal, and changes nothing of its output."""

from __future__ import annotations

import io
import os
import pty
import subprocess
import sys
from pathlib import Path

import pytest

import gateway as gw
from gateway.cli.terminal import progress
from gateway.cli.terminal.progress import Progress, duration, simulation, text
from protocols.messages import SECOND
from tests.gateway.processes import written

TEXTS = [
    (0, 100, 0.0, "replay: 0% of 100, 0 s"),
    (25, 100, 10.0, "replay: 25% of 100, 10 s, about 30 s left"),
    (1, 3, 100.0, "replay: 33% of 3, 1 min 40 s, about 3 min 20 s left"),
    (100, 100, 59.4, "replay: 100% of 100, 59 s, about 0 s left"),
    (120, 100, 10.0, "replay: 100% of 100, 10 s, about 0 s left"),  # more than the index knows of
    (9, 1000, 20.0, "replay: 1% of 1000, 20 s"),
    (10, 1000, 200.0, "replay: 1% of 1000, 3 min 20 s, about 5 h 30 min left"),
    (12345, None, 61.0, "replay: 12345 so far, 1 min 01 s"),
    (3, 0, 1.0, "replay: 3 so far, 1 s"),
]


@pytest.mark.parametrize(("done", "total", "elapsed", "line"), TEXTS)
def test_the_text(done: float, total: float | None, elapsed: float, line: str) -> None:
    assert text("replay", done, total, elapsed) == line


@pytest.mark.parametrize(
    ("seconds", "words"),
    [(0.4, "0 s"), (59.6, "1 min 00 s"), (3599.6, "1 h 00 min"), (7322.0, "2 h 02 min")],
)
def test_a_duration(seconds: float, words: str) -> None:
    assert duration(seconds) == words


@pytest.mark.parametrize(("is_terminal", "lines"), [(True, 41), (False, 2)])
def test_how_often(is_terminal: bool, lines: int, monkeypatch: pytest.MonkeyPatch) -> None:
    """In 20 s of a stopwatch that the test turns: at once and every half second; every ten."""

    class Stream(io.StringIO):
        def isatty(self) -> bool:
            return is_terminal

    now, stream = 0, Stream()
    monkeypatch.setattr(progress, "stopwatch", lambda: now)
    shown = Progress("work", 200, stream)
    for i in range(201):
        now = i * SECOND // 10
        shown.update(i)
    shown.clear()
    assert stream.getvalue().count("work: ") == lines
    assert stream.getvalue().endswith("\r\x1b[K" if is_terminal else "left\n")


def test_virtual_time_is_added_up(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    now = 0
    monkeypatch.setattr(progress, "stopwatch", lambda: now)
    with simulation("load") as simulated:
        simulated(SECOND // 4)
        now = 12 * SECOND
        simulated(2 * SECOND)
    assert capsys.readouterr().err == "load, simulated seconds: 2.2 so far, 12 s\n"


@pytest.fixture(scope="module")
def recording(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("progress") / "bench.mcap"
    with gw.open_session("bench", simulated=True, record=path) as session:
        for _ in session.run(seconds=2):
            if session.joints["left"].mode is gw.Mode.READY:
                session.submit(gw.Velocity("left", 6.0))
    return path


def test_a_replay_shows_it_on_a_terminal_and_its_output_is_the_same(recording: Path) -> None:
    command = [sys.executable, "-m", "gateway", "replay", str(recording)]
    ours, theirs = pty.openpty()
    try:
        shown = subprocess.run(command, stdout=subprocess.PIPE, stderr=theirs, text=True, check=False)
        os.close(theirs)
        drawn = written(ours).decode()
    finally:
        os.close(ours)
    plain = subprocess.run(command, capture_output=True, text=True, check=False)
    assert shown.returncode == plain.returncode == 0
    assert "replay, ticks: " in drawn
    assert drawn.endswith("\r\x1b[K")
    assert "\n" not in drawn
    assert shown.stdout.splitlines()[:2] == plain.stdout.splitlines()[:2]  # then how long it took
    assert plain.stderr == ""
