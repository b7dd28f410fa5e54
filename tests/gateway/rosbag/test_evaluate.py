"""Evaluation on a bag: figures of known drives, no ground truth among the inputs, exit statuses."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from brain.belief import Estimate, Pose
from brain.bodies import bare
from gateway.cli.main import main
from gateway.core.robot import Robot
from gateway.errors import BagError
from gateway.recording import Recorder
from gateway.rosbag import Bag, read
from gateway.rosbag.evaluate import (
    MAX_EXTRAPOLATION,
    NOT_JUDGED,
    NOT_PASSED,
    Evaluation,
    evaluate,
    extrapolated,
)
from protocols.messages import SECOND, Feedback, Fix
from tests.gateway.bag_helpers import (
    ROBOT,
    START,
    BagMessage,
    body_of,
    drive,
    fix,
    imu,
    odometry,
    rover,
    write,
)

ON_EDGE = ROBOT.replace("address = 3\n", f"address = 3\nmount = {{ roll = {math.pi / 2} }}\n")
"""The IMU's y axis points up."""
EDGE = rover(ON_EDGE)


def converted(path: Path, robot: Robot, messages: list[BagMessage]) -> Bag:
    return read(write(path / "bag", messages), robot.bag, body_of(robot))


@pytest.fixture(scope="module")
def slalom(tmp_path_factory: pytest.TempPathFactory) -> Bag:
    """60 s with an IMU on its edge."""
    messages = drive(60.0, rate=lambda w: (0.0, w, 0.0))
    return converted(tmp_path_factory.mktemp("slalom"), EDGE, messages)


@pytest.fixture(scope="module")
def evaluation(slalom: Bag) -> Evaluation:
    return evaluate(slalom, EDGE)


def test_the_figures_of_a_drive(evaluation: Evaluation) -> None:
    assert evaluation.ok
    assert evaluation.duration == pytest.approx(59.97 * SECOND, abs=0.1 * SECOND)
    assert evaluation.driven == pytest.approx(60.0, abs=0.3)
    assert (len(evaluation.truth), evaluation.early) == (150, 0)
    assert evaluation.estimated is not None
    assert evaluation.wheels is not None
    assert evaluation.odometry is not None
    assert evaluation.estimated.count == evaluation.wheels.count == evaluation.odometry.count == 150
    # what is left is the noise of the fixes, 0.3 m in each direction
    assert evaluation.estimated.rms < 0.6
    assert evaluation.wheels.rms > 3 * evaluation.estimated.rms
    assert evaluation.wheels.rms == pytest.approx(evaluation.odometry.rms, rel=0.05)
    assert {name: nis.count for name, nis in evaluation.nis.items()} == {"imu": 598}


def test_without_the_mounting_the_path_is_lost(slalom: Bag, evaluation: Evaluation) -> None:
    flat = evaluate(slalom, rover())
    assert evaluation.estimated is not None
    assert flat.estimated is not None
    assert flat.estimated.rms > 5 * evaluation.estimated.rms


def test_no_truth_is_among_the_inputs(slalom: Bag, evaluation: Evaluation) -> None:
    """With another truth, or none, the estimate is the same to the last bit."""
    fixes = [one for one in slalom.truth if isinstance(one, Fix)]
    there = tuple(replace(one, latitude=one.latitude + 1e-4 * n) for n, one in enumerate(fixes))
    moved = evaluate(replace(slalom, truth=there), EDGE)
    without = evaluate(replace(slalom, truth=()), EDGE)
    for other in (moved, without):
        assert (other.driven, other.nis) == (evaluation.driven, evaluation.nis)
        assert other.anomalies == evaluation.anomalies
    assert moved.estimated is not None
    assert moved.estimated.rms > 100.0


def test_the_evaluation_is_deterministic(slalom: Bag, evaluation: Evaluation) -> None:
    assert evaluate(slalom, EDGE) == evaluation


def test_nothing_looks_ahead(slalom: Bag, evaluation: Evaluation) -> None:
    """What comes after a fix does not change what was believed at it."""
    until = START + 30 * SECOND
    events = tuple(one for one in slalom.events if one.t <= until)
    truth = tuple(one for one in slalom.truth if one.t <= until)
    cut = evaluate(replace(slalom, events=events, truth=truth), EDGE)
    late = evaluate(replace(slalom, truth=truth), EDGE)
    assert cut.estimated == late.estimated
    assert cut.estimated != evaluation.estimated


def test_an_error_above_the_limit_does_not_pass(slalom: Bag) -> None:
    evaluation = evaluate(slalom, EDGE, at_most=0.01)
    assert not evaluation.ok
    assert "m, and at most 0.01 m is allowed" in evaluation.text()
    enough = evaluate(slalom, EDGE, at_most=1.0)
    assert enough.ok
    assert enough.text().endswith("passed: at most 1 m is allowed")


# -- what cannot be evaluated ------------------------------------------------------------------------

STILL = [odometry(START + n * SECOND, 0.0, 0.0) for n in range(5)]
TURNS = [imu(START + n * SECOND, (0.0, 0.0, 0.0)) for n in range(5)]


