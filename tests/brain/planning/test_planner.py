"""Path queries: paths, frontiers, failures with a reason; clearance, escape, shortcuts. Costmaps."""

from __future__ import annotations

import copy
from itertools import pairwise
from math import hypot, inf

import numpy as np
import pytest

from brain.planning.astar import Searching
from brain.planning.costmap import (
    BLOCKED,
    FREE,
    UNKNOWN,
    Costmap,
    Mask,
    PlannerSettings,
    build_costmap,
    dilated,
    footprint_costmap,
    nearest_cell,
    planning_costmap,
)
from brain.planning.planner import FrontierPath, NoPath, Path, PathQuery, PlanResult, shortcut
from brain.planning.polyline import Point, Polyline

RADIUS = 0.25


class PlainMap:
    """A given map, 0.1 m per cell, with its own exact inflation."""

    def __init__(self, occupied: Mask, unknown: Mask | None = None) -> None:
        self.version, self.resolution, self.origin_x, self.origin_y = 1, 0.1, -1.0, -2.0
        self.occupied = occupied
        self.unknown = np.zeros_like(occupied) if unknown is None else unknown

    def blocked(self, radius: float) -> Mask:
        rows, columns = np.indices(self.occupied.shape)
        blocked = self.occupied.copy()
        for row, column in np.argwhere(self.occupied):
            dx = np.maximum(np.abs(columns - column) - 0.5, 0.0)
            dy = np.maximum(np.abs(rows - row) - 0.5, 0.0)
            blocked |= np.hypot(dx, dy) * self.resolution < radius
        return blocked

    def clearance(self, x: float, y: float) -> float:
        """To the nearest occupied cell's edge [m]."""
        best = inf
        for row, column in np.argwhere(self.occupied):
            dx = max(abs(self.origin_x + (column + 0.5) * 0.1 - x) - 0.05, 0.0)
            dy = max(abs(self.origin_y + (row + 0.5) * 0.1 - y) - 0.05, 0.0)
            best = min(best, hypot(dx, dy))
        return best


def two_rooms(height: int = 40, width: int = 60, door: tuple[int, int] = (16, 26)) -> Mask:
    """A wall in the middle with a doorway of 1 m."""
    occupied = np.zeros((height, width), bool)
    occupied[:, 30] = True
    occupied[door[0] : door[1], 30] = False
    return occupied


def plan(grid: PlainMap, start: Point, goal: Point, settings: PlannerSettings | None = None) -> PlanResult:
    settings = settings or PlannerSettings()
    costmap = planning_costmap(grid, RADIUS, settings, standing=start)
    query = PathQuery(costmap, footprint_costmap(grid, 0.0), start, goal, settings)
    for _ in range(10_000):
        found = query.advance(200)
        if not isinstance(found, Searching):
            assert query.advance(1) == found
            return found
    raise AssertionError("the planner does not end")


def costmap_of(
    blocked: Mask,
    unknown: Mask | None = None,
    resolution: float = 0.1,
    origin: Point = (0.0, 0.0),
    **options: float,
) -> Costmap:
    unknown = np.zeros_like(blocked) if unknown is None else unknown
    return build_costmap(blocked, unknown, resolution=resolution, origin=origin, **options)  # type: ignore[arg-type]  # a flag may be among them


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
    costmap = planning_costmap(grid, RADIUS, PlannerSettings(), standing=(0.0, -1.0))
    assert all(costmap.level_at(*p) >= FREE for p in samples(found.points))
    assert found.points[-1][0] == pytest.approx(2.05)
    assert -0.4 < found.points[-1][1] < 0.6
    assert costmap.level_at(*found.beyond) == UNKNOWN


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
    occupied, unknown = two_rooms(door=(34, 40)), np.zeros((40, 60), bool)
    occupied[2:10, 30], unknown[2:10, 30] = False, True
    found = plan(PlainMap(occupied, unknown), (0.0, -1.4), (4.0, -1.4))
    assert isinstance(found, Path)
    assert max(y for _, y in found.points) > 1.4


def test_outside_the_map_the_reason_gives_its_extent() -> None:
    """The map does not grow: what lies outside of it can never become known."""
    found = plan(PlainMap(np.zeros((20, 30), bool)), (0.0, -1.0), (30.0, -1.0))
    assert found == NoPath(
        "the goal (30.00, -1.00) is outside of the map, which reaches from (-1.00, -2.00) to (2.00, 0.00)"
    )
    outside = plan(PlainMap(np.zeros((20, 30), bool)), (-5.0, -1.0), (1.0, -1.0))
    assert outside == NoPath("the robot at (-5.00, -1.00) is outside of the map")


def test_no_path_has_a_reason() -> None:
    closed = two_rooms()
    closed[:, 30] = True
    found = plan(PlainMap(closed), (0.0, 0.0), (4.0, 0.0))
    assert found == NoPath("everything between (0.00, 0.00) and the goal (4.00, 0.00) is closed")


