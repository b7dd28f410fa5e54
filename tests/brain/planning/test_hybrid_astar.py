"""Hybrid A*: a car's paths end where they should, bend no more than it can, touch nothing, and are short."""

from __future__ import annotations

import copy
from itertools import pairwise
from math import cos, dist, hypot, pi, remainder, sin

import numpy as np
import pytest

from brain.belief import Pose
from brain.planning.astar import Searching, Unreachable
from brain.planning.costmap import Mask, PlannerSettings
from brain.planning.footprint import Footprint
from brain.planning.hybrid_astar import BATCH, HybridSearch
from brain.planning.planner import FrontierPath, NoPath, Path
from brain.planning.snapshot import Halved
from brain.planning.ways import WORDS_WORK, Prices, Way, Ways
from tests.brain.planning.maps import CAR, ask, touches


def rooms() -> Mask:
    """Two rooms of 3 × 4 m, a doorway of 0.9 m, a box."""
    occupied = np.zeros((80, 120), bool)
    occupied[[0, -1], :] = occupied[:, [0, -1]] = True
    occupied[:, 60:62] = True
    occupied[45:63, 60:62] = False
    occupied[20:30, 25:35] = True
    return occupied


def driven(start: Pose, goal: tuple[float, float, float | None], occupied: Mask) -> Path:
    found, _ = ask(occupied, CAR, start, goal)
    assert isinstance(found, Path), found
    return found


@pytest.mark.parametrize(
    ("start", "goal"),
    [
        (Pose(0.6, 0.6, 0.0), (5.4, 0.8, -pi / 2.0)),
        (Pose(0.6, 3.4, pi), (5.0, 3.0, 0.0)),
        (Pose(1.0, 3.0, 0.0), (1.0, 3.0, pi)),
        (Pose(5.3, 2.0, pi), (1.8, 2.6, None)),
    ],
    ids=["to the other room", "away from the door", "about turn", "no yaw"],
)
def test_a_car_gets_there_without_touching_and_without_turning_too_tightly(
    start: Pose, goal: tuple[float, float, float | None]
) -> None:
    occupied = rooms()
    found = driven(start, goal, occupied)
    assert found.headings is not None
    assert found.gears is not None
    track = [(x, y, yaw) for (x, y), yaw in zip(found.points, found.headings, strict=True)]
    assert dist(track[0], (start.x, start.y, start.yaw)) < 1e-9
    assert dist(found.points[-1], goal[:2]) < 0.01
    assert goal[2] is None or abs(remainder(found.headings[-1] - goal[2], 2.0 * pi)) < 0.01
    assert not touches(occupied, CAR, track)
    for ((ax, ay, a), (bx, by, b)), gear in zip(pairwise(track), found.gears, strict=True):
        step, turn = hypot(bx - ax, by - ay), abs(remainder(b - a, 2.0 * pi))
        assert step <= 0.15
        assert turn <= step / CAR.turning_radius
        assert gear * ((bx - ax) * cos(a) + (by - ay) * sin(a)) > 0.0


def test_an_about_turn_needs_both_gears_and_what_is_behind_is_reached_forward_if_backing_is_dear() -> None:
    occupied = np.zeros((160, 160), bool)
    gears = []
    for goal, reverse, switch in (
        ((4.0, 4.0, pi), 2.0, 0.5),
        ((2.0, 4.0, 0.0), 1.0, 0.0),
        ((2.0, 4.0, 0.0), 50.0, 20.0),
    ):
        settings = PlannerSettings(reverse=reverse, switch=switch)
        found, _ = ask(occupied, CAR, Pose(4.0, 4.0, 0.0), goal, settings)
        assert isinstance(found, Path)
        assert found.gears is not None
        gears.append(set(found.gears))
    assert gears == [{1, -1}, {-1}, {1}]


def test_a_long_way_is_hardly_longer_than_the_shortest() -> None:
    """In a corridor with one bend, beside the way of a point that keeps the inner radius."""
    occupied = np.zeros((60, 400), bool)
    occupied[[0, -1], :] = occupied[:, [0, -1]] = True
    occupied[:30, 200] = True
    found = driven(Pose(1.0, 0.8, 0.0), (19.0, 0.8, 0.0), occupied)
    steps = np.diff(np.array(found.points), axis=0)
    corner = (10.025, 1.5 + 0.15)
    shortest = dist((1.0, 0.8), corner) + dist(corner, (19.0, 0.8))
    assert np.hypot(*steps.T).sum() <= 1.05 * shortest


