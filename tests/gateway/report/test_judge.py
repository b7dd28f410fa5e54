"""`gateway judge` and `pytest --replay`: recordings as a test suite, judged in any way to the same result."""

from __future__ import annotations

import json
import re
import subprocess
import sys
from collections.abc import Iterator, Sequence
from math import cos, sin
from pathlib import Path
from xml.etree import ElementTree as ET

import pytest

import gateway as gw
from gateway.cli.main import main
from gateway.cli.tasks import Engine, Result, run_tasks
from gateway.config import resources
from protocols.messages import SECOND
from tests.gateway.rosbag.strangers import carmen_log, motion

EXPECTED = ".expected.toml"


@pytest.fixture(scope="module")
def suite(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Three recordings, of two robots and of another program, with what is expected of them."""
    folder = tmp_path_factory.mktemp("suite")
    (folder / "more").mkdir()
    with gw.open_session("diffbot", simulated=True, record=folder / "goal.mcap") as session:
        session.submit(gw.Goal(0.6, 0.1))
        for _ in session.run(2.5):
            pass
    with gw.open_session("bench", simulated=True, record=folder / "more" / "turn.mcap") as session:
        for _ in session.run(1.5):
            session.submit(gw.Velocity("left", 3.0))
    (folder / "more" / "stranger.log").write_text(carmen_log(8.0))
    (folder / "more" / "notes.log").write_text("not a recording\n")
    assert main(["judge", str(folder), "--update"]) == 0
    return folder


@pytest.fixture
def copy(suite: Path, tmp_path: Path) -> Path:
    """The suite, to be spoilt."""
    for path in suite.rglob("*"):
        if path.is_file():
            other = tmp_path / path.relative_to(suite)
            other.parent.mkdir(exist_ok=True)
            other.write_bytes(path.read_bytes())
    return tmp_path


def test_what_was_written_is_as_expected(suite: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["judge", str(suite)]) == 0
    assert capsys.readouterr().out.splitlines() == [
        f"{suite}/goal.mcap: as expected",
        f"{suite}/more/stranger.log: as expected",
        f"{suite}/more/turn.mcap: as expected",
        "3 of 3 recordings are as expected",
    ]
    text = (suite / f"goal.mcap{EXPECTED}").read_text()
    assert re.search(r'^"goals reached" = \[1, 0, ""\]$', text, re.MULTILINE)
    assert re.search(r'^"final x" = \[0\.[56]\d*, 0\.02, "m"\]$', text, re.MULTILINE)
    assert re.search(r'^"can0" = \[\n    "[0-9a-f]{8}( [0-9a-f]{8})+",\n\]$', text, re.MULTILINE)


def test_side_by_side_and_in_shards_the_report_is_the_same_to_the_byte(suite: Path, tmp_path: Path) -> None:
    def report(*arguments: str) -> tuple[bytes, bytes]:
        assert (
            main(["judge", *arguments, "--report", str(tmp_path / "r"), "--json", str(tmp_path / "j")]) == 0
        )
        return (tmp_path / "r").read_bytes(), (tmp_path / "j").read_bytes()

    whole = report(str(suite))
    assert report(str(suite), "--jobs", "2") == whole
    shards = [str(tmp_path / f"{number}.json") for number in (1, 2)]
    for number, shard in enumerate(shards, 1):
        assert main(["judge", str(suite), "--shard", f"{number}/2", "--json", shard]) == 0
    assert {len(json.loads(Path(shard).read_text())) for shard in shards} == {1, 2}
    assert report(*shards) == whole


def test_of_a_process_that_dies_each_recording_is_judged_alone(
    suite: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def dying(tasks: Sequence[Sequence[str]], engine: Engine) -> Iterator[Result]:
        alive = iter(run_tasks([task for task in tasks if len(task) == 2], engine))
        for task in tasks:
            yield next(alive) if len(task) == 2 else ("", "its process ended with status -9: killed")

    told = {}
    for engine in (run_tasks, dying):
        monkeypatch.setattr("gateway.cli.judge.run_tasks", engine)
        assert main(["judge", str(suite), "--jobs", "2", "--json", str(tmp_path / "j")]) == 0
        told[engine.__name__] = (tmp_path / "j").read_bytes()
    assert told["dying"] == told["run_tasks"]


def test_logs_are_asked_of_the_guard_alone(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "foreign.log").write_text("(1.000000) can0 00D#0000F04100000000\n")  # 30 turns a second
    assert main(["judge", str(tmp_path), "--only", "guard", "--robot", "bench"]) == 1
    assert "guard alone: 0 of 1 recordings would have been allowed" in capsys.readouterr().out
    assert main(["judge", str(tmp_path), "--only", "control", "--robot", "bench"]) == 2
    assert "no recording of this gateway in" in capsys.readouterr().err


def test_another_robot_is_told_by_its_figures_bytes_and_cause(
    suite: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    robot = tmp_path / "slower.toml"
    text = resources.find("robots", "diffbot").read_text()
    robot.write_text(text.replace("max_linear = 0.6", "max_linear = 0.2"))
    assert main(["judge", str(suite / "goal.mcap"), "--robot", str(robot)]) == 1
    printed = capsys.readouterr().out
    assert "goal.mcap: CHANGED" in printed
    assert re.search(r"  can0: other bytes from second \d on, in \d of \d seconds", printed)
    assert "brain.differential.max_linear: 0.6 recorded, 0.2 now" in printed


def test_other_bytes_within_the_tolerances_pass_only_if_they_may(
    suite: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    robot = tmp_path / "little.toml"
    text = resources.find("robots", "diffbot").read_text()
    robot.write_text(text.replace("max_linear = 0.6", "max_linear = 0.599"))
    command = ["judge", str(suite / "goal.mcap"), "--robot", str(robot)]
    assert main(command) == 1
    assert "goal.mcap: other bytes, figures within their tolerances" in capsys.readouterr().out
    assert main([*command, "--within"]) == 0


def test_a_figure_is_held_to_its_edited_tolerance_which_an_update_keeps(
    copy: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    recording, file = copy / "more" / "turn.mcap", copy / "more" / f"turn.mcap{EXPECTED}"
    position = r'("left: final position" = \[)(.*), 0\.1,'
    file.write_text(re.sub(position, lambda m: f"{m[1]}{float(m[2]) + 0.5}, 0.1,", file.read_text()))
    assert main(["judge", str(recording)]) == 1
    assert re.search(r"  left: final position: .* rad, expected .* within 0\.1", capsys.readouterr().out)
    file.write_text(re.sub(position, r"\g<1>\2, 0.7,", file.read_text()))
    assert main(["judge", str(recording)]) == 0
    assert main(["judge", str(recording), "--update"]) == 0
    assert re.search(r'"left: final position" = \[.*, 0\.7, "rad"\]', file.read_text())


def test_what_cannot_be_read_is_told_and_keeps_nothing_from_the_others(
    copy: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    whole = (copy / "goal.mcap").read_bytes()
    (copy / "goal.mcap").write_bytes(whole[: len(whole) // 2])
    junit = copy / "junit.xml"
    assert main(["judge", str(copy), "--junit", str(junit)]) == 1
    printed = capsys.readouterr().out
    assert "goal.mcap: CHANGED\n  it is another recording than was judged before" in printed
    assert "2 of 3 recordings are as expected" in printed
    suite = ET.parse(junit).getroot()
    assert (suite.get("tests"), suite.get("failures")) == ("3", "1")
    (failed,) = [case for case in suite if len(case)]
    assert str(failed.get("name")).endswith("goal.mcap")
    assert main(["judge", str(copy / "more" / "notes.log")]) == 1
    assert "notes.log: NOT READ" in capsys.readouterr().out


def test_a_truth_beside_another_programs_recording_is_used(copy: Path) -> None:
    poses = [(t / SECOND, pose) for t, _, _, pose, _ in motion(8.0)]
    lines = [
        f"{t:.3f} {pose.x:.4f} {pose.y:.4f} 0 0 0 {sin(pose.yaw / 2)} {cos(pose.yaw / 2)}"
        for t, pose in poses
    ]
    (copy / "more" / "stranger.tum").write_text("\n".join(lines) + "\n")
    log = copy / "more" / "stranger.log"
    assert main(["judge", str(log)]) == 1  # the figure is new
    assert main(["judge", str(log), "--update"]) == 0
    text = log.with_name(f"{log.name}{EXPECTED}").read_text()
    error = re.search(r'^"estimated: RMS error" = \[(.*), 0\.02, "m"\]$', text, re.MULTILINE)
    assert error is not None
    assert float(error[1]) < 0.05


# fmt: off
WRONG = [
    # arguments, and what is told
    (["{}/nowhere"], r"there is no such file or folder"),
    (["{}/empty"], r"no recording in .*empty"),
    (["{}", "--expected", "{}/nowhere"], r"there is no such folder"),
    (["{}", "--shard", "3/2"], r"'3/2' is not I/N, such as 1/4"),
    (["{}", "--jobs", "0"], r"'0' is not a number from 1 to 99"),
    (["{}/wrong.json"], r"wrong\.json: not what `gateway judge --json` writes"),
    (["{}/bad.mcap"], r"bad\.mcap\.expected\.toml:2: figures\.x: expected \[value, tolerance"),
]
# fmt: on


def status(arguments: list[str]) -> object:
    try:
        return main(arguments)
    except SystemExit as error:
        return error.code


@pytest.mark.parametrize(("arguments", "told"), WRONG)
def test_wrong_arguments_and_files_are_told(
    arguments: list[str], told: str, copy: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (copy / "empty").mkdir()
    (copy / "wrong.json").write_text('[{"name": 5}]')
    (copy / "goal.mcap").rename(copy / "bad.mcap")
    (copy / f"bad.mcap{EXPECTED}").write_text('\nfigures.x = [1, -2, "m"]\n')
    assert status(["judge", *(one.format(copy) for one in arguments)]) == 2
    assert re.search(told, capsys.readouterr().err)


def test_pytest_runs_them_as_tests(copy: Path) -> None:
    file = copy / "more" / f"turn.mcap{EXPECTED}"
    file.write_text(re.sub(r'"ticks" = \[\d+', '"ticks" = [5', file.read_text()))
    loaded = ["-p", "no:motor_gateway", "-p", "gateway.testing", "-p", "no:cacheprovider"]
    command = [sys.executable, "-m", "pytest", "-v", *loaded, "--rootdir", str(copy), "--replay", str(copy)]
    done = subprocess.run(command, cwd=copy / "more", capture_output=True, text=True, check=False)
    assert done.returncode == 1, done.stderr
    assert re.search(r"1 failed, 2 passed", done.stdout)
    assert re.search(r"turn\.mcap: CHANGED\n  ticks: \d+, expected 5 within 0", done.stdout)
    assert "Traceback" not in done.stdout


CANDUMP = [
    f"({10 + at / 100:.6f}) can0 {message} R\n"
    for at in range(50)
    for message in ("029#0000000000000000", "049#0000000000000000", "021#0000000001000000")
]
"""What two motors of the bench report: encoders of both, a heartbeat of one"""


def test_a_log_of_can_is_judged_by_what_is_in_it(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    log = tmp_path / "can.log"
    log.write_text("".join(CANDUMP))
    (tmp_path / "notes.log").write_text("not a recording\n")
    for more, row in (
        ([], '"can0: frames" = [150, 0, ""]\n"can0: identifiers" = [3, 0, ""]'),
        (["--robot", "bench"], '"left: messages" = [51, 0, ""]'),
    ):
        assert main(["judge", str(tmp_path), "--update", *more]) == 0
        assert row in (tmp_path / f"can.log{EXPECTED}").read_text()
        assert "1 of 1 recordings are as expected" in capsys.readouterr().out
    log.write_text("".join(CANDUMP[3:]))
    assert main(["judge", str(tmp_path), "--robot", "bench"]) == 1
    printed = capsys.readouterr().out
    assert "can0: frames: 147, expected 150 within 0" in printed
    assert "right: messages: 49, expected 50 within 0" in printed
    log.write_text("".join(CANDUMP)[:-20])
    assert main(["judge", str(tmp_path)]) == 1
    assert "cut short: 1, expected 0 within 0" in capsys.readouterr().out


def test_the_other_files_of_a_folder_are_named_with_what_they_are(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "can.log").write_text("".join(CANDUMP))
    texts = {
        "LICENSE": "text, no recording",
        "hall/20250616-hboard-cycle.dat.gz": "hall sensors of a motor at 30 kHz",
        "motor.eds": "a description of a device, no recording",
        "numbers.txt": "nothing that a reader of recordings knows",
        "old.tar.xz": "packed files, which are not looked into",
        "path.tum": "a truth, by which a recording of its name beside it is judged",
    }
    (tmp_path / "hall").mkdir()
    for name in texts:
        (tmp_path / name).write_text("1 2\n3 4\n")
    report = tmp_path / "report.md"
    assert main(["judge", str(tmp_path), "--all", "--update", "--report", str(report)]) == 0
    printed = capsys.readouterr().out
    told = dict(re.findall(rf"^{tmp_path}/(.*): not judged: (.*)$", printed, re.MULTILINE))
    assert told.keys() == texts.keys()
    assert all(text in told[name] for name, text in texts.items()), told
    assert f"| {tmp_path}/LICENSE | not judged: text, no recording |" in report.read_text()
