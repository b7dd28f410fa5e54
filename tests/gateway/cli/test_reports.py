"""`--report` of run, demo and replay: written at the end, or refused at the beginning."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

import gateway as gw
from gateway.cli.main import main


@pytest.fixture(scope="module")
def recording(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("reports") / "bench.mcap"
    with gw.open_session("bench", simulated=True, record=path) as session:
        for _ in session.run(seconds=2):
            if session.joints["left"].mode is gw.Mode.READY:
                session.submit(gw.Velocity("left", 6.0))
    return path


def result(file: Path) -> tuple[str, str]:
    """Whether the page says that it ended well, and its sentence."""
    found = re.search(r'<p class="result (\w+)">([^<]*)</p>', file.read_text())
    assert found
    return found[1], found[2]


def test_of_a_run(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    file = tmp_path / "run.html"
    assert main(["run", "bench", "--fast", "--seconds", "1", "--report", str(file)]) == 0
    assert f"report: {file}\n" in capsys.readouterr().out
    assert result(file) == ("good", "ended without a fault")
    assert "<h1>bench: run, 1.0 s</h1>" in file.read_text()


def test_of_a_run_whose_goal_is_missed(tmp_path: Path) -> None:
    file = tmp_path / "run.html"
    goal = ["--goal", "3,0", "--seconds", "0.5"]
    assert main(["run", "diffbot", "--fast", *goal, "--report", str(file)]) == 1
    assert result(file) == ("bad", "goals reached: 0")


def test_of_a_demo_with_its_figures_and_the_true_walls(tmp_path: Path) -> None:
    file = tmp_path / "out" / "demo.html"  # a folder that the demo makes
    assert (
        main(["demo", "--fast", "--goal", "0.3,0", "--out", str(tmp_path / "out"), "--report", str(file)])
        == 0
    )
    text = file.read_text()
    assert result(file) == ("good", "goals reached: 1")
    assert "goals reached within 0.20 m by the true pose: 1 of 1" in text
    assert "<polyline class='wall'" in text


def test_of_a_run_that_ends_by_an_error(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def fails(*_: object) -> bool:
        raise gw.BusError("can0: the adapter is gone")

    monkeypatch.setattr("gateway.cli.run._all_done", fails)
    file = tmp_path / "run.html"
    assert main(["run", "bench", "--fast", "--report", str(file)]) == 2
    assert result(file) == ("bad", "ended by an error: can0: the adapter is gone")


def test_of_a_replay_that_differs(recording: Path, tmp_path: Path) -> None:
    text = gw.read_recording(recording).robot_text
    other = tmp_path / "other.toml"
    other.write_text(re.sub(r"velocity = [\d.]+", "velocity = 2.0", text))
    file = tmp_path / "replay.html"
    assert main(["replay", str(recording), "--report", str(file)]) == 0
    assert result(file)[0] == "good"
    assert "the same, byte for byte" in result(file)[1]
    assert main(["replay", str(recording), "--robot", str(other), "--report", str(file)]) == 1
    kind, said = result(file)
    assert kind == "bad"
    assert "NOT the same" in said
    assert re.search(r"tick \d+, [\d.]+ s after the start: bus \w+", said)
    assert "limits.velocity" in said


@pytest.mark.parametrize(
    "command", ["run bench --fast --seconds 1", "replay RECORDING", "demo --fast --out OUT"]
)
def test_a_place_that_takes_no_file_is_refused_before_anything_runs(
    command: str, recording: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    words = command.replace("RECORDING", str(recording)).replace("OUT", str(tmp_path)).split()
    for place in (tmp_path, tmp_path / "none" / "x.html"):
        assert main([*words, "--report", str(place)]) == 2
        said = capsys.readouterr()
        assert f"--report {place}: cannot be written" in said.err
        assert "ticks" not in said.out
