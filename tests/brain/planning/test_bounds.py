"""The work of a step of planning is bounded, and does not depend on the map's size: counted operations."""

from __future__ import annotations

import sys
from collections import Counter
from collections.abc import Callable
from types import CodeType, FrameType

import numpy as np
import pytest

from brain.planning.astar import BATCH, BATCH_WORK, CellSearch
from brain.planning.blocks import CUT_WORK, PIECE_WORK, BlockSearch
from brain.planning.costmap import TILE_WORK, Costmap, PlannerSettings
from brain.planning.navigator import Navigator
from brain.planning.path_watch import CHECKED_PER_STEP
from brain.planning.planner import NoPath
from brain.planning.polyline import Point
from brain.planning.shortening import SHORTCUT_CORNERS, Shortening
from brain.planning.snapshot import LINE_WORK, MAX_LINES, crossing
from brain.planning.terrain import TILES_PER_STEP
from protocols.messages import MILLISECOND, Goal
from tests.brain.helpers import BODY
from tests.brain.planning.maps import PlainMap, ground, query, two_rooms

WORK = {
    Costmap.draw.__code__: TILE_WORK,
    CellSearch._expand.__code__: BATCH_WORK,
    crossing.__code__: LINE_WORK,
    BlockSearch._cut.__code__: CUT_WORK,
    BlockSearch._expand.__code__: PIECE_WORK,
    BlockSearch._look_back.__code__: PIECE_WORK,
}


def calls(action: Callable[[], object]) -> Counter[CodeType]:
    """How often an action calls each function."""
    count: Counter[CodeType] = Counter()

    def on_event(frame: FrameType, event: str, _: object) -> None:
        if event == "call":
            count[frame.f_code] += 1

    before = sys.getprofile()
    sys.setprofile(on_event)
    try:
        action()
    finally:
        sys.setprofile(before)
    return count


@pytest.mark.parametrize(("side", "kinds"), [(200, 3), (1200, 6)])
def test_no_step_does_more_than_its_work_however_large_the_map(side: int, kinds: int) -> None:
    """From nothing drawn to the end of the path: 20 m; and 120 m, by blocks in the end."""
    occupied = np.random.Generator(np.random.PCG64(3)).random((side, side)) < 0.003
    occupied[:10, :10] = occupied[-10:, -10:] = False
    settings = PlannerSettings(patience=600_000 * MILLISECOND)
    navigator = Navigator(BODY, settings)
    grid, here, now, most, phases = PlainMap(occupied, low=(0, 0)), (0.5, 0.5), 0, 0, set()
    navigator.accept(now, Goal(side / 10 - 0.5, side / 10 - 0.5))
    while navigator._watch.checked == 0.0 or navigator._watch.checked < navigator._watch.line.length:
        now += 5 * MILLISECOND
        count = calls(lambda: navigator.step(now, here, grid))  # noqa: B023 -- called at once
        most = max(most, sum(WORK[code] * count[code] for code in WORK))
        phases |= {code for code in WORK if count[code]}
    assert len(phases) == kinds
    over = max(TILES_PER_STEP * TILE_WORK, BATCH + BATCH_WORK, 3 * LINE_WORK, CUT_WORK)
    over += CHECKED_PER_STEP * LINE_WORK
    assert most <= settings.expansions_per_step + over


def test_a_path_of_very_many_corners_is_shortened_as_far_as_the_work_goes() -> None:
    there = ground(np.zeros((90, 300), bool))
    points: list[Point] = [(0.1 + 0.004 * k, 2.0 + 4.0 * (k % 2)) for k in range(6000)]
    short = Shortening(points)
    count = calls(lambda: short.advance(there, 10**9))
    assert count[crossing.__code__] <= 2 * MAX_LINES + SHORTCUT_CORNERS
    assert short.finished
    assert (short.kept[0], short.kept[-1]) == (points[0], points[-1])


def test_the_way_out_of_an_obstacle_is_searched_along_few_lines() -> None:
    """The robot's place is enclosed by a thin wall: no straight line leads out of it."""
    occupied = two_rooms(60, 60, door=(0, 0))
    occupied[19:22, 9:12] = True
    occupied[20, 10] = False
    grid = PlainMap(occupied)
    asked, costmap = query(grid, (0.05, 0.05), (4.0, 0.0), PlannerSettings(escape=2.0))
    found = []
    count = calls(lambda: found.append(asked.advance(10**9, costmap, grid)))
    assert isinstance(found[0], NoPath)
    assert "stands too near to an obstacle" in found[0].reason
    assert count[crossing.__code__] <= MAX_LINES


def test_a_step_without_news_costs_nothing() -> None:
    navigator, grid = Navigator(BODY, PlannerSettings()), PlainMap(two_rooms())
    for _ in range(20):
        navigator.step(0, (0.0, 0.0), grid)
    assert navigator.terrain is not None
    assert not navigator.terrain.costmap.pending
    count = calls(lambda: navigator.step(0, (0.0, 0.0), grid))
    assert sum(count.values()) < 15
