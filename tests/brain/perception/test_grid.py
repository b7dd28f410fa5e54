import math

import numpy as np
import pytest

from brain.belief import Pose
from brain.perception.grid import MAX_MEAN_HITS, Grid, GridSettings, _inflated
from brain.perception.mount import BodyScan, Mount, to_body, to_world
from protocols.messages import LaserScan
from tests.brain.perception.office import MOUNTS, OFFICE, box, scan_at

SMALL = GridSettings(resolution=0.1, width=10.0, height=8.0)
HERE = Pose(0.0, 0.0, 0.0)
EXACT = GridSettings(resolution=0.1, width=10.0, height=8.0, gap=0.0)
"""Without the gaps between beams"""


def beam(distance: float, angle: float = 0.0, range_max: float = 4.0) -> BodyScan:
    scan = LaserScan("lidar", 0, angle, 0.01, 0.1, range_max, (distance,))
    return to_body(scan, Mount())


def seen(grid: Grid, pose: Pose = HERE, walls: np.ndarray = OFFICE, mount: Mount = MOUNTS["lidar"]) -> Grid:
    grid.add(pose, to_body(scan_at(walls, pose, mount, 0), mount))
    return grid


# -- the slow oracle ---------------------------------------------------------------------------


def line(start: tuple[int, int], stop: tuple[int, int]) -> list[tuple[int, int]]:
    """The cells from start to stop, one by one, without the last: along the longer side step by step,
    the other coordinate to the nearest whole number (halves up)."""
    dx, dy = stop[0] - start[0], stop[1] - start[1]
    n = max(abs(dx), abs(dy))
    return [
        (start[0] + math.floor(k * dx / n + 0.5 + 1e-12), start[1] + math.floor(k * dy / n + 0.5 + 1e-12))
        for k in range(n)
    ]


def slow(settings: GridSettings, scans: list[tuple[Pose, BodyScan]]) -> np.ndarray:
    """The same map, cell by cell in plain Python (without gaps)."""
    grid = Grid(settings)
    odds = np.zeros((grid.rows, grid.columns), dtype=np.float32)
    for pose, swept in scans:
        row, column = grid.cell(*to_world(np.array([swept.origin]), pose)[0])
        ends = to_world(swept.ends, pose)
        hit: set[tuple[int, int]] = set()
        passed: set[tuple[int, int]] = set()
        for i in range(len(ends)):
            if swept.ranges[i] > 0.0:
                end = grid.cell(float(ends[i, 0]), float(ends[i, 1]))
                passed |= {(y, x) for x, y in line((column, row), (end[1], end[0]))}
                hit |= {end} if swept.hit[i] else set()
        for y, x in sorted(passed | hit):
            if 0 <= y < grid.rows and 0 <= x < grid.columns:
                change = settings.hit if (y, x) in hit else -settings.miss
                value = np.float32(odds[y, x] + np.float32(change))
                odds[y, x] = min(max(value, np.float32(settings.low)), np.float32(settings.high))
    return odds


@pytest.mark.parametrize("seed", range(4))
def test_the_map_equals_the_slow_one(seed: int) -> None:
    random = np.random.Generator(np.random.PCG64(seed))
    scans: list[tuple[Pose, BodyScan]] = []
    for _ in range(6):
        x, y, yaw = (float(n) for n in random.uniform([-1.0, -1.2, -3.0], [3.5, 2.0, 3.0]))
        noise = 0.02 * random.normal(size=180)
        scan = scan_at(OFFICE, Pose(x, y, yaw), MOUNTS["lidar"], 0, noise, beams=180)
        scans.append((Pose(x, y, yaw), to_body(scan, MOUNTS["lidar"])))
    grid = Grid(EXACT)
    for pose, swept in scans:
        grid.add(pose, swept)
    assert (grid.log_odds == slow(EXACT, scans)).all(), f"seed {seed}"
    assert np.count_nonzero(grid.log_odds) > 2000


# -- the defects of the usual tutorial ---------------------------------------------------------


