"""Acceleration limits, as a pure function."""

from __future__ import annotations

from math import inf, nan

import numpy as np
import pytest

from brain.control.profile import REST, Twist, approach, step


def test_no_faster_than_both_accelerations() -> None:
    rng = np.random.Generator(np.random.PCG64(3))
    for _ in range(500):
        before, wanted = (Twist(*(float(v) for v in rng.uniform(-2, 2, 2))) for _ in range(2))
        dt = float(rng.uniform(0.001, 0.1))
        after = approach(before, wanted, dt, 0.8, 4.0)
        assert abs(after.linear - before.linear) <= 0.8 * dt + 1e-12
        assert abs(after.angular - before.angular) <= 4.0 * dt + 1e-12


def test_it_gets_there_and_stays() -> None:
    twist, wanted = REST, Twist(0.6, -1.0)
    for _ in range(100):
        twist = approach(twist, wanted, 0.01, 0.8, 4.0)
    assert twist == wanted


def test_speeding_up_keeps_the_arc() -> None:
    twist, wanted = REST, Twist(0.6, 0.9)
    for _ in range(30):
        twist = approach(twist, wanted, 0.02, 0.8, 4.0)
        assert twist.angular == pytest.approx(1.5 * twist.linear)


@pytest.mark.parametrize("bad", [nan, inf, -inf])
def test_what_is_not_finite_is_rest(bad: float) -> None:
    assert approach(REST, Twist(bad, 1.0), 0.1, 1.0, 1.0) == REST
    assert approach(REST, Twist(1.0, bad), 0.1, 1.0, 1.0) == REST


@pytest.mark.parametrize("dt", [0.0, -0.1, nan])
def test_no_time_no_change(dt: float) -> None:
    assert approach(Twist(0.1, 0.2), REST, dt, 1.0, 1.0) == Twist(0.1, 0.2)


def test_a_step_is_bounded_both_ways() -> None:
    assert [step(0.0, w, 0.5) for w in (-2.0, -0.3, 0.0, 0.3, 2.0)] == [-0.5, -0.3, 0.0, 0.3, 0.5]
