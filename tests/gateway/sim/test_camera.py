"""A camera from the drawn image to the pose: the world's, through its twin on a serial line, to the brain."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

import gateway as gw
from brain.perception.mount import Mount
from gateway.config import load_robot
from gateway.errors import ConfigError
from gateway.sim.camera import CameraSensor, Renderer
from gateway.sim.files import SceneFile, Tag
from gateway.sim.load import WorldError, load_plant, load_world
from gateway.sim.plant_files import Camera
from gateway.sim.sensors import stream
from gateway.sim.world import World
from gateway.vision.detectors import Detectors
from gateway.vision.tags import CELLS, FAMILY, Tags, pattern
from protocols.messages import SECOND, Marker


def scene(camera: Camera) -> tuple[World, CameraSensor]:
    """A tag 0.8 m in front of a camera."""
    robot, file = load_robot("diffbot"), load_world("office")
    assert isinstance(file, SceneFile)
    assert robot.plant is not None
    file = replace(file, tags={"one": Tag(3, 1.0, 0.0, 0.3, math.pi)}, walls={}, boxes={})
    world = World(file, load_plant(robot.plant), robot, 0)
    world.step({})
    return world, CameraSensor("camera", camera, Mount(x=0.2, z=0.2), stream(1, "camera"))


def test_one_marker_a_step_after_the_image_and_noise_by_the_seed() -> None:
    camera = Camera(Detectors(Tags(0.16)), width=160, height=120, rate_hz=10.0, noise=2.0)
    world, sensor = scene(camera)
    assert world.scene is not None
    first = sensor.measure(5, 0, world.scene)
    assert first is not None
    assert (first.sensor, first.t, first.marker) == ("camera", 5, 3)
    assert sensor.measure(6, 1, world.scene) is None
    assert sensor.period == SECOND // 10
    again = CameraSensor("camera", camera, sensor.mount, stream(1, "camera"))
    other = CameraSensor("camera", camera, sensor.mount, stream(2, "camera"))
    for one in (again, other):
        one._renderer = sensor._renderer
    assert again.measure(5, 0, world.scene) == first
    assert other.measure(5, 0, world.scene) != first
    clean = CameraSensor("camera", replace(camera, noise=0.0), sensor.mount, stream(1, "camera"))
    clean._renderer = sensor._renderer
    lit = clean.image(world.scene).astype(float)
    off = (other.image(world.scene) - lit)[(lit > 20.0) & (lit < 235.0)]
    assert np.std(off) == pytest.approx(2.0, rel=0.1)


def test_without_opengl_a_sentence_says_what_to_install(monkeypatch: pytest.MonkeyPatch) -> None:
    world, sensor = scene(Camera(Detectors(Tags(0.16)), width=160, height=120))
    monkeypatch.setattr("mujoco.egl.GLContext", lambda *_: 1 / 0)
    assert world.scene is not None
    with pytest.raises(WorldError, match="libegl1"):
        Renderer(world.scene, sensor.file)


@pytest.mark.parametrize("number", [0, 7, FAMILY - 1])
def test_a_tag_has_a_black_border(number: int) -> None:
    cells = np.array(pattern(number))
    assert cells.shape == (CELLS, CELLS)
    assert cells[[0, -1]].all()
    assert cells[:, [0, -1]].all()
    assert not cells[1:-1, 1:-1].all()


def test_the_rate_divides_the_worlds_steps() -> None:
    with pytest.raises(ValueError, match="rate_hz"):
        Camera(Detectors(Tags(0.16)), rate_hz=7.0)


def test_known_markers_correct_the_pose() -> None:
    """From a start that the robot file states 0.42 m and 0.2 rad wrong, without a map of the lidar's, by a
    tag 1.6 m away that is seen aslant; of those farther away the
    orientation is not known."""
    robot = load_robot("diffbot_camera")
    settings = robot.brain.perception
    wrong: dict[str, Any] = {
        "start_x": 0.3,
        "start_y": -0.3,
        "start_yaw": 0.2,
        "start_sigma": 0.4,
        "start_yaw_sigma": 0.3,
    }
    perception = replace(settings, filter=replace(settings.filter, **wrong), matching=False)
    robot = replace(robot, brain=replace(robot.brain, perception=perception))
    seen: list[Marker] = []
    with gw.open_session(robot, simulated=True) as session:
        for tick in session.run(seconds=0.5):
            seen += [event for event in tick.outputs.events if isinstance(event, Marker)]
        pose = session.pose
    assert {event.marker for event in seen} == {7, 12, 15}
    assert pose is not None
    assert (pose.x, pose.y, pose.yaw) == pytest.approx((0.0, 0.0, 0.0), abs=0.05)


def test_a_marker_is_known_once_in_a_robot_file() -> None:
    text = load_robot("diffbot_camera").text.replace("marker = 12", "marker = 11")
    with pytest.raises(ConfigError, match="each marker once"):
        gw.parse_robot(text)
