"""World files: the shipped ones are valid, and all mistakes are reported at once."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path

import pytest

from gateway.errors import ConfigError
from gateway.sim import World, WorldError, load_world, parse_world
from gateway.sim.files import BenchFile, SceneFile
from gateway.sim.mjcf import Polygon
from tests.gateway.world_helpers import ROOM, robot


def test_the_office() -> None:
    office = load_world("office")
    assert isinstance(office, SceneFile)
    body, lidar = office.body, office.lidars["lidar"]
    assert (body.size, body.mass, body.wheel_radius, body.wheel_separation) == (
        (0.4, 0.2, 0.1),
        5.0,
        0.05,
        0.22,
    )
    assert (lidar.beams, lidar.range_min, lidar.range_max, lidar.rate_hz) == (360, 0.1, 10.0, 10.0)
    assert office.imus["imu"].rate_hz == 200.0
    doorway = office.walls["divider_north"].start[1] - office.walls["divider_south"].end[1]
    assert doorway >= 0.9
    xs = [x for wall in office.walls.values() for x, _ in (wall.start, wall.end)]
    ys = [y for wall in office.walls.values() for _, y in (wall.start, wall.end)]
    assert 8.0 <= max(xs) - min(xs) <= 10.5
    assert 6.0 <= max(ys) - min(ys) <= 8.5


@pytest.mark.parametrize("name", ["maze", "hall", "corridor"])
def test_another_world_has_the_offices_base_and_room_for_it_at_every_goal(name: str) -> None:
    office, file = load_world("office"), load_world(name)
    assert isinstance(file, SceneFile)
    assert isinstance(office, SceneFile)
    swept = {sensor: replace(lidar, sweep=False) for sensor, lidar in file.lidars.items()}
    assert (file.body, file.imus, file.encoder) == (office.body, office.imus, office.encoder)
    assert swept == {sensor: replace(lidar, sweep=False) for sensor, lidar in office.lidars.items()}
    built = World(file, robot(), 1)
    around = [(0.35 * math.cos(a), 0.35 * math.sin(a)) for a in range(60)]
    for x, y in ((0.0, 0.0), *file.tour):
        for polygon in built.outlines():
            assert not any(_inside(polygon, x + dx, y + dy) for dx, dy in around), (x, y)


def _inside(polygon: Polygon, x: float, y: float) -> bool:
    edges = zip(polygon, polygon[1:] + polygon[:1], strict=True)
    return all((bx - ax) * (y - ay) > (by - ay) * (x - ax) for (ax, ay), (bx, by) in edges)


def test_a_world_by_its_path(tmp_path: Path) -> None:
    file = tmp_path / "here.toml"
    file.write_text('kind = "bench"\nname = "here"\n[shafts.arm]\nload = -0.5\n')
    found = load_world(file)
    assert isinstance(found, BenchFile)
    assert found.shafts["arm"].load == -0.5
    assert load_world(str(file)) == found


def test_all_mistakes_at_once_each_with_its_place() -> None:
    text = """kind = "scene"
name = "bad"
frction = 2.0
[body]
left = { motor = "a" }
right = { motor = "b" }
mass = "5"
[lidars.lidar]
beam = 3
[lidars.other]
range_min = 30.0
[imus.imu]
rate_hz = 300.0
gyro_bias = [0.0, 0.0]
[walls.a]
start = [0.0, 0.0]
end = [0.01, 0.0]
[boxes.b]
x = 1.0
size = [1.0, 0.0, 1.0]
"""
    with pytest.raises(WorldError) as caught:
        parse_world(text, "bad.toml")
    reported = [(mistake.line, mistake.key) for mistake in caught.value.mistakes]
    assert reported == [
        (3, "frction"),
        (7, "body.mass"),
        (9, "lidars.lidar.beam"),
        (11, "lidars.other.range_min"),
        (13, "imus.imu.rate_hz"),
        (14, "imus.imu.gyro_bias"),
        (17, "walls.a.end"),
        (18, "boxes.b.y"),
        (20, "boxes.b.size"),
    ]
    text = str(caught.value)
    for part in (
        "bad.toml:3: ",
        "did you mean 'friction'?",
        "did you mean 'beams'?",
        'found "5", expected a finite number',
    ):
        assert part in text


@pytest.mark.parametrize(
    ("text", "reported"),
    [
        ('kind = "scene"\nname = [', "not TOML"),
        ('name = "x"', "kind: missing; expected 'scene' or 'bench'"),
        ('kind = "sea"', "found \"sea\", expected 'scene' or 'bench'"),
        ('kind = "scene"\nname = "x"', "body: missing"),
        ('kind = "bench"\n[shaft]\ninertia = 0.0', "from 1e-07 to 1000"),
        ('kind = "bench"\n[shaft]\nfriction = inf', "expected a finite number"),
        ('kind = "bench"\n[shaft]\nstops = [1.0, 2.0]', "stops must be below and above 0"),
        ('kind = "bench"\n[shaft]\nstops = [-1.0]', "an array of 2 finite numbers"),
        ('kind = "bench"\n[encoder]\ncounts_per_turn = 8.5', "expected an integer"),
        (ROOM.replace('motor = "right"', 'motor = "left"'), "right must be another motor"),
        (ROOM.replace("[body]", "[body]\nmass = 0.3"), "mass must be more than that of the two wheels"),
        (ROOM.replace("[imus.imu]", "[imus.imu]\nrate_hz = 300.0"), "rate_hz must divide"),
        (ROOM.replace("[lidars.lidar]", "[lidars.lidar]\nbeams = 1"), "from 2 to 10000"),
        (ROOM.replace("[lidars.lidar]", "[lidars.lidar]\ndropout = 1.0"), "from 0 to 0.9"),
        (ROOM.replace("[body]", "[body.slip]\nsigma = -0.1\n[body]"), "from 0 to 0.9"),
    ],
)
def test_one_mistake(text: str, reported: str) -> None:
    with pytest.raises(WorldError) as caught:
        parse_world(text)
    assert reported in str(caught.value)
    assert len(caught.value.mistakes) == 1


def test_a_world_that_is_not_there(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match=r"'ofice' is neither.*bench, .*office.*did you mean 'office'"):
        load_world("ofice")
    with pytest.raises(ConfigError, match=r"cannot be read: there is no file .*nowhere\.toml"):
        load_world(tmp_path / "nowhere.toml")
