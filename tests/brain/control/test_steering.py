"""A base whose wheels steer: what is driven keeps the jerk while they do."""

from __future__ import annotations

from math import inf

import pytest

from brain.belief import Pose
from brain.bodies.body import Base
from brain.bodies.plane import Twist
from brain.control.motion import Motion, Wish
from brain.control.pursuit import PursuitSettings
from gateway.config import load_robot
from protocols import messages as msg
from protocols.messages import MILLISECOND
from tests.brain.control.ride import PERIOD, Free, acceleration, jerk


@pytest.mark.parametrize(
    ("name", "first", "then"),
    [
        ("swerve", Twist(0.0, 0.0, 0.4), Twist(0.4)),
        ("swerve", Twist(0.0, 1.5), Twist(0.0, 0.5)),
        ("ackermann", Twist(0.3, 0.4), Twist(0.3, -0.4)),
    ],
)
def test_wheels_are_driven_within_acceleration_and_jerk_while_they_steer(
    name: str, first: Twist, then: Twist
) -> None:
    """Joints that steer at 8 rad/s at most: they are waited for, and what follows begins gently."""
    body = load_robot(name).brain.body
    assert isinstance(body, Base)
    motion, joints = Motion(PursuitSettings(), body, body.joints), dict.fromkeys(body.joints, 0.0)
    speeds: list[float] = []
    for number in range(300):
        now = number * 20 * MILLISECOND
        motion.observe([msg.Feedback(motor, now, position=at) for motor, at in joints.items()])
        wish = Wish(Pose(0.0, 0.0, 0.0), 1.0, True, first if number < 150 else then, inf)
        rolled: list[float] = []
        for command in motion.step(now, wish, Free()):
            if isinstance(command, msg.Position):
                step = command.position - joints[command.motor]
                joints[command.motor] += max(-8.0 * PERIOD, min(8.0 * PERIOD, step))
            elif isinstance(command, msg.Velocity):
                index = body.joints.index(command.motor)
                rolled.append(abs(command.velocity) * body.rolling[index])
        speeds.append(sum(rolled) / len(rolled))
    assert min(speeds[149], speeds[299]) > 0.1
    assert acceleration(speeds) <= 1.3 * body.max_linear_acceleration
    assert jerk(speeds) <= 1.3 * body.max_linear_jerk
