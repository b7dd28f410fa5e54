"""A robot of links in MuJoCo, from its URDF: an arm on a fixed base, legs under a free one.

Rules. MuJoCo reads the URDF; what it cannot know (the motors' friction and inertia, where the joints are at
time 0) is the plant file's. Shapes are those of <collision>, and of <visual> where a link has none; meshes
are left out. The robot's links do not touch one another. The range and the effort of a joint hold as in the
URDF; its velocity is unlimited, as that of a shaft is.
"""

from __future__ import annotations

import math
import xml.etree.ElementTree as ET
from collections.abc import Sequence
from dataclasses import fields
from pathlib import Path
from typing import Any

from brain.bodies import urdf
from brain.perception.mount import Mount
from gateway.config import resources
from gateway.config.errors import unknown
from gateway.config.text import read_text
from gateway.sim import mjcf
from gateway.sim.assembly_file import AssemblyPart
from gateway.sim.files import SceneFile, Start
from gateway.sim.linked_file import LinkedFile
from gateway.sim.load import WorldError
from gateway.sim.scene import SimulatedScene, import_mujoco

FOOTHOLD = 'condim="4"'
"""A contact with a link resists twisting, too: a gripper's finger, a foot."""


class Linked(SimulatedScene):
    """A robot of links. `imus`: where each inertial sensor is mounted on the root link."""

    def __init__(self, file: SceneFile, plant: LinkedFile, imus: dict[str, Mount]) -> None:
        part = AssemblyPart("", plant)
        super().__init__(file, _model(file, part, _links(part, file.start, imus), imus), imus)
        self._height = plant.height
        self._add_links(part)
        self.settle()

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


class Standing(SimulatedScene):
    """Robots of links on one place. `imus`: where each inertial sensor is mounted there."""

    def __init__(self, file: SceneFile, parts: Sequence[AssemblyPart], imus: dict[str, Mount]) -> None:
        robot = mjcf.joined(mjcf.stand(file.start, imus), carried(parts))
        super().__init__(file, _model(file, parts[0], robot, imus), imus)
        for part in parts:
            self._add_links(part)
        self.settle()


def carried(parts: Sequence[AssemblyPart]) -> list[mjcf.MjcfRobot]:
    """Return robots of links as what another body carries. Raises WorldError if one cannot be made."""
    return [_links(part, None, {}) for part in parts]


def _model(file: SceneFile, part: AssemblyPart, robot: mjcf.MjcfRobot, imus: dict[str, Mount]) -> Any:  # noqa: ANN401
    """Return MuJoCo's model. Raises WorldError if there can be none."""
    try:
        return import_mujoco(file.name).MjModel.from_xml_string(mjcf.scene_xml(file, robot, imus))
    except ValueError as error:
        raise _wrong(part, error) from error


def _links(part: AssemblyPart, start: Start | None, imus: dict[str, Mount]) -> mjcf.MjcfRobot:
    """Return a robot of links, on its own or, without a start, as a part. Raises WorldError if it cannot."""
    try:
        return _robot(part, start, imus)
    except (ValueError, OSError) as error:
        raise _wrong(part, error) from error


def _wrong(part: AssemblyPart, error: Exception) -> WorldError:
    return WorldError.about(f"plant {part.plant.name!r}", [f"{part.plant.urdf}: {error}"])


def _element(text: str) -> ET.Element:
    return ET.fromstring(text)  # noqa: S314 - our own text


