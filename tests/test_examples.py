"""The examples run as they stand, each in a process of its own."""

from __future__ import annotations

import csv
import re
import subprocess
import sys
from pathlib import Path

import pytest

from tests.distributions import Site
from tests.guide import Comparison, blocks

FOLDER = Path(__file__).parents[1] / "examples"
PRINTED = {
    "send_one_command": [r"left: armed \(CLOSED_LOOP_CONTROL\)", r"left: \w+, 1[01]\.\d\d rad"],
    "record_a_drive": [r"brain: goal 1 reached", r"believed pose: Pose\(x=1\.[45]\d*, y=0\.[45]\d*"],
    "replay_a_recording": [r"the same, byte for byte", r"events: .*\d+ Feedback"],
    "report_of_a_recording": [r"the same, byte for byte", r"drive\.html: \d+ kB"],
    "live_view": [r"open http://127\.0\.0\.1:\d+/", r"brain: goal 1 accepted"],
    "embed_the_step": [r"right: [23]\.\d\d rad, -?[\d.]+ rad/s on the way to 3 rad"],
    "sine_to_csv": [r"6\d\d rows, 1\.00 rad, at 1\.57 rad/s"],
}
RECORDING = "drive.mcap"
GIVEN = {
    "record_a_drive": ["another.mcap"],
    "replay_a_recording": [RECORDING],
    "report_of_a_recording": [RECORDING],
    "sine_to_csv": ["sine.csv", "sine.png"],
}
PLUGIN = FOLDER / "robstride_can"
DOORS = FOLDER / "wiggle_and_steady"
"""Run by tests/brain/skills/test_found.py and tests/brain/test_other_brain.py"""
LAYOUTS = FOLDER / "layouts"
"""Held against `gateway layout` by tests/gateway/view/test_layouts.py"""
TUTORIAL = FOLDER / "ros2_tutorial"
"""Run by tests/gateway/ros/test_judges.py"""
GUIDE = FOLDER.parent / "docs" / "adding-a-skill.md"


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Where there is a recording already."""
    made = tmp_path_factory.mktemp("examples")
    run("record_a_drive", made, RECORDING)
    return made


def run(name: str, folder: Path, *given: str) -> str:
    command = [sys.executable, str(FOLDER / f"{name}.py"), *given]
    done = subprocess.run(command, cwd=folder, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stdout + done.stderr
    return done.stdout


def test_none_is_left_out() -> None:
    text = (FOLDER / "README.md").read_text()
    assert set(PRINTED) == {path.stem for path in FOLDER.glob("*.py")}
    assert all(f"[{name}.py]({name}.py)" in text for name in PRINTED)
    assert {path.name for path in FOLDER.iterdir() if path.is_dir()} == {
        PLUGIN.name,
        DOORS.name,
        TUTORIAL.name,
        LAYOUTS.name,
        "dbc",  # robot files, driven in tests/data/test_dbc_robots.py
    }
    assert all(f"({LAYOUTS.name}/{one.name})" in text for one in LAYOUTS.iterdir())
    assert f"[{TUTORIAL.name}]({TUTORIAL.name}/README.md)" in text
    assert f"[{PLUGIN.name}]({PLUGIN.name}/{PLUGIN.name}/README.md)" in text
    assert f"[{DOORS.name}]({DOORS.name}/pyproject.toml)" in text


@pytest.mark.sample(3)
@pytest.mark.parametrize("name", PRINTED)
def test_it_runs_and_prints_what_it_should(name: str, folder: Path) -> None:
    printed = run(name, folder, *GIVEN.get(name, ()))
    for pattern in PRINTED[name]:
        assert re.search(pattern, printed), f"{pattern!r} is not in:\n{printed}"


def test_a_sine_is_logged_and_plotted_in_30_lines(folder: Path) -> None:
    assert len((FOLDER / "sine_to_csv.py").read_text().splitlines()) <= 30
    run("sine_to_csv", folder, "again.csv", "again.png")
    with (folder / "again.csv").open(newline="") as file:
        head, *rows = csv.reader(file)
    t, position = head.index("t [s]"), head.index("left.position [rad]")
    assert len(rows) > 590  # 6 s, 100 a second
    values = [float(row[position]) for row in rows if row[position]]
    assert max(values) - min(values) == pytest.approx(1.0, abs=0.02)
    assert float(rows[-1][t]) - float(rows[0][t]) == pytest.approx(6.0, abs=0.5)  # and its stop action
    assert (folder / "again.png").read_bytes().startswith(b"\x89PNG")


def test_the_plugin_passes_its_own_tests(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The contract, its vectors and its transcripts, as its author runs them."""
    site = Site(tmp_path, monkeypatch)
    site.link("motor-gateway-robstride-can", "robstride_can = robstride_can:plugin", PLUGIN)
    command = [sys.executable, "-m", "pytest", "-q", "-p", "no:cacheprovider"]
    done = subprocess.run(
        command,
        cwd=PLUGIN,
        env=site.environment(PYTHONDONTWRITEBYTECODE="1"),
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stdout
    assert re.search(r"^12 passed", done.stdout, re.MULTILINE)


def test_the_guide_to_skills_and_brains_quotes_what_is_there() -> None:
    text = GUIDE.read_text()
    quoted = [Comparison(b.path, b.body, (DOORS / b.path).read_text()) for b in blocks(text) if b.path]
    assert len(quoted) == 3
    for each in quoted:
        assert each.matches(), f"{each.subject} is\n{each.actual}-- but the guide shows:\n{each.expected}"
    assert len(text.splitlines()) <= 150
    for name in re.findall(r"`(brain/[\w./]+)`", text):
        assert (FOLDER.parent / name).exists(), name
