"""Robots of links: joints of a URDF against their formulas; a quadruped rises, walks, turns and stands."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import pytest

from brain.belief import Pose
from brain.bodies.body import Base
from brain.bodies.boom import Boom
from brain.bodies.plane import REST, Twist, arc, motion
from brain.perception.mount import Mount
from gateway.config import load_robot
from gateway.sim import SceneFile, WorldError
from gateway.sim.linked import Linked
from gateway.sim.linked_file import LinkedFile
from gateway.sim.load import load_plant, parse_plant, parse_world
from protocols import messages as msg

PENDULUM = """<robot name="pendulum">
  <link name="stand"/>
  <link name="rod">
    <inertial><origin xyz="0 0 -0.5"/><mass value="2"/>
      <inertia ixx="0.1" ixy="0" ixz="0" iyy="0.1" iyz="0" izz="0.01"/></inertial>
    <visual><geometry><mesh filename="package://nowhere/rod.stl"/></geometry></visual>
    <collision><origin xyz="0 0 -0.5"/><geometry><cylinder radius="0.02" length="1"/></geometry></collision>
  </link>
  <joint name="pivot" type="revolute">
    <parent link="stand"/><child link="rod"/><axis xyz="0 1 0"/>
    <limit lower="-3" upper="2" effort="5" velocity="10"/>
  </joint>
