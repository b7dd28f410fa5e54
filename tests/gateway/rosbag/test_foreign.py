"""Judging the brain by a bag: figures of drives that are known, no truth among the inputs, exit statuses."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from brain.belief import Estimate, Pose
from gateway.cli.main import main
from gateway.core.robot import Robot
from gateway.errors import BagError
from gateway.recording import Recorder
from gateway.rosbag import Bag, read
from gateway.rosbag.evaluate import FORESIGHT, Verdict, carried, judge
from protocols.messages import SECOND, Feedback
from tests.gateway.bag_helpers import ROBOT, START, Said, drive, fix, imu, odometry, rover, write

ON_EDGE = ROBOT.replace("address = 3\n", f"address = 3\nmount = {{ roll = {math.pi / 2} }}\n")
"""The IMU's y axis points up."""


def understood(path: Path, robot: Robot, messages: list[Said]) -> Bag:
    body = robot.brain.differential
    assert body is not None
    return read(write(path / "bag", messages), robot.bag, body)


@pytest.fixture(scope="module")
def slalom(tmp_path_factory: pytest.TempPathFactory) -> Bag:
    """60 s with an IMU on its edge."""
    messages = drive(60.0, rate=lambda w: (0.0, w, 0.0))
    return understood(tmp_path_factory.mktemp("slalom"), rover(ON_EDGE), messages)


@pytest.fixture(scope="module")
def judged(slalom: Bag) -> Verdict:
    return judge(slalom, rover(ON_EDGE))


def test_the_figures_of_a_drive(judged: Verdict) -> None:
    assert judged.ok
    assert judged.lasted == pytest.approx(59.97 * SECOND, abs=0.1 * SECOND)
    assert judged.driven == pytest.approx(60.0, abs=0.3)
    assert (judged.fixes, judged.early) == (150, 1)
    assert judged.believed is not None
    assert judged.wheels is not None
    assert judged.odometry is not None
    assert judged.believed.count == judged.wheels.count == judged.odometry.count == 149
    # what is left is the noise of the fixes, 0.3 m in each direction
    assert judged.believed.rms < 0.6
    assert judged.wheels.rms > 3 * judged.believed.rms
    assert judged.wheels.rms == pytest.approx(judged.odometry.rms, rel=0.05)
    assert set(judged.nis) == {"imu", "left and right"}
    assert judged.nis["imu"].count == 2000
    assert judged.nis["left and right"].count == 599


def test_without_the_mounting_the_path_is_lost(slalom: Bag, judged: Verdict) -> None:
    flat = judge(slalom, rover())
    assert judged.believed is not None
    assert flat.believed is not None
    assert flat.believed.rms > 5 * judged.believed.rms


def test_no_truth_is_among_the_inputs(slalom: Bag, judged: Verdict) -> None:
    """With another truth, what is believed is the same to the last bit; with none, it is too."""
    there = tuple(replace(one, latitude=one.latitude + 1e-4 * n) for n, one in enumerate(slalom.truth))
    moved = judge(replace(slalom, truth=there), rover(ON_EDGE))
    feedback_lost = judge(replace(slalom, truth=()), rover(ON_EDGE))
    assert (moved.driven, moved.nis, moved.anomalies) == (judged.driven, judged.nis, judged.anomalies)
    assert (feedback_lost.driven, feedback_lost.nis, feedback_lost.anomalies) == (
        judged.driven,
        judged.nis,
        judged.anomalies,
    )
    assert moved.believed is not None
    assert moved.believed.rms > 100.0


def test_the_same_bag_gives_the_same_verdict(slalom: Bag, judged: Verdict) -> None:
    assert judge(slalom, rover(ON_EDGE)) == judged


def test_nothing_looks_ahead(slalom: Bag, judged: Verdict) -> None:
    """What comes after a fix does not change what was believed at it."""
    until = START + 30 * SECOND
    events = tuple(one for one in slalom.events if one.t <= until)
    truth = tuple(one for one in slalom.truth if one.t <= until)
    cut = judge(replace(slalom, events=events, truth=truth), rover(ON_EDGE))
    late = judge(replace(slalom, truth=truth), rover(ON_EDGE))
    assert cut.believed == late.believed
    assert cut.believed != judged.believed


def test_more_is_asked_for_than_it_gives(slalom: Bag) -> None:
    judged = judge(slalom, rover(ON_EDGE), at_most=0.01)
    assert not judged.ok
    assert "m off, and at most 0.01 m is asked for" in judged.text()
    enough = judge(slalom, rover(ON_EDGE), at_most=1.0)
    assert enough.ok
    assert enough.text().endswith("passed: at most 1 m was asked for")


# -- what cannot be judged ------------------------------------------------------------------------

STILL = [odometry(START + n * SECOND, 0.0, 0.0) for n in range(5)]
TURNS = [imu(START + n * SECOND, (0.0, 0.0, 0.0)) for n in range(5)]


