"""The command line as a person meets it: what it says, what it exits with, and never a traceback."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

from gateway.cli.main import main
from gateway.recording import read
from protocols.messages import Velocity
from tests.gateway.rig import BENCH, Rig, said

HEAVY = {"numpy", "can", "serial", "mcap", "rosbags", "filterpy", "mujoco", "matplotlib"}


@pytest.fixture(autouse=True)
def own_sockets(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    folder = tmp_path / "run"
    folder.mkdir(mode=0o700)
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(folder))


def wrong(capsys: pytest.CaptureFixture[str], *arguments: str) -> str:
    """What is said to a command that cannot begin."""
    status: object
    try:
        status = main(list(arguments))
    except SystemExit as stopped:  # argparse's own way
        status = stopped.code
    said = capsys.readouterr()
    assert status == 2, said
    assert "Traceback" not in said.err
    return said.err


@pytest.mark.parametrize(
    ("arguments", "expected"),
    [
        ([], "COMMAND"),
        (["fly"], "invalid choice"),
        (["run"], "ROBOT"),
        (["run", "difbot"], "did you mean 'diffbot'?"),
        (["run", "no/such.toml"], "there is no file no/such.toml"),
        (["check", "README"], "neither a .toml file nor one of the shipped robots"),
        (["run", "bench", "--goal", "1"], "'1' is not X,Y or X,Y,YAW"),
        (["run", "bench", "--goal", "1,nan"], "is not X,Y or X,Y,YAW"),
        (["run", "bench", "--goal", "a,b"], "is not X,Y or X,Y,YAW"),
        (["run", "bench", "--seconds", "0"], "is not a positive number of seconds"),
        (["run", "bench", "--seconds", "inf"], "is not a positive number of seconds"),
        (["run", "bench", "--bus", "can0"], "is not NAME=INTERFACE:CHANNEL"),
        (["run", "bench", "--bus", "can7=twin"], "no bus 'can7'"),
        (["run", "bench", "--bus", "can0=socketcan"], "INTERFACE:CHANNEL"),
        (["run", "bench", "--bus", "can0=sockettcan:can0"], "sockettcan"),
        (
            ["run", "bench", "--bus", "can0=virtual:x", "--fast"],
            "simulated time needs a simulated world: can0 is on a real interface",
        ),
        (["replay", "no.mcap"], "no.mcap"),
        (["replay", "pyproject.toml"], "not a recording of this gateway"),
        (["demo", "--robot", "bench", "--out", "{tmp}"], "has no tour"),
        (["demo", "--out", "/proc/no"], "--out /proc/no"),
        (["protocols", "chek", "plain"], "invalid choice: 'chek'"),
        (["protocols", "check", "plane"], "did you mean 'plain'?"),
        (["ask", "nobody", "status"], "no robot runs"),
    ],
    ids=lambda value: " ".join(value) if isinstance(value, list) else None,
)
def test_what_cannot_begin_gets_a_sentence_and_exit_status_2(
    capsys: pytest.CaptureFixture[str], tmp_path: Path, arguments: list[str], expected: str
) -> None:
    assert expected in wrong(capsys, *(a.replace("{tmp}", str(tmp_path)) for a in arguments))


def test_a_can_bus_that_is_not_there_is_named_with_what_there_is_and_how_to_get_it(
    capsys: pytest.CaptureFixture[str],
) -> None:
    said = wrong(capsys, "run", "bench", "--bus", "can0=socketcan:vcan7", "--seconds", "1")
    assert "bus 'can0' cannot be opened as 'socketcan:vcan7'" in said
    assert "sudo ip link add dev vcan7 type vcan" in said
    assert "sudo ip link set vcan7 " in said


def test_every_mistake_of_a_robot_file_is_told_at_once(
    capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    file = tmp_path / "wrong.toml"
    text = BENCH.replace("gear = 8.0", "geer = 8.0").replace("address = 2", 'address = "2"')
    file.write_text(text.replace('bus = "can0"', 'bus = "can1"'))
    said = wrong(capsys, "run", str(file))
    for part in ("geer", "gear", "motors.right.address", "can1"):
        assert part in said, said
    assert said.count(str(file)) >= 3


def test_a_recording_is_not_overwritten(capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    file = tmp_path / "old.mcap"
    file.write_bytes(b"precious")
    assert "never overwritten" in wrong(capsys, "run", "bench", "--record", str(file))
    assert file.read_bytes() == b"precious"


def test_check_says_what_was_understood(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["check", "diffbot"]) == 0
    said = capsys.readouterr().out
    for part in ("odrive_can", "wheel_separation", "3000000 bit/s", "20 rad/s"):
        assert part in said


def test_what_the_watchdog_does_not_cover_is_told_at_every_start_until_it_is_acknowledged(
    capsys: pytest.CaptureFixture[str], tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    file = tmp_path / "rig.toml"
    file.write_text(BENCH)
    assert main(["run", str(file), "--fast", "--seconds", "0.1"]) == 0
    assert "watchdog" not in caplog.text
    file.write_text(BENCH.replace('options = { watchdog = "acknowledged" }\n', ""))
    assert main(["run", str(file), "--fast", "--seconds", "0.1"]) == 0
    assert "left" in caplog.text
    assert "watchdog" in caplog.text
    assert main(["check", str(file)]) == 0
    assert "watchdog" in capsys.readouterr().out


def test_a_run_is_recorded_and_replayed(capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    robot, recording = tmp_path / "rig.toml", tmp_path / "run.mcap"
    robot.write_text(BENCH)
    assert main(["run", str(robot), "--fast", "--seconds", "1", "--record", str(recording)]) == 0
    assert main(["replay", str(recording)]) == 0
    assert "the same, byte for byte" in capsys.readouterr().out


def test_a_dry_run_moves_nothing(tmp_path: Path) -> None:
    robot, recording = tmp_path / "rig.toml", tmp_path / "run.mcap"
    robot.write_text(BENCH)
    assert main(["run", str(robot), "--fast", "--dry-run", "--seconds", "1", "--record", str(recording)]) == 0
    received = [event for tick in read(recording).ticks for event in tick.outputs.events]
    assert received  # the twins report by themselves
    assert all(getattr(event, "velocity", None) in (None, 0.0) for event in received)


def test_lines_on_the_terminal_and_by_ask_drive_the_bench(tmp_path: Path) -> None:
    """On the wall clock, in processes of their own: a terminal and a socket are theirs."""
    recording = tmp_path / "run.mcap"
    command = [sys.executable, "-m", "gateway"]
    with subprocess.Popen(
        [*command, "run", "bench", "--record", str(recording), "-v"],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
    ) as process:
        assert process.stdin is not None
        assert process.stdout is not None
        output = []
        for line in process.stdout:
            output.append(line)
            if "brain: ready" in line:
                process.stdin.write("velocity left 4\nvelosity right 4\n")
                process.stdin.flush()
            if "left: armed" in line:
                answer = subprocess.run(
                    [*command, "ask", "bench", "velocity", "right", "3"],
                    capture_output=True,
                    text=True,
                    env=os.environ,
                    check=True,
                )
                assert "accepted: velocity right 3" in answer.stdout
            if "right: armed" in line:
                process.stdin.write("quit\n")
                process.stdin.flush()
        status = process.wait()
    text = "".join(output)
    assert status == 0, text
    assert "did you mean 'velocity'?" in text
    words = [word for _, word in said(Rig(), list(read(recording).ticks))]
    assert {word.motor for word in words if isinstance(word, Velocity)} == {"left", "right"}


def test_help_is_quick_because_nothing_heavy_is_imported() -> None:
    code = (
        "import sys\nfrom gateway.cli.main import main\n"
        "try:\n    main(['--help'])\nexcept SystemExit:\n    pass\n"
        f"sys.exit(', '.join(sorted({HEAVY} & set(sys.modules))) or None)"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
