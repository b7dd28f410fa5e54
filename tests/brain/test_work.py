"""The work of a step is bounded at the worst settings that are allowed: counted operations, and memory."""

from __future__ import annotations

import math
import tracemalloc
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from brain.base_brain import BaseBrain
from brain.belief import Pose
from brain.perception.grid import Grid, GridSettings, _inflated
from brain.perception.mount import Mount, to_body
from protocols.messages import LaserScan
from tests.brain.helpers import Office, Trip

LARGEST = GridSettings(resolution=0.05, width=50.0, height=50.0, farthest=100.0)
"""A million cells."""


def peak(action: Callable[[], object]) -> int:
    """Return the most memory that an action needs at once, in bytes."""
    tracemalloc.start()
    action()
    most = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    return most


def test_a_scan_touches_few_cells_of_the_largest_map() -> None:
    grid, beams = Grid(LARGEST), 10_000
    increment = 2.0 * math.pi / beams
    scan = LaserScan("lidar", 0, 0.0, increment, 0.05, 1000.0, (99.0,) * beams)
    swept = to_body(scan, Mount(), LARGEST.farthest)
    assert peak(lambda: grid.add(Pose(0.0, 0.0, 0.3), swept)) < 80e6
    assert np.count_nonzero(grid.free) > 100_000


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
