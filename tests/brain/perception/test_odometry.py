import math
from itertools import pairwise

import numpy as np
import pytest

from brain.perception.odometry import MAX_SAMPLES, Odometry, OdometrySettings, Travel
from protocols.messages import MILLISECOND, SECOND, Feedback, Nanos
from tests.brain.perception.office import BODY

MS = MILLISECOND


def received(odometry: Odometry, *reports: tuple[str, Nanos, float | None]) -> list[Travel]:
    travels: list[Travel] = []
    for motor, t, angle in reports:
        more, trouble = odometry.observe(Feedback(motor, t, angle))
        assert trouble == ""
        travels += more
    return travels


def new() -> Odometry:
    return Odometry(BODY, OdometrySettings())


def test_reports_at_one_time_are_one_travel() -> None:
    travels = received(
        new(), ("left", 0, 1.0), ("right", 0, 2.0), ("left", 10 * MS, 1.1), ("right", 10 * MS, 2.3)
    )
    assert [(t.since, t.t) for t in travels] == [(0, 10 * MS)]
    assert (travels[0].left, travels[0].right) == pytest.approx((0.1, 0.3))


def test_the_right_wheel_is_interpolated_to_the_lefts_times() -> None:
    """Constant speeds, reports 3 ms apart: no false turn comes of it."""
    odometry = new()
    travels: list[Travel] = []
    for i in range(50):
        travels += received(odometry, ("left", 10 * i * MS, 0.02 * i), ("right", (10 * i + 3) * MS, 0.02 * i))
    assert len(travels) == 48
    for travel in travels:
        assert travel.t - travel.since == 10 * MS
        assert (travel.left, travel.right) == pytest.approx((0.02, 0.02), abs=1e-12)


@pytest.mark.parametrize("seed", range(5))
def test_travels_add_up_to_the_angles(seed: int) -> None:
    """Whatever the stamps, and with reports lost: nothing of the way is lost or counted twice."""
    random = np.random.Generator(np.random.PCG64(seed))
    reports = [
        (motor, int(t), 3.0 * math.sin(t / 1e9) * sign)
        for motor, sign in (("left", 1.0), ("right", -1.0))
        for t in np.cumsum(random.integers(1 * MS, 30 * MS, 300))
        if random.random() > 0.2
    ]
    odometry = new()
    travels = received(odometry, *sorted(reports, key=lambda report: report[1]))
    assert all(a.t == b.since for a, b in pairwise(travels)), f"seed {seed}"
    angle = {t: position for motor, t, position in reports if motor == "left"}
    way = angle[travels[-1].t] - angle[travels[0].since]
    assert sum(travel.left for travel in travels) == pytest.approx(way, abs=1e-9), f"seed {seed}"
    # The right wheel is interpolated: off by at most the bend of the sine between its reports.
    assert sum(travel.right for travel in travels) == pytest.approx(-way, abs=0.02), f"seed {seed}"


def test_a_missing_wheel_gives_no_travel_and_is_made_up_for_when_it_comes_back() -> None:
    odometry = new()
    received(odometry, ("left", 0, 0.0), ("right", 0, 0.0))
    for i in range(1, 101):
        assert received(odometry, ("left", 10 * i * MS, 0.01 * i)) == []
    travels = received(odometry, ("right", 1 * SECOND, 1.0))
    assert sum(travel.left for travel in travels) == pytest.approx(1.0)
    assert sum(travel.right for travel in travels) == pytest.approx(1.0)


@pytest.mark.parametrize("mute", ["left", "right"])
def test_a_wheel_that_stays_away_costs_no_memory_and_no_way(mute: str) -> None:
    odometry = new()
    other = "right" if mute == "left" else "left"
    received(odometry, ("left", 0, 0.0), ("right", 0, 0.0))
    reports = 3 * MAX_SAMPLES
    for i in range(1, reports + 1):
        received(odometry, (other, 10 * i * MS, 0.01 * i))
    assert sum(len(wheel.samples) for wheel in odometry._wheels.values()) <= MAX_SAMPLES + 1
    last = 10 * reports * MS
    travels = received(odometry, (mute, last, 0.5))
    assert travels[0].since == 0
    assert sum(getattr(travel, other) for travel in travels) == pytest.approx(0.01 * reports)
    assert sum(getattr(travel, mute) for travel in travels) == pytest.approx(0.5)


def test_no_position_is_no_report() -> None:
    assert received(new(), ("left", 0, None), ("right", 0, None), ("left", MS, None)) == []


def test_a_jump_is_a_new_zero() -> None:
    """A device that was reset and counts from 0 again does not throw the robot across the room."""
    odometry = new()
    received(
        odometry, ("left", 0, 40.0), ("right", 0, 40.0), ("left", 10 * MS, 40.1), ("right", 10 * MS, 40.1)
    )
    assert odometry.observe(Feedback("left", 20 * MS, 0.0)) == ([], "position jumped")
    travels = received(odometry, ("right", 20 * MS, 40.2), ("left", 30 * MS, 0.1), ("right", 30 * MS, 40.3))
    assert [(t.since, t.t) for t in travels] == [(20 * MS, 30 * MS)]
    assert (travels[0].left, travels[0].right) == pytest.approx((0.1, 0.1))


def test_the_fastest_wheel_does_not_jump() -> None:
    odometry = new()
    for i in range(20):
        received(odometry, ("left", 10 * i * MS, BODY.wheel_speed * 0.01 * i), ("right", 10 * i * MS, 0.0))


def test_what_is_refused() -> None:
    odometry = new()
    received(odometry, ("left", 10 * MS, 1.0))
    for bad in (math.nan, math.inf):
        assert odometry.observe(Feedback("left", 20 * MS, bad)) == ([], "not finite")
    assert odometry.observe(Feedback("left", 9 * MS, 1.0)) == ([], "out of order")
    assert odometry.observe(Feedback("left", 10 * MS, 1.1)) == ([], "out of order")
    assert odometry.observe(Feedback("left", 10 * MS, 1.0)) == ([], "")  # repeated


def test_reports_at_1_khz_are_joined() -> None:
    odometry = new()
    travels: list[Travel] = []
    for i in range(101):
        travels += received(odometry, ("left", i * MS, 0.001 * i), ("right", i * MS, 0.002 * i))
    assert {t.t - t.since for t in travels} == {4 * MS}
    assert sum(t.right for t in travels) == pytest.approx(0.2)