@pytest.mark.parametrize(
    ("messages", "objection"),
    [
        ([*STILL, *TURNS, fix(START + SECOND, 0.0, 0.0)], "fewer than 3 fixes can be compared"),
        (
            [*STILL, *TURNS, *(fix(START + n * SECOND, 0.0, 0.0, status=-1) for n in range(5))],
            "no message of /fix (truth) could be used: 5 × no fix",
        ),
        (
            [*STILL, *TURNS, *(fix(START + n * SECOND, 1e-6 * n, 0.0) for n in range(5))],
            "the truth stays within 0.22 m",
        ),
        (
            [*(odometry(START + n * SECOND, math.nan, 0.0) for n in range(5)), *TURNS]
            + [fix(START + n * SECOND, 1e-4 * n, 0.0) for n in range(5)],
            "no message of /odom (odometry) could be used: 5 × not finite; fewer than 3 fixes",
        ),
    ],
    ids=["one fix", "no fix", "no motion", "no odometry"],
)
def test_what_cannot_be_evaluated_does_not_pass(
    tmp_path: Path, messages: list[BagMessage], objection: str
) -> None:
    evaluation = evaluate(converted(tmp_path, rover(), messages), rover())
    assert not evaluation.ok
    assert objection in "; ".join(evaluation.objections())
    assert "NOT PASSED" in evaluation.text()


def test_without_a_ground_truth_nothing_is_judged(slalom: Bag) -> None:
    robot = rover(ON_EDGE.replace('truth = "/fix"\n', ""))
    evaluation = evaluate(replace(slalom, truth=()), robot)
    assert (evaluation.status, evaluation.ok, evaluation.objections()) == (NOT_JUDGED, False, [])
    assert "NOT JUDGED: there is no ground truth" in evaluation.text()
    asked = evaluate(replace(slalom, truth=()), robot, at_most=1.0)
    assert asked.status == NOT_PASSED


def test_an_estimate_is_extrapolated_up_to_a_limit() -> None:
    def estimate(linear: float, angular: float) -> Estimate:
        return Estimate(START, Pose(1.0, 2.0, 0.0), linear, angular, np.zeros((3, 3)))

    assert extrapolated(estimate(2.0, 0.0), START + SECOND // 4) == Pose(1.5, 2.0, 0.0)
    assert extrapolated(estimate(0.0, 1.0), START + SECOND // 4).yaw == pytest.approx(0.25)
    assert extrapolated(estimate(2.0, 0.0), START + 1000 * SECOND) == extrapolated(
        estimate(2.0, 0.0), START + MAX_EXTRAPOLATION
    )
    assert extrapolated(estimate(2.0, 0.0), START - SECOND) == Pose(1.0, 2.0, 0.0)


def test_bare_joints_have_no_path() -> None:
    robot = rover()
    bench = replace(robot, brain=replace(robot.brain, body=bare(robot.motors)))
    with pytest.raises(BagError, match="has no path to evaluate"):
        evaluate(Bag(Path("x"), (Feedback("left", 1),), (), (), ()), bench)


# -- the command ----------------------------------------------------------------------------------


@pytest.fixture
def bag(tmp_path: Path) -> str:
    (tmp_path / "rover.toml").write_text(ROBOT)
    return str(write(tmp_path / "drive", drive(20.0)))


def test_replay_evaluates_a_bag(tmp_path: Path, bag: str, capsys: pytest.CaptureFixture[str]) -> None:
    robot = str(tmp_path / "rover.toml")
    assert main(["replay", bag, "--robot", robot]) == 0
    message = capsys.readouterr().out
    assert "drive.bag: 20.0 s, 19.9 m driven" in message
    assert "/odom: 200 of 200 as odometry" in message
    assert main(["replay", bag, "--robot", robot, "--at-most", "2"]) == 0
    assert main(["replay", bag, "--robot", robot, "--at-most", "0.01"]) == 1
    assert "NOT PASSED" in capsys.readouterr().out


def test_an_operator_mistake_is_a_sentence(
    tmp_path: Path, bag: str, capsys: pytest.CaptureFixture[str]
) -> None:
    robot = str(tmp_path / "rover.toml")
    own = tmp_path / "own.mcap"
    Recorder(own, ROBOT, {}).close()
    Path(bag).with_name("cut.bag").write_bytes(Path(bag).read_bytes()[:5000])
    for arguments, message in (
        ((bag, "--view"), "is another program's recording: --view is for this gateway's"),
        ((bag, "--truth", str(tmp_path / "none")), "none: cannot be read: No such file"),
        ((str(own), "--truth", robot), "--truth is for bags and logs only"),
        ((bag, "--robot", "diffbot"), "the robot file has no table [bag]"),
        ((bag, "--robot", "bench"), "has no path to evaluate"),
        ((bag, "--robot", "husky"), "no topic '/husky_velocity_controller/odom'"),
        (
            (str(Path(bag).with_name("cut.bag")), "--robot", robot),
            "absent or damaged, and no message",
        ),
        ((str(tmp_path), "--robot", robot), "a folder without metadata.yaml"),
        ((str(tmp_path / "none.bag"), "--robot", robot), "No such file"),
        ((str(own), "--at-most", "1"), "--at-most is for bags and logs only"),
    ):
        assert main(["replay", *arguments]) == 2, arguments
        reported = capsys.readouterr()
        assert message in reported.err
        assert not reported.out