def test_where_a_car_cannot_get_there_is_no_path_after_a_bounded_search() -> None:
    """A passage that its inner circle fits, but with a corner that its length does not get round."""
    occupied = np.ones((80, 80), bool)
    occupied[5:14, 5:75] = False
    occupied[5:75, 66:75] = False
    found, _ = ask(occupied, CAR, Pose(0.6, 0.475, 0.0), (3.525, 3.4, None))
    assert isinstance(found, NoPath)
    assert "wide enough" in found.reason


def test_unknown_ground_is_explored_from_its_frontier() -> None:
    unknown = np.zeros((80, 120), bool)
    unknown[:, 80:] = True
    found, _ = ask(np.zeros((80, 120), bool), CAR, Pose(1.0, 2.0, 0.0), (5.5, 2.0, pi), unknown=unknown)
    assert isinstance(found, FrontierPath)
    assert found.points[-1][0] == pytest.approx(4.0, abs=0.1)
    assert found.headings is not None
    assert len(found.headings) == len(found.points)


def test_a_car_too_near_to_a_wall_leaves_it_straight() -> None:
    occupied = np.zeros((80, 80), bool)
    occupied[:, 38] = True
    found, _ = ask(occupied, CAR, Pose(1.5, 2.0, 0.0), (0.6, 1.0, None))
    assert isinstance(found, Path)
    assert found.escape > 0.0
    assert found.gears is not None
    assert found.gears[0] == -1
    assert found.points[1][1] == pytest.approx(2.0)
    assert 1.2 < found.points[1][0] < 1.45


def test_it_is_sliced_and_a_deep_copy_continues_alike() -> None:
    _, ground = ask(rooms(), CAR, Pose(0.6, 0.6, 0.0), (0.7, 0.6, None))
    ways = Ways(ground, Footprint(CAR, 0.05), Prices())
    search, copies = HybridSearch(ways, Pose(0.6, 0.6, 0.0), (5.4, 0.8, 0.0)), list[HybridSearch]()
    before, most = 0, 0
    while isinstance(outcome := search.advance(1000), Searching):
        most = max(most, search.work - before - 1000)
        before = search.work
        if len(copies) < 3 and search.work > 300_000 * (1 + len(copies)):
            copies.append(copy.deepcopy(search))
    assert isinstance(outcome, Way)
    assert most < 3 * WORDS_WORK
    assert copies
    for other in copies:
        found = other.advance(10**9)
        assert isinstance(found, Way)
        assert found.gears == outcome.gears
        assert np.array_equal(found.poses, outcome.poses)


def test_larger_cells_are_as_good_as_the_best_of_their_four() -> None:
    _, ground = ask(rooms(), CAR, Pose(0.6, 0.6, 0.0), (0.7, 0.6, None))
    halved = Halved(ground)
    while not halved.complete:
        halved.halve(1)
    inside = 0
    for x, y in np.random.default_rng(2).uniform((-0.2, -0.2), (6.2, 4.2), (500, 2)):
        cell, large = ground.index(x, y), halved.index(x, y)
        assert (cell is None) == (large is None)
        if cell is not None and large is not None:
            (row, column), inside = divmod(cell, ground.stride), inside + 1
            four = [(r, c) for r in (row & ~1, row | 1) for c in (column & ~1, column | 1)]
            prices = [ground.multiplier[ground.level[r * ground.stride + c]] for r, c in four]
            assert halved.multiplier[halved.level[large]] == min(prices)
    assert inside > 300


def test_no_way_for_a_point_is_no_way() -> None:
    occupied = rooms()
    occupied[:, 60] = True
    _, ground = ask(occupied, CAR, Pose(0.6, 0.6, 0.0), (0.7, 0.6, None))
    search = HybridSearch(Ways(ground, Footprint(CAR, 0.05), Prices()), Pose(0.6, 0.6, 0.0), (5.4, 0.8, 0.0))
    assert search.advance(10**9) == Unreachable()
    assert BATCH <= 16
