"""Set-points whose jerk is limited, judged by finite differences; without a limit nothing is different."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from gateway.core.joint import Joint
from gateway.core.limits import Limits, SetpointProfile
from protocols.messages import Command, Feedback, Position, Velocity
from tests.gateway.core.test_joint import STEP, armed, joint, spec

DT = 0.005
LIMITS = Limits(3.0, 20.0, 2.0, (-2.0, 2.0), jerk=200.0)


def followed(wanted: list[Command], limits: Limits = LIMITS) -> list[tuple[float, float]]:
    """Positions and velocities commanded to a device that follows exactly."""
    profile, position, velocity = SetpointProfile(), 0.3, 0.0
    rows = [(position, velocity)]
    for each in wanted:
        out = profile.limited(each, DT, Feedback("m", 0, position, velocity), limits)
        match out:
            case Position():
                position, velocity = out.position, out.velocity
            case Velocity():
                position, velocity = position + out.velocity * DT, out.velocity
        rows.append((position, velocity))
    return rows


def keeps(speeds: list[float], limits: Limits = LIMITS) -> None:
    assert limits.jerk
    assert np.abs(speeds).max() <= limits.velocity + 1e-9
    assert np.abs(np.diff(speeds)).max() <= limits.acceleration * DT + 1e-9
    assert np.abs(np.diff(speeds, 2)).max() <= limits.jerk * DT * DT + 1e-9


def test_positions_with_changes_of_mind_keep_the_jerk_and_end_exactly() -> None:
    random = np.random.Generator(np.random.PCG64(4))
    wanted: list[Command] = []
    for _ in range(12):
        wanted += [Position("m", float(random.uniform(-2.5, 2.5)))] * int(random.integers(20, 200))
    rows = followed([*wanted, *[Position("m", 1.25)] * 600])
    keeps([velocity for _, velocity in rows])
    assert rows[-1] == (1.25, 0.0)
    assert max(abs(position) for position, _ in rows) <= 2.0


def test_velocities_keep_the_jerk() -> None:
    wheel = Limits(3.0, 20.0, 2.0, jerk=200.0)
    rows = followed(
        [*[Velocity("m", 2.5)] * 100, *[Velocity("m", -9.0)] * 20, *[Velocity("m", 0.0)] * 200], wheel
    )
    keeps([velocity for _, velocity in rows], wheel)
    assert rows[100][1] == pytest.approx(2.5)
    assert rows[-1][1] == pytest.approx(0.0, abs=1e-9)


@pytest.mark.parametrize("speed", [-3.0, 0.7, 3.0])
def test_a_velocity_ends_at_the_end_of_travel(speed: float) -> None:
    rows = followed([Velocity("m", speed)] * 1000)
    assert abs(rows[-1][0]) == pytest.approx(2.0, abs=0.02)
    assert max(abs(position) for position, _ in rows) <= 2.0 + 1e-3


def test_a_stop_brakes_without_regard_to_the_jerk() -> None:
    made = armed(joint(stop_action="brake"), velocity=5.0)
    smooth = replace(made.settings, limits=replace(made.settings.limits, jerk=100.0))
    made = armed(Joint("m", smooth, spec()), velocity=5.0)
    made.command(STEP, Velocity("m", 5.0), stopped=False)
    armed(made, velocity=5.0, t=STEP + 1)
    first, second = (made.command(step * STEP, None, stopped=True) for step in (2, 3))
    assert isinstance(first, Velocity)
    assert isinstance(second, Velocity)
    assert first.velocity - second.velocity == pytest.approx(50.0 * 0.005)
