"""A robot's run as other programs log it: replayed against its robot file, and looked at as a recording."""

from __future__ import annotations

import gzip
import re
from collections.abc import Callable, Sequence
from pathlib import Path

import can
import pytest

from gateway.cli.main import main
from gateway.config import load_robot
from gateway.recording import read_recording
from gateway.replay import Player
from gateway.runtime.log_recording import record_log
from gateway.runtime.session import open_session
from protocols.frames import CanFrame, Packet
from protocols.messages import SECOND, Mode, Velocity

BENCH = load_robot("bench")


@pytest.fixture(scope="module")
def run() -> Sequence[tuple[Packet, bool]]:
    """A second and a half of a bench: 5 rad/s of one motor. What was sent is marked."""
    found: list[tuple[Packet, bool]] = []
    with open_session(BENCH, simulated=True) as session:
        for tick in session.run(1.5):
            if tick.number % 10 == 0:
                session.submit(Velocity("left", 5.0))
            found += [(packet, False) for packet in tick.inputs.packets]
            found += [(packet, True) for packet in tick.outputs.packets]
    return sorted(found, key=lambda each: each[0].t)


def write(path: Path, packets: Sequence[tuple[Packet, bool]], *, told: bool = False) -> Path:
    """Write a log as python-can does; `told`: it says what its writer had sent."""
    plain = path.with_suffix("") if path.suffix == ".gz" else path
    with can.Logger(plain) as writer:
        for packet, sent in packets:
            frame = packet.frame
            assert isinstance(frame, CanFrame)
            writer.on_message_received(
                can.Message(
                    timestamp=1_700_000_000.0 + packet.t / SECOND,
                    arbitration_id=frame.id,
                    data=None if frame.remote else frame.data,
                    dlc=frame.requested if frame.remote else len(frame.data),
                    is_extended_id=frame.extended,
                    is_remote_frame=frame.remote,
                    channel=1 if plain.suffix == ".trc" else "can0",
                    is_rx=not (told and sent),
                )
            )
    if path != plain:
        path.write_bytes(gzip.compress(plain.read_bytes()))
    return path


@pytest.mark.parametrize("suffix", [".log", ".log.gz", ".asc", ".blf", ".trc"])
@pytest.mark.parametrize("told", [False, True])
def test_a_log_is_held_against_the_robot_file(
    run: Sequence[tuple[Packet, bool]],
    suffix: str,
    told: bool,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
) -> None:
    log = write(tmp_path / f"run{suffix}", run, told=told)
    assert main(["replay", str(log), "--robot", "bench"]) == 0
    printed = capsys.readouterr().out
    assert re.search(r"^left +odrive_can +can0 1 +", printed, re.M)
    found = re.search(
        r"^left: (\d+) messages, at most (\d+) ms apart; commands: .*Velocity (\d+)", printed, re.M
    )
    assert found is not None, printed
    assert int(found[1]) > 100
    assert int(found[2]) <= 30
    assert int(found[3]) > 100
    assert "beyond" not in printed


FINDINGS: list[tuple[str, Callable[[Packet, bool], bool], str, str]] = [
    ("velocity = 20.0", lambda packet, sent: True, "velocity = 2.0",
     r"^  \d+ commands beyond its limit of velocity \(2\.0\); the first at 0\.\d+ s: left: Velocity"),
    ("", lambda packet, sent: not 0.5 < packet.t / SECOND < 0.9, "",
     r"^  silent for 4\d\d ms until 0\.9\d\d s; its timeout is 100 ms$"),
    ("", lambda packet, sent: packet.frame.id >> 5 != 2 if isinstance(packet.frame, CanFrame) else True, "",
     r"^right: 0 messages, .*\n  nothing was heard of it$"),
]  # fmt: skip


@pytest.mark.parametrize(("old", "kept", "new", "line"), FINDINGS, ids=["beyond", "silent", "absent"])
def test_what_is_wrong_is_told_with_its_time(
    run: Sequence[tuple[Packet, bool]],
    old: str,
    kept: Callable[[Packet, bool], bool],
    new: str,
    line: str,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
) -> None:
    robot = tmp_path / "bench.toml"
    robot.write_text(BENCH.text.replace(old, new) if old else BENCH.text)
    log = write(tmp_path / "run.log", [each for each in run if kept(*each)])
    assert main(["replay", str(log), "--robot", str(robot)]) == 1
    printed = capsys.readouterr().out
    assert re.search(line, printed, re.M), printed


def test_a_bus_of_a_log_that_the_robot_has_not_is_told(
    run: Sequence[tuple[Packet, bool]], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    log = write(tmp_path / "run.log", run)
    lines = log.read_text().splitlines(keepends=True)
    name = lines[0].split()[1]
    own = next(bus for bus, each in BENCH.buses.items() if not each.carries_bytes)
    two = [line.replace(f" {name} ", f" {each} ") for line in lines for each in (own, "other7")]
    log.write_text("".join(two))
    main(["replay", str(log), "--robot", "bench"])
    assert "left out: other7, since bench has no such bus" in capsys.readouterr().out


def test_a_log_that_is_cut_or_none_or_without_a_robot_is_told_in_words(
    run: Sequence[tuple[Packet, bool]], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    log = write(tmp_path / "run.blf", run)
    log.write_bytes(log.read_bytes()[:-40])
    main(["replay", str(log), "--robot", "bench"])
    assert "run.blf" in capsys.readouterr().out
    text = write(tmp_path / "run.log", run)
    text.write_text(text.read_text() + "(12.5) can7\n")
    assert main(["replay", str(text), "--robot", "bench"]) == 1
    assert re.search(r"cut short: .*run\.log: after \d+ frames it cannot be read", capsys.readouterr().out)
    for name, content, status, words in (
        ("empty.log", "", 2, "it holds no frame"),
        ("other.asc", "nothing of a log\n", 2, "it holds no frame"),
    ):
        (tmp_path / name).write_text(content)
        assert main(["replay", str(tmp_path / name), "--robot", "bench"]) == status
        assert words in capsys.readouterr().err
    assert main(["replay", str(tmp_path / "nix.log"), "--robot", "bench"]) == 2
    assert "nix.log: No such file or directory: expected a log of CAN" in capsys.readouterr().err
    for command in ("replay", "view"):
        assert main([command, str(text)]) == 2
        assert "--robot ROBOT says whose devices were on its buses" in capsys.readouterr().err
    assert main(["replay", str(text), "--robot", "diffbot_hoverboard"]) == 2
    assert "diffbot_hoverboard has none: none has the same name" in capsys.readouterr().err


def test_as_a_recording_it_shows_what_its_devices_reported(
    run: Sequence[tuple[Packet, bool]], tmp_path: Path
) -> None:
    log, made = write(tmp_path / "run.log", run), tmp_path / "run.mcap"
    record_log(log, BENCH, made)
    with Player(read_recording(made), cache=tmp_path / "cache") as player:
        player.seek(player.start + SECOND)
        while not player.advance(1000):
            pass
        left = player.gateway.joints["left"]
        assert left.feedback.velocity == pytest.approx(5.0, abs=0.3)
        assert left.mode is Mode.ARMED
