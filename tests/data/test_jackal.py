"""A Jackal, probably simulated: no truth in the recording, so a second filter's end is what there is.

cra-ros-pkg/robot_localization's own filter ends at (1.0206, 3.4292) with what its test fuses, the IMU's
absolute orientation among it (test/test_ekf_localization_node_bag2.test). That is another estimate and no
truth; ours has wheels and a gyro alone. Four wheels on two sides slip so much that the bag's own odometry
ends 22 m away from it.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import pytest

from brain.bodies.body import Base
from gateway import config
from gateway.cli.main import main
from gateway.rosbag import read
from gateway.rosbag.evaluate import evaluate
from protocols.messages import Imu

BAG = "jackal/jackal.bag"


def test_it_ends_where_another_filter_does(recording: Callable[[str], Path]) -> None:
    robot = config.load_robot("jackal")
    body = robot.brain.body
    assert isinstance(body, Base)
    bag = read(recording(BAG), robot.bag, body)
    assert [(t.role, t.count, t.used) for t in bag.topics] == [
        ("sensors.imu", 3061, 3061),
        ("odometry", 3060, 3060),
    ]
    first = next(event.orientation for event in bag.events if isinstance(event, Imu))
    assert first is not None
    x, y, z, w = first
    yaw = math.atan2(2.0 * (w * z + x * y), 1.0 - 2.0 * (y * y + z * z))
    perception = robot.brain.perception
    turned = replace(perception, filter=replace(perception.filter, start_yaw=yaw))
    evaluation = evaluate(bag, replace(robot, brain=replace(robot.brain, perception=turned)))
    assert not evaluation.contradictions
    assert evaluation.driven == pytest.approx(84.2, abs=1.0)
    assert evaluation.end is not None
    assert math.hypot(evaluation.end.x - 1.0206, evaluation.end.y - 3.4292) < 0.3
    start, end = bag.odometry[0].pose, bag.odometry[-1].pose
    x, y = end.x - start.x, end.y - start.y
    there = (math.cos(yaw) * x - math.sin(yaw) * y, math.sin(yaw) * x + math.cos(yaw) * y)
    assert math.hypot(there[0] - 1.0206, there[1] - 3.4292) > 15.0


def test_without_a_truth_it_is_not_judged(
    recording: Callable[[str], Path], capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["replay", str(recording(BAG)), "--robot", "jackal"]) == 3
    message = capsys.readouterr().out
    assert "NOT JUDGED: there is no ground truth" in message
    assert "used against the gate:\n  none" in message
