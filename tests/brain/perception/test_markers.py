"""Markers: the pose by a known one against homogeneous matrices, its covariance against Monte Carlo."""

import math
from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from brain.belief import Pose
from brain.perception import markers
from brain.perception.markers import KnownMarker, Markers, MarkerSettings, is_possible
from brain.perception.mount import Mount
from protocols.messages import SECOND, Marker

MOUNT = Mount(x=0.15, y=-0.05, z=0.2, yaw=0.3, pitch=0.1, roll=-0.05)
KNOWN = KnownMarker(7, 2.0, 1.0, -2.5)
SETTINGS = MarkerSettings((KNOWN,))


def matrix(rotation: Rotation, *at: float) -> np.ndarray:
    whole = np.eye(4)
    whole[:3, :3], whole[:3, 3] = rotation.as_matrix(), at
    return whole


def seen(robot: Pose, marker: Pose, height: float = 0.3, t: int = 0, number: int = 7) -> Marker:
    """What the camera sees, by matrices of scipy's rotations."""
    base = matrix(Rotation.from_euler("z", robot.yaw), robot.x, robot.y, 0.0)
    turned = Rotation.from_euler("ZYX", [MOUNT.yaw, MOUNT.pitch, MOUNT.roll])
    camera = base @ matrix(turned, MOUNT.x, MOUNT.y, MOUNT.z)
    tag = matrix(Rotation.from_euler("z", marker.yaw), marker.x, marker.y, height)
    there = np.linalg.inv(camera) @ tag
    quaternion = Rotation.from_matrix(there[:3, :3]).as_quat()
    return Marker(
        "camera", t, number, tuple(there[:3, 3].tolist()), tuple(quaternion.tolist()), (1e-4, 1e-6), 1e-4
    )


def test_a_known_marker_gives_the_pose_whatever_is_believed() -> None:
    rng = np.random.default_rng(1)
    for _ in range(30):
        robot = Pose(rng.uniform(-1.0, 1.0), rng.uniform(-1.0, 1.0), rng.uniform(-3.0, 3.0))
        event = seen(robot, Pose(KNOWN.x, KNOWN.y, KNOWN.yaw))
        fix = Markers(SETTINGS).observe(event, MOUNT, Pose(5.0, 5.0, 1.0), 1.0)
        assert fix is not None
        assert fix.value[:2] == pytest.approx([robot.x, robot.y], abs=1e-9)
        assert math.cos(fix.value[2] - robot.yaw) == pytest.approx(1.0, abs=1e-12)


def test_its_covariance_is_that_of_a_noisy_camera() -> None:
    """Noise along and across the line of sight and of the orientation, 4000 draws, to 10 %."""
    rng, robot, mount = np.random.default_rng(2), Pose(-0.5, 0.4, 0.6), Mount(x=0.15, yaw=0.2)
    fixes = []
    bearing, distance, turn = 0.25, 2.2, 2.9
    for draw in range(4000):
        along, across, turned = (0.02, 0.005, 0.03) * rng.standard_normal(3) if draw else (0.0, 0.0, 0.0)
        u, v = (
            np.array([math.cos(bearing), math.sin(bearing)]),
            np.array([-math.sin(bearing), math.cos(bearing)]),
        )
        x, y = (distance + along) * u + across * v
        half = (turn + turned) / 2.0
        event = Marker(
            "c", 0, 7, (x, y, 0.0), (0.0, 0.0, math.sin(half), math.cos(half)), (4e-4, 2.5e-5), 9e-4
        )
        fix = Markers(SETTINGS).observe(event, mount, robot, 0.0)
        assert fix is not None
        fixes.append(fix)
    clean, values = fixes[0], [fix.value for fix in fixes]
    sample, scale = np.cov(np.array(values[1:]).T), np.sqrt(np.diag(clean.noise))
    assert sample / np.outer(scale, scale) == pytest.approx(clean.noise / np.outer(scale, scale), abs=0.1)


def test_a_known_ball_gives_a_position_by_the_believed_yaw() -> None:
    robot = Pose(0.3, -0.2, 0.9)
    event = seen(robot, Pose(KNOWN.x, KNOWN.y, 0.0))
    ball = Marker("camera", 0, 7, event.position)
    fix = Markers(SETTINGS).observe(ball, MOUNT, Pose(9.0, 9.0, robot.yaw), 0.01)
    assert fix is not None
    assert fix.value == pytest.approx([robot.x, robot.y], abs=1e-9)
    sight = np.array([KNOWN.x - robot.x, KNOWN.y - robot.y])
    across = np.array([-sight[1], sight[0]])  # the yaw's error counts at the distance
    assert fix.noise == pytest.approx(np.eye(2) * 0.03**2 + 0.01 * np.outer(across, across))


