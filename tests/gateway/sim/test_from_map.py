"""A map as a world: boxes where it is occupied, in which a robot drives again what it was asked."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import gateway as gw
from brain.belief import Pose
from gateway.bench.again import drive_again, lasts, recorded_world, simulated
from gateway.cli.main import main
from gateway.errors import UserError
from gateway.recording import read_recording
from gateway.replay.input_log import InputLog, input_log
from gateway.runtime.scenario_file import parse_faults
from gateway.sim import SceneFile, WorldError, load_world
from gateway.sim.from_map import Grid, place_of, rectangles

ORIGIN = Pose(0.0, 0.0, 0.0)


def grid(*rows: str) -> np.ndarray[tuple[int, int], np.dtype[np.bool_]]:
    """Return the cells of a drawing, its first row at the top."""
    return np.array([[cell == "#" for cell in row] for row in reversed(rows)])


def test_every_occupied_cell_is_in_one_rectangle() -> None:
    cells = grid("####.##", "#...#.#", "#...#..", "##.....")
    assert sorted(rectangles(cells)) == [
        (0, 0, 1, 2),
        (1, 0, 2, 1),
        (1, 4, 2, 1),
        (2, 6, 1, 1),
        (3, 0, 1, 4),
        (3, 5, 1, 2),
    ]
    random = np.random.default_rng(3).random((40, 30)) < 0.4
    covered = np.zeros(random.shape, dtype=int)
    for row, column, high, wide in rectangles(random):
        covered[row : row + high, column : column + wide] += 1
    assert (covered == random).all()


@pytest.mark.parametrize("yaw", [0.0, math.pi / 2])
def test_boxes_stand_where_cells_are_occupied_but_not_where_the_robot_begins(yaw: float) -> None:
    cells = grid("..#", "...", "##.")
    place = place_of(Grid(cells, 0.5, (1.0, 2.0, yaw)), "map", Pose(1.0, 2.0, 0.3), 0.4)
    boxes = {(round(box.x, 9), round(box.y, 9), *box.size[:2]) for box in place.boxes.values()}
    turned = {0.0: {(1.75, 2.25), (2.25, 3.25)}, math.pi / 2: {(0.75, 2.75), (-0.25, 3.25)}}[yaw]
    assert boxes == {(x, y, 0.5, 0.5) for x, y in turned}
    assert (place.start.x, place.start.y, place.start.yaw) == (1.0, 2.0, 0.3)


def test_a_map_without_anything_in_it_or_with_too_much_is_no_world() -> None:
    with pytest.raises(UserError, match="nothing is occupied in it"):
        place_of(Grid(grid("..", ".."), 0.5, (0.0, 0.0, 0.0)), "map", ORIGIN)
    noise = np.indices((120, 120)).sum(axis=0) % 2 == 0
    with pytest.raises(UserError, match="7200 boxes stand in it; expected 1 to 5000"):
        place_of(Grid(noise, 0.5, (0.0, 0.0, 0.0)), "map", ORIGIN)


@pytest.fixture(scope="module")
def recorded(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A base that drives in the office for 2 s."""
    path = tmp_path_factory.mktemp("map") / "goal.mcap"
    with gw.open_session("diffbot", simulated=True, record=path) as session:
        session.submit(gw.Goal(0.6, 0.1))
        for _ in session.run(2.0):
            pass
    return path


@pytest.fixture(scope="module")
def log(recorded: Path) -> InputLog:
    return input_log(read_recording(recorded))


def test_a_robot_drives_again_in_what_was_mapped(log: InputLog) -> None:
    world = recorded_world(log)
    assert len(world.boxes) > 20
    assert math.hypot(world.start.x, world.start.y) < 0.01
    nowhere = replace(simulated(log.robot), world=None)  # as a real robot has none
    found = drive_again(log, parse_faults("", Path("none"), nowhere, lasts(log), world=world))
    assert found.figures["final x"].value == pytest.approx(0.6, abs=0.05)
    assert found.figures["error of the believed place, most"].value < 0.05
    assert found.figures["touches"].value == 0
    assert found.figures["nearest to anything"].value == pytest.approx(0.905, abs=0.1)  # as in the office


def test_it_is_stopped_by_what_the_recorded_robot_saw(
    recorded: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """A wall that comes up in the map, which is written to a file."""
    assert main(["map", str(recorded), "--out", str(tmp_path / "m")]) == 0
    assert isinstance(load_world(tmp_path / "m" / "map.yaml"), SceneFile)
    (tmp_path / "wall.toml").write_text(
        "[walls.new]\nat = 0.1\nstart = [0.5, -1.0]\nend = [0.5, 1.0]\n[never]\ntouches = 0\n"
    )
    arguments = ["--world", str(tmp_path / "m" / "map.yaml"), "--inject", str(tmp_path / "wall.toml")]
    capsys.readouterr()
    assert main(["again", str(recorded), *arguments]) == 0
    printed = capsys.readouterr().out
    x = float(printed.partition("final x: ")[2].split()[0])
    assert x < 0.4
    assert "touches: 0" in printed


@pytest.mark.parametrize(
    ("text", "told"),
    [
        ("image: none.pgm\nresolution: 0.05\norigin: [0, 0, 0]\nnegate: 0\n", "occupied_thresh"),
        ("[", "it is not YAML"),
    ],
)
def test_a_map_that_cannot_be_read_is_told(text: str, told: str, tmp_path: Path) -> None:
    (tmp_path / "map.yaml").write_text(text)
    with pytest.raises(WorldError, match=told):
        load_world(tmp_path / "map.yaml")


def test_where_nothing_was_mapped_there_is_no_world(capsys: pytest.CaptureFixture[str]) -> None:
    path = "fixtures/recordings/format1.mcap"
    assert main(["again", path, "--world", "recorded"]) == 2
    assert "nothing was mapped in the recording" in capsys.readouterr().err
