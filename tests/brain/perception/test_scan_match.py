import math

import numpy as np
import pytest

from brain.belief import Pose
from brain.bodies.differential import wrap
from brain.perception.grid import Grid, GridSettings
from brain.perception.mount import BodyScan, to_body
from brain.perception.scan_match import Match, MatchSettings, contradicts_map, match
from tests.brain.perception.office import MOUNTS, OFFICE, box, scan_at

LIDAR = MOUNTS["lidar"]
SETTINGS = MatchSettings()


def seen(
    pose: Pose, random: np.random.Generator, walls: np.ndarray = OFFICE, sigma: float = 0.01
) -> BodyScan:
    return to_body(scan_at(walls, pose, LIDAR, 0, sigma * random.normal(size=360)), LIDAR)


def drawn(
    poses: list[Pose],
    random: np.random.Generator,
    walls: np.ndarray = OFFICE,
    settings: GridSettings | None = None,
) -> Grid:
    grid = Grid(settings or GridSettings())
    for pose in poses:
        for _ in range(5):
            grid.add(pose, seen(pose, random, walls))
    return grid


def error(found: Match | None, truth: Pose) -> np.ndarray:
    assert found is not None
    pose = found.pose
    return np.array([pose.x - truth.x, pose.y - truth.y, wrap(pose.yaw - truth.yaw)])


@pytest.mark.parametrize("seed", range(6))
def test_a_wrong_guess_is_put_right(seed: int) -> None:
    """Off by up to 6 cm and 2°: found to 1.5 cm and 0.3°."""
    random = np.random.Generator(np.random.PCG64(seed))
    grid = drawn([Pose(0.0, 0.0, 0.0), Pose(1.0, 0.5, 0.5)], random)
    truth = Pose(0.6, 0.2, 0.4)
    for _ in range(5):
        dx, dy, turn = (float(n) for n in random.uniform(-1.0, 1.0, 3) * [0.06, 0.06, 0.035])
        guess = Pose(truth.x + dx, truth.y + dy, truth.yaw + turn)
        off = error(match(grid, seen(truth, random), guess, SETTINGS), truth)
        assert math.hypot(off[0], off[1]) < 0.015, f"seed {seed}"
        assert abs(off[2]) < 0.005, f"seed {seed}"


def test_a_poor_guess_needs_to_be_called_one() -> None:
    random = np.random.Generator(np.random.PCG64(9))
    grid = drawn([Pose(0.0, 0.0, 0.0)], random)
    truth = Pose(0.1, 0.0, 0.1)
    guess = Pose(0.35, -0.2, 0.1)
    found = match(grid, seen(truth, random), guess, SETTINGS, sigma=0.15)
    assert np.hypot(*error(found, truth)[:2]) < 0.03


def test_the_covariance_covers_the_error() -> None:
    random = np.random.Generator(np.random.PCG64(11))
    grid = drawn([Pose(0.0, 0.0, 0.0), Pose(1.0, 0.5, 0.5)], random)
    distances = []
    for _ in range(60):
        x, y, yaw = (float(n) for n in random.uniform(0.0, 0.6, 3))
        truth = Pose(x, y, yaw)
        found = match(grid, seen(truth, random), Pose(x + 0.02, y - 0.02, yaw + 0.01), SETTINGS)
        off = error(found, truth)
        assert found is not None
        distances.append(float(off @ np.linalg.solve(found.noise, off)))
    assert np.mean(distances) < 3.0  # of 3 degrees of freedom: at least as wide as the error
    assert np.max(distances) < 16.3


