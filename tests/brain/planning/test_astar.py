"""A*: optimal in its own metric to 1e-9 against scipy's Dijkstra, bounded, repeatable."""

from __future__ import annotations

from math import inf, sqrt

import numpy as np
import pytest

from brain.planning.astar import (
    BATCH,
    BATCH_WORK,
    BEYOND,
    CellPath,
    CellSearch,
    Outcome,
    Searching,
    Unreachable,
)
from brain.planning.costmap import FREE, UNKNOWN, Mask, PlannerSettings
from brain.planning.polyline import Point
from brain.planning.snapshot import Snapshot
from tests.brain.helpers import dijkstra
from tests.brain.planning.maps import PlainMap, drawn, ground


def picture(*rows: str) -> tuple[Mask, Mask]:
    """`#` blocked, `?` unknown, `.` free; the first line is the top, as on paper."""
    cells = np.array([list(row) for row in reversed(rows)])
    return cells == "#", cells == "?"


def at(there: Snapshot, row: int, column: int) -> int:
    """The cell in this row and column of the picture, from below."""
    return (row + 2) * there.stride + column + 2


def run(search: CellSearch, slice_: int = 500) -> Outcome:
    for _ in range(100_000):
        outcome = search.advance(slice_)
        if not isinstance(outcome, Searching):
            return outcome
    raise AssertionError("the search does not end")


def random_map(rng: np.random.Generator, size: int, share: float) -> Mask:
    blocked: Mask = rng.random((size, size)) < share
    blocked[size // 2, : size // 3] = True
    return blocked


@pytest.mark.parametrize("seed", range(12))
@pytest.mark.parametrize("dislike", [0.0, 3.0])
def test_cost_is_the_eight_connected_optimum(seed: int, dislike: float) -> None:
    """Not 4-connected, not Manhattan: the cost equals Dijkstra's to 1e-9, walls disliked or not."""
    rng = np.random.Generator(np.random.PCG64(seed))
    there = ground(random_map(rng, 40, 0.1 + 0.02 * seed), comfort=0.3, dislike=dislike)
    free = [cell for cell, level in enumerate(there.level) if FREE <= level < UNKNOWN]
    start, goal = (int(c) for c in rng.choice(free, 2, replace=False))
    optimum = dijkstra(there, start, goal)
    outcome = run(CellSearch(there, start, goal))
    if optimum == inf:
        assert outcome == Unreachable()
    else:
        assert isinstance(outcome, CellPath)
        assert outcome.cost == pytest.approx(optimum, abs=1e-9)


def test_an_empty_map_costs_the_octile_distance() -> None:
    there = ground(np.zeros((30, 30), bool))
    start, goal = there.index(0.05, 0.05), there.index(2.05, 0.75)
    assert start is not None
    assert goal is not None
    outcome = run(CellSearch(there, start, goal))
    assert isinstance(outcome, CellPath)
    assert outcome.cost == pytest.approx(0.1 * (13 + 7 * sqrt(2.0)), abs=1e-12)
    assert (outcome.cells[0], outcome.cells[-1]) == (start, goal)


def test_a_diagonal_gap_between_two_corners_is_closed() -> None:
    blocked, unknown = picture(
        "..#",
        ".#.",
        "#..",
    )
    there = ground(blocked, unknown)
    assert run(CellSearch(there, at(there, 2, 0), at(there, 0, 2))) == Unreachable()


def test_unknown_is_never_planned_through_unless_allowed() -> None:
    blocked, unknown = picture(
        "..?..",
        "..?..",
    )
    there = ground(blocked, unknown)
    start, goal = at(there, 0, 0), at(there, 0, 4)
    assert run(CellSearch(there, start, goal)) == Unreachable()
    assumed = run(CellSearch(there, start, goal, through_unknown=1.2))
    assert isinstance(assumed, CellPath)
    assert assumed.cost == pytest.approx(0.1 * (3 + 1.2))
    assert isinstance(run(CellSearch(ground(blocked, unknown, free=True), start, goal)), CellPath)


def test_failure_is_typed_and_never_a_partial_path() -> None:
    """The usual defect returns came_from.get(goal), an empty or partial path, on failure."""
    blocked, unknown = picture(
        ".#.",
        ".#.",
    )
    there = ground(blocked, unknown)
    search = CellSearch(there, at(there, 0, 0), at(there, 0, 2))
    assert run(search) == Unreachable()
    assert search.advance(10) == Unreachable()
    blocked_goal = CellSearch(there, at(there, 0, 0), at(there, 0, 1))
    assert blocked_goal.advance(1) == Unreachable()


def test_start_is_the_goal() -> None:
    there = ground(np.zeros((4, 4), bool))
    cell = at(there, 1, 2)
    assert run(CellSearch(there, cell, cell)) == CellPath((cell,), 0.0)


def test_each_call_is_bounded_by_expansions_and_slicing_changes_nothing() -> None:
    rng = np.random.Generator(np.random.PCG64(4))
    there = ground(random_map(rng, 60, 0.2), comfort=0.3, dislike=2.0)
    free = [cell for cell, level in enumerate(there.level) if FREE <= level < UNKNOWN]
    start, goal = free[0], free[-1]
    search, total = CellSearch(there, start, goal), 0
    while isinstance(outcome := search.advance(7), Searching):
        assert outcome.work - total <= 7 + BATCH + BATCH_WORK
        total = outcome.work
    assert total > 10 * BATCH_WORK
    assert run(CellSearch(there, start, goal), 10**9) == outcome == run(CellSearch(there, start, goal), 1)


@pytest.mark.parametrize("goal", [(9.0, 2.0), (-3.0, 7.5), (2.0, -1.0), (1.0, 30.0), (-4.0, -6.0)])
def test_a_goal_beyond_costs_as_much_as_if_the_unknown_ground_belonged_to_the_snapshot(goal: Point) -> None:
    """Around the region, too: a snapshot that contains the goal is the oracle."""
    rng = np.random.Generator(np.random.PCG64(6))
    grid = PlainMap(random_map(rng, 60, 0.25), low=(0, 0))
    costmap, start, costs = drawn(grid, 0.0, PlannerSettings(margin=0.0)), (3.05, 3.05), []
    for here in (start, goal):
        region = Snapshot(costmap, here, goal, ())
        assert region.assemble(costmap, grid, 10**6) > 0
        first, last = region.index(*start), region.index(*goal)
        assert first is not None
        if last is not None:
            costs.append(dijkstra(region, first, last, 1.2))
            continue
        found = run(CellSearch(region, first, BEYOND, beyond=region.goal, through_unknown=1.2))
        assert isinstance(found, CellPath)
        costs.append(found.cost)
    assert len(costs) == 2
    assert costs[0] == pytest.approx(costs[1], abs=1e-9)
