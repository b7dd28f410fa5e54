"""Plans for an outline: narrow doors, corners, length beside the shortest path, goals that are blocked."""

from __future__ import annotations

import tomllib
from itertools import pairwise
from math import atan2, cos, dist, gcd, hypot, inf, pi, radians, remainder, sin
from pathlib import Path as File

import numpy as np
import pytest
from scipy.ndimage import distance_transform_edt
from scipy.sparse import coo_array
from scipy.sparse.csgraph import dijkstra

from brain.belief import Floats, Pose
from brain.planning.costmap import Costmap, Mask, PlannerSettings
from brain.planning.footprint import Footprint, Shape
from brain.planning.planner import NoPath, Path
from brain.planning.polyline import Point, Polyline
from tests.brain.planning.maps import DIFFBOT, EVERYTHING, PlainMap, ask, touches


def along(points: tuple[Point, ...]) -> list[tuple[float, float, float]]:
    """Poses every 2 cm along a path, and every 0.1 rad of a turn at its corners."""
    poses: list[tuple[float, float, float]] = []
    for (ax, ay), (bx, by) in pairwise(points):
        yaw, count = atan2(by - ay, bx - ax), 1 + int(dist((ax, ay), (bx, by)) / 0.02)
        if poses:
            turn = remainder(yaw - poses[-1][2], 2.0 * pi)
            poses += [(ax, ay, poses[-1][2] + turn * k / 10.0) for k in range(10)]
        poses += [(ax + (bx - ax) * k / count, ay + (by - ay) * k / count, yaw) for k in range(count + 1)]
    return poses


def walls(gap: float, angle: float, seed: int) -> Mask:
    """A hall of 8 × 6 m, and a wall through its middle, at an angle, with a gap: as a lidar hits it."""
    rng = np.random.Generator(np.random.PCG64(seed))
    occupied = np.zeros((120, 160), bool)
    occupied[[0, -1], :] = occupied[:, [0, -1]] = True
    across = np.arange(gap / 2.0, 6.0, 0.01)
    for off in np.linspace(-0.05, 0.05, 5):
        for side in (1.0, -1.0):
            x = 4.0 + off * cos(angle) - side * across * sin(angle) + rng.normal(0.0, 0.003, len(across))
            y = 3.0 + off * sin(angle) + side * across * cos(angle) + rng.normal(0.0, 0.003, len(across))
            inside = (x > 0.0) & (x < 8.0) & (y > 0.0) & (y < 6.0)
            occupied[(y[inside] / 0.05).astype(int), (x[inside] / 0.05).astype(int)] = True
    return occupied


@pytest.mark.parametrize("degrees", [0, 10, 22.5, 30, 45, 60, 75, 90])
def test_a_robot_0_24_m_wide_passes_a_door_of_0_45_m_at_any_angle(degrees: float) -> None:
    angle = radians(degrees)
    occupied, far = walls(0.45, angle, int(degrees)), 2.2
    start = Pose(4.0 - far * cos(angle), 3.0 - far * sin(angle), 0.0)
    goal = (4.0 + far * cos(angle) + 0.4 * sin(angle), 3.0 + far * sin(angle) - 0.4 * cos(angle), None)
    found, _ = ask(occupied, DIFFBOT, start, goal)
    assert isinstance(found, Path)
    assert not touches(occupied, DIFFBOT, along(found.points))
    assert Polyline(found.points).length <= 1.05 * (far + hypot(far, 0.4))


def test_a_circle_does_not_pass_it_and_the_outline_no_door_narrower_than_itself() -> None:
    start, goal = Pose(1.0, 3.0, 0.0), (7.0, 3.0, None)
    assert isinstance(ask(walls(0.45, 0.0, 1), Shape.circle(0.25), start, goal)[0], NoPath)
    assert isinstance(ask(walls(0.22, 0.0, 1), DIFFBOT, start, goal)[0], NoPath)


@pytest.mark.parametrize("seed", [1, 3])
def test_no_cell_is_inside_the_outline_anywhere_along_a_path(seed: int) -> None:
    """Single cells all over: the oracle tests every pose against every cell."""
    rng = np.random.Generator(np.random.PCG64(seed))
    occupied = rng.random((70, 70)) < 0.02
    found_any = 0
    for _ in range(4):
        ax, ay, bx, by = rng.uniform(0.4, 3.1, 4).tolist()
        found, _ = ask(occupied, DIFFBOT, Pose(ax, ay, 0.0), (bx, by, None))
        if isinstance(found, Path):
            found_any += 1
            first = next(i for i, p in enumerate(found.points) if dist(p, (ax, ay)) >= found.escape - 1e-9)
            way = found.points[first:]
            if found.gears is None:
                assert not touches(occupied, DIFFBOT, along(way)), f"seed {seed}"
    assert found_any, f"seed {seed}"