def test_the_map_lasts_from_scan_to_scan() -> None:
    """Defect: a fresh map for each scan."""
    grid = seen(Grid(GridSettings()))
    before = grid.log_odds.copy()
    seen(grid, Pose(5.5, 2.0, 1.0))
    known = before != 0.0
    assert np.count_nonzero(grid.log_odds) > np.count_nonzero(known) + 1000
    assert (grid.log_odds[known] != 0.0).all()
    assert grid.version == 2


def test_a_moved_obstacle_disappears_after_a_known_number_of_scans() -> None:
    """Defect: no clearing along the rays."""
    grid = Grid(GridSettings())
    room, crate = np.array(box(-2.0, -2.0, 3.0, 2.0)), np.array(box(1.0, -0.2, 1.4, 0.2))
    for _ in range(20):
        seen(grid, HERE, np.concatenate([room, crate]))
    spot = grid.cell(1.0, 0.0)
    assert grid.log_odds[spot] == np.float32(grid.settings.high)
    scans = math.ceil(grid.settings.high / grid.settings.miss)
    for i in range(scans):
        assert grid.log_odds[spot] > 0.0, f"gone after {i} scans"
        seen(grid, HERE, room)
    assert grid.log_odds[spot] < 0.0
    crate_cells = grid.occupied[grid.cell(0, -0.3)[0] : grid.cell(0, 0.3)[0], spot[1] - 1 : spot[1] + 8]
    assert not crate_cells.any()


@pytest.mark.parametrize(
    "mount",
    [Mount(), Mount(0.3, -0.1, yaw=1.2), Mount(-0.2, 0.0, yaw=math.pi), Mount(0.1, 0.1, yaw=2.0)],
)
@pytest.mark.parametrize("pose", [HERE, Pose(1.0, 0.5, 2.5), Pose(5.5, 2.0, -1.0)])
def test_a_scan_lands_where_the_walls_are(mount: Mount, pose: Pose) -> None:
    """Defect: the lidar's mounting and the robot's pose ignored."""
    grid = seen(Grid(GridSettings()), pose, OFFICE, mount)
    rows, columns = np.nonzero(grid.occupied)
    assert len(rows) > 150
    x = grid.origin_x + (columns + 0.5) * grid.resolution
    y = grid.origin_y + (rows + 0.5) * grid.resolution
    for wx, wy in zip(x, y, strict=True):
        dx = np.maximum(np.maximum(OFFICE[:, [0, 2]].min(1) - wx, wx - OFFICE[:, [0, 2]].max(1)), 0.0)
        dy = np.maximum(np.maximum(OFFICE[:, [1, 3]].min(1) - wy, wy - OFFICE[:, [1, 3]].max(1)), 0.0)
        assert np.hypot(dx, dy).min() <= grid.resolution * math.sqrt(0.5) + 1e-9


def test_unknown_is_not_free() -> None:
    """Defect: -1 is less than 50, so unknown was free."""
    grid = seen(Grid(GridSettings()))
    assert not (grid.unknown & grid.free).any()
    assert not (grid.unknown & grid.occupied).any()
    assert (grid.unknown | grid.free | grid.occupied).all()
    behind = grid.cell(9.8, 0.0)
    assert grid.unknown[behind]
    assert grid.log_odds[behind] == 0.0
    assert grid.free[grid.cell(0.5, 0.0)]


def test_obstacles_are_inflated() -> None:
    """Defect: no inflation."""
    grid = Grid(SMALL)
    grid.add(HERE, beam(2.05))
    blocked = grid.blocked(0.36)
    rows, columns = np.nonzero(blocked)
    middle = grid.center(*grid.cell(2.05, 0.0))
    half = grid.resolution / 2
    for row in range(grid.rows):
        for column in range(grid.columns):
            x, y = grid.center(row, column)
            away = math.hypot(max(abs(x - middle[0]) - half, 0.0), max(abs(y - middle[1]) - half, 0.0))
            assert blocked[row, column] == (away < 0.36), (row, column)
    assert len(rows) == len(columns) > 37


