"""The work of a step is bounded at the worst settings that are allowed: counted operations, and memory."""

from __future__ import annotations

import math
import sys
import tracemalloc
from collections.abc import Callable
from dataclasses import replace
from types import FrameType
from typing import Any

import numpy as np
import pytest

from brain.base_brain import BaseBrain
from brain.belief import Pose
from brain.perception.grid import Grid, GridSettings, _inflated
from brain.perception.mount import Mount, to_body
from brain.planning.costmap import (
    BLOCKED,
    FREE,
    MAX_LINES,
    Costmap,
    PlannerSettings,
    build_costmap,
    nearest_cell,
)
from brain.planning.navigator import Navigator
from brain.planning.planner import SHORTCUT_CORNERS, shortcut
from protocols.messages import Goal, LaserScan
from tests.brain.helpers import Office, Trip

LARGEST = GridSettings(resolution=0.05, width=50.0, height=50.0, farthest=100.0)
"""A million cells."""
WORST = PlannerSettings(margin=1.0, comfort=2.0, escape=2.0, slack=2.0)


def peak(action: Callable[[], object]) -> int:
    """Return the most memory that an action needs at once, in bytes."""
    tracemalloc.start()
    action()
    most = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    return most


def calls(of: Callable[..., Any], action: Callable[[], object]) -> int:
    """Return how often an action calls a function."""
    count, code = 0, of.__code__

    def on_event(frame: FrameType, event: str, _: object) -> None:
        nonlocal count
        count += event == "call" and frame.f_code is code

    before = sys.getprofile()
    sys.setprofile(on_event)
    try:
        action()
    finally:
        sys.setprofile(before)
    return count


@pytest.mark.parametrize("share", [0.05, 0.6])
def test_a_check_of_the_largest_map_needs_few_bytes_per_cell(share: float) -> None:
    """As of `set brain.planner.margin 1` in a cluttered hall: an inflation of every obstacle by 5 m."""
    grid = Grid(LARGEST)
    grid.log_odds[:] = np.where(np.random.default_rng(1).random(grid.log_odds.shape) < share, 1.0, -1.0)
    navigator = Navigator(2.0, WORST)
    navigator.accept(0, Goal(20.0, 20.0))
    assert peak(lambda: navigator.step(0, (0.0, 0.0), grid)) < 80 * grid.log_odds.size
    assert navigator.costmap is not None


def test_a_scan_touches_few_cells_of_the_largest_map() -> None:
    grid, beams = Grid(LARGEST), 10_000
    increment = 2.0 * math.pi / beams
    scan = LaserScan("lidar", 0, 0.0, increment, 0.05, 1000.0, (99.0,) * beams)
    swept = to_body(scan, Mount(), LARGEST.farthest)
    assert peak(lambda: grid.add(Pose(0.0, 0.0, 0.3), swept)) < 80e6
    assert np.count_nonzero(grid.free) > 100_000


def open_ground(cells: int, *, blocked: bool = False) -> Costmap:
    mask = np.full((cells, cells), blocked)
    return build_costmap(mask, mask & False, resolution=0.05, origin=(0.0, 0.0))


def test_a_path_of_very_many_corners_is_shortened_as_far_as_the_work_goes() -> None:
    costmap = open_ground(300)
    points = [(0.1 + 0.002 * k, 5.0 + 4.0 * (k % 2)) for k in range(6000)]
    found: list[tuple[float, float]] = []
    count = calls(Costmap.crossing, lambda: found.extend(shortcut(costmap, points)))
    assert count <= 2 * MAX_LINES + SHORTCUT_CORNERS
    assert (found[0], found[-1]) == (points[0], points[-1])


def test_the_way_out_of_an_obstacle_is_searched_along_few_lines() -> None:
    costmap, closed = open_ground(300), open_ground(300, blocked=True)
    assert closed.level_at(5.0, 5.0) == BLOCKED
    search = [nearest_cell(costmap, (5.0, 5.0), 2.0, FREE, closed)]
    assert search == [None]
    assert calls(Costmap.crossing, lambda: nearest_cell(costmap, (5.0, 5.0), 2.0, FREE, closed)) == MAX_LINES


@pytest.mark.parametrize("radius", [0.0, 0.3, 0.5, 1.0, 1.5, 2.2, 4.9, 30.0])
def test_an_inflation_is_the_union_of_discs(radius: float) -> None:
    """Against each pair of cells: the middle of one, and the nearest part of the other."""
    random = np.random.default_rng(7)
    for shape in ((1, 1), (1, 9), (9, 1), (12, 17)):
        occupied = random.random(shape) < 0.1
        occupied[0, 0] = True
        rows, columns = (axis.reshape(-1) for axis in np.indices(shape))
        up, across = (
            np.maximum(np.abs(axis[:, None] - axis[None, :]) - 0.5, 0.0) for axis in (rows, columns)
        )
        near = (up**2 + across**2 < radius**2) | np.eye(rows.size, dtype=bool)
        expected = near[:, occupied.reshape(-1)].any(axis=1).reshape(shape)
        assert (_inflated(occupied, radius) == expected).all()


@pytest.mark.parametrize(
    ("change", "counted"),
    [
        ({"angle_increment": 1e-19}, "not a scan"),
        ({"angle_increment": 5e-324}, "not a scan"),
        ({"angle_increment": 1e308}, "not a scan"),
        ({"angle_min": 1e300}, "not a scan"),
        ({"range_min": -1e308}, "not a scan"),
        ({"range_max": 1e308}, "not a scan"),
        ({"ranges": (1.0,) * 1_000_000, "angle_increment": 1e-5}, "not a scan"),
        ({"ranges": (1e308,) * 360}, "too few returns"),
        ({"ranges": (-1e308,) * 360}, "too few returns"),
        ({"t": -(2**62)}, "out of order"),
    ],
)
def test_a_scan_that_no_lidar_sends_is_counted_and_left_out(change: dict[str, Any], counted: str) -> None:
    trip = Trip(Office())
    trip.run(0.5)
    assert isinstance(trip.brain._body, BaseBrain)
    perception = trip.brain._body.perception
    scan = replace(trip.office.scan(), **{"t": trip.office.now + 1, **change})
    before, anomalies = perception.map.version, perception.anomalies["lidar"].get(counted, 0)
    trip.brain.step(trip.office.now + 1, [scan], [], "")
    trip.run(0.05)
    assert perception.anomalies["lidar"][counted] == anomalies + 1
    assert perception.map.version == before