def test_the_check_of_poses_is_that_of_the_oracle() -> None:
    rng = np.random.Generator(np.random.PCG64(5))
    occupied = rng.random((60, 60)) < 0.03
    _, ground = ask(occupied, DIFFBOT, Pose(1.5, 1.5, 0.0), (1.6, 1.5, None))
    x, y, yaw = rng.uniform(0.5, 2.5, 400), rng.uniform(0.5, 2.5, 400), rng.uniform(-pi, pi, 400)
    hit = Footprint(DIFFBOT, 0.05).collides(ground, x, y, yaw)
    inside = [touches(occupied, DIFFBOT, [pose]) for pose in zip(x, y, yaw, strict=True)]
    assert all(found for found, true in zip(hit, inside, strict=True) if true)
    assert 0.5 < np.mean(inside) / np.mean(hit) < 1.0


# -- lengths ---------------------------------------------------------------------------------------

LOW = (-2.0, -3.5)
"""m: the corner of the office's picture"""


def office(cell: float) -> Mask:
    """fixtures/worlds/office.toml from above, with cells of this size [m]."""
    world = tomllib.loads(File("fixtures/worlds/office.toml").read_text())
    x, y = np.meshgrid(
        LOW[0] + (np.arange(9.0 / cell) + 0.5) * cell, LOW[1] + (np.arange(7.0 / cell) + 0.5) * cell
    )
    occupied = np.zeros(x.shape, bool)
    for wall in world["walls"].values():
        (ax, ay), (bx, by) = wall["start"], wall["end"]
        half = 0.05 + cell / 2.0
        occupied |= (abs(x - (ax + bx) / 2) <= abs(ax - bx) / 2 + half) & (
            abs(y - (ay + by) / 2) <= abs(ay - by) / 2 + half
        )
    for box in world["boxes"].values():
        c, s, (long, wide, _) = cos(box.get("yaw", 0.0)), sin(box.get("yaw", 0.0)), box["size"]
        u, v = c * (x - box["x"]) + s * (y - box["y"]), c * (y - box["y"]) - s * (x - box["x"])
        occupied |= (abs(u) <= (long + cell) / 2) & (abs(v) <= (wide + cell) / 2)
    return occupied


def shortest(start: Point, goals: list[Point], clearance: float) -> list[float]:
    """The lengths [m] of the shortest paths that keep this far from everything: SciPy's Dijkstra on
    cells of 25 mm with 40 directions and more, which is less than 1 % too long."""
    cell = 0.025
    free = (distance_transform_edt(~office(cell)) - 0.5) * cell > clearance
    height, width = free.shape
    numbers = np.arange(free.size).reshape(free.shape)
    tails, heads, lengths = [], [], []
    for up in range(6):
        for right in range(-5, 6):
            if gcd(up, abs(right)) != 1 or (up == 0 and right < 0):
                continue
            first, last = max(-right, 0), width - max(right, 0)
            open_ = free[: height - up, first:last] & free[up:, first + right : last + right]
            for k in range(1, max(up, abs(right))):
                row, column = (round(k * each / max(up, abs(right))) for each in (up, right))
                open_ &= free[row : height - up + row, first + column : last + column]
            tails.append(numbers[: height - up, first:last][open_])
            heads.append(numbers[up:, first + right : last + right][open_])
            lengths.append(np.full(int(open_.sum()), hypot(up, right) * cell))
    entries = (np.concatenate(lengths), (np.concatenate(tails), np.concatenate(heads)))
    graph = coo_array(entries, shape=(free.size, free.size)).tocsr()

    def at(place: Point) -> int:
        return int(numbers[int((place[1] - LOW[1]) / cell), int((place[0] - LOW[0]) / cell)])

    found: Floats = dijkstra(graph, directed=False, indices=at(start))
    return [float(found[at(goal)]) for goal in goals]


