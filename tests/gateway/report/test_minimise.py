"""`gateway minimise`: the fewest inputs that still do it, as fixture, golden and a test."""

from __future__ import annotations

import re
import subprocess
import sys
from pathlib import Path

import pytest

import gateway as gw
from gateway.cli.main import main
from gateway.core.step import Gateway
from gateway.core.tick import Inputs, Outputs
from gateway.errors import UserError
from gateway.recording import read_recording
from gateway.replay import replay_recording
from gateway.replay.input_log import InputLog, input_log
from gateway.report.condition import condition
from gateway.report.minimise import minimise
from gateway.testing import holds
from protocols.messages import SECOND


@pytest.fixture(scope="module")
def cable(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A bench whose left motor turns from 0.6 s on, and is silent from 1.2 s on."""
    path = tmp_path_factory.mktemp("minimise") / "cable.mcap"
    with gw.open_session("bench", simulated=True, record=path) as session:
        for tick in session.run(1.6):
            if tick.now > 0.6 * SECOND:
                session.submit(gw.Velocity("left", 3.0))
            if tick.now == 1.2 * SECOND:
                assert session.twins is not None
                session.twins.disconnect("left")
    return path


@pytest.fixture(scope="module")
def log(cable: Path) -> InputLog:
    return input_log(read_recording(cable))


@pytest.mark.prove
def test_what_remains_still_does_it_and_is_far_less(log: InputLog) -> None:
    silent = condition("tells silent: no feedback")
    found = minimise(log, silent, 80)
    assert found is not None
    assert silent.first(found.log) == len(found.log.ticks) - 1
    assert len(found.log.ticks) < len(log.ticks) / 2
    inputs = [one for given in found.log.ticks for one in (*given.inputs.packets, *given.inputs.instructions)]
    assert 1 <= len(inputs) <= 8
    assert found.trials <= 80


def test_a_step_that_fails_is_found_with_the_input_at_which_it_does(
    cable: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """A defect is put in: a step fails if a command comes with a frame, from 0.9 s on."""
    step = Gateway.step

    def failing(self: Gateway, now: int, inputs: Inputs) -> Outputs:
        asked = any(isinstance(one, gw.Velocity) for one in inputs.instructions)
        if asked and now > 0.9 * SECOND and any(packet.bus == "can0" for packet in inputs.packets):
            raise ZeroDivisionError("by what nobody thought of")
        return step(self, now, inputs)

    monkeypatch.setattr(Gateway, "step", failing)
    out = tmp_path / "zero.mcap"
    command = ["minimise", str(cable), "--while", "raises zerodivision", "--trials", "60"]
    assert main([*command, "-o", str(out)]) == 0
    assert f"written: {out}, test_zero.py" in capsys.readouterr().out
    ticks = list(read_recording(out).ticks)
    assert len(ticks) <= 4
    assert len(ticks[-1].inputs.instructions) == len(ticks[-1].inputs.packets) == 1
    assert holds("raises", out)
    monkeypatch.undo()
    assert not holds("raises", out)


def test_it_writes_fixture_golden_and_a_test_that_fails_until_it_is_mended(
    cable: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "Cable out.mcap"
    command = ["minimise", str(cable), "--while", "tells silent", "--trials", "40", "-o", str(out)]
    assert main([*command, "--anonymise"]) == 0
    printed = capsys.readouterr().out
    assert re.match(r"\d+ of 4\d\d ticks, 0\.\d\d s, and \d+ of \d+ inputs still do, after \d+ tria", printed)
    assert main(["judge", str(out)]) == 0
    assert replay_recording(out).ok
    assert read_recording(out).facts["made from"] == "another recording, as small as 'tells silent' allows"
    test = tmp_path / "test_cable_out.py"
    arguments = [sys.executable, "-m", "pytest", "-q", "-p", "no:cacheprovider", "--rootdir", str(tmp_path)]
    done = subprocess.run([*arguments, str(test)], capture_output=True, text=True, check=False)
    assert done.returncode == 1
    assert 'assert not holds("tells silent", RECORDING)' in done.stdout
    assert main(command) == 2
    assert "exists already; it is never overwritten" in capsys.readouterr().err


# fmt: off
CONDITIONS = [
    # text, and whether it holds of the recording; or what is told
    ("tells silent", True),
    ("tells SILENT: no feedback", True),
    ("tells bus-off", False),
    ("raises", False),
    ("ticks > 300", True),
    ("ticks<300", False),
    ("oldest feedback > 300", True),
    ("left: final position < -100", False),
    ("no such figure > 0", False),
]
NONE = ["", "tells", "silent", "ticks", "ticks = 3", "ticks > many", "> 3"]
# fmt: on


@pytest.mark.parametrize(("text", "expected"), CONDITIONS)
def test_conditions(text: str, expected: bool, log: InputLog) -> None:
    assert (condition(text).first(log) is not None) is expected


@pytest.mark.parametrize("text", NONE)
def test_what_is_no_condition_is_told_with_examples(text: str) -> None:
    with pytest.raises(UserError, match='is no condition; expected one such as "tells silent"'):
        condition(text)


def test_where_it_does_not_hold_what_does_is_told(cable: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["minimise", str(cable), "--while", "tells overheated"]) == 1
    printed = capsys.readouterr().out
    assert "cable.mcap: 'tells overheated' does not hold of it\n" in printed
    assert "  told: left: fault: silent: no feedback for more than 100 ms" in printed
    assert main(["minimise", str(cable), "--while", "clearance < 3"]) == 1
    assert re.search(r"\n  ticks: 4\d\d\n", capsys.readouterr().out)
    assert [one.name for one in cable.parent.iterdir()] == ["cable.mcap"]


@pytest.mark.parametrize(
    "name", ['a"); raise SystemExit("run") #', '"""\nraise SystemExit("run")\n"""', "a\\"]
)
def test_a_name_is_no_program(cable: Path, tmp_path: Path, name: str) -> None:
    recording = tmp_path / f"{name}.mcap"
    recording.write_bytes(cable.read_bytes())
    assert main(["minimise", str(recording), "--while", "tells silent", "--trials", "10"]) == 0
    (test,) = tmp_path.glob("test_*.py")
    scope: dict[str, object] = {"__file__": str(test), "__name__": "test"}
    exec(compile(test.read_text(), str(test), "exec"), scope)
    assert scope["RECORDING"] == tmp_path / f"{name}.minimal.mcap"
