"""What messages of the graph ask: instructions, every refusal, and who holds the robot by a stream."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest

from gateway.config import load_robot
from gateway.ros import asked, graph
from gateway.ros.asked import PERSON, Held
from gateway.ros.types import make
from protocols import messages as msg
from protocols.messages import MILLISECOND, SECOND

NAN, INF = math.nan, math.inf
DIFFBOT, MECANUM, BENCH = (load_robot(name) for name in ("diffbot", "mecanum", "bench"))


def twist(x: float = 0.0, y: float = 0.0, z: float = 0.0) -> Any:
    vector = "geometry_msgs/msg/Vector3"
    return make("geometry_msgs/msg/Twist", linear=make(vector, x=x, y=y), angular=make(vector, z=z))


def pose(
    x: float, y: float, q: tuple[float, float, float, float] = (0.0, 0.0, 0.0, 1.0), frame: str = "map"
) -> Any:
    names = dict(zip("xyzw", q, strict=True))
    return make(
        "geometry_msgs/msg/PoseStamped",
        header=make("std_msgs/msg/Header", frame_id=frame),
        pose=make(
            "geometry_msgs/msg/Pose",
            position=make("geometry_msgs/msg/Point", x=x, y=y),
            orientation=make("geometry_msgs/msg/Quaternion", **names),
        ),
    )


def test_twists() -> None:
    assert asked.drive(DIFFBOT, twist(0.5, 0.0, -0.2)) == msg.Drive(0.5, -0.2)
    assert asked.drive(MECANUM, twist(0.5, 0.1)) == msg.Drive(0.5, 0.0, 0.1)
    for wrong, why in (
        (twist(NAN), "not finite"),
        (twist(0.0, 0.0, INF), "not finite"),
        (twist(0.0, 0.1), "sideways"),
    ):
        with pytest.raises(asked.Refused, match=why):
            asked.drive(DIFFBOT, wrong)


def test_goals() -> None:
    turned = (0.0, 0.0, math.sin(0.5), math.cos(0.5))
    for frame in ("map", "/map", ""):
        goal = asked.goal(DIFFBOT, pose(1.0, 2.0, turned, frame))
        assert (goal.x, goal.y) == (1.0, 2.0)
        assert goal.yaw == pytest.approx(1.0)
    for wrong, why in (
        (pose(1.0, NAN), "not finite"),
        (pose(1.0, 1.0, (0.0, 0.0, 0.0, 0.0)), "no rotation"),
        (pose(1.0, 1.0, (0.0, 0.0, 2.0, 1.0)), "no rotation"),
        (pose(1.0, 1.0, (math.sin(0.5), 0.0, 0.0, math.cos(0.5))), "leans"),
        (pose(1.0, 1.0, frame="odom"), "in the frame 'map', not in 'odom'"),
    ):
        with pytest.raises(asked.Refused, match=why):
            asked.goal(DIFFBOT, wrong)
    with pytest.raises(asked.Refused, match="no base"):
        asked.goal(BENCH, pose(1.0, 1.0))


def located(covariance: dict[int, float], x: float = 1.0, frame: str = "map") -> Any:
    """`covariance`: by index in its 36 numbers."""
    one, cells = pose(x, 2.0, (0.0, 0.0, math.sin(0.5), math.cos(0.5)), frame), np.zeros(36)
    cells[list(covariance)] = list(covariance.values())
    kind = "geometry_msgs/msg/PoseWithCovariance"
    return make(graph.POSE_KNOWN, header=one.header, pose=make(kind, pose=one.pose, covariance=cells))


@pytest.mark.parametrize(
    ("covariance", "sigma", "sigma_yaw"),
    [
        ({0: 0.25, 7: 0.25, 35: 0.0685}, 0.5, 0.2617),  # as RViz sends it
        ({}, 0.5, 0.26),  # not stated
        ({0: 0.04, 7: 0.01, 35: 1e-9}, 0.2, 0.001),  # the larger axis; no surer than 1 mm, or 1 mrad
        ({0: 0.05, 1: 0.04, 6: 0.04, 7: 0.05, 35: 0.01}, 0.3, 0.1),  # along a diagonal
        ({0: 0.25, 7: 0.25, 14: -1.0, 21: NAN, 35: 0.01}, 0.5, 0.1),  # what is not of the plane is not read
    ],
)
def test_where_it_is(covariance: dict[int, float], sigma: float, sigma_yaw: float) -> None:
    found = asked.located(DIFFBOT, located(covariance))
    assert (found.x, found.y, found.yaw) == pytest.approx((1.0, 2.0, 1.0))
    assert (found.sigma, found.sigma_yaw) == pytest.approx((sigma, sigma_yaw), rel=1e-3)


@pytest.mark.parametrize(
    ("wrong", "why"),
    [
        (located({}, frame="odom"), "the robot is in the frame 'map', not in 'odom'"),
        (located({}, x=INF), "not finite"),
        (located({0: NAN}), "not finite"),
        (located({7: -0.1}), "its covariance is none: x 0, y -0.1"),
        (located({35: -0.1}), "its covariance is none"),
        (located({0: 0.1, 7: 0.1, 1: 0.05}), "its covariance is none"),
        (located({0: 0.1, 7: 0.1, 1: 0.2, 6: 0.2}), "its covariance is none"),
    ],
)
def test_where_it_is_not(wrong: Any, why: str) -> None:
    with pytest.raises(asked.Refused, match=why):
        asked.located(DIFFBOT, wrong)
    with pytest.raises(asked.Refused, match="no base"):
        asked.located(BENCH, located({}))


def test_targets_of_joints() -> None:
    assert asked.targets(BENCH, "velocity", np.array([1.0, -2.0])) == [
        msg.Velocity("left", 1.0),
        msg.Velocity("right", -2.0),
    ]
    assert isinstance(asked.targets(BENCH, "position", [0.0, 0.0])[0], msg.Position)
    assert isinstance(asked.targets(BENCH, "effort", [0.0, 0.0])[0], msg.Torque)
    with pytest.raises(asked.Refused, match="3 numbers for 2 joints: left, right"):
        asked.targets(BENCH, "velocity", [1.0, 2.0, 3.0])
    with pytest.raises(asked.Refused, match="not finite"):
        asked.targets(BENCH, "velocity", [1.0, NAN])
    arm = load_robot("arm")
    with pytest.raises(asked.Refused, match="goes from"):
        asked.targets(arm, "position", [99.0] * len(arm.brain.abilities(arm.motors).joints))


# -- who holds ------------------------------------------------------------------------------------

A, B = b"a" * 16, b"b" * 16
TIMEOUT = 500 * MILLISECOND


def held() -> Held:
    return Held(TIMEOUT)


def test_it_holds_for_as_long_as_it_is_repeated() -> None:
    one = held()
    assert one.take(0, A, rests=False) == (True, "")
    assert not one.ended(TIMEOUT)
    assert one.ended(TIMEOUT + 1)
    assert not one.ended(TIMEOUT + 2), "once"


def test_rest_ends_a_motion_of_its_own_once_and_nobody_elses() -> None:
    one = held()
    assert one.take(0, A, rests=True) == (False, ""), "a goal goes on"
    assert one.take(1, A, rests=False) == (True, "")
    assert one.take(2, A, rests=True) == (True, "")
    assert one.take(3, A, rests=True) == (False, "")
    assert not one.ended(2 * TIMEOUT), "it had come to rest"


def test_a_second_publisher_counts_for_nothing_until_the_first_is_silent() -> None:
    one = held()
    one.take(0, A, rests=False)
    changes, why = one.take(1, B, rests=False)
    assert (changes, why[:17]) == (False, "another publisher")
    assert one.take(2, B, rests=True)[0] is False
    assert one.take(TIMEOUT + 1, B, rests=False) == (True, "")


@pytest.mark.parametrize("let_go", ["zeros", "silence"])
def test_after_a_stop_it_must_let_go_first(let_go: str) -> None:
    one = held()
    one.take(0, A, rests=False)
    one.on_stop("a button")
    assert not one.ended(1), "the stop has ended it"
    assert one.take(1, A, rests=False) == (False, "stopped: a button")
    one.on_stop("")
    assert "must let go first" in one.take(2, A, rests=False)[1]
    later = 3
    if let_go == "zeros":
        assert one.take(later, A, rests=True) == (False, "")
    else:
        later += TIMEOUT
        assert not one.ended(later)
    assert one.take(later + 1, A, rests=False) == (True, "")


def test_who_did_not_move_it_before_a_stop_need_not_let_go() -> None:
    one = held()
    one.on_stop("a button")
    one.on_stop("")
    assert one.take(1, A, rests=False) == (True, "")


def test_a_person_has_the_robot_for_a_while() -> None:
    one = held()
    one.take(0, A, rests=False)
    one.on_person(1)
    assert "a person has the robot" in one.take(2, A, rests=False)[1]
    assert "a person has the robot" in one.take(PERSON, A, rests=False)[1]
    assert "let go first" in one.take(PERSON + SECOND // 4, A, rests=False)[1]
    assert one.take(PERSON + SECOND // 2, A, rests=True) == (False, "")
    assert one.take(PERSON + SECOND // 2 + 1, A, rests=False) == (True, "")
