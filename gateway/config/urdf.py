"""`urdf` in a robot file: what its links and joints say where the file says nothing.

Rules. What is written in the robot file wins. A recording carries the robot file alone, so the URDF's text is
appended to it when it is loaded (`gateway.config.files`), and read from there and from nowhere else.

    urdf = "robot.urdf"            beside the robot file, or shipped with the robots
    [motors.NAME]                  urdf_joint = "shoulder_joint"; by default the joint of the motor's name
    [motors.NAME.limits]           velocity, torque (effort), position (range) of that joint
    [sensors.NAME.mount]           link = "lidar_link": where that link is at rest
    [brain.BODY]                   what the body takes from a URDF (`Body.from_urdf`)
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any, TypeAlias

from brain.bodies import urdf
from brain.bodies.body import Body
from brain.bodies.chain import at_rest
from gateway.config.errors import Key, Mistakes, unknown

Table: TypeAlias = dict[str, Any]


@dataclass(frozen=True, slots=True)
class UrdfKeys:
    """The keys of a motor (joint) and of a sensor's mount (link) that name a part of the URDF."""

    urdf_joint: str = ""
    """The joint of the URDF that this motor moves; by default that of the motor's name"""
    link: str = ""
    """The link of the URDF where this sensor is, at rest; keys beside it count instead of its own"""


class Description:
    """The URDF of a robot file; without one it says nothing."""

    def __init__(self, table: Table, mistakes: Mistakes) -> None:
        self.text = ""
        self._model: urdf.UrdfModel | None = None
        self._mistakes = mistakes
        self.broken = False
        """Whether there is one that cannot be used."""
        name, files = table.get("urdf"), table.get("files", {})
        if not isinstance(name, str):
            return
        text = files.get(name) if isinstance(files, dict) else None
        if not isinstance(text, str):
            mistakes.add(
                ("urdf",), f"there is no text of {name!r} in [files]; it comes there by loading the file"
            )
            return
        try:
            self._model = urdf.parse(text)
            self.text = text
        except ValueError as error:
            self.broken = True
            for sentence in str(error).split("; "):
                mistakes.add(("urdf",), f"{name}: {sentence}")

    def motors(self, motors: dict[str, Table]) -> dict[str, str]:
        """Complete the limits of motors by those of their joints, and return joint by motor."""
        found: dict[str, str] = {}
        for name, table in motors.items():
            renamed = table.pop("urdf_joint", None)
            if self._model is None:
                if renamed is not None:
                    self._mistakes.add(("motors", name, "urdf_joint"), "the robot file has no urdf")
                continue
            joints = [key for key, joint in self._model.joints.items() if joint.moves]
            if renamed is not None and renamed not in joints:
                self._mistakes.add(("motors", name, "urdf_joint"), unknown("joint", str(renamed), joints))
            elif (joint_name := renamed or name) in joints:
                found[name] = joint_name
                joint = self._model.joints[joint_name]
                given = table.get("limits", {})
                if isinstance(given, dict):
                    table["limits"] = _limits(joint) | given
        return found

    def sensors(self, sensors: dict[str, Table]) -> None:
        """Replace the links that mountings name by where they are."""
        for name, table in sensors.items():
            mount = table.get("mount")
            if not isinstance(mount, dict) or "link" not in mount:
                continue
            link, at = mount["link"], ("sensors", name, "mount", "link")
            table["mount"] = {key: value for key, value in mount.items() if key != "link"}
            if self._model is None:
                self._mistakes.add(at, "the robot file has no urdf")
            elif link not in self._model.links:
                self._mistakes.add(at, unknown("link", str(link), self._model.links))
            else:
                table["mount"] = _mount(self._model, link) | table["mount"]

    def body(self, kind: type[Body], table: object, at: Key, joints: dict[str, str]) -> object:
        """Return the table of a body, there `at`, with what the URDF says of the keys that it lacks."""
        if self._model is None or not isinstance(table, dict):
            return table
        try:
            return kind.from_urdf(self.text, joints, table) | table
        except ValueError as error:
            self._mistakes.add(at, f"from the urdf: {error}")
            return table


def _limits(joint: urdf.UrdfJoint) -> Table:
    known = {"velocity": joint.velocity, "torque": joint.effort}
    limits: Table = {key: value for key, value in known.items() if value is not None}
    return limits | ({"position": list(joint.range)} if joint.range else {})


def _mount(model: urdf.UrdfModel, link: str) -> Table:
    turned, (x, y, z) = at_rest(model, link)
    pitch = math.asin(max(-1.0, min(1.0, -turned[2, 0])))
    roll, yaw = math.atan2(turned[2, 1], turned[2, 2]), math.atan2(turned[1, 0], turned[0, 0])
    angles = {"yaw": yaw, "pitch": pitch, "roll": roll}
    return {"x": float(x), "y": float(y), "z": float(z)} | angles
