"""Reeds-Shepp paths: lengths as OMPL has them, ends exact, curvature bounded by finite differences."""

from __future__ import annotations

import json
from itertools import pairwise
from math import hypot, pi, remainder
from pathlib import Path

import numpy as np
import pytest

from brain.belief import Pose
from brain.planning.reeds_shepp import lengths, poses, words

ORIGIN = Pose(0.0, 0.0, 0.0)
ROWS = json.loads(Path(__file__).with_name("reeds_shepp.json").read_text())["poses"]


def test_lengths_equal_those_of_ompl_for_400_poses() -> None:
    x, y, yaw, expected = np.array(ROWS).T
    assert len(x) == 400
    assert np.abs(lengths(x, y, yaw, 1.0) - expected).max() < 1e-9
    assert np.abs(lengths(2.5 * x, 2.5 * y, yaw, 2.5) - 2.5 * expected).max() < 1e-8


@pytest.mark.parametrize("row", ROWS[::10], ids=lambda row: f"{row[0]:.2f},{row[1]:.2f},{row[2]:.2f}")
def test_every_word_ends_at_the_pose_and_the_first_is_the_shortest(row: list[float]) -> None:
    """From another place, and with another radius: neither changes the words."""
    x, y, yaw, expected = row
    found = words(Pose(3.0, -1.0, 0.0), Pose(3.0 + 0.5 * x, -1.0 + 0.5 * y, yaw), 0.5)
    assert sum(abs(part.distance) for part in found[0]) == pytest.approx(0.5 * expected, abs=1e-9)
    for parts in found:
        end_x, end_y, end_yaw = poses(Pose(3.0, -1.0, 0.0), parts, 1.0)[0][-1]
        assert hypot(end_x - 3.0 - 0.5 * x, end_y + 1.0 - 0.5 * y) < 1e-9, parts
        assert abs(remainder(end_yaw - yaw, 2.0 * pi)) < 1e-9, parts


def test_no_way_turns_more_tightly_than_its_radius() -> None:
    """Finite differences of the heading over the chord; the gear is the chord's side."""
    for x, y, yaw, _ in ROWS[::20]:
        track, gears = poses(ORIGIN, words(ORIGIN, Pose(x, y, yaw), 1.0)[0], 0.02)
        assert len(gears) == len(track) - 1
        for ((ax, ay, a), (bx, by, b)), gear in zip(pairwise(track.tolist()), gears, strict=True):
            step = hypot(bx - ax, by - ay)
            assert step <= 0.02 + 1e-9
            assert abs(remainder(b - a, 2.0 * pi)) <= step * 1.001 + 1e-9
            ahead = (bx - ax) * np.cos(a) + (by - ay) * np.sin(a)
            assert gear * ahead >= -1e-9


def test_straight_on_is_one_part_and_nowhere_is_none() -> None:
    assert [
        [round(part.distance, 9) for part in words(ORIGIN, Pose(d, 0.0, 0.0), 1.0)[0]] for d in (2.0, -2.0)
    ] == [
        [2.0],
        [-2.0],
    ]
    assert words(ORIGIN, ORIGIN, 1.0)[0] == ()
    assert lengths(np.zeros(1), np.zeros(1), np.zeros(1), 1.0)[0] == pytest.approx(0.0, abs=1e-9)
