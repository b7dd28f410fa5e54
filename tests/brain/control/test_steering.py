"""A base begins to move when its motors are armed, and keeps acceleration and jerk while its wheels steer."""

from __future__ import annotations

from math import inf

import numpy as np
import pytest

from brain.belief import Pose
from brain.bodies.body import Base
from brain.bodies.plane import Twist, arc
from brain.control.motion import MotionControl, MotionInputs
from brain.control.pursuit import PursuitSettings
from gateway.config import load_robot
from protocols import messages as msg
from protocols.messages import MILLISECOND
from tests.brain.control.ride import PERIOD, Free

STEPS, FASTEST = 4, 8.0
"""Of the joints, between two commands; rad/s of one that steers"""
HERE = Pose(0.0, 0.0, 0.0)
SAMPLED = 3
"""Commands from one sample of the motion to the next"""


@pytest.mark.parametrize(
    ("name", "first", "then"),
    [
        ("swerve", Twist(0.0, 0.0, 0.4), Twist(0.4)),
        ("swerve", Twist(0.21, -1.9, -0.34), Twist(0.5, -0.8, -0.1)),  # the centre passes a module
        ("swerve", Twist(0.07, 2.0, 0.55), Twist(0.44, 1.5, 0.2)),
        ("ackermann", Twist(0.3, 0.4), Twist(0.3, -0.4)),
    ],
)
def test_a_base_moves_within_acceleration_and_jerk_while_its_wheels_steer(
    name: str, first: Twist, then: Twist
) -> None:
    """By what its wheels do together, without slip; where they contradict each other by least squares."""
    body = load_robot(name).brain.body
    assert isinstance(body, Base)
    motion, joints = MotionControl(PursuitSettings(), body, body.joints), dict.fromkeys(body.joints, 0.0)
    pose = Pose(0.0, 0.0, 0.0)
    track: list[tuple[float, float]] = [(0.0, 0.0)]
    for number in range(300):
        now = number * 20 * MILLISECOND
        motion.observe([msg.Feedback(motor, now, position=at) for motor, at in joints.items()])
        inputs = MotionInputs(HERE, HERE, 1.0, True, first if number < 150 else then, inf)
        commands = motion.step(now, inputs, Free())
        for _ in range(STEPS):
            before, dt = list(joints.values()), PERIOD / STEPS
            for command in commands:
                if isinstance(command, msg.Position):
                    step = command.position - joints[command.motor]
                    joints[command.motor] += max(-FASTEST * dt, min(FASTEST * dt, step))
                elif isinstance(command, msg.Velocity):
                    joints[command.motor] += command.velocity * dt
            moved = body.travel(before, list(joints.values()))
            pose = arc(pose, moved.distance, moved.turn, moved.sideways)
        track.append((pose.x, pose.y))
    places, dt = np.array(track[::SAMPLED]).T, SAMPLED * PERIOD
    assert np.hypot(*np.diff(places, 2)).max() / dt**2 <= 1.3 * body.max_linear_acceleration
    assert np.hypot(*np.diff(places, 3)).max() / dt**3 <= 1.5 * body.max_linear_jerk


def test_a_base_begins_to_move_when_its_motors_are_armed() -> None:
    """What has grown meanwhile would be driven at once by the first motor that is armed."""
    body = load_robot("ackermann").brain.body
    assert isinstance(body, Base)
    motion, last = MotionControl(PursuitSettings(), body, body.joints), body.joints[-1]
    inputs = MotionInputs(HERE, HERE, 1.0, True, Twist(0.5), inf)
    for number in range(100):
        now = number * 20 * MILLISECOND
        mode = msg.Mode.ARMED if number >= 50 else msg.Mode.READY
        motion.observe([msg.State(joint, now, msg.Mode.ARMED) for joint in body.joints[:-1]])
        motion.observe([msg.State(last, now, mode)])
        assert not any(isinstance(command, msg.Idle) for command in motion.step(now, inputs, Free()))
        assert motion.twist.linear <= 0.01 or number >= 50
    assert motion.twist.linear == pytest.approx(0.5)
