"""The costmap: levels as distances to obstacles, drawn tile by tile as the map changes and rolls."""

from __future__ import annotations

from math import inf

import numpy as np
import pytest

from brain.belief import Pose
from brain.perception.body_scan import to_body
from brain.perception.map import Map, MapSettings
from brain.perception.mount import Mount
from brain.planning.costmap import (
    NEAR,
    OCCUPIED,
    TILE,
    TOUCHING,
    UNKNOWN,
    Costmap,
    PlannerSettings,
    disc,
)
from tests.brain.perception.office import box, scan_at
from tests.brain.planning.maps import RADIUS, PlainMap, drawn


def test_levels_give_the_distance_to_blocked_cells() -> None:
    occupied = np.zeros((21, 21), bool)
    occupied[10, 10] = True
    settings = PlannerSettings(margin=0.0, comfort=0.4, dislike=2.0)
    costmap = drawn(PlainMap(occupied, low=(0, 0)), 0.0, settings)
    at = [costmap.clearance(1.05 + 0.1 * i, 1.05) for i in range(6)]
    assert at == pytest.approx([0.0, 0.1, 0.2, 0.3, 0.4, inf])
    assert costmap.multiplier[: costmap.top + 1].tolist() == [inf, inf, 12.0, 3.0, 2.5, 2.0, 1.5, 1.0]
    assert costmap.clearance(-50.0, 0.0) == 0.0


@pytest.mark.parametrize(("radius", "margin"), [(0.25, 0.05), (0.0, 0.15), (0.31, 0.0), (0.8, 0.7)])
def test_blocked_are_the_cells_within_the_radius_of_an_obstacle(radius: float, margin: float) -> None:
    """Across the borders of tiles, against each obstacle and cell in turn."""
    rng = np.random.Generator(np.random.PCG64(5))
    grid = PlainMap(rng.random((140, 150)) < 0.004, rng.random((140, 150)) < 0.2, (-70, -60))
    costmap = drawn(grid, radius, PlannerSettings(margin=margin))
    rows, columns = (axis.reshape(-1) for axis in np.indices(grid.occupied.shape))
    level = costmap.levels(rows + grid.low[0], columns + grid.low[1]).reshape(grid.occupied.shape)
    seen = grid.occupied & ~grid.unknown
    grid.occupied = seen
    assert np.array_equal(level == OCCUPIED, seen)
    assert np.array_equal(level <= TOUCHING, grid.blocked(radius))
    assert np.array_equal(level % UNKNOWN <= NEAR, grid.blocked(radius + margin))
    assert np.array_equal(level >= UNKNOWN, grid.unknown & (level > NEAR))


@pytest.mark.parametrize("radius", [0.0, 0.3, 0.5, 1.0, 1.5, 2.2, 4.9])
def test_an_inflation_is_the_union_of_discs(radius: float) -> None:
    """Against each pair of cells: the middle of one, and the nearest part of the other."""
    side, cells = 17, [(8, 8), (6, 9), (10, 5)]
    grown = disc(sum(1 << row * side + column for row, column in cells), side, radius)
    rows, columns = np.indices((side, side))
    near = np.zeros((side, side), bool)
    for row, column in cells:
        up, across = (np.maximum(np.abs(axis) - 0.5, 0.0) for axis in (rows - row, columns - column))
        near |= (up**2 + across**2 < radius**2) | (up + across == 0)
    assert [bool(grown >> bit & 1) for bit in range(side * side)] == near.reshape(-1).tolist()


def test_what_changes_is_drawn_anew_a_few_tiles_at_a_time_as_if_from_scratch() -> None:
    """Obstacles come and go, ground becomes known, or is forgotten; tiles beside those that changed, too."""
    rng = np.random.Generator(np.random.PCG64(9))
    grid = PlainMap(np.zeros((300, 300), bool), np.ones((300, 300), bool), (-150, -150))
    grid.window = range(-2, 2), range(-2, 2)
    costmap, redrawn = Costmap(0.1, RADIUS, PlannerSettings()), 0
    for _ in range(60):
        row, column = rng.integers(0, 280, 2)
        grid.occupied[row : row + 20, column : column + 20] = rng.random((20, 20)) < rng.choice((0.0, 0.02))
        row, column = rng.integers(0, 250, 2)
        grid.unknown[row : row + 50, column : column + 50] = False
        if rng.random() < 0.2:
            south, west = rng.integers(-3, 0, 2).tolist()
            grid.window = range(south, south + 3), range(west, west + 3)
        grid.version += 1
        assert costmap.update(grid, (0.0, 0.0), 2) <= 2
        redrawn += 2
    while costmap.pending:
        redrawn += costmap.update(grid, (0.0, 0.0), 2)
    assert costmap.tiles == drawn(grid).tiles
    assert redrawn < 60 * 20


def test_each_tile_is_drawn_once_and_a_change_far_from_its_edge_draws_no_other() -> None:
    grid = PlainMap(np.eye(3 * TILE, dtype=bool), low=(0, 0))
    costmap = Costmap(0.1, RADIUS, PlannerSettings())
    beside = 10  # about the two ends of the diagonal
    assert sum(costmap.update(grid, (0.0, 0.0), 1) for _ in range(100)) == 9 + beside
    for cell, tiles in ((TILE + 32, 1), (TILE + 1, 4)):
        grid.occupied[cell, cell] = False
        grid.version += 1
        count = costmap.update(grid, (0.0, 0.0), 1)
        while costmap.pending:
            count += costmap.update(grid, (0.0, 0.0), 1)
        assert count == tiles


def test_of_a_large_map_only_what_was_observed_is_drawn() -> None:
    large, pose = Map(MapSettings()), Pose(0.0, 0.0, 0.0)
    scan = scan_at(np.array(box(-2.0, -2.0, 2.0, 2.0)), pose, Mount(), 0, np.zeros(360))
    large.add(pose, to_body(scan, Mount()), np.zeros((3, 3)))
    costmap = Costmap(large.resolution, RADIUS, PlannerSettings())
    assert sum(costmap.update(large, (0.0, 0.0), 1) for _ in range(100)) <= 16
    assert costmap.region is not None
    assert costmap.clearance(0.0, 0.0) > 0.0
    assert costmap.clearance(1.9, 0.0) == 0.0
