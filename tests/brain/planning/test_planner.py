"""Path queries: paths, frontiers, failures with a reason; clearance, escape, shortcuts. Costmaps."""

from __future__ import annotations

import copy
from itertools import pairwise
from math import hypot, inf

import numpy as np
import pytest

from brain.planning.astar import Searching
from brain.planning.costmap import FREE, UNKNOWN, PlannerSettings
from brain.planning.planner import FrontierPath, NoPath, Path
from brain.planning.polyline import Point, Polyline
from brain.planning.shortening import Shortening
from brain.planning.snapshot import crossing, is_blocked, line_cost
from tests.brain.planning.maps import EVERYTHING, RADIUS, PlainMap, drawn, ground, plan, query, two_rooms


def samples(points: tuple[Point, ...]) -> list[Point]:
    line = Polyline(points)
    return [line.point(float(at)) for at in np.arange(0.0, line.length, 0.02)] + [points[-1]]


def test_plan_starts_at_the_estimated_pose_and_ends_at_the_goal() -> None:
    """Not at a cell (50, 50), not at a cell's middle."""
    found = plan(PlainMap(two_rooms()), (-0.312, 0.123), (4.021, 1.457))
    assert isinstance(found, Path)
    assert found.points[0] == (-0.312, 0.123)
    assert found.points[-1] == (4.021, 1.457)
    assert found.escape == 0.0


@pytest.mark.parametrize("seed", range(6))
def test_path_clearance_is_at_least_the_footprint_radius(seed: int) -> None:
    """Obstacles are inflated, and neither the diagonal moves nor the shortcuts undo it."""
    rng = np.random.Generator(np.random.PCG64(seed))
    occupied = rng.random((45, 45)) < 0.008
    grid = PlainMap(occupied)
    free = np.argwhere(~grid.blocked(RADIUS + 0.1))
    (r0, c0), (r1, c1) = (free[i] for i in rng.choice(len(free), 2, replace=False))
    start, goal = (-1.0 + 0.1 * c0 + 0.05, -2.0 + 0.1 * r0 + 0.05), (-0.95 + 0.1 * c1, -1.95 + 0.1 * r1)
    found = plan(grid, start, goal)
    assert isinstance(found, Path), f"seed {seed}"
    # Inflation is decided at the cells' middles: half a cell's diagonal is what the margin is for.
    assert min(grid.clearance(*p) for p in samples(found.points)) >= RADIUS + 0.05 - 0.0708, f"seed {seed}"


def test_a_doorway_without_room_for_the_margin_is_passed_if_another_is_far() -> None:
    narrow, wide, start, goal = two_rooms(door=(10, 15)), two_rooms(door=(20, 30)), (0.0, -0.8), (4.0, -0.8)
    only, other = plan(PlainMap(narrow), start, goal), plan(PlainMap(narrow & wide), start, goal)
    assert isinstance(only, Path)
    assert isinstance(other, Path)
    assert [len(path.points) > 2 for path in (only, other)] == [False, True]


def test_walls_are_disliked() -> None:
    """In a wide corridor the path keeps off the walls, although along the wall would be shorter."""
    occupied = np.zeros((40, 60), bool)
    occupied[0, :] = occupied[39, :] = True
    occupied[0:12, 25:35] = True
    found = plan(PlainMap(occupied), (-0.5, -1.5), (4.5, -1.5))
    bold = plan(PlainMap(occupied), (-0.5, -1.5), (4.5, -1.5), PlannerSettings(dislike=0.0, comfort=0.0))
    assert isinstance(found, Path)
    assert isinstance(bold, Path)
    nearest_of = [
        min(PlainMap(occupied).clearance(*p) for p in samples(a.points)[20:-20]) for a in (found, bold)
    ]
    assert nearest_of[0] > nearest_of[1] + 0.1
    assert Polyline(found.points).length > Polyline(bold.points).length


def test_towards_an_unknown_goal_the_path_stays_on_known_ground() -> None:
    unknown = np.zeros((40, 60), bool)
    unknown[:, 31:] = True
    grid = PlainMap(two_rooms(), unknown)
    found = plan(grid, (0.0, -1.0), (4.0, -1.0))
    assert isinstance(found, FrontierPath)
    costmap = drawn(grid)
    assert all(FREE <= costmap.level_at(*p) < UNKNOWN for p in samples(found.points))
    assert found.points[-1][0] == pytest.approx(2.05)
    assert -0.4 < found.points[-1][1] < 0.6
    assert costmap.level_at(*found.beyond) >= UNKNOWN


def test_unknown_is_planned_through_only_if_the_settings_allow_it() -> None:
    unknown = np.zeros((40, 60), bool)
    unknown[:, 31:] = True
    found = plan(
        PlainMap(two_rooms(), unknown), (0.0, -1.0), (4.0, -1.0), PlannerSettings(unknown_is_free=True)
    )
    assert isinstance(found, Path)
    assert found.points[-1] == (4.0, -1.0)


