"""Positions beyond the range in which they are reported."""

from __future__ import annotations

import pytest

from protocols.messages import MILLISECOND
from protocols.toolkit.turns import Turns


def test_a_position_that_wraps_goes_on() -> None:
    turns, end = Turns(), 10.0
    places = []
    for step in range(100):
        wrapped = (0.5 * step + end) % (2.0 * end) - end
        places.append(turns.add(step * MILLISECOND, wrapped, 500.0, end))
    assert places == pytest.approx([0.5 * step for step in range(100)])


def test_beyond_the_range_the_velocity_counts_and_back_inside_nothing_is_lost() -> None:
    turns, end = Turns(), 10.0
    path = [0.5 * step for step in range(40)] + [0.5 * step for step in range(40, 0, -1)]
    speeds = [500.0] * 40 + [-500.0] * 40
    inside = [place if place < end else None for place in path]
    places = [
        turns.add(at * MILLISECOND, place, speed, end)
        for at, (place, speed) in enumerate(zip(inside, speeds, strict=True))
    ]
    assert places == pytest.approx(path, abs=0.51)
    assert places[:20] == path[:20]