# -- the rest ----------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("distance", "range_max", "cleared", "hits"),
    [
        (2.05, 4.0, 20, 1),
        (99.0, 3.0, 30, 0),  # it meets nothing: cleared as far as it sees
        (0.05, 4.0, 0, 0),  # no reading
    ],
)
def test_a_beam_clears_its_way_and_marks_its_end(
    distance: float, range_max: float, cleared: int, hits: int
) -> None:
    grid = Grid(EXACT)
    grid.add(HERE, beam(distance, range_max=range_max))
    row, column = grid.cell(0.0, 0.0)
    assert (grid.log_odds[row, column : column + cleared] == np.float32(-0.4)).all()
    assert (grid.log_odds[row, column + cleared : column + cleared + hits] == np.float32(0.85)).all()
    assert np.count_nonzero(grid.log_odds) == cleared + hits


def test_a_cell_counts_once_per_scan() -> None:
    """A hundred beams into one cell are one hit, and one of them passing through does not clear it."""
    grid = Grid(EXACT)
    ranges = (1.05,) * 50 + (3.0,) + (1.05,) * 50
    scan = LaserScan("lidar", 0, -0.005, 0.0001, 0.1, 4.0, ranges)
    grid.add(HERE, to_body(scan, Mount()))
    assert grid.log_odds[grid.cell(1.05, 0.0)] == np.float32(0.85)
    assert grid.log_odds[grid.cell(0.5, 0.0)] == np.float32(-0.4)


def test_values_stay_within_their_bounds() -> None:
    grid = Grid(EXACT)
    for _ in range(30):
        grid.add(HERE, beam(2.05))
    assert grid.log_odds.max() == np.float32(grid.settings.high)
    assert grid.log_odds.min() == np.float32(grid.settings.low)


def test_a_known_cell_is_never_exactly_nought() -> None:
    """Hits and misses that cancel do not make a cell unknown again."""
    grid = Grid(GridSettings(resolution=0.1, width=10.0, height=8.0, hit=0.5, miss=0.5, gap=0.0))
    grid.add(HERE, beam(2.05))
    grid.add(HERE, beam(3.05))
    spot = grid.cell(2.05, 0.0)
    assert grid.log_odds[spot] != 0.0
    assert grid.free[spot]


def test_narrow_gaps_between_beams_are_free() -> None:
    """At 6 m the beams of a lidar of 360 lie two cells apart: a goal between them is not unknown."""
    walls = np.array(box(-7.0, -7.0, 7.0, 7.0))
    bare = seen(Grid(GridSettings(gap=0.0)), HERE, walls)
    filled = seen(Grid(GridSettings()), HERE, walls)
    inside = bare.cell(-6.8, -6.8)[0], bare.cell(6.8, 6.8)[0]
    middle = np.s_[inside[0] : inside[1], inside[0] : inside[1]]
    assert np.count_nonzero(bare.unknown[middle]) > 10_000
    assert np.count_nonzero(filled.unknown[middle]) < 200
    assert (filled.occupied == bare.occupied).all()
    assert filled.unknown[filled.cell(8.0, 0.0)]


def test_gaps_never_clear() -> None:
    """A leg of a chair that the beams miss on both sides stays where it was seen."""
    grid = Grid(GridSettings())
    grid.add(HERE, beam(5.0, angle=math.radians(0.5), range_max=10.0))
    leg = grid.cell(5.0 * math.cos(math.radians(0.5)), 5.0 * math.sin(math.radians(0.5)))
    assert grid.occupied[leg]
    wide = LaserScan("lidar", 0, math.radians(-1.0), math.radians(2.0), 0.1, 10.0, (8.0, 8.0))
    for _ in range(50):
        grid.add(HERE, to_body(wide, Mount()))
    assert grid.occupied[leg]
    assert grid.free[grid.cell(4.0, 0.0)]  # unknown before, between the two


def test_wide_gaps_stay_unknown() -> None:
    grid = Grid(GridSettings())
    wide = LaserScan("lidar", 0, -0.3, 0.6, 0.1, 10.0, (6.0, 6.0))
    grid.add(HERE, to_body(wide, Mount()))
    assert grid.unknown[grid.cell(3.0, 0.0)]
    assert grid.free[grid.cell(0.25, 0.0)]


def test_behind_the_shorter_of_two_beams_is_unknown() -> None:
    grid = Grid(GridSettings())
    scan = LaserScan("lidar", 0, -0.01, 0.02, 0.1, 10.0, (2.0, 6.0))
    grid.add(HERE, to_body(scan, Mount()))
    assert grid.unknown[grid.cell(4.0, 0.0)]


