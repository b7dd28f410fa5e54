"""The bytes encoded by `struct` equal those of a general serialiser; the fields are checked in test_views."""

from __future__ import annotations

from functools import cache
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from rosbags.typesys.store import Typestore

from brain.belief import Estimate, Pose
from gateway.recording import ros_cdr
from gateway.recording.ros_messages import CAN_FRAME, FD_FRAME
from gateway.recording.ros_views import IMU, JOINT_STATE, ODOMETRY, SCAN, TRANSFORMS, typestore
from protocols.frames import CanFrame
from protocols.messages import Imu, LaserScan, Nanos
from tests.gateway import little

names = st.text(max_size=12)
floats = st.floats(allow_nan=False)
three = st.tuples(floats, floats, floats)
LAYOUTS = ros_cdr.Layouts()
few = settings(max_examples=100, deadline=None)


@cache
def store() -> Typestore:
    return typestore()


def the_same(data: bytes, type_: str) -> Any:
    """The message, read and written by the general serialiser."""
    message: Any = store().deserialize_cdr(data, type_)
    assert bytes(store().serialize_cdr(message, type_, little_endian=True)) == data
    return message


def frames(fd: bool, most: int) -> st.SearchStrategy[CanFrame]:
    return st.builds(
        CanFrame,
        id=st.integers(0, 2**29 - 1),
        data=st.binary(max_size=most),
        extended=st.booleans(),
        remote=st.booleans(),
        fd=st.just(fd),
    )


@few
@given(little.int64, names, frames(False, 9))
def test_classic_frames(t: Nanos, bus: str, frame: CanFrame) -> None:
    message = the_same(ros_cdr.can_frame(LAYOUTS, t, bus, frame), CAN_FRAME)
    assert message.data.tobytes() == frame.data[:8].ljust(8, b"\0")
    assert (message.id, message.dlc, message.is_rtr) == (frame.id, min(8, len(frame.data)), frame.remote)


@few
@given(little.int64, names, frames(True, 65))
def test_fd_frames(t: Nanos, bus: str, frame: CanFrame) -> None:
    message = the_same(ros_cdr.fd_frame(LAYOUTS, t, bus, frame), FD_FRAME)
    assert message.data.tobytes() == frame.data[:64]
    assert (message.id, message.len) == (frame.id, min(64, len(frame.data)))


@few
@given(little.int64, names, three, three, st.none() | st.tuples(floats, floats, floats, floats))
def test_imu(t: Nanos, sensor: str, turn: Any, push: Any, orientation: Any) -> None:
    message = the_same(ros_cdr.imu(LAYOUTS, Imu(sensor, t, turn, push, orientation)), IMU)
    push_back = message.linear_acceleration
    assert (push_back.x, push_back.y, push_back.z) == push


@few
@given(little.int64, names, st.lists(floats, max_size=9), floats, floats, floats, floats)
def test_scans(
    t: Nanos, sensor: str, ranges: list[float], start: float, step: float, low: float, high: float
) -> None:
    scan = LaserScan(sensor, t, start, step, low, high, tuple(ranges))
    assert len(the_same(ros_cdr.laser_scan(LAYOUTS, scan), SCAN).ranges) == len(ranges)


@few
@given(little.int64, three, floats, floats, st.lists(floats, min_size=9, max_size=9))
def test_odometry_and_transform(
    t: Nanos, pose: Any, linear: float, angular: float, covariance: list[float]
) -> None:
    x, y, yaw = pose
    at = Pose(x, y, yaw if abs(yaw) < 1e300 else 0.0)
    estimate = Estimate(t, at, linear, angular, np.array(covariance).reshape(3, 3))
    message = the_same(ros_cdr.odometry(LAYOUTS, estimate), ODOMETRY)
    full = message.pose.covariance.reshape(6, 6)
    assert full[np.ix_((0, 1, 5), (0, 1, 5))].ravel().tolist() == covariance
    assert np.count_nonzero(full) == np.count_nonzero(covariance)
    assert message.twist.twist.linear.x == linear
    assert message.twist.twist.angular.z == angular
    the_same(ros_cdr.dead_reckoning(LAYOUTS, t, at), ODOMETRY)
    (transform,) = the_same(ros_cdr.base_transform(LAYOUTS, estimate), TRANSFORMS).transforms
    assert (transform.child_frame_id, transform.transform.translation.y) == ("base_link", y)


@few
@given(little.int64, st.dictionaries(names, st.tuples(*[st.none() | floats] * 3), max_size=4))
def test_joint_states(t: Nanos, joints: dict[str, Any]) -> None:
    message = the_same(ros_cdr.joint_state(t, joints), JOINT_STATE)
    assert len(message.name) == len(joints)


@pytest.mark.parametrize("name", ["", "a", "can0", "späte", "\udcff"])
def test_any_name_is_a_name(name: str) -> None:
    frame = CanFrame(1, b"12345678")
    message = the_same(ros_cdr.can_frame(LAYOUTS, 0, name, frame), CAN_FRAME)
    assert message.header.frame_id == name.encode(errors="backslashreplace").decode()
    the_same(ros_cdr.joint_state(0, {name: (1.0, None, None)}), JOINT_STATE)
