"""Detectors against the truth of the world: MuJoCo draws, homogeneous matrices say where a marker is."""

from __future__ import annotations

import math
import sys
from dataclasses import replace
from functools import cache
from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from brain.belief import Pose
from brain.perception.mount import Mount
from gateway.config import load_robot
from gateway.errors import UserError
from gateway.sim.camera import CameraSensor
from gateway.sim.files import Ball, SceneFile, Tag
from gateway.sim.load import load_plant, load_world
from gateway.sim.plant_files import Camera
from gateway.sim.sensors import stream
from gateway.sim.world import World
from gateway.vision import camera as vision
from gateway.vision.camera import Intrinsics, Sighting, events
from gateway.vision.detectors import Detectors
from gateway.vision.tags import Tags
from gateway.vision.targets import Target
from protocols.messages import Marker

TAGS = {
    "front": Tag(7, 1.6, 0.1, 0.25, math.pi - 0.5),
    "aslant": Tag(586, 1.3, -0.35, 0.3, math.pi + 0.7),
    "straight": Tag(0, 2.2, -0.1, 0.65, math.pi),
}
BALL = Ball(1.2, 0.4, 0.2, 0.1)
RED = Target(1000, 0.1, 0.0)
CAMERA = Camera(Detectors(Tags(0.16), (RED,)), noise=2.0)
MOUNT = Mount(x=0.15, y=0.02, z=0.2, yaw=0.05, pitch=-0.03, roll=0.02)
POSES = [Pose(x, y, yaw) for x, y, yaw in ((0.0, 0.0, 0.0), (0.4, -0.1, 0.1))]


@cache
def images() -> list[tuple[Pose, vision.Image]]:
    """What the camera sees from each pose."""
    import mujoco

    robot, file = load_robot("diffbot"), load_world("office")
    assert isinstance(file, SceneFile)
    assert robot.plant is not None
    file = replace(file, tags=TAGS, balls={"red": BALL}, walls={}, boxes={})
    world = World(file, load_plant(robot.plant), robot, 0)
    scene, sensor = world.scene, CameraSensor("camera", CAMERA, MOUNT, stream(0, "camera"))
    assert scene is not None
    found = []
    for pose in POSES:
        scene.data.qpos[:7] = pose.x, pose.y, 0.0, math.cos(pose.yaw / 2), 0.0, 0.0, math.sin(pose.yaw / 2)
        mujoco.mj_forward(scene.model, scene.data)
        found.append((pose, sensor.image(scene)))
    return found


def matrix(rotation: Rotation, *at: float) -> np.ndarray[Any, Any]:
    whole = np.eye(4)
    whole[:3, :3], whole[:3, 3] = rotation.as_matrix(), at
    return whole


def in_camera(pose: Pose, x: float, y: float, z: float, yaw: float = 0.0) -> np.ndarray[Any, Any]:
    """A marker's frame in that of the sensor."""
    base = matrix(Rotation.from_euler("z", pose.yaw), pose.x, pose.y, 0.0)
    turned = Rotation.from_euler("ZYX", [MOUNT.yaw, MOUNT.pitch, MOUNT.roll])
    sensor = base @ matrix(turned, MOUNT.x, MOUNT.y, MOUNT.z)
    return np.asarray(np.linalg.inv(sensor) @ matrix(Rotation.from_euler("z", yaw), x, y, z))


def test_tags_are_where_the_world_has_them() -> None:
    """Within 3 standard deviations, along and across the line of sight and in their turn; all are seen."""
    squares: list[float] = []
    for pose, image in images():
        seen = {
            event.marker: event
            for event in events("camera", 5, CAMERA.detectors.detect(image, CAMERA.intrinsics))
        }
        assert {tag.marker for tag in TAGS.values()} <= set(seen)
        for tag in TAGS.values():
            event, true = seen[tag.marker], in_camera(pose, tag.x, tag.y, tag.z, tag.yaw)
            assert event.position is not None
            assert event.variance is not None
            place = true[:3, 3]
            sight, off = place / np.linalg.norm(place), np.array(event.position) - place
            along = float(sight @ off)
            across = float(np.linalg.norm(off - along * sight))
            squares += [along**2 / event.variance[0], across**2 / event.variance[1] / 2.0]
            assert abs(along) < 0.01  # blurred corners alone: 0.02 m too far at 2 m, in every image
            assert across < 0.002
            if event.orientation is not None and event.turn_variance is not None:
                turn = Rotation.from_matrix(true[:3, :3]).inv() * Rotation.from_quat(event.orientation)
                squares.append(turn.as_rotvec()[2] ** 2 / event.turn_variance)
    assert max(squares) < 9.0
    assert np.mean(squares) < 1.5


def test_a_lens_that_distorts_moves_no_tag() -> None:
    """The image as a lens with barrel distortion would show it gives the same places."""
    import cv2

    plain = CAMERA.intrinsics
    lens = replace(plain, distortion=(-0.25, 0.06, 0.001, -0.001, 0.0))
    image = images()[0][1]
    rows, columns = np.mgrid[: image.shape[0], : image.shape[1]].astype(np.float64)
    shown = np.stack((columns.ravel(), rows.ravel()), axis=1)[:, None]
    straight = cv2.undistortPoints(shown, lens.matrix, np.array(lens.distortion), P=lens.matrix)
    places = straight.reshape(*image.shape[:2], 2).astype(np.float32)
    bent: Any = cv2.remap(image, places[..., 0], places[..., 1], cv2.INTER_LINEAR)
    before, after = (
        {one.marker: one.position for one in Tags(0.16).detect(picture, lens_of)}
        for picture, lens_of in ((image, plain), (bent, lens))
    )
    assert set(before) == set(after) == {0, 7, 586}
    assert all(np.linalg.norm(before[number] - after[number]) < 0.01 for number in before)


