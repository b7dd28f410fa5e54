"""The work of a step is bounded at the worst settings that are allowed: counted operations, and memory."""

from __future__ import annotations

import math
import tracemalloc
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from brain.base_limb import BaseLimb
from brain.belief import Pose
from brain.perception.body_scan import to_body, to_world
from brain.perception.map import Map, MapSettings
from brain.perception.mount import Mount
from protocols.messages import LaserScan
from tests.brain.helpers import Office, Trip

LARGEST = MapSettings(farthest=97.0)
"""Sixteen million cells, all within reach of the beams."""


def peak(action: Callable[[], object]) -> int:
    """Return the most memory that an action needs at once, in bytes."""
    tracemalloc.start()
    action()
    most = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    return most


def test_a_scan_touches_few_cells_of_the_largest_map() -> None:
    chart, beams = Map(LARGEST), 10_000
    scan = LaserScan("lidar", 0, 0.0, 2.0 * math.pi / beams, 0.05, 1000.0, (96.0,) * beams)
    swept = to_body(scan, Mount(), LARGEST.farthest)
    assert peak(lambda: chart.add(Pose(0.0, 0.0, 0.3), swept, np.eye(3))) < 30e6
    assert np.count_nonzero(chart.view().log_odds < 0) > 50_000
    assert (
        np.count_nonzero(chart.values(*chart.cells(to_world(swept.ends, Pose(0.0, 0.0, 0.3))).T) > 0) == beams
    )


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
    trip.run(0.54)  # between two of the lidar's own
    assert isinstance(trip.brain.base, BaseLimb)
    perception = trip.brain.base.perception
    scan = replace(trip.office.scan(), **{"t": trip.office.now + 1, **change})
    before, anomalies = perception.map.version, perception.anomalies["lidar"].get(counted, 0)
    trip.brain.step(trip.office.now + 1, [scan], [], "")
    trip.run(0.05)
    assert perception.anomalies["lidar"][counted] == anomalies + 1
    assert perception.map.version == before
