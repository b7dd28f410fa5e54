"""Search by blocks: it reaches what A* on cells reaches, at hardly more cost, however it is sliced; and the
answers of a navigator, whatever the rate of its ticks."""

from __future__ import annotations

import copy
from itertools import pairwise
from math import inf

import numpy as np
import pytest

from benchmarks import plans
from brain.planning import planner
from brain.planning.astar import BEYOND, CellPath, CellSearch, Searching, Unreachable
from brain.planning.blocks import BlockSearch, CornerPath
from brain.planning.costmap import FREE, UNKNOWN, Mask, PlannerSettings
from brain.planning.planner import FrontierPath, NoPath, Path
from brain.planning.polyline import Polyline
from brain.planning.snapshot import Snapshot, is_blocked
from protocols.messages import SECOND
from tests.brain.helpers import dijkstra
from tests.brain.planning.maps import EVERYTHING, PlainMap, drawn, ground, plan, query, two_rooms

DEARER = 1.15
"""How much more a way by blocks may cost than the cheapest on cells: it is made shorter afterwards"""


def blobs(seed: int, size: int, share: float) -> Mask:
    """Obstacles of 3 × 3 cells."""
    rng = np.random.Generator(np.random.PCG64(seed))
    coarse = rng.random((size // 3, size // 3)) < share
    return np.repeat(np.repeat(coarse, 3, axis=0), 3, axis=1)


def ends(there: Snapshot, seed: int) -> tuple[int, int]:
    free = np.flatnonzero((there.level >= FREE) & (there.level < UNKNOWN))
    start, goal = np.random.Generator(np.random.PCG64(seed)).choice(free, 2, replace=False).tolist()
    return start, goal


@pytest.mark.parametrize(("share", "seeds"), [(0.05, 3), (0.3, 3), (0.4, 8), (0.45, 4)])
def test_what_can_be_reached_is_exact_and_what_it_costs_nearly(share: float, seeds: int) -> None:
    """Where obstacles are so dense that about half of the goals cannot be reached, too."""
    reached = 0
    for seed in range(seeds):
        there = ground(blobs(seed, 120, share), comfort=0.3, dislike=0.5)
        start, goal = ends(there, seed)
        optimum = dijkstra(there, start, goal)
        outcome = BlockSearch(there, start, goal).advance(EVERYTHING)
        assert isinstance(outcome, CornerPath) == (optimum < inf), f"seed {seed}"
        if isinstance(outcome, CornerPath):
            reached += 1
            assert (outcome.cells[0], outcome.cells[-1], outcome.frontier) == (start, goal, None)
            centres = [there.centre(cell) for cell in outcome.cells]
            assert not any(is_blocked(there, a, b, FREE) for a, b in pairwise(centres)), f"seed {seed}"
            assert outcome.cost <= DEARER * optimum + 1.0, f"seed {seed}"
    assert (reached == seeds, reached == 0) == (share < 0.4, share > 0.4)


def test_single_cells_and_diagonals() -> None:
    """No corner is cut between two blocks, either: all ways across pictures of very few cells."""
    rng = np.random.Generator(np.random.PCG64(5))
    for trial in range(40):
        there = ground(rng.random((24, 24)) < 0.4)
        start, goal = ends(there, trial)
        outcome = BlockSearch(there, start, goal).advance(EVERYTHING)
        assert isinstance(outcome, CornerPath) == (dijkstra(there, start, goal) < inf), f"trial {trial}"


def test_however_it_is_sliced_and_copied_the_way_is_the_same() -> None:
    there = ground(blobs(3, 240, 0.3), comfort=0.3, dislike=0.5)
    start, goal = ends(there, 1)
    whole = BlockSearch(there, start, goal).advance(EVERYTHING)
    assert isinstance(whole, CornerPath)
    search, copies = BlockSearch(there, start, goal), []
    for number in range(100_000):
        if number % 20 == 0:
            copies.append(copy.deepcopy(search))
        if not isinstance(outcome := search.advance(7), Searching):
            break
    assert outcome == whole
    assert len(copies) > 5
    assert all(other.advance(EVERYTHING) == whole for other in copies)


@pytest.mark.parametrize("goal", [(30.0, 3.0), (-9.0, 40.0), (7.0, -20.0)])
def test_a_goal_beyond_the_known_ground(goal: tuple[float, float]) -> None:
    grid = PlainMap(blobs(2, 150, 0.2), low=(0, 0))
    costmap, here = drawn(grid, 0.0, PlannerSettings(margin=0.0)), (7.55, 7.55)
    region = Snapshot(costmap, here, goal, ())
    assert region.assemble(costmap, grid, EVERYTHING) > 0
    start = region.index(*here)
    assert start is not None
    how = {"beyond": region.goal, "through_unknown": 1.2}
    exact = CellSearch(region, start, BEYOND, **how).advance(EVERYTHING)  # type: ignore[arg-type]
    found = BlockSearch(region, start, BEYOND, **how).advance(EVERYTHING)  # type: ignore[arg-type]
    assert isinstance(exact, CellPath)
    assert isinstance(found, CornerPath)
    assert found.frontier is not None
    _, last, unknown = found.frontier
    assert region.level[last] < UNKNOWN <= region.level[unknown]


def test_a_goal_in_a_closed_room_is_known_soon() -> None:
    """Not after all that can be reached was, of which there is nine times as much."""
    work = []
    for size in (300, 900):
        occupied = np.zeros((size, size), bool)
        occupied[-30, -30:] = occupied[-30:, -30] = True
        there = ground(occupied)
        start, goal = there.index(0.55, 0.55), there.index(size / 10 - 1.0, size / 10 - 1.0)
        assert start is not None
        assert goal is not None
        search = BlockSearch(there, start, goal)
        assert search.advance(EVERYTHING) == Unreachable()
        work.append(search.work)
    assert work[1] < 2 * work[0]


UNSEEN = np.zeros((40, 60), bool)
UNSEEN[:, 31:] = True
CLOSED = two_rooms(door=(0, 0))


OPEN = two_rooms()
OPEN[:, [0, -1]] = False
DARING = PlannerSettings(unknown_is_free=True)


@pytest.mark.parametrize(
    ("occupied", "unknown", "goal", "settings", "kind"),
    [
        (two_rooms(), None, (4.0, 1.2), None, Path),
        (two_rooms(), UNSEEN, (4.0, 1.2), None, FrontierPath),
        (two_rooms(), UNSEEN, (4.0, 1.2), DARING, Path),
        (OPEN, None, (30.0, 0.5), None, FrontierPath),
        (OPEN, None, (30.0, 0.5), DARING, Path),
        (CLOSED, None, (4.0, 1.2), None, NoPath),
    ],
    ids=["known", "unknown", "unknown is free", "beyond", "beyond is free", "closed"],
)
def test_a_query_by_blocks_has_the_answer_of_one_on_cells(
    occupied: Mask,
    unknown: Mask | None,
    goal: tuple[float, float],
    settings: PlannerSettings | None,
    kind: type,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    grid, start = PlainMap(occupied, unknown), (0.0, -1.0)
    exact = plan(grid, start, goal, settings)
    monkeypatch.setattr(planner, "CELLS_WORK", 0)
    found = plan(grid, start, goal, settings)
    assert type(found) is type(exact) is kind
    if isinstance(exact, NoPath):
        assert found == exact
    elif isinstance(exact, Path | FrontierPath) and isinstance(found, Path | FrontierPath):
        ground = drawn(grid, settings=settings)
        assert not any(is_blocked(ground, a, b, FREE) for a, b in pairwise(found.points))
        assert Polyline(found.points).length <= 1.05 * Polyline(exact.points).length


def test_a_closed_goal_is_approached_by_blocks(monkeypatch: pytest.MonkeyPatch) -> None:
    asked = []
    for work in (planner.CELLS_WORK, 0):
        monkeypatch.setattr(planner, "CELLS_WORK", work)
        search, costmap = query(grid := PlainMap(CLOSED), (0.0, 0.0), (4.0, 0.0))
        search.near = True
        found = search.advance(EVERYTHING, costmap, grid)
        assert isinstance(found, Path)
        asked.append((found.points[-1], found.short_of))
    assert asked[0] == asked[1]


@pytest.mark.parametrize("place", plans.PLACES)
def test_the_answer_does_not_depend_on_the_rate_of_the_ticks(
    place: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Searched cell by cell, then by blocks; a difference raises. And it comes after about the same time."""
    monkeypatch.setattr(planner, "CELLS_WORK", 30_000)
    found = [answer for _, answer in plans.answers(place, 16.0, plans.RATES)]
    assert bool(found[0].points) == (place in ("serpentine", "clutter"))
    took = [answer.took for answer in found]
    assert max(took) <= 1.3 * min(took) + 2 * SECOND // min(plans.RATES)