def test_a_known_path_is_preferred_to_an_assumed_one() -> None:
    """There is an unknown shortcut, and a longer known path."""
    occupied, unknown = two_rooms(door=(30, 39)), np.zeros((40, 60), bool)
    occupied[2:10, 30], unknown[2:10, 30] = False, True
    found = plan(PlainMap(occupied, unknown), (0.0, -1.4), (4.0, -1.4))
    assert isinstance(found, Path)
    assert max(y for _, y in found.points) > 1.2


@pytest.mark.parametrize("goal", [(30.0, 0.5), (-1e6, 0.5)])
def test_to_a_goal_beyond_the_map_leads_the_frontier_that_is_nearest_in_cost(goal: Point) -> None:
    """Known ground ends at x = -1 and 5 m; the wall between the two rooms has a door."""
    occupied = two_rooms()
    occupied[:, [0, -1]] = False
    found = plan(PlainMap(occupied), (0.0, 0.0), goal)
    assert isinstance(found, FrontierPath)
    end = found.points[-1]
    assert end == pytest.approx((4.95, 0.45) if goal[0] > 0.0 else (-0.95, 0.45), abs=0.3)
    assert abs(found.beyond[0] - end[0]) == pytest.approx(0.1)
    free = plan(PlainMap(occupied), (0.0, 0.0), goal, PlannerSettings(unknown_is_free=True))
    assert isinstance(free, Path)
    assert free.points[-1] == goal


def test_no_path_has_a_reason() -> None:
    closed = two_rooms()
    closed[:, 30] = True
    found = plan(PlainMap(closed), (0.0, 0.0), (4.0, 0.0))
    assert found == NoPath("everything between (0.00, 0.00) and the goal (4.00, 0.00) is closed")
    again = plan(PlainMap(closed), (0.0, -0.001), (4.0, 0.0))
    assert again == found  # a pose that varies about zero says nothing new


def test_for_a_goal_too_near_to_a_wall_the_reason_gives_the_nearest_that_fits() -> None:
    found = plan(PlainMap(two_rooms()), (0.0, 0.0), (1.9, -1.52))
    assert isinstance(found, NoPath)
    assert "too near to an obstacle" in found.reason
    assert "the nearest place that fits is (1.65, -1.55)" in found.reason


def test_a_goal_hardly_too_near_is_moved_by_no_more_than_the_slack() -> None:
    found = plan(PlainMap(two_rooms()), (0.0, 0.0), (1.72, -1.5))
    assert isinstance(found, Path)
    end = found.points[-1]
    assert 0.0 < hypot(end[0] - 1.72, end[1] + 1.5) <= 0.1


def test_start_inside_the_inflated_zone_escapes_to_the_nearest_free_place() -> None:
    found = plan(PlainMap(two_rooms()), (1.85, -1.5), (0.0, 1.0))
    assert isinstance(found, Path)
    assert 0.0 < found.escape <= 0.5
    assert found.points[0] == (1.85, -1.5)
    out = found.points[1]
    assert hypot(out[0] - 1.85, out[1] + 1.5) == pytest.approx(found.escape)
    assert PlainMap(two_rooms()).clearance(*out) >= RADIUS


def test_escape_does_not_lead_through_a_wall_and_is_bounded() -> None:
    thin = PlainMap(two_rooms(door=(0, 0)))
    found = plan(thin, (2.15, 0.0), (4.0, 0.0))
    assert isinstance(found, Path)
    assert found.points[1][0] > 2.1
    boxed = np.zeros((40, 60), bool)
    boxed[10:30, 10:30] = True
    boxed[18:22, 18:22] = False
    stuck = plan(PlainMap(boxed), (1.0, 0.0), (4.0, 0.0))
    assert isinstance(stuck, NoPath)
    assert "stands too near to an obstacle" in stuck.reason


def test_the_ground_under_the_robot_is_known() -> None:
    unknown = np.zeros((40, 60), bool)
    unknown[18:22, 8:12] = True
    found = plan(PlainMap(np.zeros((40, 60), bool), unknown), (0.0, 0.0), (3.0, 0.0))
    assert isinstance(found, Path)


def test_unreachable_frontiers_are_excluded() -> None:
    unknown = np.zeros((40, 60), bool)
    unknown[:, 31:] = True
    grid = PlainMap(two_rooms(), unknown)
    asked, costmap = query(grid, (0.0, 0.0), (4.0, 0.0), unreachable=((2.15, 0.05),), radius=0.6)
    assert isinstance(asked.advance(EVERYTHING, costmap, grid), NoPath)


def test_a_sliced_query_is_bounded_and_a_deep_copy_continues_alike() -> None:
    """At whatever stage it is copied: while tiles are drawn and copied, searching, tracing, shortening."""
    grid = PlainMap(two_rooms())
    asked, costmap = query(grid, (0.0, 0.0), (4.0, 1.0))
    whole, copies = plan(grid, (0.0, 0.0), (4.0, 1.0)), []
    for _ in range(10_000):
        copies.append(copy.deepcopy((asked, costmap)))
        if not isinstance(asked.advance(20, costmap, grid), Searching):
            break
    assert len(copies) > 20
    for other, its_costmap in copies:
        assert other.advance(EVERYTHING, its_costmap, grid) == whole


