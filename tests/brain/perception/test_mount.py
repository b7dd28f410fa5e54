import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from brain.perception.mount import Mount

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
