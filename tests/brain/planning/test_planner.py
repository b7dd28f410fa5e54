"""One question to the planner: ways, guesses, refusals with a reason; clearance, escape, short cuts."""

from __future__ import annotations

import copy
from itertools import pairwise
from math import hypot, inf

import numpy as np
import pytest

from brain.planning.astar import Searching
from brain.planning.costmap import BLOCKED, FREE, UNKNOWN, Costmap, Mask, build, dilated
from brain.planning.line import Line, Point
from brain.planning.planner import Answer, FrontierPath, NoPath, Path, Planning, shortcut
from brain.planning.survey import PlannerSettings, nearest, survey

RADIUS = 0.25


class Paper:
    """A map drawn by hand, 0.1 m a cell: the planner's view of a grid, with its own exact inflation."""

    def __init__(self, occupied: Mask, unknown: Mask | None = None) -> None:
        self.version, self.resolution, self.origin_x, self.origin_y = 1, 0.1, -1.0, -2.0
        self.occupied = occupied
        self._unknown = np.zeros_like(occupied) if unknown is None else unknown

    @property
    def unknown(self) -> Mask:
        return self._unknown

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


def answer(grid: Paper, start: Point, goal: Point, settings: PlannerSettings | None = None) -> Answer:
    settings = settings or PlannerSettings()
    costmap = survey(grid, RADIUS, settings, standing=start)
    occupied = build(grid.occupied, grid.unknown, resolution=0.1, origin=(-1.0, -2.0), unknown_is_free=True)
    planning = Planning(costmap, occupied, start, goal, settings)
    for _ in range(10_000):
        found = planning.advance(200)
        if not isinstance(found, Searching):
            assert planning.advance(1) == found
            return found
    raise AssertionError("the planner does not end")


def samples(points: tuple[Point, ...]) -> list[Point]:
    line = Line(points)
    return [line.point(float(at)) for at in np.arange(0.0, line.length, 0.02)] + [points[-1]]


def test_plan_starts_at_the_estimated_pose_and_ends_at_the_goal() -> None:
    """Not at a cell (50, 50), not at a cell's middle."""
    found = answer(Paper(two_rooms()), (-0.312, 0.123), (4.021, 1.457))
    assert isinstance(found, Path)
    assert found.points[0] == (-0.312, 0.123)
    assert found.points[-1] == (4.021, 1.457)
    assert found.escapes == 0.0


@pytest.mark.parametrize("seed", range(6))
def test_path_clearance_is_at_least_the_footprint_radius(seed: int) -> None:
    """Obstacles are inflated, and neither the diagonal moves nor the short cuts undo it."""
    rng = np.random.Generator(np.random.PCG64(seed))
    occupied = rng.random((45, 45)) < 0.008
    grid = Paper(occupied)
    free = np.argwhere(~grid.blocked(RADIUS + 0.1))
    (r0, c0), (r1, c1) = (free[i] for i in rng.choice(len(free), 2, replace=False))
    start, goal = (-1.0 + 0.1 * c0 + 0.05, -2.0 + 0.1 * r0 + 0.05), (-0.95 + 0.1 * c1, -1.95 + 0.1 * r1)
    found = answer(grid, start, goal)
    assert isinstance(found, Path), f"seed {seed}"
    # Inflation is decided at the cells' middles: half a cell's diagonal is what the margin is for.
    assert min(grid.clearance(*p) for p in samples(found.points)) >= RADIUS + 0.05 - 0.0708, f"seed {seed}"


def test_walls_are_disliked() -> None:
    """In a wide corridor the way keeps off the walls although along the wall would be shorter."""
    occupied = np.zeros((40, 60), bool)
    occupied[0, :] = occupied[39, :] = True
    occupied[0:12, 25:35] = True
    found = answer(Paper(occupied), (-0.5, -1.5), (4.5, -1.5))
    bold = answer(Paper(occupied), (-0.5, -1.5), (4.5, -1.5), PlannerSettings(dislike=0.0, comfort=0.0))
    assert isinstance(found, Path)
    assert isinstance(bold, Path)
    nearest_of = [
        min(Paper(occupied).clearance(*p) for p in samples(a.points)[20:-20]) for a in (found, bold)
    ]
    assert nearest_of[0] > nearest_of[1] + 0.1
    assert Line(found.points).length > Line(bold.points).length