def test_paths_of_the_office_are_at_most_1_05_times_the_shortest() -> None:
    """Of those that keep a circle of 0.25 m free, as the robot file says; the two legs round corners."""
    occupied = office(0.05)
    for start, goal in (((1.6, 0.6), (5.6, 1.0)), ((3.4, -2.2), (0.2, 1.8))):
        (optimum,) = shortest(start, [goal], 0.25)
        here, there = ((x - LOW[0], y - LOW[1]) for x, y in (start, goal))
        found, _ = ask(occupied, DIFFBOT, Pose(*here, 0.0), (*there, None))
        assert isinstance(found, Path)
        assert optimum < inf
        assert optimum * 0.99 <= Polyline(found.points).length <= 1.05 * optimum


def test_corners_are_round() -> None:
    """No corner of more than 15° where there is room for a curve, and no curve tighter than 0.15 m."""
    occupied = np.zeros((120, 120), bool)
    occupied[:70, 58:62] = True
    found, _ = ask(occupied, DIFFBOT, Pose(1.0, 1.0, 0.0), (5.0, 1.0, None))
    assert isinstance(found, Path)
    way = np.array(found.points)
    steps = np.diff(way, axis=0)
    turns = np.abs(np.diff(np.unwrap(np.arctan2(steps[:, 1], steps[:, 0]))))
    assert turns.max() < radians(15.0)
    curvature = turns / np.minimum(*(np.hypot(*part.T) for part in (steps[1:], steps[:-1])))
    assert curvature.max() < 1.0 / 0.15


# -- goals that are blocked ------------------------------------------------------------------------


def test_a_goal_in_a_closed_room_is_approached_as_near_as_can_be_if_asked() -> None:
    occupied = np.zeros((100, 100), bool)
    occupied[30:70, [50, 89]] = occupied[[30, 69], 50:90] = True
    start, goal = Pose(1.0, 2.5, 0.0), (3.0, 2.5, None)
    assert isinstance(ask(occupied, DIFFBOT, start, goal)[0], NoPath)
    found, ground = ask(occupied, DIFFBOT, start, goal, near=True)
    assert isinstance(found, Path)
    assert found.points[-1] == pytest.approx((2.225, 2.5), abs=0.06)
    assert found.short_of == pytest.approx(dist(found.points[-1], goal[:2]))
    assert ground.index(*found.points[-1]) is not None


def test_a_goal_in_a_box_is_approached_from_the_side_that_can_be_reached() -> None:
    occupied = np.zeros((100, 100), bool)
    occupied[:, 60] = True
    occupied[40:60, 40:61] = True
    found, _ = ask(occupied, DIFFBOT, Pose(1.0, 2.5, 0.0), (2.9, 2.5, None), near=True)
    assert isinstance(found, Path)
    assert found.points[-1][0] < 2.0 + 1.0
    assert 0.5 < found.short_of < 1.2


def test_the_clearance_is_that_of_the_outline_where_not_every_heading_fits() -> None:
    """A long car beside a wall: against each occupied cell in turn, in the frame of the car. Before a corner
    of the outline it may be less, by as much as the corner is nearer than the lines of its sides."""
    car = Shape(0.1, hypot(0.4, 0.2), ((0.4, -0.1), (0.4, 0.1), (-0.1, 0.1), (-0.1, -0.1)), 0.5)
    occupied = np.zeros((80, 80), bool)
    occupied[[0, -1], :] = occupied[:, [0, -1]] = occupied[40, 40:45] = True
    grid = PlainMap(occupied, low=(0, 0), resolution=0.05)
    costmap = Costmap(0.05, car.inner, PlannerSettings(), car.outer)
    costmap.update(grid, (2.0, 2.0), EVERYTHING)
    footprint, rng, seen = Footprint(car, 0.05), np.random.default_rng(3), 0
    rows, columns = np.nonzero(occupied)
    for x, y, yaw in rng.uniform((1.0, 1.0, -pi), (3.0, 3.0, pi), (400, 3)):
        dx, dy = (columns + 0.5) * 0.05 - x, (rows + 0.5) * 0.05 - y
        ahead, left = cos(yaw) * dx + sin(yaw) * dy, cos(yaw) * dy - sin(yaw) * dx
        beyond = np.maximum(np.maximum(ahead - 0.4, -0.1 - ahead), 0.0), np.maximum(np.abs(left) - 0.1, 0.0)
        nearest = float(np.hypot(*beyond).min()) - 0.025
        found = footprint.clearance(costmap, Pose(x, y, yaw), 0.15)
        if 0.0 < costmap.clearance(x, y) <= 0.05:
            seen += nearest < 0.15
            assert min(nearest / 2**0.5 - 0.01, 0.15) <= found <= min(max(nearest, 0.0), 0.15) + 1e-9
        else:
            assert found == costmap.clearance(x, y)
    assert seen > 10
