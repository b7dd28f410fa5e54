"""The set-point of the firmware, turn by turn: what the bench shows as a motion only."""

from __future__ import annotations

import math

import pytest

from protocols.moteus.decoder import DEFAULTS
from protocols.moteus.options import Settings
from protocols.moteus.registers import Register
from protocols.moteus.setpoint import Setpoint, trajectory_limits

DT = 1e-3
GENTLE = Settings(default_accel_limit=1.0)


def command(**registers: float) -> dict[int, float]:
    """A command as it stands after its frame: what is not named has its default."""
    return {**DEFAULTS, **{Register[f"COMMAND_{name.upper()}"]: value for name, value in registers.items()}}


def test_it_begins_where_the_shaft_is_and_as_fast_as_it_turns() -> None:
    setpoint = Setpoint()
    setpoint.take(math.nan)
    setpoint.follow(DT, GENTLE, command(position=math.nan, velocity=0.0), 2.0, 3.0)
    assert setpoint.velocity == pytest.approx(3.0 - 1.0 * DT)
    assert setpoint.position == pytest.approx(2.0 + setpoint.velocity * DT)


def test_passing_through_the_goal_is_not_the_end() -> None:
    goal = 4.999e-3
    setpoint = Setpoint(position=0.0, velocity=5.0)
    setpoint.take(goal)
    setpoint.follow(DT, GENTLE, command(position=goal), 0.0, 5.0)
    assert setpoint.position == pytest.approx(goal, abs=1e-9)
    assert setpoint.velocity == pytest.approx(4.999)
    assert not setpoint.done


@pytest.mark.parametrize("goal", [0.5, -0.5])
def test_a_trajectory_ends_at_its_goal_at_rest(goal: float) -> None:
    setpoint = Setpoint(position=0.0)
    setpoint.take(goal)
    done = list[bool]()
    for _ in range(3000):
        setpoint.follow(DT, GENTLE, command(position=goal, velocity_limit=0.4), 0.0, 0.0)
        assert abs(setpoint.velocity) <= 0.4 + 1e-9
        done.append(setpoint.done)
    assert (setpoint.position, setpoint.velocity) == (goal, 0.0)
    assert done.index(True) == pytest.approx((0.5 / 0.4 + 0.4 / 1.0) / DT, rel=0.05)
    assert all(done[done.index(True) :])


@pytest.mark.parametrize(("hardest", "turns"), [(math.nan, 1), (10.0, 20)])
def test_it_comes_to_rest_at_once_or_with_its_acceleration(hardest: float, turns: int) -> None:
    setpoint = Setpoint(position=1.0, velocity=-0.2)
    speeds = []
    for _ in range(turns + 1):
        setpoint.come_to_rest(DT, hardest, 0.0)
        speeds.append(setpoint.velocity)
    assert speeds[-1] == pytest.approx(0.0, abs=1e-12)
    assert [abs(speed) > 1e-9 for speed in speeds] == [True] * (turns - 1) + [False] * 2


def test_the_limits_of_a_command_go_before_those_of_the_device() -> None:
    settings = Settings(default_velocity_limit=2.0, default_accel_limit=3.0)
    assert trajectory_limits(settings, command()) == (2.0, 3.0)
    assert trajectory_limits(settings, command(velocity_limit=1.0, accel_limit=-1.0)) == (1.0, None)
    assert trajectory_limits(Settings(), command()) == (None, None)
