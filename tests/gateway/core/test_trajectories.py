"""A trajectory is followed as it is given; a position alone is a place to come to rest at."""

from __future__ import annotations

from collections.abc import Callable
from itertools import pairwise
from math import cos, pi, sin

import pytest

from gateway.core.limits import Limits, SetpointProfile
from protocols import messages as msg
from protocols.messages import Feedback, Position
from tests.gateway.core.starts import MOTORS, Bench, robot_of

DT = 0.005
LIMITS = Limits(5.0, 20.0, 2.0, (-1.5, 1.5))
RATE = 2.0 * pi * 0.7
"""rad/s of the sine: 0.8 rad give 3.5 rad/s and 15.5 rad/s²"""


def sine(t: float) -> tuple[float, float]:
    """Return position and velocity that begin at rest."""
    return 0.8 * (1.0 - cos(RATE * t)) / 2.0, 0.4 * RATE * sin(RATE * t)


def set_points(
    sample: Callable[[float], tuple[float, float]], every: int = 1, limits: Limits = LIMITS
) -> list[tuple[float, float]]:
    """Return what a joint is commanded that is given a sample at every so many steps, for two seconds."""
    profile, given, out = SetpointProfile(), Position("m", 0.0), list[tuple[float, float]]()
    for step in range(400):
        if step % every == 0:
            given = Position("m", *sample(step * DT))
        one = profile.limited(given, DT, Feedback("m", 0, 0.0, 0.0), limits)
        assert isinstance(one, Position)
        out.append((one.position, one.velocity))
    return out


def smooth(t: float) -> tuple[float, float]:
    """Return position and velocity that begin at rest and without acceleration: the jerk is small."""
    return 0.4 * (t - sin(RATE * t) / RATE), 0.4 * (1.0 - cos(RATE * t))


@pytest.mark.parametrize(("jerk", "sample"), [(None, sine), (None, smooth), (400.0, smooth)])
def test_a_trajectory_within_the_limits_is_followed_as_it_is_given(
    jerk: float | None, sample: Callable[[float], tuple[float, float]]
) -> None:
    out = set_points(sample, limits=Limits(5.0, 20.0, 2.0, (-1.5, 1.5), jerk))
    assert out[20:] == [pytest.approx(sample(n * DT), abs=1e-9) for n in range(20, 400)]


def test_a_step_of_its_acceleration_takes_a_moment_where_the_jerk_is_limited() -> None:
    out = set_points(sine, limits=Limits(5.0, 20.0, 2.0, (-1.5, 1.5), 400.0))
    changes = [b[1] - a[1] for a, b in pairwise(out)]
    assert max(abs(b - a) for a, b in pairwise(changes)) <= 400.0 * DT * DT + 1e-9
    assert out[60:] == [pytest.approx(sine(n * DT), abs=0.05) for n in range(60, 400)]


@pytest.mark.parametrize("every", [2, 4, 10])
def test_one_with_fewer_samples_is_followed_between_them(every: int) -> None:
    out = set_points(sine, every)
    for step in range(100, 400):
        assert out[step][0] == pytest.approx(sine(step * DT)[0], abs=0.01 * every)
        assert out[step][1] == pytest.approx(sine(step * DT)[1], abs=0.2 * every)


def test_one_beyond_the_limits_is_followed_within_them() -> None:
    out = set_points(lambda t: (3.0 * sin(6.0 * t), 18.0 * cos(6.0 * t)))
    speeds = [velocity for _, velocity in out]
    assert max(map(abs, speeds)) <= LIMITS.velocity
    assert max(abs(b - a) for a, b in pairwise(speeds)) <= LIMITS.acceleration * DT + 1e-9
    assert max(abs(b[0] - a[0]) for a, b in pairwise(out)) <= LIMITS.velocity * DT + 1e-9
    assert max(abs(position) for position, _ in out) <= 1.5


def test_a_velocity_beside_a_position_that_stays_moves_nothing() -> None:
    assert set_points(lambda _: (0.0, 1.5)) == [(0.0, 0.0)] * 400
    rest = set_points(lambda _: (1.0, -1.5))[-1]
    assert rest == (1.0, 0.0)


@pytest.mark.sample(4)
@pytest.mark.parametrize(
    "motor", [motor for motor in MOTORS if msg.Position in robot_of(motor).motors["left"].spec.commands]
)
def test_every_language_follows_a_trajectory(motor: str) -> None:
    """What a program gives at each step arrives: the shaft is where it should be, at most 60 ms later."""
    bench = Bench.of(robot_of(motor), 1)
    bench.run(0.5, msg.Position("left", 0.0))
    begin, worst = bench.clock.now(), [0.0]

    def sample() -> msg.Position:
        t = (bench.clock.now() - begin) / 1e9
        lags = [abs(bench.place - sine(max(0.0, t - lag * 0.005))[0]) for lag in range(13)]
        worst.append(min(lags))
        return msg.Position("left", *sine(t))

    bench.run(2.0, each=sample)
    assert not bench.gateway.joints["left"].faults
    assert max(worst) < 0.05, max(worst)