def test_a_ball_is_where_the_world_has_it() -> None:
    for pose, image in images():
        found = [
            event
            for event in events("camera", 5, RED.detect(image, CAMERA.intrinsics))
            if event.marker == 1000
        ]
        assert len(found) == 1
        position, variance = found[0].position, found[0].variance
        assert position is not None
        assert variance is not None
        off = np.array(position) - in_camera(pose, BALL.x, BALL.y, BALL.z)[:3, 3]
        assert float(np.linalg.norm(off)) < 3.0 * math.sqrt(variance[0])
        assert found[0].orientation is None


def test_an_image_that_shows_nothing_is_reported() -> None:
    nothing = np.full((480, 640, 3), 90, dtype=np.uint8)
    assert events("camera", 5, CAMERA.detectors.detect(nothing, CAMERA.intrinsics)) == [
        Marker("camera", 5, None)
    ]


def test_a_ball_that_is_partly_hidden_or_tiny_is_left_out() -> None:
    image = np.full((120, 160, 3), 90, dtype=np.uint8)
    rows, columns = np.ogrid[:120, :160]
    seen = Intrinsics(150.0, 150.0, 79.5, 59.5)
    whole = (rows - 60) ** 2 + (columns - 80) ** 2 <= 20**2
    image[whole] = (200, 20, 20)
    assert len(RED.detect(image, seen)) == 1
    image[60:] = 90
    assert RED.detect(image, seen) == []
    image[:] = 90
    image[(rows - 60) ** 2 + (columns - 5) ** 2 <= 20**2] = (200, 20, 20)
    assert RED.detect(image, seen) == []
    image[:] = 90
    image[58:60, 80:82] = (200, 20, 20)
    assert RED.detect(image, seen) == []


def test_the_covariance_of_a_tag_is_that_of_noisy_corners() -> None:
    """Corners of a tag seen aslant, by a projection of its own; 250 draws."""
    tags, rng, place = Tags(0.16, corner_sigma=0.3), np.random.default_rng(1), np.array([0.1, -0.2, 1.2])
    turned = Rotation.from_euler("y", 40, degrees=True).as_matrix() @ np.diag([1.0, -1.0, -1.0])
    half = 0.08
    flat = np.array([[-half, half, 0.0], [half, half, 0.0], [half, -half, 0.0], [-half, -half, 0.0]])
    points = flat @ turned.T + place
    camera = Intrinsics(500.0, 500.0, 320.0, 240.0)
    corners = 500.0 * points[:, :2] / points[:, 2:] + (320.0, 240.0)
    clean = tags._sighting(3, corners, camera)
    assert clean is not None
    assert clean.position == pytest.approx(place, abs=1e-6)
    assert clean.rotation == pytest.approx(turned, abs=1e-6)
    places, turns = [], []
    for _ in range(250):
        one = tags._sighting(3, corners + 0.3 * rng.standard_normal((4, 2)), camera)
        assert one is not None
        places.append(one.position - place)
        if one.rotation is not None:
            turns.append(Rotation.from_matrix(turned.T @ one.rotation).as_rotvec()[1])
    sight = place / np.linalg.norm(place)
    along = np.array(places) @ sight
    across = np.array(places) - along[:, None] * sight
    assert np.mean(along**2) == pytest.approx(clean.variance[0], rel=0.25)
    assert np.mean(across**2) * 1.5 == pytest.approx(clean.variance[1], rel=0.25)
    assert clean.turn_variance is not None
    assert np.mean(np.square(turns)) == pytest.approx(clean.turn_variance, rel=0.25)


def test_rotations_of_all_kinds_become_quaternions() -> None:
    for turned in [*Rotation.random(50, random_state=2), *Rotation.from_euler("z", [[0.0], [math.pi]])]:
        sighting = Sighting(1, np.array([0.0, 0.0, 1.0]), turned.as_matrix(), (1.0, 1.0))
        [event] = events("camera", 0, [sighting])
        assert event.orientation is not None
        wanted = Rotation.from_matrix(vision.TO_SENSOR @ turned.as_matrix() @ np.eye(3)[:, [2, 0, 1]])
        assert (Rotation.from_quat(event.orientation) * wanted.inv()).magnitude() < 1e-6


def test_without_opencv_a_sentence_says_how_to_install_it(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "cv2", None)
    with pytest.raises(UserError, match=r"pip install 'motor-gateway\[camera\]'"):
        vision.opencv()


@pytest.mark.parametrize(
    ("tags", "targets"),
    [(None, ()), (None, (RED, RED)), (None, tuple(replace(RED, marker=i) for i in range(17)))],
)
def test_detectors_look_for_something_and_each_target_is_one(
    tags: Tags | None, targets: tuple[Target, ...]
) -> None:
    with pytest.raises(ValueError, match="targets"):
        Detectors(tags, targets)
