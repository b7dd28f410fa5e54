"""A bag that contradicts itself is named and does not pass, and no good one is."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from brain.bodies.body import Base
from brain.perception.mount import Mount
from gateway.cli.main import main
from gateway.core.robot import Robot
from gateway.rosbag import agreement, read, stamps
from gateway.rosbag.contradictions import contradictions
from gateway.rosbag.evaluate import evaluate
from tests.gateway.bag_helpers import ROBOT, Kind, rover, write
from tests.gateway.rosbag import drives
from tests.gateway.rosbag.drives import CASES, Drive, drive
from tests.sampled import sampled

SLIP = 0.1
"""The drives slip by up to this in turns: their robot file says so."""
SHORT = 5
"""Seed of a drive that turns often."""
MECANUM = ROBOT.replace('body = "differential"', 'body = "mecanum"').replace(
    """[brain.differential]
left = "left"
right = "right"
wheel_radius = 0.1
""",
    """[brain.mecanum]
front_left = "left"
front_right = "right"
rear_left = "rear_left"
rear_right = "rear_right"
wheelbase = 0.5
wheel_radius = 0.1
""",
)
REAR = "[motors.rear_left]\naddress = 4\n[motors.rear_right]\naddress = 5\n"
MECANUM = MECANUM.replace("[sensors.imu]", f"{REAR}[sensors.imu]")


def named(one: Drive, body: Base | None = None) -> tuple[str, ...]:
    return contradictions(drives.bag(one), body or base(rover()), {"imu": Mount()}, SLIP)


def base(robot: Robot) -> Base:
    assert isinstance(robot.brain.body, Base)
    return robot.brain.body


@pytest.mark.parametrize("seed", sampled(range(400), every=80))
def test_no_good_drive_is_named(seed: int) -> None:
    assert named(drive(seed)) == ()
    assert named(drive(seed, sideways=0.7), base(rover(MECANUM))) == ()


LIES = [(name, size, seed) for name, c in CASES.items() for seed in range(20) for size in c.magnitudes]


@pytest.mark.sample(14)
@pytest.mark.parametrize(("lie", "size", "seed"), sampled(LIES, every=43))
def test_a_lie_is_named(lie: str, size: float, seed: int) -> None:
    case, one = CASES[lie], drive(seed)
    case.lie(one, size)
    assert any(text.startswith(case.topic) and case.named in text for text in named(one)), named(one)


@pytest.mark.parametrize(
    ("lie", "size", "kind"),
    [
        ("time jumps back", 5.0, "mcap"),
        ("degrees", 57.29578, "ros1"),
        ("in the odometry's frame", 0.0, "sqlite3"),
    ],
)
def test_the_command_does_not_pass_it(
    tmp_path: Path, lie: str, size: float, kind: Kind, capsys: pytest.CaptureFixture[str]
) -> None:
    robot = tmp_path / "rover.toml"
    robot.write_text(ROBOT)
    one = drive(SHORT, 25.0)
    CASES[lie].lie(one, size)
    bad = write(tmp_path / "bad", drives.messages(one), kind)
    assert main(["replay", str(bad), "--robot", str(robot)]) == 1
    assert f"NOT PASSED: {CASES[lie].topic}: " in (out := capsys.readouterr().out)
    assert CASES[lie].named in out


def test_a_base_that_moves_sideways_is_believed(tmp_path: Path) -> None:
    robot = rover(MECANUM)
    one = drive(2, 25.0, sideways=0.7)
    bag = read(write(tmp_path / "bag", drives.messages(one)), robot.bag, base(robot))
    evaluation = evaluate(bag, robot)
    assert evaluation.ok, evaluation.objections()
    assert evaluation.wheels is not None
    assert evaluation.wheels.rms < 0.3


# -- what may be so in a good one ---------------------------------------------------------------------


def test_messages_may_overtake_each_other() -> None:
    times = np.arange(0.0, 2.0, 0.02)
    times[[50, 52, 70]] = times[[52, 50, 67]]
    assert not stamps.order(times)


def test_a_receiver_may_stamp_whole_seconds() -> None:
    assert not stamps.resolution(np.arange(60.0))


def test_a_log_without_true_times_proves_nothing() -> None:
    """Written as fast as the disk is, or played at another speed: only the order of the topics is true."""
    t = np.arange(0.0, 60.0, 0.02)
    odometry = stamps.Stamps(t / 37.0, t)
    assert not stamps.steps(odometry)
    assert not stamps.clock(stamps.Stamps((t + 0.01) / 37.0, t), odometry)


def test_what_hardly_moves_shows_nothing() -> None:
    t = np.arange(0.0, 60.0, 0.02)
    rng = np.random.Generator(np.random.PCG64(1))
    noise = rng.normal(0.0, 0.02, (3, len(t)))
    still = agreement.turns_of(t, noise[0])
    assert not agreement.gyro(agreement.turns_of(t, -noise[1]), still, SLIP)
    place = 1e-3 * (noise[1] + 1j * noise[2])
    assert not agreement.odometry(
        agreement.Odometry(t, noise[0] + 0j, noise[1], place, noise[2]), sideways=True
    )


def test_a_pose_that_jumps_once_is_no_other_motion() -> None:
    """A relocalisation in the poses of a fused odometry: its twists are as right as before."""
    one = drive(5)
    columns = one.odom.columns
    half = len(columns["x"]) // 2
    columns["x"][half:] += 4.0
    assert named(one) == ()


def test_a_base_that_slips_is_what_its_file_says() -> None:
    one = drive(7)
    one.imu.columns["w"] *= 0.5
    bag, body = drives.bag(one), base(rover())
    assert contradictions(bag, body, {"imu": Mount()}, 0.1)
    assert not contradictions(bag, body, {"imu": Mount()}, 1.0)
