"""A joint trajectory: samples of it, and every reason for which one is refused."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest

from gateway.ros import trajectory
from gateway.ros.types import encode, make
from protocols.messages import SECOND, Position

POINT = "trajectory_msgs/msg/JointTrajectoryPoint"


def point(seconds: float, *positions: float, velocities: tuple[float, ...] = ()) -> Any:
    whole = int(seconds)
    since = make("builtin_interfaces/msg/Duration", sec=whole, nanosec=round((seconds - whole) * SECOND))
    return make(POINT, positions=np.array(positions), velocities=np.array(velocities), time_from_start=since)


def message(names: list[str], *points: Any) -> Any:
    return make("trajectory_msgs/msg/JointTrajectory", joint_names=names, points=list(points))


def read(names: list[str], *points: Any) -> trajectory.Trajectory:
    """As the process with the sockets packs it, and a step reads it."""
    data = trajectory.packed("trajectory_msgs/msg/JointTrajectory", encode(message(names, *points)))
    return trajectory.read(trajectory.unpacked(data)[0], ("a", "b"), {"a": 0.0, "b": 1.0})


def test_without_velocities_it_goes_straight() -> None:
    one = read(["a", "b"], point(1.0, 2.0, 1.0), point(3.0, 0.0, 2.0))
    assert one.at(0.0)[1] == Position("b", 1.0, 0.0)
    assert one.at(2.0) == [Position("a", 1.0, -1.0), Position("b", 1.5, 0.5)]
    assert one.at(3.0) == one.at(99.0) == [Position("a", 0.0), Position("b", 2.0)]
    assert one.goal == {"a": 0.0, "b": 2.0}


def test_with_velocities_it_is_a_cubic_whose_velocity_is_its_slope() -> None:
    one = read(["a"], point(1.0, 1.0, velocities=(2.0,)), point(2.0, 2.0, velocities=(0.0,)))
    for time in (0.3, 0.7, 1.2, 1.9):
        before, after = (one.at(time + d)[0].position for d in (-1e-6, 1e-6))
        assert one.at(time)[0].velocity == pytest.approx((after - before) / 2e-6, abs=1e-5)
    assert one.at(1.0)[0].position == pytest.approx(1.0)
    assert one.at(1.0)[0].velocity == pytest.approx(2.0)
    assert one.at(0.0)[0] == Position("a", 0.0, 0.0), "it begins at rest, where the joint is"


def test_a_first_point_at_once_is_where_the_joints_are() -> None:
    one = read(["a"], point(0.0, 0.1), point(1.0, 0.2))
    assert one.times.tolist() == [0.0, trajectory.SOONEST, 1.0]


@pytest.mark.parametrize(
    ("names", "points", "why"),
    [
        ([], [point(1.0)], "names no joints"),
        (["a", "a"], [point(1.0, 1.0, 1.0)], "or one twice"),
        (["c"], [point(1.0, 1.0)], "there is no joint 'c'"),
        (["a"], [], "0 points, expected 1 to"),
        (["a"], [point(1.0, 1.0)] * 2001, "2001 points"),
        (["a"], [point(1.0, 1.0, 2.0)], "2 positions and 0 velocities for 1 joint"),
        (["a"], [point(1.0, 1.0, velocities=(1.0, 1.0))], "1 positions and 2 velocities"),
        (["a"], [point(1.0, math.nan)], "not finite"),
        (["a"], [point(1.0, 1.0, velocities=(math.inf,))], "not finite"),
        (["a"], [point(1.0, 1.0), point(1.0, 2.0)], "times do not grow"),
        (["a"], [point(700.0, 1.0)], "takes 700 s"),
    ],
)
def test_what_is_refused(names: list[str], points: list[Any], why: str) -> None:
    with pytest.raises(trajectory.Refused, match=why):
        read(names, *points)


def test_where_it_begins_must_be_known() -> None:
    points = trajectory.points_of(message(["a", "b"], point(1.0, 1.0, 1.0)))
    with pytest.raises(trajectory.Refused, match="where b is, is not known"):
        trajectory.read(points, ("a", "b"), {"a": 0.0, "b": None})


def test_bytes_that_are_none_are_refused_where_they_are_used() -> None:
    data = trajectory.packed("trajectory_msgs/msg/JointTrajectory", b"\x00\x01\x00\x00" + bytes(60))
    with pytest.raises(trajectory.Refused, match="JointTrajectory"):
        trajectory.unpacked(data)
