"""A robot of links in MuJoCo, from its URDF: an arm on a fixed base, legs under a free one.

Rules. MuJoCo reads the URDF; what it cannot know (the motors' friction and inertia, where the joints are at
time 0) is the plant file's. Shapes are those of <collision>, and of <visual> where a link has none; meshes
are left out. The robot's links do not touch one another. The range and the effort of a joint hold as in the
URDF; its velocity is unlimited, as that of a shaft is.
"""

from __future__ import annotations

import math
import xml.etree.ElementTree as ET
from collections.abc import Mapping
from dataclasses import fields
from pathlib import Path
from typing import Any

from brain.bodies import urdf
from brain.perception.mount import Mount
from gateway.config import resources
from gateway.config.errors import unknown
from gateway.config.text import read_text
from gateway.sim import mjcf
from gateway.sim.files import SceneFile, Start
from gateway.sim.linked_file import LinkedFile
from gateway.sim.load import WorldError
from gateway.sim.scene import SETTLING, Scene, import_mujoco

FOOTHOLD = 'condim="4"'
"""A contact with a link resists twisting, too: a gripper's finger, a foot."""


class Linked(Scene):
    """A robot of links. `imus`: where each inertial sensor is mounted on the root link."""

    def __init__(self, file: SceneFile, plant: LinkedFile, imus: dict[str, Mount]) -> None:
        mujoco = import_mujoco(file.name)
        try:
            xml = mjcf.scene_xml(file, _robot(plant, file.start, imus), imus)
            model: Any = mujoco.MjModel.from_xml_string(xml)
        except (ValueError, OSError) as error:
            raise WorldError.about(f"plant {plant.name!r}", [f"{plant.urdf}: {error}"]) from error
        super().__init__(file, model, imus)
        self._height = plant.height
        self._start: list[tuple[int, float]] = []
        """Index of each joint in qpos, and where it starts."""
        for index, (motor, (name, joint)) in enumerate(zip(plant.motors, plant.joints.items(), strict=True)):
            at = model.joint(name)
            self._shafts[motor] = index, int(at.qposadr[0]), int(at.dofadr[0])
            self._start.append((int(at.qposadr[0]), joint.start))
        self.settle()

    def settle(self) -> None:
        """Settle into the contacts with the joints where they start, then begin time at rest."""
        data, start, base = self.data, self.file.start, self._free
        if base is not None:
            turned = math.cos(start.yaw / 2.0), 0.0, 0.0, math.sin(start.yaw / 2.0)
            data.qpos[base : base + 7] = start.x, start.y, self._height, *turned
        for _ in range(SETTLING):
            self._put_joints()
            self._mj_step(self.model, data)
        self._put_joints()
        if base is not None:
            data.qpos[base : base + 2] = start.x, start.y
        data.qvel[:] = 0.0
        data.time = 0.0

    def _put_joints(self) -> None:
        for (_, position, velocity), (_, angle) in zip(self._shafts.values(), self._start, strict=True):
            self.data.qpos[position], self.data.qvel[velocity] = angle, 0.0

    def step(self, torques: Mapping[str, float]) -> None:
        """Advance by one time step under torques [N·m] at the joints."""
        for motor, (index, _, _) in self._shafts.items():
            self.data.ctrl[index] = torques.get(motor, 0.0)
        self.advance()

    def attitude(self) -> tuple[float, float, float]:
        """Return the root link's roll and pitch [rad] and its height [m], now."""
        if self._free is None:
            return 0.0, 0.0, self._height
        _, _, z, w, i, j, k = self.data.qpos[self._free : self._free + 7].tolist()
        roll = math.atan2(2.0 * (w * i + j * k), 1.0 - 2.0 * (i * i + j * j))
        return roll, math.asin(max(-1.0, min(1.0, 2.0 * (w * j - k * i)))), z


def find_urdf(name: str) -> Path:
    """Return the URDF of this path, or the one that ships with the robots."""
    path = Path(name)
    return path if "/" in name or path.is_file() else resources.shipped("robots") / name


def _element(text: str) -> ET.Element:
    return ET.fromstring(text)  # noqa: S314 - our own text, or one that `urdf.parse` has taken


def _robot(plant: LinkedFile, start: Start, imus: dict[str, Mount]) -> mjcf.Robot:
    """Return the URDF's links as MJCF, with actuators for the motors, in their order."""
    text = read_text(find_urdf(plant.urdf), urdf.MOST_CHARACTERS)
    model = urdf.parse(text)
    moving = [name for name, joint in model.joints.items() if joint.moves]
    if wrong := [unknown("joint", name, moving) for name in plant.joints if name not in moving]:
        raise ValueError("; ".join(wrong))
    spec: Any = import_mujoco(plant.name).MjSpec.from_string(_prepared(text))
    tree = _element(spec.to_xml())
    base = tree.find("worldbody/body")
    assert base is not None, "the root link is the first body"
    for body in tree.iter("body"):
        if body.get("name") == "base":
            body.set("name", "base_link")
    base.set("name", "base")
    for joint in base.iter("joint"):
        _set_figures(joint, plant)
    for geom in base.iter("geom"):
        for key in ("contype", "conaffinity", "group"):
            geom.attrib.pop(key, None)
        geom.attrib |= _element(f"<geom {mjcf.OF_ROBOT} {FOOTHOLD}/>").attrib
    if plant.base == "free":
        base.insert(0, ET.Element("freejoint", name="base"))
    else:
        base.set("pos", f"{start.x} {start.y} {plant.height}")
        base.set("quat", f"{math.cos(start.yaw / 2.0)} 0 0 {math.sin(start.yaw / 2.0)}")
    for name, mount in imus.items():
        base.append(_element(mjcf.site(name, mount)))
    actuators = "".join(f'<motor joint="{name}"/>' for name in plant.joints)
    followers = "".join(ET.tostring(one, encoding="unicode") for one in tree.findall("equality/joint"))
    return mjcf.Robot(ET.tostring(base, encoding="unicode"), actuators, followers)


def _prepared(text: str) -> str:
    """Return the URDF with links that stay apart, and with the shapes that touch alone."""
    root = _element(text)
    for old in root.findall("mujoco"):
        root.remove(old)
    root.append(_element('<mujoco><compiler fusestatic="false"/></mujoco>'))
    for link in root.findall("link"):
        touching = link.findall("collision") or link.findall("visual")
        for shape in (*link.findall("collision"), *link.findall("visual")):
            if shape not in touching or shape.find("geometry/mesh") is not None:
                link.remove(shape)
            else:
                shape.tag = "collision"
    return ET.tostring(root, encoding="unicode")


def _set_figures(joint: ET.Element, plant: LinkedFile) -> None:
    """Set what the plant file says of a joint."""
    own = plant.joints.get(joint.get("name", ""))
    if own is None:
        return
    for figure in fields(plant.joint):
        value = getattr(own, figure.name)
        attribute = "frictionloss" if figure.name == "friction" else figure.name
        joint.set(attribute, str(getattr(plant.joint, figure.name) if value is None else value))