def test_unknown_goal_is_gone_toward_over_known_ground_only() -> None:
    unknown = np.zeros((40, 60), bool)
    unknown[:, 31:] = True
    grid = Paper(two_rooms(), unknown)
    found = answer(grid, (0.0, -1.0), (4.0, -1.0))
    assert isinstance(found, FrontierPath)
    costmap = survey(grid, RADIUS, PlannerSettings(), standing=(0.0, -1.0))
    assert all(costmap.level_at(*p) >= FREE for p in samples(found.points))
    assert found.points[-1][0] == pytest.approx(2.05)
    assert -0.4 < found.points[-1][1] < 0.6
    assert costmap.level_at(*found.beyond) == UNKNOWN


def test_unknown_is_planned_through_only_if_the_settings_say_so() -> None:
    unknown = np.zeros((40, 60), bool)
    unknown[:, 31:] = True
    found = answer(
        Paper(two_rooms(), unknown), (0.0, -1.0), (4.0, -1.0), PlannerSettings(unknown_is_free=True)
    )
    assert isinstance(found, Path)
    assert found.points[-1] == (4.0, -1.0)


def test_a_known_way_is_preferred_to_a_guess() -> None:
    """An unknown short cut does not tempt: the goal is known, and so is a longer way to it."""
    occupied, unknown = two_rooms(door=(34, 40)), np.zeros((40, 60), bool)
    occupied[2:10, 30], unknown[2:10, 30] = False, True
    found = answer(Paper(occupied, unknown), (0.0, -1.4), (4.0, -1.4))
    assert isinstance(found, Path)
    assert max(y for _, y in found.points) > 1.4


def test_a_goal_outside_of_the_map_says_how_far_the_map_reaches() -> None:
    """The map does not grow: what lies outside of it can never become known."""
    found = answer(Paper(np.zeros((20, 30), bool)), (0.0, -1.0), (30.0, -1.0))
    assert found == NoPath(
        "the goal (30.00, -1.00) is outside of the map, which reaches from (-1.00, -2.00) to (2.00, 0.00)"
    )
    outside = answer(Paper(np.zeros((20, 30), bool)), (-5.0, -1.0), (1.0, -1.0))
    assert outside == NoPath("the robot at (-5.00, -1.00) is outside of the map")


def test_no_path_says_why() -> None:
    closed = two_rooms()
    closed[:, 30] = True
    found = answer(Paper(closed), (0.0, 0.0), (4.0, 0.0))
    assert found == NoPath("everything between (0.00, 0.00) and the goal (4.00, 0.00) is closed")


def test_a_goal_too_near_to_a_wall_says_where_it_would_fit() -> None:
    found = answer(Paper(two_rooms()), (0.0, 0.0), (1.9, -1.5))
    assert isinstance(found, NoPath)
    assert "too near to an obstacle" in found.reason
    assert "the nearest place that fits is (1.65, -1.55)" in found.reason


def test_a_goal_hardly_too_near_is_moved_by_no_more_than_the_slack() -> None:
    found = answer(Paper(two_rooms()), (0.0, 0.0), (1.72, -1.5))
    assert isinstance(found, Path)
    end = found.points[-1]
    assert 0.0 < hypot(end[0] - 1.72, end[1] + 1.5) <= 0.1


def test_start_inside_the_inflated_zone_escapes_to_the_nearest_free_place() -> None:
    found = answer(Paper(two_rooms()), (1.85, -1.5), (0.0, 1.0))
    assert isinstance(found, Path)
    assert 0.0 < found.escapes <= 0.5
    assert found.points[0] == (1.85, -1.5)
    out = found.points[1]
    assert hypot(out[0] - 1.85, out[1] + 1.5) == pytest.approx(found.escapes)
    assert Paper(two_rooms()).clearance(*out) >= RADIUS


def test_escape_does_not_lead_through_a_wall_and_is_bounded() -> None:
    thin = Paper(two_rooms(door=(0, 0)))
    found = answer(thin, (2.15, 0.0), (4.0, 0.0))
    assert isinstance(found, Path)
    assert found.points[1][0] > 2.1
    boxed = np.zeros((40, 60), bool)
    boxed[10:30, 10:30] = True
    boxed[18:22, 18:22] = False
    stuck = answer(Paper(boxed), (1.0, 0.0), (4.0, 0.0))
    assert isinstance(stuck, NoPath)
    assert "stands too near to an obstacle" in stuck.reason