</robot>"""
PLANT = """
kind = "linked"
name = "pendulum"
urdf = "{urdf}"
base = "fixed"
height = 2.0
[joint]
damping = 0.0
friction = 0.0
armature = 1e-6
[joints]
pivot = {{ motor = "swing", start = 0.1 }}
"""
PLACE = 'kind = "scene"\nname = "p"\nstart = { x = 1.0, y = 2.0, yaw = 0.5 }\n'


def place(text: str = PLACE) -> SceneFile:
    file = parse_world(text)
    assert isinstance(file, SceneFile)
    return file


def pendulum(folder: Path, text: str = PENDULUM, plant: str = PLANT) -> Linked:
    path = folder / "pendulum.urdf"
    path.write_text(text)
    file = parse_plant(plant.format(urdf=path))
    assert isinstance(file, LinkedFile)
    return Linked(place(), file, {})


def test_a_pendulum_swings_with_the_period_of_its_formula(tmp_path: Path) -> None:
    world, crossings, last = pendulum(tmp_path), [], 0.1
    pose = world.pose()
    assert (pose.x, pose.y, pose.yaw) == pytest.approx((1.0, 2.0, 0.5))
    for step in range(2400):
        world.step({})
        angle = world.shaft("swing")[0]
        if last > 0.0 >= angle:
            crossings.append(step)
        last = angle
    inertia = 0.1 + 2.0 * 0.5**2
    period = 2.0 * math.pi * math.sqrt(inertia / (2.0 * 9.81 * 0.5)) * (1.0 + 0.1**2 / 16.0)
    assert (crossings[1] - crossings[0]) * 1e-3 == pytest.approx(period, abs=2e-3)


def test_a_torque_holds_it_and_effort_bounds_it(tmp_path: Path) -> None:
    held = pendulum(tmp_path)
    for _ in range(500):
        held.step({"swing": 9.81 * math.sin(0.1)})
    assert held.shaft("swing") == pytest.approx((0.1, 0.0), abs=1e-4)
    pushed = pendulum(tmp_path, plant=PLANT.replace("damping = 0.0", "damping = 5.0"))
    for _ in range(8000):
        pushed.step({"swing": 1e4})
    assert pushed.shaft("swing")[0] == pytest.approx(math.asin(5.0 / 9.81), abs=1e-3)


@pytest.mark.parametrize("limit", ['lower="-1e16" upper="1e16" effort="1e7" velocity="-1"',
    'lower="-inf" upper="inf" effort="-1" velocity="1e16"'])  # fmt: skip
def test_what_means_no_limit_is_none(tmp_path: Path, limit: str) -> None:
    text = PENDULUM.replace('lower="-3" upper="2" effort="5" velocity="10"', limit)
    loose = '<link name="flag"/><joint name="f" type="fixed"><parent link="rod"/><child link="flag"/>'
    text = text.replace("</robot>", f'{loose}<axis xyz="0 0 0"/></joint><sensor:eye/></robot>')
    pushed = pendulum(tmp_path, text)
    for _ in range(1000):
        pushed.step({"swing": 50.0})
    assert pushed.shaft("swing")[0] > 7.0, "once around, and against a weight that 5 N·m cannot lift"


def test_what_is_wrong_is_said(tmp_path: Path) -> None:
    with pytest.raises(WorldError, match="no joint 'pivot'"):
        pendulum(tmp_path, PENDULUM.replace('"pivot"', '"hinge"'))
    with pytest.raises(WorldError, match="link 'rod': no body has these moments of inertia"):
        pendulum(tmp_path, PENDULUM.replace('izz="0.01"', 'izz="1"'))
    with pytest.raises(WorldError, match="has an ENTITY"):
        pendulum(tmp_path, "<!DOCTYPE robot [<!ENTITY a 'b'>]>" + PENDULUM)
    with pytest.raises(WorldError, match=r"urdf: .*No such file"):
        pendulum(tmp_path, plant=PLANT.replace("{urdf}", "nowhere/{urdf}"))
    with pytest.raises(WorldError, match="a motor of its own"):
        pendulum(tmp_path, plant=PLANT + 'other = {{ motor = "swing" }}\n')


# -- the quadruped -------------------------------------------------------------------------------------


class Walker:
    """The quadruped's plant under its body's commands, given every 20 ms, without motors in between."""

    def __init__(self) -> None:
        plant, body = load_plant("quadruped"), load_robot("quadruped").brain.body
        assert isinstance(plant, LinkedFile)
        assert isinstance(body, Base)
        self.body = body
        self.plant = Linked(place('kind = "scene"\nname = "floor"\n'), plant, {"imu": Mount()})
        self.by_feet = Pose(0.0, 0.0, 0.0)
        self.tilt = 0.0
        """rad, the largest roll or pitch so far,"""
        self.heights: list[float] = []
        """and the heights [m] of the trunk."""
        self._memory: Any = None
        self._before: list[float] | None = None

    def walk(self, seconds: float, twist: Twist) -> tuple[float, float, float]:
        """Walk; return the true mean twist: forward, turn, sideways."""
        start, self.heights, self.tilt = self.plant.pose(), [], 0.0
        for step in range(round(seconds * 1000)):
            state = {motor: self.plant.shaft(motor) for motor in self.body.joints}
            positions = [position for position, _ in state.values()]
            if step % 20 == 0:
                commands, self._memory = self.body.actuate(twist, positions, 0.02, self._memory)
                way = self.body.travel(self._before or positions, positions)
                self.by_feet = arc(self.by_feet, way.distance, way.turn, way.sideways)
                self._before = positions
            self.plant.step({one.motor: torque(one, state[one.motor]) for one in commands})
            roll, pitch, height = self.plant.attitude()
            self.tilt = max(self.tilt, abs(roll), abs(pitch))
            self.heights.append(height)
        forward, turn, aside = motion(start, self.plant.pose())
        return forward / seconds, turn / seconds, aside / seconds


def torque(command: msg.Command, state: tuple[float, float]) -> float:
    """Return the torque [N·m] of an actuator in its impedance mode."""
    assert isinstance(command, msg.Impedance)
    pull = command.stiffness * (command.position - state[0]) + command.damping * (command.velocity - state[1])
    return max(-20.0, min(20.0, command.torque + pull))


def test_the_quadruped_rises_walks_turns_and_stands() -> None:
    walker = Walker()
    assert walker.plant.attitude()[2] < 0.12, "it lies on its belly"
    walker.walk(2.0, REST)
    assert walker.tilt < math.radians(3.0)
    walker.by_feet = walker.plant.pose()
    for twist in (Twist(0.25, 0.6), Twist(0.1, 0.0, 0.12)):
        walker.walk(0.6, twist)
        true = walker.walk(0.8, twist)
        assert true == pytest.approx((twist.linear, twist.angular, twist.lateral), abs=0.06)
        assert walker.tilt < math.radians(3.0)
        assert 0.29 < min(walker.heights) < max(walker.heights) < 0.31
    pose = walker.plant.pose()
    assert math.hypot(walker.by_feet.x - pose.x, walker.by_feet.y - pose.y) < 0.02
    assert walker.by_feet.yaw == pytest.approx(pose.yaw, abs=0.02)
    walker.walk(0.9, REST)
    assert walker.walk(0.2, REST) == pytest.approx((0.0, 0.0, 0.0), abs=1e-3)
    assert walker.heights[-1] == pytest.approx(0.299, abs=0.003)
    assert walker.plant.touches == 0
    assert walker.plant.inertial("imu")[1] == pytest.approx((0.0, 0.0, 9.81), abs=0.1)


def test_a_cylinder_moves_a_joint_by_its_lever() -> None:
    """The shaft of its motor is its length; the force that gravity takes by hand holds it."""
    plant, file = load_plant("boom"), parse_world(PLACE)
    assert isinstance(plant, LinkedFile)
    assert isinstance(file, SceneFile)
    body = load_robot("boom").brain.body
    assert isinstance(body, Boom)
    scene = Linked(file, plant, {})
    names = ("lift", "fold")
    lengths = [scene.shaft(name)[0] for name in names]
    assert lengths == pytest.approx(body.lengths((0.0, -1.6)))
    held = dict(zip(names, body.gravity(lengths), strict=True))
    for _ in range(300):
        scene.step(held)
    assert [scene.shaft(name)[0] for name in names] == pytest.approx(lengths, abs=2e-3)
    before, _ = scene.shaft("lift")
    for _ in range(100):
        scene.step(held | {"lift": held["lift"] + 2000.0})
    after, speed = scene.shaft("lift")
    assert after > before
    assert speed > 0.0
    scene.step(held | {"lift": held["lift"] + 2000.0})
    assert scene.shaft("lift")[0] - after == pytest.approx(speed * 1e-3, rel=0.05)
