from __future__ import annotations

import math
from dataclasses import astuple

import numpy as np
import pytest

from brain.belief import Floats, Pose
from brain.bodies.plane import wrap
from brain.perception.body_scan import BodyScan, to_body
from brain.perception.lines import TILE
from brain.perception.map import Map, MapSettings
from brain.perception.match import Match, MatchSettings, MatchShares, examine, match
from tests.brain.perception.office import MOUNTS, OFFICE, box, scan_at

LIDAR = MOUNTS["lidar"]
SETTINGS = MatchSettings()
HERE = Pose(0.0, 0.0, 0.0)
SURE = np.eye(3) * 1e-12
Places = list[tuple[float, float]]

MAZE = np.array(
    [
        *box(-4.0, -4.0, 4.0, 4.0),
        *[(-2.0, -4.0, -2.0, 2.0), (0.0, -2.0, 0.0, 4.0), (2.0, -4.0, 2.0, 2.0)],
        *[(-2.0, 2.0, -1.0, 2.0), (0.0, 0.0, 1.0, 0.0)],
    ]
)
HALL = np.array(
    box(-10.0, -8.0, 10.0, 8.0)
    + box(-6.0, -4.0, -5.6, -3.6)
    + box(3.0, 3.0, 3.5, 3.5)
    + box(6.0, -5.0, 6.5, -4.0)
    + box(-4.0, 4.0, -3.0, 4.6)
)
WORLDS: dict[str, tuple[Floats, Places]] = {
    "office": (
        OFFICE,
        [(0, 0), (1, 0.5), (2.6, 0.3), (3.2, 1.8), (5.2, 1.8), (5.2, -0.8), (8.3, 2.2), (6, 2.6)],
    ),
    "maze": (MAZE, [(x, y) for x in (-3, -1, 1, 3) for y in (-3, -0.8, 3)]),
    "hall": (HALL, [(x, y) for x in (-7, -2, 1, 5, 8) for y in (-6, 0, 5)]),
}


def seen(pose: Pose, random: np.random.Generator, walls: Floats = OFFICE, sigma: float = 0.01) -> BodyScan:
    return to_body(scan_at(walls, pose, LIDAR, 0, sigma * random.normal(size=360)), LIDAR, 12.0)


def drawn(places: Places, random: np.random.Generator, walls: Floats = OFFICE, scans: int = 5) -> Map:
    """A map drawn at true poses."""
    chart = Map(MapSettings())
    for x, y in places:
        for _ in range(scans):
            pose = Pose(x + 0.1 * random.normal(), y + 0.1 * random.normal(), random.uniform(-3.0, 3.0))
            chart.add(pose, seen(pose, random, walls), SURE)
    return chart


def error(found: Match | None, truth: Pose) -> Floats:
    assert found is not None
    pose = found.pose
    return np.array([pose.x - truth.x, pose.y - truth.y, wrap(pose.yaw - truth.yaw)])


@pytest.mark.sample(1)
@pytest.mark.parametrize("world", WORLDS)
def test_errors_are_small_and_as_large_as_the_covariance_states(world: str) -> None:
    random = np.random.Generator(np.random.PCG64(11))
    walls, places = WORLDS[world]
    errors, distances = [], []
    for _ in range(4):
        chart = drawn(places, random, walls)
        for _ in range(40):
            x, y = places[random.integers(len(places))]
            truth = Pose(x + 0.15 * random.normal(), y + 0.15 * random.normal(), random.uniform(-3.0, 3.0))
            dx, dy, turn = random.uniform(-1.0, 1.0, 3) * [0.03, 0.03, 0.02]
            guess = Pose(truth.x + dx, truth.y + dy, wrap(truth.yaw + turn))
            found = match(chart, seen(truth, random, walls), guess, 0.02, SETTINGS)
            off = error(found, truth)
            assert found is not None
            errors.append(off)
            distances.append(float(off @ np.linalg.solve(found.noise + found.shared, off)) / 3.0)
    rms = np.sqrt(np.mean(np.square(errors), axis=0))
    assert math.hypot(rms[0], rms[1]) < 0.005
    assert rms[2] < math.radians(0.15)
    assert 0.5 < np.mean(distances) < 1.5


