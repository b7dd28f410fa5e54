"""The bytes encoded by `struct` equal those of a general serialiser; the fields are checked in test_views."""

from __future__ import annotations

from functools import cache, partial
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from rosbags.typesys.store import Typestore

from brain.belief import Estimate, Pose
from gateway.recording import ros_cdr
from gateway.recording.ros_messages import CAN_FRAME, FD_FRAME
from gateway.recording.ros_views import JOINT_STATE, ODOMETRY, POSE, TRANSFORMS, typestore
from protocols.frames import CanFrame
from protocols.sensors import OURS
from tests.gateway import little
from tests.protocols.message_samples import messages_of

LAYOUTS = ros_cdr.Layouts()
names = st.text(max_size=12)
floats = st.floats(allow_nan=False)
poses = st.builds(Pose, floats, floats, st.floats(-1e300, 1e300))
estimates = st.builds(
    Estimate,
    little.int64,
    poses,
    floats,
    floats,
    st.lists(floats, min_size=9, max_size=9).map(lambda values: np.array(values).reshape(3, 3)),
    odom=poses,
)


def frames(fd: bool, most: int) -> st.SearchStrategy[CanFrame]:
    return st.builds(
        CanFrame,
        id=st.integers(0, 2**29 - 1),
        data=st.binary(max_size=most),
        extended=st.booleans(),
        remote=st.booleans(),
        fd=st.just(fd),
    )


ENCODED: list[tuple[str, st.SearchStrategy[bytes]]] = [
    (CAN_FRAME, st.builds(partial(ros_cdr.can_frame, LAYOUTS), little.int64, names, frames(False, 9))),
    (FD_FRAME, st.builds(partial(ros_cdr.fd_frame, LAYOUTS), little.int64, names, frames(True, 65))),
    *(
        (kind.ros.type, messages_of(kind.message).map(partial(ros_cdr.reading, LAYOUTS, kind.ros)))
        for kind in OURS
        if kind.ros
    ),
    (ODOMETRY, estimates.map(partial(ros_cdr.odometry, LAYOUTS))),
    (ODOMETRY, st.builds(partial(ros_cdr.dead_reckoning, LAYOUTS), little.int64, poses)),
    (TRANSFORMS, estimates.map(partial(ros_cdr.transforms, LAYOUTS))),
    (POSE, estimates.map(partial(ros_cdr.pose_in_map, LAYOUTS))),
    (
        JOINT_STATE,
        st.builds(
            ros_cdr.joint_state,
            little.int64,
            st.dictionaries(names, st.tuples(*[st.none() | floats] * 3), max_size=4),
        ),
    ),
]


@cache
def store() -> Typestore:
    return typestore()


def the_same(data: bytes, type_: str) -> Any:
    """Return the message; the general serialiser reads it, and writes the same bytes."""
    message: Any = store().deserialize_cdr(data, type_)
    assert bytes(store().serialize_cdr(message, type_, little_endian=True)) == data
    return message


@pytest.mark.parametrize(("type_", "encoded"), ENCODED)
@settings(max_examples=100, deadline=None)
@given(data=st.data())
def test_the_bytes_are_those_of_the_general_serialiser(
    type_: str, encoded: st.SearchStrategy[bytes], data: st.DataObject
) -> None:
    the_same(data.draw(encoded), type_)


@pytest.mark.parametrize("fd", [False, True])
def test_data_beyond_the_longest_frame_are_cut(fd: bool) -> None:
    data = bytes(range(65))
    if fd:
        message = the_same(ros_cdr.fd_frame(LAYOUTS, 0, "can0", CanFrame(1, data, fd=True)), FD_FRAME)
        assert (message.len, message.data.tobytes()) == (64, data[:64])
    else:
        message = the_same(ros_cdr.can_frame(LAYOUTS, 0, "can0", CanFrame(1, data)), CAN_FRAME)
        assert (message.dlc, message.data.tobytes()) == (8, data[:8])


@pytest.mark.parametrize("name", ["", "a", "can0", "späte", "\udcff"])
def test_any_name_is_a_name(name: str) -> None:
    frame = CanFrame(1, b"12345678")
    message = the_same(ros_cdr.can_frame(LAYOUTS, 0, name, frame), CAN_FRAME)
    assert message.header.frame_id == name.encode(errors="backslashreplace").decode()
    the_same(ros_cdr.joint_state(0, {name: (1.0, None, None)}), JOINT_STATE)
