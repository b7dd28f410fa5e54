"""The filter alone on recordings with a reference: a Husky that turns by slipping, a mower."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Literal

import numpy as np
import pytest
from scipy.io import loadmat

from brain.bodies.body import Base
from brain.bodies.differential import Differential
from brain.perception.filter import Filter
from brain.perception.filter_inputs import GyroRate, Input, PoseFix, WheelAngle
from brain.perception.filter_settings import FilterSettings
from gateway import config
from gateway.rosbag import read
from gateway.rosbag.trajectory_error import east_north, path_error
from protocols.messages import SECOND, Feedback, Fix, Imu
from tests.brain.bodies.kinematics import speeds

SKID = FilterSettings(
    resolution=1e-3, jitter=1e-3, turn_slip=1.0, slip_bound=1.0, bias_sigma=1e-3, bias_walk=1e-6
)
"""Of a base that turns by slipping the wheels tell the distance, and the gyro the turn."""
MOWER = Differential(
    left="left",
    right="right",
    wheel_radius=0.2,
    wheel_separation=1.0,
    radius=0.5,
    max_linear=3.0,
    max_angular=3.0,
    max_linear_acceleration=2.0,
    max_angular_acceleration=4.0,
)


@pytest.mark.parametrize("engine", ["structured", "filterpy"])
def test_husky_by_wheels_and_gyro(
    recording: Callable[[str], Path], engine: Literal["structured", "filterpy"]
) -> None:
    """At most 3.1 m from its receiver: the best that others make of these sensors is 2.9 to 3.1."""
    robot = config.load_robot("husky")
    body = robot.brain.body
    assert isinstance(body, Base)
    bag = read(recording("husky/husky.bag"), robot.bag, body)
    up = robot.sensors["imu"].mount.rotation()[2]
    belief, path, fixes = Filter(body, replace(SKID, engine=engine)), [], []
    for event in sorted([*bag.events, *bag.truth], key=lambda event: event.t):
        if isinstance(event, Imu):
            rate = sum(a * b for a, b in zip(up, event.angular_velocity, strict=True))
            belief.observe([GyroRate("imu", event.t, rate, 0.02)])
        elif isinstance(event, Feedback) and event.position is not None:
            belief.observe([WheelAngle(event.motor, event.t, event.position)])
        elif isinstance(event, Fix) and (found := belief.at(event.t)):
            path.append((found[0].x, found[0].y))
            fixes.append(event)
    assert len(fixes) > 900
    assert path_error(np.array(path), east_north(fixes)).rms < 3.1


def test_a_mower_for_half_an_hour(recording: Callable[[str], Path]) -> None:
    """1.86 km by wheels alone end 4.45 m off, as plain dead reckoning does. With a position every 10 s, good
    to 0.2 m, the error is below 0.7 m even before the next one, and the covariance is honest."""
    whole = loadmat(recording("plaza/Plaza1_.mat"))
    truth, rolled = whole["GT"], whole["DR"]
    rng = np.random.Generator(np.random.PCG64(1))
    start = dict(zip(("start_x", "start_y", "start_yaw"), truth[0, 1:4], strict=True))
    settings = FilterSettings(**start, start_yaw_sigma=0.05, turn_slip=0.05, travel_noise=0.02)
    alone, helped = Filter(MOWER, settings), Filter(MOWER, settings)
    angles, errors, nees = np.zeros(2), [], []
    for k in range(len(rolled) + 1):
        t = int((truth[k, 0] - truth[0, 0]) * SECOND)
        if k:
            angles = angles + speeds(MOWER, *rolled[k - 1, 1:3])
        inputs: list[Input] = [
            WheelAngle(m, t, float(a)) for m, a in zip(("left", "right"), angles, strict=True)
        ]
        alone.observe(inputs)
        if k and k % 50 == 0:
            inputs.append(PoseFix("gps", t, truth[k, 1:3] + 0.2 * rng.normal(size=2), np.eye(2) * 0.04))
        helped.observe(inputs[:2])
        found = helped.at(t)
        if found is not None and k % 50 == 49:  # just before the next one
            error = np.array([found[0].x, found[0].y]) - truth[k, 1:3]
            errors.append(float(error @ error))
            nees.append(float(error @ np.linalg.solve(found[1][:2, :2], error)) / 2.0)
        helped.observe(inputs[2:])
    end = np.array(alone.state.x[:2]) - truth[-1, 1:3]
    assert np.hypot(*end) == pytest.approx(4.45, abs=0.01)
    assert np.sqrt(np.mean(errors)) < 0.7
    assert 0.4 < np.mean(nees) < 2.0
