"""The map that another program has perceived."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from brain.belief import Pose
from brain.perception.given_map import MOST_GONE, GivenMap
from protocols.messages import Grid

HERE = Pose(0.0, 0.0, 0.0)
GRID = Grid(0.0, 0.0, 0.0, False, 0.05, 64, np.full(64 * 64, 2, np.uint8).tobytes())
"""One tile, occupied"""


def test_who_looks_at_each_version_sees_what_came_and_what_went() -> None:
    given = GivenMap(0.05)
    assert given.take(GRID, HERE) == ""
    assert given.changed(0) == [(0, 0)]
    assert given.take(GRID, HERE) == ""
    assert given.changed(1) == []
    assert given.take(replace(GRID, x=3.2), HERE) == ""
    assert sorted(given.changed(2)) == [(0, 0), (0, 1)]
    assert given.tile(0, 0) is None


def test_a_grid_whose_origin_keeps_jumping_takes_no_more_memory() -> None:
    given = GivenMap(0.05)
    for jump in range(MOST_GONE + 100):
        given.take(replace(GRID, x=3.2 * jump), HERE)
        assert sorted(given.changed(given.version - 1)) == [(0, n) for n in (jump - 1, jump) if n >= 0]
    assert len(given.changed(0)) == MOST_GONE + 1
