"""Positions of a device that takes only velocities: a valve and its cylinder."""

from __future__ import annotations

import pytest

from gateway.config import load_robot
from gateway.core.joint import Joint
from gateway.core.velocity_loop import VelocityLoop
from protocols import messages as msg
from protocols.messages import MILLISECOND, SECOND, Mode

MOTOR = load_robot("boom").motors["lift"]
LIMITS = MOTOR.joint.limits
STEP = 0.01
"""s"""


def loop() -> VelocityLoop:
    return VelocityLoop(3.0, SECOND)


def test_a_difference_makes_a_velocity_within_the_limits() -> None:
    one, here = loop(), msg.Feedback("lift", 0, 0.6)
    made = [one.velocity(msg.Position("lift", 0.9), STEP, here, LIMITS, armed=True) for _ in range(60)]
    velocities = [each.velocity for each in made if isinstance(each, msg.Velocity)]
    assert len(velocities) == 60
    assert velocities[0] == pytest.approx(LIMITS.acceleration * STEP)
    assert velocities[-1] == pytest.approx(LIMITS.velocity)
    assert velocities == sorted(velocities)


def test_near_its_place_it_is_proportional_with_what_is_fed_forward() -> None:
    one, here = loop(), msg.Feedback("lift", 0, 0.6)
    for _ in range(60):
        out = one.velocity(msg.Position("lift", 0.61, 0.02), STEP, here, LIMITS, armed=True)
    assert isinstance(out, msg.Velocity)
    assert out.velocity == pytest.approx(3.0 * 0.01 + 0.02)


def test_hold_comes_to_rest_and_what_is_not_armed_gets_none() -> None:
    one, here = loop(), msg.Feedback("lift", 0, 0.6)
    for _ in range(30):
        one.velocity(msg.Position("lift", 0.9), STEP, here, LIMITS, armed=True)
    made = [one.velocity(msg.Hold("lift"), STEP, here, LIMITS, armed=True) for _ in range(60)]
    assert made[-1] == msg.Velocity("lift", 0.0)
    still = one.velocity(msg.Position("lift", 0.9), STEP, here, LIMITS, armed=False)
    assert still == msg.Velocity("lift", 0.0)
    for command in (msg.Idle("lift"), msg.Velocity("lift", 0.05)):
        assert one.velocity(command, STEP, here, LIMITS, armed=True) == command


def test_the_joint_takes_positions_only_if_it_has_a_gain() -> None:
    joint = Joint("lift", MOTOR.joint, MOTOR.spec)
    joint.on_event(msg.State("lift", 1, Mode.READY, "ports closed"))
    joint.on_event(msg.Feedback("lift", 1, 0.6))
    out = joint.command(2 * MILLISECOND, msg.Position("lift", 0.7), stopped=False)
    assert out == msg.Velocity("lift", 0.0)  # it arms
    assert not joint.refused
    assert msg.Position in MOTOR.joint.commands(MOTOR.spec)
    vesc = load_robot("car").motors["drive"]
    assert msg.Position not in vesc.joint.commands(vesc.spec)
