"""Raw ticks of the two wheels of a real robot (Mines ParisTech), and its lidar: odometry from ticks alone."""

from __future__ import annotations

import math
from collections.abc import Callable
from itertools import pairwise
from pathlib import Path

import pytest

from brain.belief import Pose
from brain.bodies.differential import Differential
from brain.bodies.plane import arc, wrap

WHEELS = Differential(
    left="left",
    right="right",
    wheel_radius=0.077,
    wheel_separation=0.33,
    radius=0.3,
    max_linear=1.5,
    max_angular=2.0,
    max_linear_acceleration=1.0,
    max_angular_acceleration=2.0,
)
TICKS = 2000
"""Of a turn: upstream's mines.py has them, and the wheels."""


@pytest.fixture(scope="module")
def lines(recording: Callable[[str], Path]) -> list[list[float]]:
    return [list(map(float, line.split())) for line in recording("mines/exp1.dat").read_text().splitlines()]


def test_ticks_give_the_path_and_its_end(lines: list[list[float]]) -> None:
    pose, path, turned = Pose(0.0, 0.0, 0.0), 0.0, 0.0
    angles = [[ticks * math.tau / TICKS for ticks in line[2:4]] for line in lines]
    for before, after in pairwise(angles):
        travel = WHEELS.travel(before, after)
        pose = arc(pose, travel.distance, travel.turn)
        path, turned = path + abs(travel.distance), turned + travel.turn
    assert path == pytest.approx(45.97, abs=0.005)
    assert (pose.x, pose.y) == pytest.approx((-5.78, -2.98), abs=0.005)
    assert math.degrees(pose.yaw) == pytest.approx(106.9, abs=0.05)
    assert wrap(turned) == pytest.approx(pose.yaw)


def test_nothing_in_the_ticks_is_faster_than_the_robot(lines: list[list[float]]) -> None:
    """Its largest step is a pause of the recording, not a jump of the counter."""
    steps = [
        (abs(after[at] - before[at]), (after[0] - before[0]) * 1e-6)
        for before, after in pairwise(lines)
        for at in (2, 3)
    ]
    assert max(ticks for ticks, _ in steps) == 917
    assert max(ticks / time for ticks, time in steps) == pytest.approx(7098, abs=1)
    assert lines[-1][0] - lines[0][0] == pytest.approx(74.6e6, abs=0.05e6)


def test_a_range_of_zero_is_no_return(lines: list[list[float]]) -> None:
    ranges = [mm for line in lines for mm in line[24:][:682]]
    assert ranges.count(0.0) / len(ranges) == pytest.approx(0.525, abs=5e-4)
    assert max(ranges) == 5562