def test_a_complete_snapshot_does_not_change() -> None:
    """What appears while a search is under way is the next one's."""
    grid = PlainMap(two_rooms())
    asked, costmap = query(grid, (0.0, 0.0), (4.0, 0.0))
    while not asked.ground.complete:
        asked.advance(1, costmap, grid)
    before = asked.ground.level.tobytes()
    grid.occupied[:, 30] = True
    grid.version += 1
    costmap.update(grid, (0.0, 0.0), 100)
    found = asked.advance(EVERYTHING, costmap, grid)
    assert isinstance(found, Path)
    assert asked.ground.level.tobytes() == before
    assert isinstance(plan(grid, (0.0, 0.0), (4.0, 0.0)), NoPath)


def test_shortcuts_never_cost_more_and_never_leave_free_ground() -> None:
    rng = np.random.Generator(np.random.PCG64(2))
    grid, settings = (
        PlainMap(rng.random((60, 60)) < 0.08),
        PlannerSettings(margin=0.0, comfort=0.3, dislike=2.0),
    )
    free = np.argwhere(~grid.occupied)
    for trial in range(8):
        a, b = ((float(x), float(y)) for y, x in rng.choice(free, 2, replace=False) * 0.1 + (-1.95, -0.95))
        asked, costmap = query(grid, a, b, settings, radius=0.0)
        found = asked.advance(EVERYTHING, costmap, grid)
        if isinstance(found, FrontierPath):
            continue
        assert isinstance(found, Path)
        straight = sum(line_cost(asked.ground, p, q) for p, q in pairwise(found.points))
        # A move is charged by the cell entered, a line by all it crosses: half a cell at each end differs.
        assert straight <= found.cost + 0.1 * 3.0, f"trial {trial}"


def test_open_ground_needs_no_corner() -> None:
    there = ground(np.zeros((30, 30), bool))
    stairs: list[Point] = [
        (0.05 + 0.1 * x, 0.05 + 0.1 * y) for x, y in ((0, 0), (1, 0), (2, 1), (3, 1), (3, 2))
    ]
    for corners in (stairs, stairs[:1]):
        short = Shortening(corners)
        short.advance(there, EVERYTHING)
        assert short.kept == [corners[0], corners[-1]][: len(corners)]


def test_nearest_is_nearest() -> None:
    blocked = np.zeros((20, 20), bool)
    blocked[5:15, 5:15] = True
    there = ground(blocked)
    assert there.centre(there.nearest((0.62, 1.0), 0.5, known=True)[0]) == pytest.approx(
        (0.45, 1.05), abs=0.11
    )
    assert there.nearest((1.0, 1.0), 0.3, known=True) == []


def test_a_line_crosses_exactly_its_cells() -> None:
    rng = np.random.Generator(np.random.PCG64(3))
    for a, b in rng.uniform(-3.0, 5.0, (50, 2, 2)).tolist():
        rows, columns, spans = crossing(0.5, a, b)
        assert float(spans.sum()) == pytest.approx(hypot(b[0] - a[0], b[1] - a[1]), abs=1e-9)
        t = np.linspace(0.0, 1.0, 997)
        dense = np.floor(np.stack([a[1] + t * (b[1] - a[1]), a[0] + t * (b[0] - a[0])]) / 0.5)
        assert set(zip(*dense.tolist(), strict=True)) <= set(
            zip(rows.tolist(), columns.tolist(), strict=True)
        )


def test_a_line_has_the_same_levels_on_the_live_costmap_as_on_a_snapshot() -> None:
    """Over several tiles, unknown and blocked ground, and out of what is known."""
    rng = np.random.Generator(np.random.PCG64(8))
    grid = PlainMap(rng.random((150, 150)) < 0.01, rng.random((150, 150)) < 0.005, (-70, -60))
    asked, costmap = query(grid, (0.0, 0.0), (1.0, 1.0))
    asked.advance(EVERYTHING, costmap, grid)
    for a, b in rng.uniform(-9.0, 9.0, (100, 2, 2)).tolist():
        rows, columns, _ = crossing(0.1, a, b)
        found = asked.ground.levels(rows, columns)
        away = np.hypot(rows + 0.5, columns + 0.5) > 2.5  # the ground under the robot is known there
        assert costmap.levels(rows, columns)[away].tolist() == found[away].tolist()
        assert is_blocked(costmap, a, b, FREE) == is_blocked(asked.ground, a, b, FREE)
    assert line_cost(costmap, (40.0, 0.0), (41.0, 0.0)) == inf


def test_a_cell_and_its_middle_agree() -> None:
    there = ground(np.zeros((70, 90), bool))
    for cell in range(2 * there.stride + 2, len(there.level) - 3 * there.stride, 7):
        if 2 <= cell % there.stride < there.stride - 2:
            assert there.index(*there.centre(cell)) == cell
    assert there.index(-0.01, 2.1) is None