def test_along_a_bare_corridor_nothing_is_known() -> None:
    """Its end is out of sight: across and the heading are found, the way along stays as guessed."""
    random = np.random.Generator(np.random.PCG64(4))
    corridor = np.array(box(-30.0, -1.0, 30.0, 1.0))
    grid = drawn([Pose(0.0, 0.0, 0.0), Pose(0.3, 0.0, 0.0)], random, corridor)
    truth, guess = Pose(0.5, 0.1, 0.02), Pose(0.55, 0.14, 0.0)
    found = match(grid, seen(truth, random, corridor), guess, SETTINGS)
    assert found is not None
    assert found.pose.x == pytest.approx(guess.x, abs=0.005)
    assert found.pose.y == pytest.approx(truth.y, abs=0.01)
    assert found.pose.yaw == pytest.approx(truth.yaw, abs=0.005)
    assert found.noise[0, 0] > 100.0
    across = np.linalg.inv(found.noise)[1, 1]
    assert across > 1.0 / 0.03**2


def test_both_faces_of_a_thin_wall_are_two_lines() -> None:
    """A wall of 6 cm seen from the other side is not where its first face is."""
    random = np.random.Generator(np.random.PCG64(5))
    rooms = np.array(box(-3.0, -2.0, 3.0, 2.0) + box(-0.03, -2.0, 0.03, 0.8))
    grid = drawn([Pose(-1.0, 0.0, 0.0), Pose(-1.0, 1.0, 0.0), Pose(0.0, 1.4, 0.0)], random, rooms)
    for _ in range(5):
        grid.add(Pose(1.0, 0.0, math.pi), seen(Pose(1.0, 0.0, math.pi), random, rooms))
    truth = Pose(0.9, 0.1, 3.0)
    found = match(grid, seen(truth, random, rooms), Pose(0.88, 0.1, 3.0), SETTINGS)
    assert np.hypot(*error(found, truth)[:2]) < 0.012


def test_an_empty_map_has_no_match() -> None:
    random = np.random.Generator(np.random.PCG64(6))
    here = Pose(0.0, 0.0, 0.0)
    assert match(Grid(GridSettings()), seen(here, random), here, SETTINGS) is None


def test_another_place_has_no_match() -> None:
    """A scan of the far room on a map of the near one."""
    random = np.random.Generator(np.random.PCG64(7))
    grid = drawn([Pose(0.0, 0.0, 0.0)], random)
    far = Pose(7.5, 1.5, 0.0)
    assert match(grid, seen(far, random), far, SETTINGS) is None


def test_no_hits_no_match() -> None:
    random = np.random.Generator(np.random.PCG64(8))
    grid = drawn([Pose(0.0, 0.0, 0.0)], random)
    void = to_body(scan_at(OFFICE + 100.0, Pose(0.0, 0.0, 0.0), LIDAR, 0), LIDAR)
    assert match(grid, void, Pose(0.0, 0.0, 0.0), SETTINGS) is None


def test_what_contradicts_the_map_does_not_fit() -> None:
    """At the right pose, and in a place never seen, nothing is contradicted; half a metre off, much is."""
    random = np.random.Generator(np.random.PCG64(12))
    here = Pose(0.0, 0.0, 0.0)
    grid = drawn([here], random)
    assert not contradicts_map(grid, seen(here, random), here, SETTINGS)
    assert contradicts_map(grid, seen(Pose(0.6, 0.4, 1.0), random), here, SETTINGS)
    assert not contradicts_map(grid, seen(Pose(7.5, 1.5, 0.0), random), Pose(7.5, 1.5, 0.0), SETTINGS)
    assert not contradicts_map(grid, seen(here, random), Pose(90.0, 0.0, 0.0), SETTINGS)


def test_at_the_edge_of_the_map() -> None:
    """Points that lie outside, or too near the edge to look about, are left out, and nothing breaks."""
    random = np.random.Generator(np.random.PCG64(10))
    small = GridSettings(width=4.0, height=4.0)
    grid = drawn([Pose(0.0, 0.0, 0.0)], random, settings=small)
    found = match(grid, seen(Pose(1.5, 1.5, 0.0), random), Pose(1.5, 1.5, 0.0), SETTINGS)
    assert found is None or np.isfinite(found.noise).all()