def _robot(part: AssemblyPart, start: Start | None, imus: dict[str, Mount]) -> mjcf.MjcfRobot:
    """Return the URDF's links as MJCF, with actuators for the motors, in their order."""
    plant = part.plant
    text = read_text(find_urdf(plant.urdf), urdf.MOST_CHARACTERS)
    model = urdf.parse(text)
    moving = [name for name, joint in model.joints.items() if joint.moves]
    if wrong := [unknown("joint", name, moving) for name in plant.joints if name not in moving]:
        raise ValueError("; ".join(wrong))
    if wrong := [
        link.inertial.wrong for link in model.links.values() if link.inertial and link.inertial.wrong
    ]:
        raise ValueError("; ".join(wrong))
    spec: Any = import_mujoco(plant.name).MjSpec.from_string(_prepared(text, model))
    tree = _element(spec.to_xml())
    base = tree.find("worldbody/body")
    assert base is not None, "the root link is the first body"
    for joint in base.iter("joint"):
        _set_figures(joint, plant)
    for geom in base.iter("geom"):
        for key in ("contype", "conaffinity", "group"):
            geom.attrib.pop(key, None)
        geom.attrib |= _element(f"<geom {mjcf.OF_ROBOT} {FOOTHOLD}/>").attrib
    followers = tree.findall("equality/joint")
    if start is None:
        at = part.at
        _place(base, at.x, at.y, at.z + plant.height, at.yaw)
        for one in (*base.iter(), *followers):
            for key in ("name", "joint1", "joint2"):
                if key in one.attrib:
                    one.set(key, part.named(one.attrib[key]))
    else:
        for body in tree.iter("body"):
            if body.get("name") == "base":
                body.set("name", "base_link")
        base.set("name", "base")
        if plant.base == "free":
            base.insert(0, ET.Element("freejoint", name="base"))
        else:
            _place(base, start.x, start.y, plant.height, start.yaw)
    for name, mount in imus.items():
        base.append(_element(mjcf.site(name, mount)))
    actuators = "".join(f'<motor joint="{part.named(name)}"/>' for name in plant.joints)
    equal = "".join(ET.tostring(one, encoding="unicode") for one in followers)
    return mjcf.MjcfRobot(ET.tostring(base, encoding="unicode"), actuators, equal)


def _place(body: ET.Element, x: float, y: float, z: float, yaw: float) -> None:
    body.set("pos", f"{x} {y} {z}")
    body.set("quat", f"{math.cos(yaw / 2.0)} 0 0 {math.sin(yaw / 2.0)}")


def _prepared(text: str, model: urdf.UrdfModel) -> str:
    """Return the URDF with links that stay apart, the shapes that touch alone, and limits as read."""
    root = urdf.read(text)
    for old in root.findall("mujoco"):
        root.remove(old)
    root.append(_element('<mujoco><compiler fusestatic="false"/></mujoco>'))
    for link in root.findall("link"):
        touching = link.findall("collision") or link.findall("visual")
        for shape in (*link.findall("collision"), *link.findall("visual")):
            if shape not in touching or not _solid(shape):
                link.remove(shape)
            else:
                shape.tag = "collision"
    for joint in root.findall("joint"):
        _set_limits(joint, model.joints[joint.get("name", "")])
    return ET.tostring(root, encoding="unicode")


def _solid(shape: ET.Element) -> bool:
    """Return whether a shape is one of ours: no mesh, nothing without extent."""
    sizes = " ".join(" ".join(one.attrib.values()) for one in shape.findall("geometry/*"))
    return shape.find("geometry/mesh") is None and all(float(size) > 0.0 for size in sizes.split())


def _set_limits(joint: ET.Element, read: urdf.UrdfJoint) -> None:
    """Set the range and effort of a joint as they were read; MuJoCo would take what means none for one."""
    if not read.moves:
        for axis in joint.findall("axis"):
            joint.remove(axis)
    elif read.range is None and read.kind == "revolute":
        joint.set("type", "continuous")
    for limit in joint.findall("limit"):
        limit.attrib.clear()
        if read.range is not None:
            limit.attrib |= {"lower": str(read.range[0]), "upper": str(read.range[1])}
        if read.effort is not None:
            limit.set("effort", str(read.effort))


def _set_figures(joint: ET.Element, plant: LinkedFile) -> None:
    """Set what the plant file says of a joint."""
    own = plant.joints.get(joint.get("name", ""))
    if own is None:
        return
    for figure in fields(plant.joint):
        value = getattr(own, figure.name)
        attribute = "frictionloss" if figure.name == "friction" else figure.name
        joint.set(attribute, str(getattr(plant.joint, figure.name) if value is None else value))
