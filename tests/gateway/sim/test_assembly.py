"""Robots made of others: what they weigh, where their parts are, and that each moves."""

from __future__ import annotations

from pathlib import Path

import pytest

from gateway.config import load_robot
from gateway.sim import World, WorldError, load_plant, load_world
from gateway.sim.assembly_file import Assembly

mujoco = pytest.importorskip("mujoco")


def world(name: str) -> World:
    robot = load_robot(name)
    assert robot.world is not None
    assert robot.plant is not None
    return World(load_world(robot.world), load_plant(robot.plant), robot, 1)


def test_a_base_carries_the_weight_of_its_arm_and_stands() -> None:
    made = world("mobile_arm")
    assert made.scene is not None
    model, data = made.scene.model, made.scene.data
    base = model.body("base").id
    assert model.body_subtreemass[base] == pytest.approx(40.0 + 5.7, abs=0.1)
    assert data.xpos[model.body("arm/base").id] == pytest.approx((0.2, 0.0, 0.2), abs=0.01)
    assert made.shaft("elbow") == (2.6, 0.0)
    for _ in range(300):
        made.step({})
    assert made.truth().x == pytest.approx(0.0, abs=0.02)
    assert made.contacts() == 0


def test_wheels_and_joints_each_follow_their_own_torque() -> None:
    made = world("mobile_arm")
    for _ in range(300):
        made.step({"left": 1.5, "right": 1.5, "turn": 2.0})
    assert made.truth().x > 0.01
    assert made.shaft("turn")[0] > 0.1
    assert made.shaft("wrist_roll")[0] == pytest.approx(0.0, abs=0.05)


def test_two_arms_stand_side_by_side_and_move_each_by_itself() -> None:
    made = world("two_arms")
    assert made.scene is not None
    model, data = made.scene.model, made.scene.data
    for side, y in (("left", 0.35), ("right", -0.35)):
        assert data.xpos[model.body(f"{side}/base").id] == pytest.approx((0.0, y, 0.0), abs=1e-6)
    for _ in range(200):
        made.step({"left_turn": 2.0})
    assert made.shaft("left_turn")[0] > 0.1
    assert made.shaft("right_turn")[0] == pytest.approx(0.0, abs=1e-3)


WRONG = [
    ('[parts.a]\nplant = "arm"\n[parts.b]\nplant = "arm"\n', "would move two joints; a part's `prefix`"),
    ('[parts.a]\nplant = "diffbot"\nprefix = "x_"\n', "parts.a: plant 'diffbot' cannot be this"),
    ('[parts.a]\nplant = "diffbot"\n[parts.b]\nplant = "mobile_base"\n', "one base on wheels, at the origin"),
    ('[parts.a]\nplant = "quadruped"\n', "parts.a: plant 'quadruped' cannot be this"),
    ("parts = {}\n", "parts must have at least one"),
]


@pytest.mark.parametrize(("text", "words"), WRONG)
def test_what_is_no_robot_is_refused_with_the_reason(tmp_path: Path, text: str, words: str) -> None:
    file = tmp_path / "made.toml"
    file.write_text(f'kind = "assembly"\nname = "made"\n{text}')
    with pytest.raises(WorldError, match=words):
        load_plant(file)


def test_the_sensors_of_its_base_are_the_robots() -> None:
    plant = load_plant("mobile_arm")
    assert isinstance(plant, Assembly)
    assert list(plant.lidars) == ["lidar"]
    assert plant.motors[:3] == ("left", "right", "turn")