@pytest.mark.parametrize(("away", "turn"), [(0.1, 6.0), (0.2, 12.0)])
def test_a_wrong_guess_is_put_right(away: float, turn: float) -> None:
    random = np.random.Generator(np.random.PCG64(2))
    walls, places = WORLDS["office"]
    chart, right = drawn(places, random), 0
    for _ in range(40):
        x, y = places[random.integers(len(places))]
        truth, way = Pose(x, y, random.uniform(-3.0, 3.0)), random.uniform(-3.0, 3.0)
        yaw = wrap(truth.yaw + math.radians(turn) * random.choice([-1.0, 1.0]))
        guess = Pose(x + away * math.cos(way), y + away * math.sin(way), yaw)
        found = match(chart, seen(truth, random, walls), guess, away / 2.0, SETTINGS)
        off = error(found, truth) if found else np.full(3, np.inf)
        right += math.hypot(off[0], off[1]) < 0.02 and abs(off[2]) < 0.01
    assert right >= 36


def test_along_a_corridor_whose_ends_are_out_of_sight_nothing_is_known() -> None:
    """Across and heading are found to millimetres; the scatter of the walls' directions is no constraint."""
    random = np.random.Generator(np.random.PCG64(4))
    corridor = np.array(box(0.0, -1.0, 25.0, 1.0))
    chart = drawn([(x, 0.0) for x in (11.5, 12.0, 12.5, 13.0, 13.5)], random, corridor)
    for _ in range(20):
        truth = Pose(random.uniform(12.0, 13.0), random.uniform(-0.3, 0.3), random.uniform(-0.3, 0.3))
        guess = Pose(truth.x + 0.05, truth.y + 0.04, truth.yaw - 0.02)
        found = match(chart, seen(truth, random, corridor), guess, 0.03, SETTINGS)
        off = error(found, truth)
        assert off[0] == pytest.approx(0.05, abs=0.005)  # as guessed
        assert abs(off[1]) < 0.006
        assert abs(off[2]) < 0.002
        assert found is not None
        assert found.noise[0, 0] > 100.0
        assert math.sqrt(1.0 / np.linalg.inv(found.noise)[1, 1]) < 0.005


def test_the_end_of_a_corridor_holds_it() -> None:
    random = np.random.Generator(np.random.PCG64(5))
    corridor = np.array(box(0.0, -1.0, 25.0, 1.0))
    chart = drawn([(x, 0.0) for x in (2.0, 3.0, 4.0)], random, corridor)
    truth = Pose(3.3, 0.1, 0.02)
    found = match(chart, seen(truth, random, corridor), Pose(3.34, 0.08, 0.0), 0.03, SETTINGS)
    assert found is not None
    assert np.abs(error(found, truth)).max() < 0.01
    assert found.noise[0, 0] < 0.02**2


def test_both_faces_of_a_thin_wall_are_two_lines() -> None:
    """A wall of 6 cm seen from the other side is not where its first face is."""
    random = np.random.Generator(np.random.PCG64(5))
    rooms = np.array(box(-3.0, -2.0, 3.0, 2.0) + box(-0.03, -2.0, 0.03, 0.8))
    chart = drawn([(-1.0, 0.0), (-1.0, 1.0), (0.0, 1.4), (1.0, 0.0)], random, rooms)
    truth = Pose(0.9, 0.1, 3.0)
    off = error(match(chart, seen(truth, random, rooms), Pose(0.88, 0.1, 3.0), 0.02, SETTINGS), truth)
    assert np.hypot(off[0], off[1]) < 0.006