def test_beams_that_leave_the_map_are_cut() -> None:
    grid = Grid(GridSettings(resolution=0.1, width=2.0, height=2.0, gap=0.0))
    grid.add(HERE, beam(3.0))
    assert not grid.occupied.any()
    assert np.count_nonzero(grid.free) == 10
    grid.add(Pose(50.0, 50.0, 0.0), beam(3.0))
    assert np.count_nonzero(grid.log_odds) == 10


def test_a_robot_outside_the_map_still_sees_into_it() -> None:
    grid = Grid(GridSettings(resolution=0.1, width=2.0, height=2.0))
    grid.add(Pose(-3.0, 0.0, 0.0), beam(3.55))
    assert grid.occupied[grid.cell(0.55, 0.0)]
    assert grid.free[grid.cell(-0.5, 0.0)]


def test_cells_and_places() -> None:
    grid = Grid(GridSettings(resolution=0.1, width=10.0, height=8.0, center_x=1.0, center_y=-2.0))
    assert (grid.rows, grid.columns) == (80, 100)
    assert grid.cell(1.0, -2.0) == (40, 50)
    assert grid.center(0, 0) == pytest.approx((-3.95, -5.95))
    for row, column in [(0, 0), (79, 99), (13, 57)]:
        assert grid.cell(*grid.center(row, column)) == (row, column)


def test_a_view_is_a_value() -> None:
    grid = seen(Grid(GridSettings()))
    view = grid.view()
    assert view is grid.view()
    assert view.version == 1
    assert (view.log_odds == grid.log_odds).all()
    before = view.log_odds.copy()
    seen(grid, Pose(1.0, 1.0, 1.0))
    assert (view.log_odds == before).all()
    assert grid.view().version == 2


def test_blocked_follows_the_map() -> None:
    grid = seen(Grid(GridSettings()))
    first = grid.blocked(0.2)
    assert first is grid.blocked(0.2)
    assert np.count_nonzero(grid.blocked(0.4)) > np.count_nonzero(first)
    for _ in range(2):
        seen(grid, Pose(5.5, 2.0, 1.0))
    assert np.count_nonzero(grid.blocked(0.2)) > np.count_nonzero(first)


@pytest.mark.parametrize("radius", [0.0, 0.5, 1.0, 3.2, 7.0])
def test_inflation_equals_the_slow_one(radius: float) -> None:
    random = np.random.Generator(np.random.PCG64(5))
    occupied = random.random((40, 50)) < 0.02
    rows, columns = np.nonzero(occupied)
    y, x = np.mgrid[0:40, 0:50]
    away = np.full((40, 50), np.inf)
    for row, column in zip(rows, columns, strict=True):
        dy = np.maximum(np.abs(y - row) - 0.5, 0.0)
        dx = np.maximum(np.abs(x - column) - 0.5, 0.0)
        away = np.minimum(away, np.hypot(dx, dy))
    assert (_inflated(occupied, radius) == ((away < radius) | occupied)).all()


def test_inflation_of_nothing() -> None:
    assert not Grid(SMALL).blocked(0.3).any()


def test_means_are_finer_than_cells() -> None:
    grid = Grid(SMALL)
    for distance in (2.02, 2.04):
        grid.add(HERE, beam(distance))
    row, column = grid.cell(2.03, 0.0)
    cell = row * grid.columns + column
    assert grid.hits[cell] == 2
    assert grid.means[cell] == pytest.approx((2.03, 0.0))
    assert grid.facing[cell] == pytest.approx((-1.0, 0.0))
    for _ in range(2 * MAX_MEAN_HITS):
        grid.add(HERE, beam(2.09))
    assert grid.hits[cell] == MAX_MEAN_HITS  # the first count
    assert grid.means[cell, 0] == pytest.approx((2.02 + 2.04 + (MAX_MEAN_HITS - 2) * 2.09) / MAX_MEAN_HITS)
    for _ in range(20):
        grid.add(HERE, beam(3.5))
    assert grid.hits[cell] == 0  # what has gone is forgotten
