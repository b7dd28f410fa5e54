"""What a file, a device or a peer wrote is printed so that no terminal obeys it, and no line is forged.

Hostile recordings: tests/gateway/recording/test_hostile.py; the operator's socket: tests/gateway/operator.
"""

from __future__ import annotations

import io
import logging
import re
import socket
import subprocess
import sys
import threading
from pathlib import Path
from typing import TextIO, cast

import pytest

from gateway.cli.main import LogHandler, main
from gateway.cli.terminal.screen import ENTER, Escaping, screen
from gateway.config import load_robot
from gateway.core.message_text import escaped, message_text
from protocols import messages as msg
from tests.gateway.recording.hostile import NASTY, assert_printable

BENCH = load_robot("bench").text
IN_TOML = "".join(f"\\u{ord(c):04x}" for c in NASTY)
PLACES = ('name = "bench"', 'world = "bench"', 'kind = "can"', 'interface = "twin"', 'body = "joints"')
COMMANDS = (
    ["check", "FILE"],
    ["run", "FILE", "--fast", "--seconds", "0.02"],
    ["watch", "FILE", "--seconds", "0.02"],
    ["jog", "left", "FILE"],
    ["twin", "FILE", "--seconds", "0.02"],
    ["motor", "dump", "FILE"],
    ["replay", "FILE"],
    ["recover", "FILE"],
)


@pytest.mark.parametrize("place", [*PLACES, "[motors.left]"])
def test_no_command_prints_what_controls_a_terminal(
    place: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    text = BENCH.replace(place, re.sub(r'"\w+"|left', lambda _: f'"{IN_TOML}"', place))
    assert text != BENCH
    path = tmp_path / "x\x1b[2J.toml"
    path.write_text(text)
    for command in COMMANDS:
        main([str(path) if word == "FILE" else word for word in command])
        printed = capsys.readouterr()
        assert printed.out + printed.err
        assert_printable(printed.out + printed.err)


def test_the_answer_of_a_peer_is_escaped(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(tmp_path))
    (tmp_path / "motor-gateway").mkdir(mode=0o700)
    out = io.StringIO()
    with socket.socket(socket.AF_UNIX) as listener:
        listener.bind(str(tmp_path / "motor-gateway" / "bench.sock"))
        listener.listen()

        def answer() -> None:
            connection, _ = listener.accept()
            with connection:
                connection.recv(100)
                connection.sendall(NASTY.encode())

        peer = threading.Thread(target=answer)
        peer.start()
        monkeypatch.setattr("sys.stdout", out)
        assert main(["ask", "bench", "status"]) == 0
        peer.join()
    assert "\\x1b]0;owned" in out.getvalue()
    assert_printable(out.getvalue())


def test_a_message_of_the_log_is_one_line() -> None:
    out = io.StringIO()
    log = logging.Logger("test")
    log.addHandler(LogHandler(out))
    log.error("left: %s", "a device\nERROR: lies\x1b[2J")
    assert out.getvalue() == "left: a device\\nERROR: lies\\x1b[2J\n"


def test_a_line_of_the_log_comes_once_a_second_and_then_says_how_often_it_came() -> None:
    out = io.StringIO()
    handler = LogHandler(out)
    for t, text in ((0.0, "a"), (0.3, "a"), (0.5, "b"), (0.9, "a"), (1.1, "a"), (1.2, "a"), (9.0, "c")):
        record = logging.LogRecord("gateway", logging.WARNING, "", 0, "%s", (text,), None)
        record.created = t
        handler.emit(record)
    handler.emit(record)
    handler.settle()
    assert out.getvalue().splitlines() == [
        "a",
        "b",
        "a (2 times more)",
        "a",
        "a (1 times more)",
        "c",
        "c (1 times more)",
    ]


def test_the_newest_line_of_a_subject_is_always_written() -> None:
    """Defect: a motor that was armed twice within a second, and ready between, was ready by the log."""
    out = io.StringIO()
    handler = LogHandler(out)

    def say(t: float, text: str) -> list[str]:
        record = logging.LogRecord("gateway", logging.INFO, "", 0, "%s: %s", ("left", text), None)
        record.created = t
        handler.emit(record)
        return out.getvalue().splitlines()

    assert say(0.0, "armed") == ["left: armed"]
    assert say(0.2, "ready") == ["left: armed", "left: ready"]
    assert say(0.4, "armed") == say(0.5, "armed") == ["left: armed", "left: ready", "left: armed"]
    for number in range(200):
        said = say(0.6 + 0.001 * number, ("ready", "armed")[number % 2])
    assert len(said) <= 12, "a flood is bounded"
    assert say(3.0, "ready")[-1] == "left: ready"


def test_a_message_as_text_is_one_line() -> None:
    assert message_text(msg.Fault("left", 0, 1, "a\nb", "\x9b", "\u202e")).isprintable()
    assert escaped("Grüße: 3 N·m, 20 °C") == "Grüße: 3 N·m, 20 °C"


@pytest.mark.parametrize("closed", [">&-", "2>&-", ">&- 2>&-"])
def test_a_stream_that_was_closed_is_no_error(closed: str) -> None:
    command = f'"{sys.executable}" -m gateway check bench {closed}'
    done = subprocess.run(["/bin/sh", "-c", command], capture_output=True, text=True, check=False)
    assert (done.returncode, done.stderr) == (0, "")


def test_a_page_is_drawn_through_it() -> None:
    out = io.StringIO()
    with screen(cast("TextIO", Escaping(out))) as draw:
        draw(["a\x1bb"])
    assert out.getvalue().startswith(ENTER)
    assert "a\\x1bb" in out.getvalue()
