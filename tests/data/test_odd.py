"""Bags that are odd in other ways: damaged, without odometry, without anything that moves, simulated."""

from __future__ import annotations

import math
import os
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, cast

import numpy as np
import pytest

from brain.bodies.body import Base
from gateway.cli.main import main
from gateway.core.robot import BagTopics
from gateway.errors import BagError
from gateway.rosbag import is_bag, read, stamps
from gateway.rosbag.convert import stamp
from gateway.rosbag.evaluate import NOT_JUDGED, evaluate, evaluate_file
from gateway.rosbag.file import open_bag
from gateway.rosbag.survey import proposed_robot, survey
from protocols.messages import SECOND
from tests.gateway.bag_helpers import ROBOT, body_of, rover

if TYPE_CHECKING:
    from rosbags.typesys.stores.ros2_jazzy import sensor_msgs__msg__Imu as RosImu

DAMAGED = "odd/laser_scan_matcher_demo.bag"
TILTED = "odd/tilt_laser.bag"
SIMULATED = "turtlebot3/turtlebot3.bag"
TELEMETRY = "f110/vesc.bag"

ROVER = rover()
BODY = body_of(ROVER)


def test_without_its_checks_the_library_is_not_asked(recording: Callable[[str], Path]) -> None:
    command = [sys.executable, "-O", "-m", "gateway", "replay", str(recording(DAMAGED))]
    environ = {**os.environ, "PYTHONDONTWRITEBYTECODE": "1"}
    done = subprocess.run(command, env=environ, capture_output=True, text=True, check=False)
    assert done.returncode == 2
    assert "Traceback" not in done.stderr
    assert "the checks of the library" in done.stderr


def test_a_lidar_that_was_carried_about_is_mapped_by_its_scans_alone(
    recording: Callable[[str], Path],
) -> None:
    """Its bag has an index that states lengths which are not its own, types of ROS C Turtle, no odometry."""
    path = recording(DAMAGED)
    evaluation = evaluate_file(path, proposed_robot(survey(path)))
    assert (evaluation.scans, evaluation.lost, evaluation.status) == (360, 0, NOT_JUDGED)
    assert evaluation.notes[0].startswith("its index is absent or damaged: gone through from its beginning")
    assert "no odometry: the motion is what its scans show" in evaluation.notes[0]
    assert evaluation.driven == pytest.approx(4.9, abs=0.5)


def test_a_bag_without_odometry_is_told_what_there_is(recording: Callable[[str], Path]) -> None:
    """Types that are in no store (they stand in the bag) hinder nothing."""
    path = recording(TILTED)
    assert is_bag(path)
    with pytest.raises(BagError) as reported:
        read(path, BagTopics("/odom", {"imu": "/imu_dat"}, "/position_gps"), BODY)
    assert str(reported.value).splitlines() == [
        f"{path}: odometry: no topic '/odom'",
        f"{path}: sensors.imu: no topic '/imu_dat'; did you mean '/imu_data'?",
        "there is",
        "  /gravity_vector: 356 of geometry_msgs/msg/Vector3Stamped",
        "  /imu_data: 356 of sensor_msgs/msg/Imu",
        "  /info_gps: 356 of xsens_mtig/msg/GPSInfoStatus2",
        "  /magnetic_vector: 356 of geometry_msgs/msg/Vector3Stamped",
        "  /position_gps: 356 of sensor_msgs/msg/NavSatFix",
        "  /scan: 178 of sensor_msgs/msg/LaserScan",
        "  /temperature: 712 of xsens_mtig/msg/Thermistor",
        "  /tf: 711 of tf/msg/tfMessage",
        "  /velocity: 712 of geometry_msgs/msg/TwistStamped",
    ]


def test_the_stamps_of_an_imu_are_of_one_clock(recording: Callable[[str], Path]) -> None:
    with open_bag(recording(TILTED)) as (reader, _):
        connections = [one for one in reader.connections if one.topic == "/imu_data"]
        read_in = [
            (logged, stamp(cast("RosImu", reader.deserialize(data, one.msgtype))))
            for one, logged, data in reader.messages(connections)
        ]
    logged, stamped = (
        np.array([t - read_in[0][0] for t in times]) / SECOND for times in zip(*read_in, strict=True)
    )
    one = stamps.Stamps(logged, stamped)
    assert not [
        *stamps.resolution(stamped),
        *stamps.order(stamped),
        *stamps.steps(one),
        *stamps.clock(one, one),
    ]


def test_telemetry_alone_moves_nothing(
    recording: Callable[[str], Path], capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["replay", str(recording(TELEMETRY)), "--robot", "husky"]) == 2
    assert "/sensors/core: 2244 of vesc_msgs/msg/VescStateStamped" in capsys.readouterr().err


def test_a_simulated_drive(recording: Callable[[str], Path]) -> None:
    """A TurtleBot3 in Gazebo (wheels of 0.033 m, 0.287 m apart): its path agrees with its odometry."""
    text = ROBOT.replace('truth = "/fix"\n', "").replace('"/imu/data"', '"/imu"')
    text = text.replace("wheel_radius = 0.1", "wheel_radius = 0.033").replace("= 0.5\n", "= 0.287\n")
    robot = rover(text)
    body = robot.brain.body
    assert isinstance(body, Base)
    bag = read(recording(SIMULATED), robot.bag, body)
    assert {t.name: t.used for t in bag.topics if t.role} == {"/imu": 2253, "/odom": 2741}
    evaluation = evaluate(bag, robot)
    assert not evaluation.contradictions
    assert evaluation.driven == pytest.approx(24.81, abs=0.15)
    assert evaluation.end is not None
    start, end = bag.odometry[0].pose, bag.odometry[-1].pose
    assert math.hypot(evaluation.end.x - (end.x - start.x), evaluation.end.y - (end.y - start.y)) < 0.25
