"""This project's own recordings: they cover what they say, are what was driven, and are judged as expected.

What is expected is held to the byte on the processor and with the packages that recorded them; elsewhere each
figure within its tolerance. After a change that is meant: `gateway judge FOLDER --update`.
"""

from __future__ import annotations

import shutil
from itertools import product
from pathlib import Path

import pytest

from gateway.cli.main import main
from gateway.errors import ConfigError, RecordingError
from gateway.recording import environment, read_recording
from gateway.recording.layout import VIEWS_FROM
from gateway.recording.matrix import FILE, Cell, read_levels, read_matrix
from tests.matrix import FOLDER
from tests.matrix.cover import cover
from tests.matrix.drive import record
from tests.matrix.robots import file_of, robot_of

LEVELS = read_levels(FOLDER / FILE)
CELLS = cover(LEVELS)
SAME = (
    "machine",
    "numpy blas",
    "processor flags",
    "processor model name",
    "package numpy",
    "package filterpy",
)
"""Facts on which the bytes depend, beside the program"""


def recorded_here() -> bool:
    recorded, here = read_recording(file_of(FOLDER, *CELLS[0])).facts, environment.facts()
    return all(recorded.get(fact) == here.get(fact) for fact in SAME)


@pytest.mark.parametrize("language", LEVELS.languages)
def test_they_are_judged_as_expected(language: str, capsys: pytest.CaptureFixture[str]) -> None:
    files = sorted(map(str, FOLDER.glob(f"{language}_*.mcap")))
    files = [one for one in files if read_recording(one).facts["fixture language"] == language]
    more = [] if recorded_here() else ["--within"]
    assert main(["judge", *files, *more]) == 0, capsys.readouterr().out
    assert f"{len(files)} of {len(files)} recordings are as expected" in capsys.readouterr().out


def test_every_pair_that_can_be_is_covered(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["fixtures", "matrix", str(FOLDER)]) == 0
    printed = capsys.readouterr().out
    assert "language and body: 133 of 133 pairs" in printed
    assert "language and bad day: 141 of 141 pairs" in printed
    assert "body and bad day: 70 of 70 pairs" in printed
    found = read_matrix(FOLDER)
    assert set(found.recordings) == set(CELLS)
    assert found.bytes < 30e6


def test_what_is_not_covered_is_told(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    shutil.copy(FOLDER / FILE, tmp_path)
    shutil.copy(file_of(FOLDER, "j1939_valve", "boom", "a"), tmp_path)
    assert main(["fixtures", "matrix", str(tmp_path)]) == 1
    printed = capsys.readouterr().out
    assert "language and body: 1 of 133 pairs" in printed
    assert any(line.split() == ["vesc", *"???????", *"---"] for line in printed.splitlines())


def test_what_is_no_matrix_is_told(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="cannot be read: No such file"):
        read_matrix(tmp_path)
    shutil.copy(FOLDER / FILE, tmp_path)
    shutil.copy(FOLDER.parent / "format1.mcap", tmp_path)
    with pytest.raises(RecordingError, match="fixture language '', fixture body '', fixture bad day ''"):
        read_matrix(tmp_path)


def test_cells_cover_every_pair_and_none_is_impossible() -> None:
    covered = frozenset().union(*(cell.pairs for cell in CELLS))
    assert covered == LEVELS.pairs()
    assert set(CELLS) <= set(LEVELS.cells())
    every = product(LEVELS.languages, LEVELS.bodies, LEVELS.bad_days)
    impossible = {Cell(*one) for one in every} - set(LEVELS.cells())
    assert not impossible & set(CELLS)
    assert cover(LEVELS, CELLS) == []
    assert len(cover(LEVELS, CELLS[1:])) == 1


@pytest.mark.parametrize(
    ("language", "body"),
    sorted(
        {cell[:2] for cell in CELLS if cell.language in ("odrive_can", "damiao", "maestro", "sabertooth")}
    ),
)
def test_each_robot_has_motors_of_its_language(language: str, body: str) -> None:
    robot = robot_of(LEVELS, language, body)
    assert language in {motor.plugin.name for motor in robot.motors.values()}


@pytest.mark.sample(1)
@pytest.mark.parametrize("cell", CELLS, ids="_".join)
def test_a_recording_is_made_again_to_the_same_ticks(cell: Cell, tmp_path: Path) -> None:
    """So none is edited by hand; with the code that made it. In `./go prove` all: a difference tells that the
    simulated world, or the program, has changed since, and is no defect of the recording."""
    if not recorded_here():
        pytest.skip("NOT RUN: fixtures/recordings/matrix: another processor than recorded them")
    path = tmp_path / "again.mcap"
    record(LEVELS, cell, path)
    there, again = read_recording(file_of(FOLDER, *cell)), read_recording(path)
    assert again.robot_text == there.robot_text
    assert again.facts[VIEWS_FROM] == there.facts[VIEWS_FROM]
    assert list(again.ticks) == list(there.ticks)