def test_an_unknown_marker_is_a_place_while_it_is_seen() -> None:
    robot, dock = Pose(0.5, 0.5, 0.4), Pose(2.0, 1.5, -2.0)
    kept = Markers(MarkerSettings())
    assert kept.observe(seen(robot, dock, t=SECOND, number=3), MOUNT, robot, 0.0) is None
    place = kept.seen(3, SECOND + markers.FRESH)
    assert place is not None
    assert (place.x, place.y, place.yaw) == pytest.approx((dock.x, dock.y, dock.yaw))
    assert kept.seen(3, SECOND + markers.FRESH + 1) is None
    assert kept.seen(4, SECOND) is None
    assert kept.observe(Marker("camera", SECOND, None), MOUNT, robot, 0.0) is None


def test_the_direction_of_a_face_is_kept_while_it_is_not_shown() -> None:
    robot, dock = Pose(0.5, 0.5, 0.4), Pose(2.0, 1.5, -2.0)
    kept, whole = Markers(MarkerSettings()), seen(robot, dock, number=3)
    for event, yaw in (
        (replace(whole, orientation=None), math.atan2(0.5 - 1.5, 0.5 - 2.0)),
        (whole, dock.yaw),
        (replace(whole, orientation=None), dock.yaw),
    ):
        kept.observe(event, MOUNT, robot, 0.0)
        place = kept.seen(3, 0)
        assert place is not None
        assert place.yaw == pytest.approx(yaw, abs=1e-6)


def test_the_direction_of_a_face_is_the_mean_of_what_was_shown() -> None:
    """Against least squares; and one that was turned is as it is shown."""
    robot, dock, rng = Pose(0.5, 0.5, 0.4), Pose(2.0, 1.5, -2.0), np.random.default_rng(3)
    kept, errors, variances = Markers(MarkerSettings()), [], []
    for sigma in (0.1, 0.02, 0.05, 0.02):
        errors.append(sigma * rng.uniform(-1.0, 1.0))
        variances.append(sigma**2)
        turned = replace(dock, yaw=dock.yaw + errors[-1])
        event = replace(seen(robot, turned, number=3), turn_variance=variances[-1])
        kept.observe(event, MOUNT, robot, 0.0)
    mean = np.average(errors, weights=1.0 / np.array(variances))
    assert kept.places[3].pose.yaw == pytest.approx(dock.yaw + mean, abs=1e-6)
    kept.observe(seen(robot, replace(dock, yaw=-1.0), number=3), MOUNT, robot, 0.0)
    assert kept.places[3].pose.yaw == pytest.approx(-1.0, abs=1e-6)


def test_only_so_many_are_kept() -> None:
    kept, robot = Markers(MarkerSettings()), Pose(0.0, 0.0, 0.0)
    for number in range(markers.MOST + 5):
        kept.observe(Marker("camera", number, number, (1.0, 0.0, 0.0)), MOUNT, robot, 0.0)
    assert list(kept.places) == list(range(5, markers.MOST + 5))


@pytest.mark.parametrize(
    ("event", "possible"),
    [
        (Marker("c", 0, None), True),
        (Marker("c", 0, 1, (1.0, 0.0, 0.0)), True),
        (Marker("c", 0, 1, (51.0, 0.0, 0.0)), False),
        (Marker("c", 0, 1, (1.0, 0.0, 0.0), (0.0, 0.0, 0.0, 0.0)), False),
        (Marker("c", 0, 1, (1.0, 0.0, 0.0), None, (-1.0, 0.0)), False),
        (Marker("c", 0, 1, (1.0, 0.0, 0.0), None, None, math.inf), False),
    ],
)
def test_what_no_camera_sees_is_left_out(event: Marker, possible: bool) -> None:
    assert is_possible(event) is possible


@pytest.mark.parametrize("known", [(KNOWN, KNOWN), tuple(KnownMarker(i, 0.0, 0.0) for i in range(257))])
def test_known_markers_are_few_and_each_is_one(known: tuple[KnownMarker, ...]) -> None:
    with pytest.raises(ValueError, match="known"):
        MarkerSettings(known)