def test_the_ground_under_the_robot_is_known() -> None:
    unknown = np.zeros((40, 60), bool)
    unknown[18:22, 8:12] = True
    found = answer(Paper(np.zeros((40, 60), bool), unknown), (0.0, 0.0), (3.0, 0.0))
    assert isinstance(found, Path)


def test_places_given_up_are_not_gone_toward_again() -> None:
    unknown = np.zeros((40, 60), bool)
    unknown[:, 31:] = True
    grid, settings = Paper(two_rooms(), unknown), PlannerSettings()
    costmap = survey(grid, 0.6, settings, standing=(0, 0), given_up=((2.15, 0.05),))
    found = Planning(costmap, None, (0.0, 0.0), (4.0, 0.0), settings).advance(10**6)
    assert isinstance(found, NoPath)


def test_planning_in_slices_is_bounded_and_a_copy_goes_on_as_the_original() -> None:
    grid, settings = Paper(two_rooms()), PlannerSettings()
    costmap = survey(grid, RADIUS, settings, standing=(0, 0))
    planning = Planning(costmap, None, (0.0, 0.0), (4.0, 1.0), settings)
    first = planning.advance(20)
    assert first == Searching(20)
    other = copy.deepcopy(planning)
    assert planning.advance(10**6) == other.advance(10**6) == answer(grid, (0.0, 0.0), (4.0, 1.0))


def test_short_cuts_are_never_dearer_and_never_leave_free_ground() -> None:
    rng = np.random.Generator(np.random.PCG64(2))
    blocked = rng.random((60, 60)) < 0.08
    costmap = build(blocked, np.zeros_like(blocked), resolution=0.1, origin=(0, 0), comfort=0.3, dislike=2.0)
    free = [c for c, level in enumerate(costmap.level) if level >= FREE]
    for trial in range(8):
        a, b = (int(c) for c in rng.choice(free, 2, replace=False))
        found = Planning(costmap, None, costmap.centre(a), costmap.centre(b), PlannerSettings()).advance(
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
    costmap = build(np.zeros((30, 30), bool), np.zeros((30, 30), bool), resolution=0.1, origin=(0.0, 0.0))
    stairs: list[Point] = [costmap.centre(c) for c in (33, 34, 67, 68, 101, 102, 135)]
    assert shortcut(costmap, stairs) == (stairs[0], stairs[-1])
    assert shortcut(costmap, stairs[:1]) == (stairs[0],)


def test_nearest_is_nearest() -> None:
    blocked = np.zeros((20, 20), bool)
    blocked[5:15, 5:15] = True
    costmap = build(blocked, np.zeros_like(blocked), resolution=0.1, origin=(0.0, 0.0))
    cell = nearest(costmap, (0.62, 1.0), 0.5, FREE)
    assert cell is not None
    assert costmap.centre(cell) == pytest.approx((0.45, 1.05), abs=0.11)
    assert nearest(costmap, (1.0, 1.0), 0.3, FREE) is None


def test_a_line_crosses_exactly_its_cells() -> None:
    costmap = build(np.zeros((10, 10), bool), np.zeros((10, 10), bool), resolution=0.5, origin=(1.0, -1.0))
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


def test_levels_tell_the_distance_to_what_is_blocked() -> None:
    blocked = np.zeros((21, 21), bool)
    blocked[10, 10] = True
    costmap = build(blocked, np.zeros_like(blocked), resolution=0.1, origin=(0, 0), comfort=0.4, dislike=2.0)
    at = [costmap.clearance(1.05 + 0.1 * i, 1.05) for i in range(6)]
    assert at == pytest.approx([0.0, 0.1, 0.2, 0.3, 0.4, inf])
    assert costmap.multiplier == (inf, inf, 3.0, 2.5, 2.0, 1.5, 1.0)
    assert costmap.clearance(-5.0, 0.0) == 0.0


def test_a_cell_and_its_middle_agree() -> None:
    costmap: Costmap = build(
        np.zeros((7, 9), bool), np.zeros((7, 9), bool), resolution=0.05, origin=(-3.0, 2.0)
    )
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


@pytest.mark.parametrize(
    ("name", "value"), [("margin", -0.1), ("period", 0), ("unknown_multiplier", 0.5), ("comfort", inf)]
)
def test_settings_refuse_what_makes_no_sense(name: str, value: float) -> None:
    with pytest.raises(ValueError, match=name):
        PlannerSettings(**{name: value})  # type: ignore[arg-type]  # the point of the test