def test_the_map_is_no_surer_than_the_poses_it_was_drawn_from() -> None:
    """The shared error is that of the anchors, moved to the robot: their turn displaces it by the lever."""
    random = np.random.Generator(np.random.PCG64(6))
    covariance = np.array([[4e-4, 1e-4, 2e-5], [1e-4, 9e-4, -1e-5], [2e-5, -1e-5, 1e-5]])
    chart = Map(MapSettings())
    for _ in range(3):
        chart.add(HERE, seen(HERE, random), covariance)
    there = Pose(2.0, 1.0, 0.5)
    found = match(chart, seen(there, random), there, 0.02, SETTINGS)
    assert found is not None
    lever = np.array([[1.0, 0.0, -found.pose.y], [0.0, 1.0, found.pose.x], [0.0, 0.0, 1.0]])
    floor = np.diag([SETTINGS.floor**2, SETTINGS.floor**2, SETTINGS.floor_yaw**2])
    assert found.shared == pytest.approx(lever @ covariance @ lever.T + floor, rel=1e-6)
    assert found.noise[0, 0] < 1e-4  # what is the match's own does not contain it


@pytest.mark.parametrize(
    ("places", "walls", "at"),
    [
        ([], OFFICE, HERE),  # an empty map
        ([(0.0, 0.0)], OFFICE, Pose(7.5, 1.5, 0.0)),  # another room
        ([(0.0, 0.0)], OFFICE + 100.0, HERE),  # no hits
        ([(0.0, 0.0)], OFFICE, Pose(-300.0, 200.0, 0.0)),  # far away
    ],
)
def test_no_match(places: Places, walls: Floats, at: Pose) -> None:
    random = np.random.Generator(np.random.PCG64(7))
    assert match(drawn(places, random), seen(at, random, walls), at, 0.02, SETTINGS) is None


def test_what_lies_a_whole_window_away_is_not_found_here() -> None:
    """Its cells have the same numbers in the window."""
    random = np.random.Generator(np.random.PCG64(8))
    chart = drawn([(0.0, 0.0)], random)
    far = Pose(0.0, chart.settings.across * TILE * chart.resolution, 0.0)
    scan = seen(HERE, random)
    assert match(chart, scan, HERE, 0.02, SETTINGS) is not None
    assert match(chart, scan, far, 0.02, SETTINGS) is None
    assert examine(chart, scan, far) == MatchShares(0.0, 0.0, 0.0, 0.0)


def test_what_contradicts_the_map_is_denied() -> None:
    """At the right pose, and in a place never seen, nothing is; 0.7 m off, much; a screen, its share."""
    random = np.random.Generator(np.random.PCG64(12))
    chart = drawn([(0.0, 0.0)], random)
    fit, denied, known, _ = astuple(examine(chart, seen(HERE, random), HERE))
    assert (fit > 0.95, denied < 0.02, known > 0.95) == (True, True, True)
    far = Pose(7.5, 1.5, 0.0)
    assert examine(chart, seen(far, random), far).known < 0.3
    fit, denied, _, crossed = astuple(examine(chart, seen(Pose(0.6, 0.4, 1.0), random), HERE))
    assert (fit < 0.5, denied > 0.3, crossed > 0.2) == (True, True, True)
    screen = np.concatenate([OFFICE, [(0.8, -1.0, 0.8, 1.0)]])
    fit, denied, _, crossed = astuple(examine(chart, seen(HERE, random, screen), HERE))
    assert denied == pytest.approx(110.0 / 360.0, abs=0.05)
    assert fit == pytest.approx(1.0 - denied)
    assert crossed < 0.02  # what appears hides walls, it is not seen through them
    found = match(chart, seen(HERE, random, screen), Pose(0.02, 0.01, 0.01), 0.02, SETTINGS)
    assert np.abs(error(found, HERE)).max() < 0.01
    assert found is not None
    assert examine(chart, seen(HERE, random, screen), found.pose).denied == pytest.approx(denied, abs=0.05)
