"""World files: the shipped ones are valid, and all mistakes are reported at once."""

from __future__ import annotations

import math
from pathlib import Path

import pytest

from gateway.errors import ConfigError
from gateway.sim import World, WorldError, load_plant, load_world, parse_plant, parse_world
from gateway.sim.files import BenchFile, Person, SceneFile
from gateway.sim.mjcf import Polygon
from tests.gateway.world_helpers import PLANT, robot


def test_the_office() -> None:
    office = load_world("office")
    assert isinstance(office, SceneFile)
    doorway = office.walls["divider_north"].start[1] - office.walls["divider_south"].end[1]
    assert doorway >= 0.9
    xs = [x for wall in office.walls.values() for x, _ in (wall.start, wall.end)]
    ys = [y for wall in office.walls.values() for _, y in (wall.start, wall.end)]
    assert 8.0 <= max(xs) - min(xs) <= 10.5
    assert 6.0 <= max(ys) - min(ys) <= 8.5


@pytest.mark.parametrize("name", ["office", "maze", "hall", "corridor"])
def test_there_is_room_at_every_goal(name: str) -> None:
    file = load_world(name)
    built = World(file, load_plant("diffbot"), robot(), 1)
    around = [(0.35 * math.cos(a), 0.35 * math.sin(a)) for a in range(60)]
    for x, y in ((0.0, 0.0), *built.tour):
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
[walls.a]
start = [0.0, 0.0]
end = [0.01, 0.0]
[boxes.b]
x = 1.0
size = [1.0, 0.0, 1.0]
[people.c]
path = [[0.0, 0.0], [0.0, 0.0]]
"""
    with pytest.raises(WorldError) as caught:
        parse_world(text, "bad.toml")
    reported = [(mistake.line, mistake.key) for mistake in caught.value.mistakes]
    assert reported == [
        (3, "frction"), (6, "walls.a.end"), (7, "boxes.b.y"), (9, "boxes.b.size"), (11, "people.c.path")
    ]  # fmt: skip
    text = """kind = "wheels"
name = "bad"
[body]
mass = "5"
[body.wheels.one]
motor = "a"
radus_error = 0.1
[lidars.other]
range_min = 30.0
[imus.imu]
rate_hz = 300.0
gyro_bias = [0.0, 0.0]
"""
    with pytest.raises(WorldError) as caught:
        parse_plant(text, "bad.toml")
    reported = [(mistake.line, mistake.key) for mistake in caught.value.mistakes]
    assert reported == [
        (4, "body.mass"),
        (7, "body.wheels.one.radus_error"),
        (9, "lidars.other.range_min"),
        (11, "imus.imu.rate_hz"),
        (12, "imus.imu.gyro_bias"),
    ]
    for part in ("bad.toml:4: ", "did you mean 'radius_error'?", 'found "5", expected a finite number'):
        assert part in str(caught.value)


@pytest.mark.parametrize(
    ("text", "reported"),
    [
        ('kind = "scene"\nname = [', "not TOML"),
        ('name = "x"', "kind: missing; expected 'scene' or 'bench'"),
        ('kind = "sea"', "found \"sea\", expected 'scene' or 'bench'"),
        ('kind = "bench"\n[shaft]\ninertia = 0.0', "from 1e-07 to 1000"),
        ('kind = "bench"\n[shaft]\nfriction = inf', "expected a finite number"),
        ('kind = "bench"\n[shaft]\nstops = [1.0, 2.0]', "stops must be below and above 0"),
        ('kind = "bench"\n[shaft]\nstops = [-1.0]', "an array of 2 finite numbers"),
        ('kind = "bench"\n[encoder]\ncounts_per_turn = 8.5', "expected an integer"),
    ],
)
def test_one_mistake(text: str, reported: str) -> None:
    with pytest.raises(WorldError) as caught:
        parse_world(text)
    assert reported in str(caught.value)
    assert len(caught.value.mistakes) == 1


STEERED = 'front = { motor = "a", steer = { motor = "b" } }\n'


@pytest.mark.parametrize(
    ("text", "reported"),
    [
        ('kind = "boat"', "found \"boat\", expected 'wheels'"),
        ('kind = "wheels"\nname = "x"', "body: missing"),
        (PLANT.replace("[body.wheels]", "[body]\nmass = 0.3\n[body.wheels]"), "more than that of the wheels"),
        (PLANT.replace("[imus.imu]", "[imus.imu]\nrate_hz = 300.0"), "rate_hz must divide"),
        (PLANT.replace("[lidars.lidar]", "[lidars.lidar]\nbeams = 1"), "from 2 to 10000"),
        (PLANT.replace("[lidars.lidar]", "[lidars.lidar]\ndropout = 1.0"), "from 0 to 0.9"),
        (PLANT + "[body.slip]\nsigma = -0.1", "from 0 to 0.9"),
        (f'kind = "wheels"\nname = "x"\n[body.wheels]\n{STEERED}rear = {{ motor = "b" }}', "do nothing else"),
        ('kind = "wheels"\nname = "x"\n[body.wheels]\n"a b" = {}', "a name of letters"),
        (PLANT.replace("y = 0.11", 'roller = 0.0, steer = { motor = "x" }'), "cannot be steered"),
        (PLANT.replace("y = 0.11", 'steer = { motor = "x", range = [0.1, 0.2] }'), "below and above 0"),
    ],
)
def test_one_mistake_in_a_plant(text: str, reported: str) -> None:
    with pytest.raises(WorldError) as caught:
        parse_plant(text)
    assert reported in str(caught.value)
    assert len(caught.value.mistakes) == 1


def test_a_person_walks_to_and_fro() -> None:
    """By hand: 3 m along x and 1 m along y at 0.5 m/s take 8 s; 2 s of pause at each end, from 1 s on."""
    person = Person(path=((0.0, 0.0), (3.0, 0.0), (3.0, 1.0)), speed=0.5, start=1.0, pause=2.0)
    for t, place in (
        (0.0, (0.0, 0.0)),
        (1.0, (0.0, 0.0)),
        (3.0, (1.0, 0.0)),
        (8.0, (3.0, 0.5)),
        (9.5, (3.0, 1.0)),
        (12.0, (3.0, 0.5)),
        (19.0, (0.0, 0.0)),
        (23.0, (1.0, 0.0)),
    ):
        assert person.place(t) == pytest.approx(place), t


def test_a_world_that_is_not_there(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match=r"'ofice' is neither.*bench, .*office.*did you mean 'office'"):
        load_world("ofice")
    with pytest.raises(ConfigError, match=r"cannot be read: there is no file .*nowhere\.toml"):
        load_world(tmp_path / "nowhere.toml")
