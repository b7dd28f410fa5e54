import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from brain.belief import Pose
from brain.perception.mount import Mount, to_body, to_world
from protocols.messages import LaserScan
from tests.brain.perception.office import OFFICE, scan_at

angles = st.floats(-3.2, 3.2)


def turned(axis: int, angle: float) -> np.ndarray:
    c, s = math.cos(angle), math.sin(angle)
    a, b = [(1, 2), (2, 0), (0, 1)][axis]
    matrix = np.eye(3)
    matrix[a, a], matrix[a, b], matrix[b, a], matrix[b, b] = c, -s, s, c
    return matrix


@given(angles, angles, angles, st.tuples(*[st.floats(-10.0, 10.0)] * 3))
def test_rotation_is_yaw_then_pitch_then_roll(
    yaw: float, pitch: float, roll: float, vector: tuple[float, float, float]
) -> None:
    expected = turned(2, yaw) @ turned(1, pitch) @ turned(0, roll) @ np.array(vector)
    mount = Mount(1.0, 2.0, 3.0, yaw, pitch, roll)
    assert mount.rotate(vector) == pytest.approx(tuple(expected), abs=1e-9)


def test_husky_lies_on_its_back() -> None:
    """robot_localization 1cb9533, test1: an IMU mounted by yaw -90°, roll +90° reads gravity on its y."""
    mount = Mount(0.0, -0.3, 0.52, yaw=-math.pi / 2, roll=math.pi / 2)
    x, y, z = mount.rotate((-0.2, 9.8, 0.1))
    assert z == pytest.approx(9.8)
    assert math.hypot(x, y) == pytest.approx(math.hypot(0.2, 0.1))
    assert mount.rotate((0.0, 0.5, 0.0))[2] == pytest.approx(0.5)  # a turn to the left


@pytest.mark.parametrize("field", ["x", "y", "z", "yaw", "pitch", "roll"])
def test_a_mount_is_finite(field: str) -> None:
    with pytest.raises(ValueError, match=f"{field} must be from"):
        Mount(**{field: math.nan})


def scan(*ranges: float, increment: float = math.pi / 2) -> LaserScan:
    return LaserScan("lidar", 0, 0.0, increment, 0.1, 10.0, ranges)


def test_beams_in_the_robots_frame() -> None:
    swept = to_body(scan(1.0, 2.0, 3.0, 4.0), Mount(0.5, 0.25, yaw=math.pi / 2))
    ends = [(0.5, 1.25), (-1.5, 0.25), (0.5, -2.75), (4.5, 0.25)]
    assert swept.ends == pytest.approx(np.array(ends), abs=1e-12)
    assert swept.origin == (0.5, 0.25)
    assert swept.hit.all()


def test_a_lidar_upside_down_turns_the_other_way() -> None:
    swept = to_body(scan(1.0, 2.0, 3.0, 4.0), Mount(roll=math.pi))
    assert swept.ends == pytest.approx(np.array([(1, 0), (0, -2), (-3, 0), (0, 4)]), abs=1e-12)


def test_what_is_no_hit() -> None:
    """Too near is no reading; at the end, or beyond it, is nothing met; and all is cut at `farthest`."""
    swept = to_body(scan(0.05, 10.0, 12.0, 7.0), Mount(), farthest=8.0)
    assert swept.hit.tolist() == [False, False, False, True]
    assert swept.ranges.tolist() == [0.0, 8.0, 8.0, 7.0]
    assert swept.ends[0].tolist() == [0.0, 0.0]


@pytest.mark.parametrize("bad", [math.nan, math.inf, -1.0, 0.0])
def test_what_is_no_range_is_no_reading(bad: float) -> None:
    swept = to_body(scan(1.0, bad, 1.0, 1.0), Mount())
    assert swept.ranges[1] == 0.0
    assert not swept.hit[1]
    assert np.isfinite(swept.ends).all()


@pytest.mark.parametrize("mount", [Mount(0.1, -0.05, yaw=0.7), Mount(yaw=-3.0)])
def test_ends_lie_on_walls(mount: Mount) -> None:
    """From any pose and mount, an exact scan's hits lie on the walls that it saw."""
    pose = Pose(0.4, -0.3, 2.0)
    swept = to_body(scan_at(OFFICE, pose, mount, 0), mount)
    ends = to_world(swept.ends[swept.hit], pose)
    for end in ends[::5]:
        along = np.clip(
            np.sum((end - OFFICE[:, :2]) * (OFFICE[:, 2:] - OFFICE[:, :2]), axis=1)
            / np.sum((OFFICE[:, 2:] - OFFICE[:, :2]) ** 2, axis=1),
            0.0,
            1.0,
        )
        nearest = OFFICE[:, :2] + along[:, None] * (OFFICE[:, 2:] - OFFICE[:, :2])
        assert np.hypot(*(nearest - end).T).min() < 1e-9
