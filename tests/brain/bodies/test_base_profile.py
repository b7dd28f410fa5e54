"""Limits of acceleration and jerk, judged by finite differences of what is commanded."""

from __future__ import annotations

from dataclasses import replace
from math import hypot, inf, nan

import numpy as np
import pytest

from brain.bodies.base_profile import approach, braked, step
from brain.bodies.differential import Differential
from brain.bodies.plane import REST, Commanded, Twist
from tests.brain.control.ride import PERIOD, acceleration, jerk
from tests.brain.helpers import BODY

ROUGH = replace(BODY, max_linear_jerk=6.0, max_angular_jerk=30.0)


def commanded(wanted: list[Twist], now: Commanded = Commanded(), dt: float = PERIOD) -> list[Twist]:  # noqa: B008  # frozen
    twists = [now.twist]
    for each in wanted:
        now = approach(now, each, dt, ROUGH)
        twists.append(now.twist)
    return twists


def test_whatever_is_wanted_the_speed_keeps_acceleration_and_jerk() -> None:
    random = np.random.Generator(np.random.PCG64(3))
    wanted: list[Twist] = []
    for _ in range(40):
        each = Twist(*(float(v) for v in random.uniform((-0.6, -2.0), (0.6, 2.0))))
        wanted += [each] * int(random.integers(1, 60))
    twists = commanded(wanted)
    linear, angular = [t.linear for t in twists], [t.angular for t in twists]
    assert acceleration(linear) <= ROUGH.max_linear_acceleration + 1e-9
    assert jerk(linear) <= ROUGH.max_linear_jerk + 1e-6
    assert acceleration(angular) <= ROUGH.max_angular_acceleration + 1e-9


def test_it_gets_there_and_stays() -> None:
    wanted = Twist(0.6, -1.0)
    assert commanded([wanted] * 100)[-1] == pytest.approx(wanted)


def test_rest_is_exact_and_soon() -> None:
    for twist in (Twist(0.6, 1.0), Twist(0.0, -2.0), Twist(0.3, 0.5, -0.4)):
        twists = commanded([REST] * 75, Commanded(twist))
        assert twists[-1] == REST


@pytest.mark.parametrize("curvature", [0.5, -2.0, 4.0, 12.0])
def test_braking_and_speeding_up_keep_the_arc(curvature: float) -> None:
    """Within 5 %, and the limits of the angular motion too: on a tight arc the speed changes less quickly."""
    speed = min(0.6, 2.0 / abs(curvature))
    fast = Twist(speed, curvature * speed)
    for wanted in ([fast] * 100 + [REST] * 100, [fast] * 100 + [fast.scaled(0.3)] * 60):
        twists = commanded(wanted)
        on_way = [t for t in twists if abs(t.linear) > 0.02]
        assert max(abs(t.angular / t.linear / curvature - 1.0) for t in on_way) < 0.05
        assert twists[-1] == pytest.approx(wanted[-1], abs=1e-9)
        angular = [t.angular for t in twists]
        assert acceleration(angular) <= ROUGH.max_angular_acceleration + 1e-9
        assert jerk(angular) <= ROUGH.max_angular_jerk * 1.01


def test_what_moves_sideways_changes_its_direction_within_the_limits() -> None:
    ways = [(0.5, 0.0), (0.0, 0.4), (-0.3, 0.3), (0.0, 0.0)]
    twists = np.array(commanded([Twist(x, 0.5, y) for x, y in ways for _ in range(80)]))
    first = np.diff(twists[:, ::2], axis=0) / PERIOD
    assert np.hypot(*first.T).max() <= ROUGH.max_linear_acceleration + 1e-9
    second = np.diff(first, axis=0) / PERIOD
    assert np.hypot(*second.T).max() <= ROUGH.max_linear_jerk * 2.0**0.5 + 1e-6
    assert hypot(*twists[-1, ::2]) == pytest.approx(0.0, abs=1e-9)


@pytest.mark.parametrize("bad", [nan, inf, -inf])
def test_what_is_not_finite_is_rest(bad: float) -> None:
    for wanted in (Twist(bad, 1.0), Twist(1.0, bad), Twist(1.0, 0.0, bad)):
        assert approach(Commanded(), wanted, 0.1, BODY) == Commanded()


@pytest.mark.parametrize("dt", [0.0, -0.1, nan])
def test_no_time_no_change(dt: float) -> None:
    now = Commanded(Twist(0.1, 0.2), Twist(0.3))
    assert approach(now, REST, dt, BODY) == now


def test_a_step_is_bounded_both_ways() -> None:
    assert [step(0.0, w, 0.5) for w in (-2.0, -0.3, 0.0, 0.3, 2.0)] == [-0.5, -0.3, 0.0, 0.3, 0.5]


@pytest.mark.parametrize("body", [BODY, ROUGH])
def test_braking_keeps_to_the_arc_within_the_jerks_and_ends_at_rest(body: Differential) -> None:
    """From each motion, also while it speeds up, brakes already, or changes its curvature."""
    for twist in (Twist(0.6), Twist(-0.5, 0.7), Twist(0.0, 1.8), Twist(0.3, 0.2, -0.4), Twist(1e-4, 1e-5)):
        for growth, turning in ((0.0, 0.0), (0.8, 0.0), (-0.9, 0.0), (0.4, 2.0), (0.0, -3.0)):
            speed = max(twist.speed, 1e-3)
            rate = twist.scaled(growth / speed) if twist.speed else Twist()
            now = Commanded(twist, Twist(rate.linear, rate.angular + turning, rate.lateral))
            track, limit = [now], 0.7 * (1.0 + 1e-6)
            while any(track[-1].twist) or any(track[-1].rate):
                track.append(braked(track[-1], PERIOD, body))
                assert len(track) < 150
            accelerations = np.array([each.rate for each in track])
            changes = np.abs(np.diff(accelerations, axis=0)) / PERIOD
            assert changes[:, 0].max() <= limit * body.max_linear_jerk
            assert changes[:, 2].max() <= limit * body.max_linear_jerk
            assert changes[:, 1].max() <= 2.0 * limit * body.max_angular_jerk  # of the arc, and off it
            if not turning:
                for each in track:
                    share = sum(each.twist) / sum(twist)
                    assert each.twist == pytest.approx(tuple(twist.scaled(share)), abs=1e-6)