@pytest.mark.parametrize(
    ("messages", "said"),
    [
        ([*STILL, *TURNS, fix(START + SECOND, 0.0, 0.0)], "fewer than 3 fixes can be compared"),
        (
            [*STILL, *TURNS, *(fix(START + n * SECOND, 0.0, 0.0, status=-1) for n in range(5))],
            "not one message of /fix (truth) could be used: 5 × no fix; there is no truth in it",
        ),
        (
            [*STILL, *TURNS, *(fix(START + n * SECOND, 1e-6 * n, 0.0) for n in range(5))],
            "the truth stays within 0.17 m",
        ),
        (
            [*(odometry(START + n * SECOND, math.nan, 0.0) for n in range(5)), *TURNS]
            + [fix(START + n * SECOND, 1e-4 * n, 0.0) for n in range(5)],
            "not one message of /odom (odometry) could be used: 5 × not finite; fewer than 3 fixes",
        ),
    ],
    ids=["one fix", "no fix", "no motion", "no odometry"],
)
def test_what_cannot_be_judged_is_not_passed(tmp_path: Path, messages: list[Said], said: str) -> None:
    judged = judge(understood(tmp_path, rover(), messages), rover())
    assert not judged.ok
    assert said in "; ".join(judged.objections())
    assert "NOT PASSED" in judged.text()


def test_a_robot_without_a_truth_is_told_so(slalom: Bag) -> None:
    robot = rover(ON_EDGE.replace('truth = "/fix"\n', ""))
    judged = judge(replace(slalom, truth=()), robot)
    assert judged.objections() == ["there is no truth in it: nothing to judge the path by"]


def test_an_estimate_is_carried_on_but_not_for_ever() -> None:
    def estimate(linear: float, angular: float) -> Estimate:
        return Estimate(START, Pose(1.0, 2.0, 0.0), linear, angular, np.zeros((3, 3)))

    assert carried(estimate(2.0, 0.0), START + SECOND // 4) == Pose(1.5, 2.0, 0.0)
    assert carried(estimate(0.0, 1.0), START + SECOND // 4).yaw == pytest.approx(0.25)
    assert carried(estimate(2.0, 0.0), START + 1000 * SECOND) == carried(
        estimate(2.0, 0.0), START + FORESIGHT
    )
    assert carried(estimate(2.0, 0.0), START - SECOND) == Pose(1.0, 2.0, 0.0)


def test_bare_joints_have_no_path() -> None:
    robot = rover()
    bench = replace(robot, brain=replace(robot.brain, body="joints"))
    with pytest.raises(BagError, match="goes nowhere"):
        judge(Bag(Path("x"), (Feedback("left", 1),), (), (), ()), bench)


# -- the command ----------------------------------------------------------------------------------


@pytest.fixture
def bag(tmp_path: Path) -> str:
    (tmp_path / "rover.toml").write_text(ROBOT)
    return str(write(tmp_path / "drive", drive(20.0)))


def replay(*arguments: str) -> int:
    return main(["replay", *arguments])


def test_replay_judges_a_bag(tmp_path: Path, bag: str, capsys: pytest.CaptureFixture[str]) -> None:
    robot = str(tmp_path / "rover.toml")
    assert replay(bag, "--robot", robot) == 0
    said = capsys.readouterr().out
    assert "drive.bag: 20.0 s, 19.9 m driven" in said
    assert "/odom: 200 of 200 as odometry" in said
    assert replay(bag, "--robot", robot, "--at-most", "2") == 0
    assert replay(bag, "--robot", robot, "--at-most", "0.01") == 1
    assert "NOT PASSED" in capsys.readouterr().out


def test_what_a_person_got_wrong_is_a_sentence(
    tmp_path: Path, bag: str, capsys: pytest.CaptureFixture[str]
) -> None:
    robot = str(tmp_path / "rover.toml")
    own = tmp_path / "own.mcap"
    Recorder(own, ROBOT, {}).close()
    Path(bag).with_name("cut.bag").write_bytes(Path(bag).read_bytes()[:5000])
    for arguments, said in (
        ((bag,), "is another program's bag: name its robot file with --robot"),
        ((bag, "--robot", "diffbot"), "the robot file has no table [bag]"),
        ((bag, "--robot", "bench"), "goes nowhere"),
        ((bag, "--robot", "husky"), "no topic '/husky_velocity_controller/odom'"),
        ((str(Path(bag).with_name("cut.bag")), "--robot", robot), "index looks damaged"),
        ((str(tmp_path), "--robot", robot), "a folder without metadata.yaml"),
        ((str(tmp_path / "none.bag"), "--robot", robot), "No such file"),
        ((str(own), "--at-most", "1"), "--at-most is for bags only"),
    ):
        assert replay(*arguments) == 2, arguments
        reported = capsys.readouterr()
        assert said in reported.err
        assert not reported.out


@pytest.mark.parametrize("metres", ["-1", "nan", "inf", "three"])
def test_an_error_is_asked_for_in_metres(bag: str, metres: str, capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as left:
        replay(bag, "--robot", "husky", f"--at-most={metres}")
    assert left.value.code == 2
    assert "is not a number of metres" in capsys.readouterr().err
