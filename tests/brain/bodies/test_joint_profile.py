"""Profiles of joints against their limits, and against optima from elsewhere."""

from __future__ import annotations

from math import inf, nan, sqrt

import numpy as np
import pytest

from brain.bodies.joint_profile import (
    JointLimits,
    JointState,
    Profile,
    fastest,
    stopping,
    synchronised,
    velocity_step,
)

LIMITS = JointLimits(2.0, 5.0, 40.0)
RANDOM = 21


def random_state(random: np.random.Generator, limits: JointLimits, rest: bool = False) -> JointState:
    position, v, a = (float(x) for x in random.uniform(-1.0, 1.0, 3))
    if rest:
        return JointState(3.0 * position)
    a *= min(limits.acceleration, sqrt(limits.jerk * limits.velocity))
    room = limits.velocity - a * a / (2.0 * limits.jerk)  # its velocity stays within when it is calmed
    return JointState(3.0 * position, v * max(room, 0.0), a)


def random_limits(random: np.random.Generator) -> JointLimits:
    return JointLimits(*(float(x) for x in 10.0 ** random.uniform((-1, -0.5, 0.0), (1, 1.5, 3.0))))


def keeps(profile: Profile, limits: JointLimits) -> None:
    """Finite differences of the positions are within the limits, and the ends are exact."""
    end = profile.duration
    times = np.linspace(0.0, end, 200)
    dt = times[1] - times[0] if end else 1.0
    position = np.array([profile.at(float(t)).position for t in times])
    velocity, scale = np.diff(position) / dt, max(np.abs(position).max(), 1.0)
    assert np.abs(velocity).max() <= limits.velocity * (1.0 + 1e-9) + 1e-12 * scale / dt
    assert np.abs(np.diff(velocity)).max() / dt <= limits.acceleration * (1.0 + 1e-9) + 1e-12 * scale / dt**2
    assert np.abs(np.diff(velocity, 2)).max() / dt**2 <= limits.jerk * (1 + 1e-9) + 1e-12 * scale / dt**3
    states = np.array([profile.at(float(t)) for t in times])
    assert np.abs(np.diff(states[:, 0]) - states[:-1, 1] * dt).max() <= limits.acceleration * dt * dt + 1e-9
    assert profile.at(end) == profile.at(end + 1.0) == JointState(profile.goal)
    before = profile.at(end * (1.0 - 1e-9))
    assert before.position == pytest.approx(profile.goal, abs=1e-6)


def test_any_state_comes_to_rest_at_any_goal_within_the_limits() -> None:
    random = np.random.Generator(np.random.PCG64(RANDOM))
    for case in range(60):
        limits = random_limits(random)
        start = random_state(random, limits, rest=case % 3 == 0)
        profile = fastest(start, float(random.uniform(-4.0, 4.0) * random.choice([0.01, 1.0])), limits)
        assert profile.at(0.0) == pytest.approx(start)
        keeps(profile, limits)


@pytest.mark.parametrize(
    ("distance", "seconds"),
    [
        # Biagiotti and Melchiorri 2008, section 3.4: which of the limits are reached, symmetric double S.
        (10.0, 10.0 / 2.0 + 2.0 / 5.0 + 5.0 / 40.0),  # velocity and acceleration
        (0.5, 5.0 / 40.0 + sqrt((5.0 / 40.0) ** 2 + 4.0 * 0.5 / 5.0)),  # acceleration only
        (0.01, 4.0 * (0.01 / (2.0 * 40.0)) ** (1.0 / 3.0)),  # none but the jerk
    ],
)
def test_from_rest_it_takes_the_time_of_the_double_s(distance: float, seconds: float) -> None:
    for goal in (distance, -distance):
        assert fastest(JointState(0.0), goal, LIMITS).duration == pytest.approx(seconds, rel=1e-6)


def test_from_a_constant_velocity_it_is_what_is_left_of_a_longer_profile() -> None:
    """The end of an optimal profile is optimal (Bellman)."""
    whole = fastest(JointState(0.0), 3.0, LIMITS)
    for t in (0.6, 0.9, 1.2):
        assert whole.at(t).acceleration == 0.0
        rest = fastest(whole.at(t), 3.0, LIMITS)
        assert rest.duration == pytest.approx(whole.duration - t, abs=1e-6)
        assert rest.at(0.2) == pytest.approx(whole.at(t + 0.2), abs=1e-5)


def test_joints_begin_and_end_together_and_the_slowest_is_as_fast_as_alone() -> None:
    random = np.random.Generator(np.random.PCG64(RANDOM + 1))
    for _ in range(8):
        limits = [random_limits(random) for _ in range(6)]
        start = [random_state(random, one, rest=True) for one in limits]
        goal = [float(x) for x in random.uniform(-3.0, 3.0, 6)]
        both = synchronised(start, goal, limits)
        alone = max(fastest(*each).duration for each in zip(start, goal, limits, strict=True))
        assert both.duration == pytest.approx(alone)
        for joint, limit in zip(both.joints, limits, strict=True):
            assert joint.duration == pytest.approx(alone)
            keeps(joint, limit)


def test_joints_that_move_already_end_together_unless_one_cannot_wait() -> None:
    random, late = np.random.Generator(np.random.PCG64(RANDOM + 2)), 0
    for _ in range(30):
        limits = [LIMITS] * 3
        start = [JointState(0.0, float(v)) for v in random.uniform(-1.5, 1.5, 3)]
        goal = [float(x) for x in random.uniform(-3.0, 3.0, 3)]
        motion = synchronised(start, goal, limits)
        for joint in motion.joints:
            keeps(joint, LIMITS)
            late += abs(joint.duration - motion.duration) > 1e-6
    assert late <= 5


def test_the_way_to_rest_is_the_shortest_in_time() -> None:
    profile = stopping(JointState(1.0, 1.5), LIMITS)
    keeps(profile, LIMITS)
    assert profile.duration == pytest.approx(1.5 / 5.0 + 5.0 / 40.0)


def test_a_velocity_is_approached_step_by_step_as_at_once() -> None:
    random = np.random.Generator(np.random.PCG64(RANDOM + 3))
    for _ in range(50):
        state, goal = random_state(random, LIMITS), float(random.uniform(-3.0, 3.0))
        for _ in range(200):
            before, state = state, velocity_step(state, goal, 0.01, LIMITS)
            assert abs(state.acceleration - before.acceleration) <= LIMITS.jerk * 0.01 + 1e-9
            assert abs(state.acceleration) <= LIMITS.acceleration + 1e-9
        assert state[1:] == pytest.approx((max(min(goal, 2.0), -2.0), 0.0), abs=1e-9)


def test_a_start_beyond_the_limits_still_ends_at_the_goal() -> None:
    for start in (JointState(0.0, 9.0), JointState(0.0, -9.0, 30.0), JointState(0.0, 1.0, -30.0)):
        for goal in (-2.0, 0.1, 40.0):
            profile = fastest(start, goal, LIMITS)
            assert profile.at(profile.duration * (1.0 - 1e-9)).position == pytest.approx(goal, abs=1e-5)


@pytest.mark.parametrize("wrong", [nan, inf])
def test_what_is_not_finite_is_refused(wrong: float) -> None:
    for start, goal, limits in (
        (JointState(wrong), 0.0, LIMITS),
        (JointState(0.0), wrong, LIMITS),
        (JointState(0.0), 1.0, JointLimits(wrong, 1.0, 1.0)),
        (JointState(0.0), 1.0, JointLimits(1.0, 0.0, 1.0)),
    ):
        with pytest.raises(ValueError, match=r"finite|above 0"):
            fastest(start, goal, limits)
