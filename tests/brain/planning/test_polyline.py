"""Polylines."""

from __future__ import annotations

from math import hypot

import pytest

from brain.planning.polyline import Polyline

L = Polyline(((0.0, 0.0), (2.0, 0.0), (2.0, 0.0), (2.0, 1.0)))


@pytest.mark.parametrize(
    ("along", "point"),
    [(0.0, (0.0, 0.0)), (1.0, (1.0, 0.0)), (2.0, (2.0, 0.0)), (2.5, (2.0, 0.5)), (4.0, (2.0, 2.0))],
)
def test_the_point_at_a_length(along: float, point: tuple[float, float]) -> None:
    assert L.point(along) == pytest.approx(point)


def test_repeated_points_are_dropped() -> None:
    assert L.length == 3.0
    assert len(L.points) == 3


@pytest.mark.parametrize(
    ("place", "low", "high", "along", "off"),
    [
        ((0.5, 0.3), 0.0, 9.0, 0.5, 0.3),
        ((-1.0, 0.0), 0.0, 9.0, 0.0, 1.0),
        ((2.5, 2.0), 0.0, 9.0, 3.0, hypot(0.5, 1.0)),
        ((1.8, 0.4), 0.0, 9.0, 2.4, 0.2),
        ((1.8, 0.4), 0.0, 2.0, 1.8, 0.4),
        ((0.5, 0.3), 1.0, 9.0, 1.0, hypot(0.5, 0.3)),
        ((0.5, 0.3), 3.0, 9.0, 3.0, hypot(1.5, 0.7)),
    ],
)
def test_projection(place: tuple[float, float], low: float, high: float, along: float, off: float) -> None:
    assert L.project(place, low, high) == pytest.approx((along, off))


def test_a_line_of_one_point() -> None:
    dot = Polyline(((1.0, 2.0),))
    assert dot.length == 0.0
    assert dot.point(3.0) == (1.0, 2.0)
    assert dot.project((1.0, 0.0)) == (0.0, 2.0)


def test_straight_parts_end_at_corners_and_at_the_end() -> None:
    line = Polyline(((0.0, 0.0), (3.0, 0.0), (3.0, 1.0)))
    assert [line.straight(at, 2.0) for at in (0.0, 2.0, 3.0, 3.5, 4.0)] == [2.0, 3.0, 4.0, 4.0, 4.0]
