"""A Husky outdoors: the path that wheels and gyro make, against its satellite receiver.

Figures of others on this recording, aligned in the same way: raw odometry 7.0 m, wheel speed with the mounted
gyro 3.07 m, the usual filter of ROS as its own test sets it 21.4 m, the gyro without its mounting 102 m.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import pytest

from brain.bodies.body import Base
from brain.perception.mount import Mount
from gateway import config
from gateway.cli.main import main
from gateway.core.robot import Robot
from gateway.rosbag import Bag, read
from gateway.rosbag.evaluate import Evaluation, evaluate
from protocols.messages import SECOND, Imu

BAG = "husky/husky.bag"


@pytest.fixture(scope="module")
def husky() -> Robot:
    return config.load_robot("husky")


@pytest.fixture(scope="module")
def bag(recording: Callable[[str], Path], husky: Robot) -> Bag:
    body = husky.brain.body
    assert isinstance(body, Base)
    return read(recording(BAG), husky.bag, body)


@pytest.fixture(scope="module")
def evaluation(bag: Bag, husky: Robot) -> Evaluation:
    return evaluate(bag, husky, at_most=3.1)


def test_all_of_it_is_used(bag: Bag) -> None:
    assert [(t.name, t.count, t.used, t.unused) for t in bag.topics] == [
        ("/fix", 989, 989, {}),
        ("/husky_velocity_controller/odom", 3952, 3952, {}),
        ("/imu/data", 11865, 11865, {}),
    ]
    times = [event.t for event in bag.events]
    assert times == sorted(times)


def test_the_path_is_within_what_was_promised(evaluation: Evaluation) -> None:
    assert evaluation.ok
    assert not evaluation.contradictions  # though its twists are 0.38 s later than its poses
    assert evaluation.duration == pytest.approx(395.3 * SECOND, abs=0.1 * SECOND)
    assert evaluation.driven == pytest.approx(359.0, abs=1.0)
    assert (len(evaluation.truth), evaluation.early) == (989, 0)
    assert evaluation.estimated is not None
    assert evaluation.estimated.count == 989
    assert evaluation.estimated.rms <= 3.1


def test_the_others_on_the_same_fixes(evaluation: Evaluation) -> None:
    """As measured by others: so alignment, projection and the choice of fixes are theirs."""
    assert evaluation.odometry is not None
    assert evaluation.wheels is not None
    assert evaluation.odometry.rms == pytest.approx(7.0, abs=0.05)
    assert evaluation.wheels.rms == pytest.approx(6.9, abs=0.05)


def test_nothing_was_refused_and_the_filter_is_not_too_sure(evaluation: Evaluation) -> None:
    assert not any(evaluation.anomalies.values())
    assert all(0.0 < nis.mean < 1.0 for nis in evaluation.nis.values())


def test_without_the_mounting_of_the_imu_the_path_is_lost(bag: Bag, husky: Robot) -> None:
    flat = replace(husky, sensors={"imu": replace(husky.sensors["imu"], mount=Mount())})
    evaluation = evaluate(bag, flat, at_most=3.1)
    assert not evaluation.ok
    assert evaluation.estimated is not None
    assert evaluation.estimated.rms == pytest.approx(102.0, abs=3.0)


def test_gravity_shows_the_mounting(bag: Bag, husky: Robot) -> None:
    """Turned by the mounting, what the accelerometer reads on average points up."""
    pushes = [event.linear_acceleration for event in bag.events if isinstance(event, Imu)]
    x, y, z = (sum(axis) / len(pushes) for axis in zip(*pushes, strict=True))
    assert (x, y, z) == pytest.approx((-0.22, 9.79, 0.08), abs=0.01)
    forward, left, up = husky.sensors["imu"].mount.rotate((x, y, z))
    assert up == pytest.approx(9.79, abs=0.01)
    assert max(abs(forward), abs(left)) < 0.25


def test_the_settings_are_no_lucky_hit(bag: Bag, husky: Robot) -> None:
    """Half or twice the slip, its time and the gyro's noise: the path hardly changes."""
    perception = husky.brain.perception
    for factor in (0.5, 2.0):
        wheels = perception.filter
        loose = replace(
            wheels, turn_slip=min(1.0, wheels.turn_slip * factor), slip_length=wheels.slip_length * factor
        )
        other = replace(perception, filter=loose, gyro_sigma=perception.gyro_sigma * factor)
        evaluation = evaluate(bag, replace(husky, brain=replace(husky.brain, perception=other)))
        assert evaluation.estimated is not None
        assert evaluation.estimated.rms < 3.2, factor


def test_the_command(recording: Callable[[str], Path], capsys: pytest.CaptureFixture[str]) -> None:
    arguments = ["replay", str(recording(BAG)), "--robot", "husky"]
    assert main([*arguments, "--at-most", "3.1"]) == 0
    message = capsys.readouterr().out
    assert "395.3 s, 358.9 m driven" in message
    assert "/imu/data: 11865 of 11865 as sensors.imu" in message