def test_for_a_goal_too_near_to_a_wall_the_reason_gives_the_nearest_that_fits() -> None:
    found = plan(PlainMap(two_rooms()), (0.0, 0.0), (1.9, -1.5))
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
    grid, settings = PlainMap(two_rooms(), unknown), PlannerSettings()
    costmap = planning_costmap(grid, 0.6, settings, standing=(0, 0), unreachable=((2.15, 0.05),))
    found = PathQuery(costmap, None, (0.0, 0.0), (4.0, 0.0), settings).advance(10**6)
    assert isinstance(found, NoPath)


def test_a_sliced_query_is_bounded_and_a_deep_copy_continues_alike() -> None:
    grid, settings = PlainMap(two_rooms()), PlannerSettings()
    costmap = planning_costmap(grid, RADIUS, settings, standing=(0, 0))
    query = PathQuery(costmap, None, (0.0, 0.0), (4.0, 1.0), settings)
    first = query.advance(20)
    assert first == Searching(20)
    other = copy.deepcopy(query)
    assert query.advance(10**6) == other.advance(10**6) == plan(grid, (0.0, 0.0), (4.0, 1.0))


def test_shortcuts_never_cost_more_and_never_leave_free_ground() -> None:
    rng = np.random.Generator(np.random.PCG64(2))
    blocked = rng.random((60, 60)) < 0.08
    costmap = costmap_of(blocked, comfort=0.3, dislike=2.0)
    free = [c for c, level in enumerate(costmap.level) if level >= FREE]
    for trial in range(8):
        a, b = (int(c) for c in rng.choice(free, 2, replace=False))
        found = PathQuery(costmap, None, costmap.centre(a), costmap.centre(b), PlannerSettings()).advance(
            10**6
        )
        if isinstance(found, NoPath):
            continue
        assert isinstance(found, Path)
        straight = sum(costmap.line_cost(p, q) for p, q in pairwise(found.points))
        # A move is charged by the cell entered, a line by all it crosses: half a cell at each end differs.
        assert straight <= found.cost + 0.1 * 3.0, f"trial {trial}"
        assert straight < inf


def test_an_empty_map_needs_no_corner() -> None:
    costmap = costmap_of(np.zeros((30, 30), bool))
    stairs: list[Point] = [costmap.centre(c) for c in (33, 34, 67, 68, 101, 102, 135)]
    assert shortcut(costmap, stairs) == (stairs[0], stairs[-1])
    assert shortcut(costmap, stairs[:1]) == (stairs[0],)


def test_nearest_is_nearest() -> None:
    blocked = np.zeros((20, 20), bool)
    blocked[5:15, 5:15] = True
    costmap = costmap_of(blocked)
    cell = nearest_cell(costmap, (0.62, 1.0), 0.5, FREE)
    assert cell is not None
    assert costmap.centre(cell) == pytest.approx((0.45, 1.05), abs=0.11)
    assert nearest_cell(costmap, (1.0, 1.0), 0.3, FREE) is None


def test_a_line_crosses_exactly_its_cells() -> None:
    costmap = costmap_of(np.zeros((10, 10), bool), resolution=0.5, origin=(1.0, -1.0))
    rng = np.random.Generator(np.random.PCG64(3))
    for _ in range(50):
        a, b = ((float(x) + 1.0, float(y) - 1.0) for x, y in rng.uniform(0.0, 5.0, (2, 2)))
        cells, spans = costmap.crossing(a, b)
        assert float(spans.sum()) == pytest.approx(hypot(b[0] - a[0], b[1] - a[1]), abs=1e-9)
        dense = {
            costmap.index(a[0] + t * (b[0] - a[0]), a[1] + t * (b[1] - a[1])) for t in np.linspace(0, 1, 997)
        }
        assert dense <= {int(c) for c in cells}
    outside, _ = costmap.crossing((2.0, 0.0), (20.0, 0.0))
    assert -1 in outside
    assert costmap.line_cost((2.0, 0.0), (20.0, 0.0)) == inf
    assert costmap.is_blocked((2.0, 0.0), (20.0, 0.0))


def test_levels_give_the_distance_to_blocked_cells() -> None:
    blocked = np.zeros((21, 21), bool)
    blocked[10, 10] = True
    costmap = costmap_of(blocked, comfort=0.4, dislike=2.0)
    at = [costmap.clearance(1.05 + 0.1 * i, 1.05) for i in range(6)]
    assert at == pytest.approx([0.0, 0.1, 0.2, 0.3, 0.4, inf])
    assert costmap.multiplier == (inf, inf, 3.0, 2.5, 2.0, 1.5, 1.0)
    assert costmap.clearance(-5.0, 0.0) == 0.0


def test_a_cell_and_its_middle_agree() -> None:
    costmap = costmap_of(np.zeros((7, 9), bool), resolution=0.05, origin=(-3.0, 2.0))
    for row in range(7):
        for column in range(9):
            cell = (row + 1) * 11 + column + 1
            assert costmap.index(*costmap.centre(cell)) == cell
    assert costmap.index(-3.01, 2.1) is None
    assert costmap.level_at(-3.01, 2.1) == BLOCKED


def test_dilation_by_one_cell() -> None:
    dot = np.zeros((5, 5), bool)
    dot[2, 2] = True
    assert int(dilated(dot, diagonal=False).sum()) == 5
    assert int(dilated(dot, diagonal=True).sum()) == 9
