"""A URDF completes a robot file: limits, mountings, the body's own keys; its text travels with the file."""

from __future__ import annotations

import math
from pathlib import Path

import pytest

from gateway.config import load_robot, parse_robot
from gateway.errors import ConfigError

CART = """<robot name="cart">
  <link name="base"/>
  <link name="left_link"><collision><geometry>
    <cylinder radius="0.06" length="0.02"/></geometry></collision></link>
  <link name="right_link"><collision><geometry>
    <cylinder radius="0.06" length="0.02"/></geometry></collision></link>
  <link name="mast"/>
  <link name="lidar_link"/>
  <joint name="left" type="continuous"><parent link="base"/><child link="left_link"/>
    <origin xyz="0 0.15 0.06"/><axis xyz="0 1 0"/><limit velocity="12" effort="3"/></joint>
  <joint name="right_wheel" type="continuous"><parent link="base"/><child link="right_link"/>
    <origin xyz="0 -0.15 0.06"/><axis xyz="0 1 0"/><limit velocity="12" effort="3"/></joint>
  <joint name="mast_joint" type="fixed"><parent link="base"/><child link="mast"/>
    <origin xyz="0.1 0 0.2"/></joint>
  <joint name="lidar_joint" type="fixed"><parent link="mast"/><child link="lidar_link"/>
    <origin xyz="0 0.02 0.1" rpy="0 0 1.5707963267948966"/></joint>
</robot>"""  # fmt: skip

ROBOT = """
name = "cart"
urdf = "cart.urdf"
[buses.can0]
kind = "can"
bitrate = 1_000_000
interface = "twin"
[buses.line]
kind = "serial"
baudrate = 1_000_000
interface = "twin"
[defaults.motors]
protocol = "damiao"
bus = "can0"
options = { mode = "vel", position = "xout" }
[motors.left]
address = 1
limits = { acceleration = 50.0, torque = 2.0 }
[motors.right]
address = 2
urdf_joint = "right_wheel"
limits = { acceleration = 50.0 }
[sensors.lidar]
protocol = "plain"
bus = "line"
address = 1
mount = { link = "lidar_link", z = 0.25 }
[brain]
body = "differential"
[brain.differential]
left = "left"
right = "right"
radius = 0.25
max_linear = 0.5
max_angular = 2.0
max_linear_acceleration = 0.8
max_angular_acceleration = 4.0
"""


def write(folder: Path, robot: str = ROBOT, urdf: str = CART) -> Path:
    (folder / "cart.urdf").write_text(urdf, "utf-8")
    path = folder / "robot.toml"
    path.write_text(robot, "utf-8")
    return path


def test_what_is_missing_is_taken_from_it_and_what_is_written_wins(tmp_path: Path) -> None:
    robot = load_robot(write(tmp_path))
    left, right = (robot.motors[name].joint.limits for name in ("left", "right"))
    assert (left.velocity, left.torque, left.position) == (12.0, 2.0, None)
    assert (right.velocity, right.torque) == (12.0, 3.0)
    mount = robot.sensors["lidar"].mount
    assert (mount.x, mount.y, mount.z, mount.yaw) == pytest.approx((0.1, 0.02, 0.25, math.pi / 2))
    body = robot.brain.body
    assert (getattr(body, "wheel_radius", 0), getattr(body, "wheel_separation", 0)) == (0.06, 0.3)
    given = load_robot(write(tmp_path, ROBOT + "wheel_radius = 0.055\n"))
    assert getattr(given.brain.body, "wheel_radius", 0) == 0.055


def test_the_text_of_a_robot_is_enough_for_a_replay(tmp_path: Path) -> None:
    path = write(tmp_path)
    robot = load_robot(path)
    path.with_name("cart.urdf").unlink()
    again = parse_robot(robot.text)
    assert (again.brain, again.text) == (robot.brain, robot.text)
    assert [one.joint for one in again.motors.values()] == [one.joint for one in robot.motors.values()]
    assert again.sensors["lidar"].mount == robot.sensors["lidar"].mount


@pytest.mark.parametrize(
    ("old", "new", "place", "sentence"),
    [
        ('"cart.urdf"', '"none.urdf"', "urdf", "there is no 'none.urdf' beside the robot file"),
        ('"right_wheel"', '"rigth_wheel"', "motors.right.urdf_joint", "did you mean 'right_wheel'?"),
        ('"lidar_link"', '"lidar"', "sensors.lidar.mount.link", "did you mean 'lidar_link'?"),
        ('urdf_joint = "right_wheel"', "", "brain.differential", "'right' moves no joint"),
    ],
)
def test_mistakes(tmp_path: Path, old: str, new: str, place: str, sentence: str) -> None:
    with pytest.raises(ConfigError) as caught:
        load_robot(write(tmp_path, ROBOT.replace(old, new)))
    found = {f"{one.key}: {one.text}" for one in caught.value.mistakes}
    assert any(text.startswith(place) and sentence in text for text in found), found


def test_a_wrong_urdf_is_told_in_sentences_all_at_once(tmp_path: Path) -> None:
    wrong = CART.replace('radius="0.06"', 'radius="thick"').replace('velocity="12"', 'velocity="fast"')
    with pytest.raises(ConfigError) as caught:
        load_robot(write(tmp_path, urdf=wrong))
    texts = [one.text for one in caught.value.mistakes]
    assert {one.key for one in caught.value.mistakes} == {"urdf"}, "not what follows from it"
    assert len(texts) == 4
    assert "cart.urdf: link 'left_link': radius is 'thick', expected a number within ±100000" in texts


def test_a_robot_file_that_has_no_urdf_cannot_refer_to_one(tmp_path: Path) -> None:
    with pytest.raises(ConfigError) as caught:
        load_robot(write(tmp_path, ROBOT.replace('urdf = "cart.urdf"\n', "")))
    assert {one.key for one in caught.value.mistakes if "no urdf" in one.text} == {
        "motors.right.urdf_joint",
        "sensors.lidar.mount.link",
    }
