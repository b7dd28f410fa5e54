"""Path error: positions on the earth against known distances, alignment against known motions."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from brain.belief import Floats
from gateway.rosbag.trajectory_error import aligned, east_north, path_error, spread
from protocols.messages import Fix


def fixes(*places: tuple[float, float]) -> list[Fix]:
    return [Fix("gps", 1, latitude, longitude) for latitude, longitude in places]


# Latitude, m of 0.001 degree along the meridian, along the parallel: from the radii of curvature of WGS 84
# (6335439.3 and 6378137.0 m at the equator, 6367381.8 and 6388838.3 m at 45 degrees, 6399593.6 m at the
# pole).
ARCS = [
    (0.0, 110.574276, 111.319491),
    (45.0, 111.131777, 78.846806),
    (-45.0, 111.131777, 78.846806),
    (89.999, 111.693980, 0.0),
]


@pytest.mark.parametrize(("latitude", "north", "east"), ARCS)
def test_a_thousandth_of_a_degree(latitude: float, north: float, east: float) -> None:
    towards = math.copysign(0.001, -latitude)
    here, along, beside = east_north(fixes((latitude, 11.0), (latitude + towards, 11.0), (latitude, 11.001)))
    assert here == pytest.approx([0.0, 0.0])
    assert along == pytest.approx([0.0, math.copysign(north, towards)], abs=1e-3)
    if east:
        assert beside[0] == pytest.approx(east, abs=1e-3)
        assert abs(beside[1]) < 1e-3


def test_there_is_no_seam_at_the_date_line() -> None:
    west, east = east_north(fixes((10.0, 179.9999), (10.0, -179.9999)))
    assert west == pytest.approx([0.0, 0.0])
    assert east == pytest.approx(east_north(fixes((10.0, 5.0), (10.0, 5.0002)))[1], abs=1e-6)


def path(seed: int, count: int = 40) -> Floats:
    random = np.random.Generator(np.random.PCG64(seed))
    steps: Floats = random.normal(0.0, 1.0, (count, 2)).cumsum(axis=0)
    return steps


def moved(points: Floats, turn: float, x: float, y: float) -> Floats:
    c, s = math.cos(turn), math.sin(turn)
    there: Floats = points @ np.array([[c, s], [-s, c]]) + [x, y]
    return there


@given(st.integers(0, 1000), st.floats(-math.pi, math.pi), st.floats(-1e4, 1e4), st.floats(-1e4, 1e4))
def test_where_a_path_begins_and_in_which_direction_is_no_error(
    seed: int, turn: float, x: float, y: float
) -> None:
    truth = path(seed)
    error = path_error(moved(truth, turn, x, y), truth)
    assert error.count == len(truth)
    assert error.largest < 1e-7


def test_a_wrong_scale_is_an_error() -> None:
    truth = path(1)
    centred = truth - truth.mean(axis=0)
    error = path_error(1.1 * truth, truth)
    assert error.rms == pytest.approx(0.1 * math.sqrt((centred**2).sum() / len(truth)))


def test_the_mirror_image_is_an_error() -> None:
    truth = path(2)
    assert path_error(truth * [1.0, -1.0], truth).rms > 0.5


@pytest.mark.parametrize("seed", range(5))
def test_no_other_turn_or_shift_leaves_less(seed: int) -> None:
    truth, believed = path(seed), path(seed) + path(seed + 100) * 0.3
    best = aligned(believed, truth)
    least = float(((truth - best) ** 2).sum())
    for turn, x, y in ((1e-3, 0, 0), (-1e-3, 0, 0), (0, 1e-2, 0), (0, -1e-2, 0), (0, 0, 1e-2), (0, 0, -1e-2)):
        assert float(((truth - moved(best, turn, x, y)) ** 2).sum()) > least


def test_figures_of_an_error_worked_out_by_hand() -> None:
    """A square whose corners are 1 m further out in x than they were: what remains is 1 m at each."""
    truth = np.array([(2.0, 2.0), (-2.0, 2.0), (-2.0, -2.0), (2.0, -2.0)])
    error = path_error(truth * [1.5, 1.0], truth)
    assert (error.count, error.rms, error.median, error.largest) == pytest.approx((4, 1.0, 1.0, 1.0))


@pytest.mark.parametrize(
    ("one", "other", "message"),
    [
        (np.zeros((2, 2)), np.zeros((2, 2)), "2 positions against 2: at least 3"),
        (np.zeros((4, 2)), np.zeros((5, 2)), "4 positions against 5"),
        (np.array([[0.0, 0.0], [1.0, math.nan], [2.0, 0.0]]), np.zeros((3, 2)), "not finite"),
        (np.zeros((3, 2)), np.array([[0.0, 0.0], [math.inf, 0.0], [2.0, 0.0]]), "not finite"),
    ],
)
def test_what_cannot_be_judged_is_refused(one: Floats, other: Floats, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        path_error(one, other)


def test_spread_is_the_farthest_from_the_centre() -> None:
    assert spread(np.array([(1.0, 1.0), (1.0, 1.0)])) == 0.0
    assert spread(np.array([(0.0, 0.0), (6.0, 8.0)])) == pytest.approx(5.0)
