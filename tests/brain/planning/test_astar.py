"""A*: optimal in its own metric to 1e-9 against scipy's Dijkstra, bounded, repeatable."""

from __future__ import annotations

from math import inf, sqrt

import numpy as np
import pytest

from brain.planning.astar import CellPath, Outcome, Search, Searching, Unreachable
from brain.planning.costmap import BLOCKED, UNKNOWN, Mask
from tests.brain.helpers import dijkstra
from tests.brain.planning.test_planner import costmap_of


def picture(*rows: str) -> tuple[Mask, Mask]:
    """`#` blocked, `?` unknown, `.` free; the first line is the top, as on paper."""
    cells = np.array([list(row) for row in reversed(rows)])
    return cells == "#", cells == "?"


def run(search: Search, slice_: int = 500) -> Outcome:
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
    there = costmap_of(random_map(rng, 40, 0.1 + 0.02 * seed), comfort=0.3, dislike=dislike)
    free = [cell for cell, level in enumerate(there.level) if level != BLOCKED]
    start, goal = (int(c) for c in rng.choice(free, 2, replace=False))
    optimum = dijkstra(there, start, goal)
    outcome = run(Search(there, start, goal))
    if optimum == inf:
        assert outcome == Unreachable()
    else:
        assert isinstance(outcome, CellPath)
        assert outcome.cost == pytest.approx(optimum, abs=1e-9)


def test_an_empty_map_costs_the_octile_distance() -> None:
    there = costmap_of(np.zeros((30, 30), bool))
    start, goal = there.index(0.05, 0.05), there.index(2.05, 0.75)
    assert start is not None
    assert goal is not None
    outcome = run(Search(there, start, goal))
    assert isinstance(outcome, CellPath)
    assert outcome.cost == pytest.approx(0.1 * (13 + 7 * sqrt(2.0)), abs=1e-12)
    assert (outcome.cells[0], outcome.cells[-1]) == (start, goal)


def test_a_diagonal_gap_between_two_corners_is_closed() -> None:
    blocked, unknown = picture(
        "..#",
        ".#.",
        "#..",
    )
    there = costmap_of(blocked, unknown)
    assert run(Search(there, 3 * 5 + 1, 1 * 5 + 3)) == Unreachable()


def test_unknown_is_never_planned_through_unless_allowed() -> None:
    blocked, unknown = picture(
        "..?..",
        "..?..",
    )
    start, goal = 1 * 7 + 1, 1 * 7 + 5
    assert run(Search(costmap_of(blocked, unknown), start, goal)) == Unreachable()
    assumed = run(Search(costmap_of(blocked, unknown), start, goal, through_unknown=True))
    assert isinstance(assumed, CellPath)
    there = costmap_of(blocked, unknown, unknown_is_free=True)
    assert UNKNOWN not in there.level
    assert isinstance(run(Search(there, start, goal)), CellPath)


def test_failure_is_typed_and_never_a_partial_path() -> None:
    """The usual defect returns came_from.get(goal), an empty or partial path, on failure."""
    blocked, unknown = picture(
        ".#.",
        ".#.",
    )
    there = costmap_of(blocked, unknown)
    search = Search(there, 1 * 5 + 1, 1 * 5 + 3)
    assert run(search) == Unreachable()
    assert search.advance(10) == Unreachable()
    blocked_goal = Search(there, 1 * 5 + 1, 1 * 5 + 2)
    assert blocked_goal.advance(1) == Unreachable()


def test_start_is_the_goal() -> None:
    there = costmap_of(np.zeros((4, 4), bool))
    assert run(Search(there, 14, 14)) == CellPath((14,), 0.0)


def test_each_call_is_bounded_by_expansions_and_slicing_changes_nothing() -> None:
    rng = np.random.Generator(np.random.PCG64(4))
    there = costmap_of(random_map(rng, 60, 0.2), comfort=0.3, dislike=2.0)
    free = [cell for cell, level in enumerate(there.level) if level != BLOCKED]
    start, goal = free[0], free[-1]
    search, total = Search(there, start, goal), 0
    while isinstance(outcome := search.advance(7), Searching):
        assert outcome.expansions - total <= 7
        total = outcome.expansions
    assert total > 100
    assert run(Search(there, start, goal), 10**9) == outcome == run(Search(there, start, goal), 1)
