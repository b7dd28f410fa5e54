"""A scene, and a base on wheels, in MuJoCo's modelling language (MJCF). Text in, text out; imports no MuJoCo.

Rules. A plain tyre touches the floor as an ellipsoid, since a cylinder makes two contacts and scrubs when it
turns on the spot. Where tyres creep, each has two joints on one axle: the shaft, which the motor turns and
the encoder measures, and the creep of the tyre against it, which an equality constraint holds at the angle
given by the slip. A wheel with rollers is a ball with a second, free joint, whose axis is that of the roller
on the floor (`rover` keeps that joint at angle 0, where a ball does not differ from itself turned): exactly
one direction of the contact is free, as of an ideal mecanum or omni wheel, with the friction, the contacts
and the steps of a plain one. Casters have priority, little friction and no tangential contact dimension, or
they drag. Tyres that others drag sideways have no friction here: `rover` has it.

Groups of geoms: 0 floor, walls, boxes, people: what beams hit; 1 the robot; 2 what is only seen. The robot's
own parts do not touch one another. People touch without force.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import TypeAlias

import numpy as np

from brain.perception.mount import Mount
from gateway.sim.files import STEP, Box, SceneFile, Start, Wall
from gateway.sim.marks import ball_xml, tag_xml
from gateway.sim.plant_files import Caster, Steer, Wheel, WheeledBody
from protocols.messages import seconds

Polygon: TypeAlias = tuple[tuple[float, float], ...]

ROLLING = "0.005 0.0001"
"""Torsional and rolling friction [m] of a contact with the floor."""
CREEP_SOLREF = "0.004 1"
"""s, damping ratio: how closely a tyre is held to the angle that it has crept."""
OF_ROBOT = 'group="1" contype="0" conaffinity="3"'
"""Attributes of a robot's geom: it touches what stands around (bit 0) and people (bit 1)."""
ONLY_IN_PAIRS = 'group="1" contype="0" conaffinity="0"'
"""Of one that touches nothing but what a pair of geoms names."""


@dataclass(frozen=True, slots=True)
class MjcfRobot:
    """A robot in MJCF: children of worldbody, actuator, equality and contact."""

    bodies: str = ""
    """Its base is the body called "base"."""
    actuators: str = ""
    constraints: str = ""
    contacts: str = ""


def scene_xml(file: SceneFile, robot: MjcfRobot, imus: dict[str, Mount]) -> str:
    """Return the model: floor, walls and boxes, the robot, people and what can be pushed, and for each IMU,
    mounted on a site of its name, a gyro and an accelerometer."""
    sensors = "".join(f'<gyro site="{name}"/><accelerometer site="{name}"/>' for name in imus)
    movable = [_movable(name, box) for name, box in file.boxes.items() if box.mass is not None]
    return f"""
<mujoco model="{"".join(c for c in file.name if c.isalnum())}">
 <compiler angle="radian"/>
 <option timestep="{seconds(STEP)}" integrator="implicitfast" cone="elliptic" impratio="10"/>
 <visual><headlight ambient="0.5 0.5 0.5" diffuse="0.4 0.4 0.4" specular="0 0 0"/></visual>
 <default><geom friction="{file.friction} {ROLLING}"/></default>
 <worldbody>
  <geom name="floor" type="plane" size="0 0 1"/>
  {"".join(_solids(file))}
  {robot.bodies}
  {"".join(_person(name, one.radius, one.height) for name, one in file.people.items())}
  {"".join(movable)}
  {"".join(map(tag_xml, file.tags.values()))}{"".join(map(ball_xml, file.balls.values()))}
 </worldbody>
 <actuator>{robot.actuators}</actuator>
 <equality>{robot.constraints}</equality>
 <contact>{robot.contacts}</contact>
 <sensor>{sensors}</sensor>
</mujoco>"""


# -- what stands around --------------------------------------------------------------------------------


def _solids(file: SceneFile) -> list[str]:
    """Return walls and fixed boxes, in the order of `outlines`."""
    walls = [_wall(name, wall) for name, wall in file.walls.items()]
    return walls + [_solid(box.x, box.y, box.yaw, *box.size, box.z) for box in _fixed(file)]


def _wall(name: str, wall: Wall) -> str:
    """Return a wall; one that appears later is moved from outside."""
    solid = _solid(*_middle(wall), wall.thickness, wall.height)
    if not wall.appears:
        return solid
    named = solid.replace("<geom", f'<geom name="wall_{name}"')
    return f'<body name="wall_{name}" mocap="true">{named}</body>'


def _fixed(file: SceneFile) -> list[Box]:
    return [box for box in file.boxes.values() if box.mass is None]


def _solid(
    x: float, y: float, yaw: float, length: float, width: float, height: float, below: float = 0.0
) -> str:
    size = f"{length / 2.0} {width / 2.0} {height / 2.0}"
    return f'<geom type="box" size="{size}" pos="{x} {y} {below + height / 2.0}" quat="{_about_z(yaw)}"/>'


def _movable(name: str, box: Box) -> str:
    half = [size / 2.0 for size in box.size]
    place = f'pos="{box.x} {box.y} {box.z + half[2]}" quat="{_about_z(box.yaw)}"'
    size = f'size="{half[0]} {half[1]} {half[2]}"'
    return (
        f'<body name="box_{name}" {place}><freejoint/>'
        f'<geom type="box" {size} mass="{box.mass}" condim="4"/></body>'
    )


def _person(name: str, radius: float, height: float) -> str:
    """Return a person, moved from outside. A contact has a force only as deep as the margin, which is
    none; with the gap it is found all the same."""
    size = f'size="{radius} {height / 2.0}" pos="0 0 {height / 2.0}"'
    return (
        f'<body name="person_{name}" mocap="true"><geom name="person_{name}" type="cylinder" {size} '
        f'contype="2" conaffinity="0" margin="-10" gap="10"/></body>'
    )


def _about_z(yaw: float) -> str:
    return f"{math.cos(yaw / 2.0)} 0 0 {math.sin(yaw / 2.0)}"


def outlines(file: SceneFile) -> list[Polygon]:
    """Return walls and fixed boxes seen from above, as polygons of four corners [m] in the world's frame."""
    walls = [_rectangle(*_middle(wall), wall.thickness) for wall in file.walls.values()]
    return walls + [_rectangle(box.x, box.y, box.yaw, box.size[0], box.size[1]) for box in _fixed(file)]


def _middle(wall: Wall) -> tuple[float, float, float, float]:
    """Return x, y, yaw and length of a wall."""
    (x0, y0), (x1, y1) = wall.start, wall.end
    return (x0 + x1) / 2.0, (y0 + y1) / 2.0, math.atan2(y1 - y0, x1 - x0), math.dist(wall.start, wall.end)


def _rectangle(x: float, y: float, yaw: float, length: float, width: float) -> Polygon:
    c, s = math.cos(yaw) / 2.0, math.sin(yaw) / 2.0
    corners = ((length, width), (-length, width), (-length, -width), (length, -width))
    return tuple((x + c * a - s * b, y + s * a + c * b) for a, b in corners)


# -- a base on wheels ----------------------------------------------------------------------------------


def site(name: str, mount: Mount) -> str:
    """Return the site of a sensor: the x and the y axis of its frame are those of its mount."""
    rows = mount.rotation()
    axes = " ".join(str(rows[row][column]) for column in (0, 1) for row in range(3))
    return f'<site name="{name}" pos="{mount.x} {mount.y} {mount.z}" xyaxes="{axes}"/>'


def joined(base: MjcfRobot, parts: Sequence[MjcfRobot]) -> MjcfRobot:
    """Return a robot whose base carries others."""
    head, end, rest = base.bodies.rpartition("</body>")
    return MjcfRobot(
        head + "".join(part.bodies for part in parts) + end + rest,
        base.actuators + "".join(part.actuators for part in parts),
        base.constraints + "".join(part.constraints for part in parts),
        base.contacts,
    )


def stand(start: Start, imus: dict[str, Mount]) -> MjcfRobot:
    """Return a base that is nothing but a place: what stands on it is screwed to the floor."""
    place = f'pos="{start.x} {start.y} 0" quat="{_about_z(start.yaw)}"'
    sites = "".join(site(name, mount) for name, mount in imus.items())
    return MjcfRobot(f'<body name="base" {place}>{sites}</body>')


def wheeled(body: WheeledBody, imus: dict[str, Mount], friction: float) -> MjcfRobot:
    """Return the base: for each wheel NAME the joint `NAME`, and `NAME_creep`, `NAME_roller`, `NAME_steer`
    where it has one; for each motor that steers several the joint `MOTOR_linkage`. Actuators: of the wheel
    `first` for each motor, then of each that steers."""
    size = 'size="{} {} {}"'.format(*(side / 2.0 for side in body.size))
    chassis = body.mass - len(body.wheels) * body.wheel.mass
    bodies = f"""<body name="base">
   <freejoint name="base"/>
   {"".join(site(name, mount) for name, mount in imus.items())}
   <geom type="box" {size} pos="{body.x} 0 {body.height}" mass="{chassis}" {OF_ROBOT}/>
   {"".join(_caster(caster) for caster in body.casters.values())}
   {"".join(_wheel(body, name, wheel) for name, wheel in body.wheels.items())}
   {"".join(_rack(body, motor, names) for motor, names in linkages(body).items())}
  </body>"""
    leaders = first(body)
    held = [f'joint1="{name}_creep"' for name in body.wheels if has_creep(body, name)]
    held += [
        f'joint1="{name}" joint2="{leaders[wheel.motor]}"'
        for name, wheel in body.wheels.items()
        if wheel.motor and name != leaders[wheel.motor]
    ]
    held += [
        f'joint1="{name}_steer" joint2="{motor}_linkage" polycoef="{_linked(body.wheels[name])}"'
        for motor, names in linkages(body).items()
        for name in names
    ]
    constraints = "".join(f'<joint {one} solref="{CREEP_SOLREF}"/>' for one in held)
    actuators = "".join(f'<motor joint="{joint}"/>' for joint in [*leaders.values(), *steered(body).values()])
    grip = f'condim="3" friction="{friction} {friction} 0 0 0"'
    pairs = [(name, 'condim="1"') for name in dragged(body)]
    pairs += [(name, grip) for name, wheel in body.wheels.items() if wheel.roller is not None]
    contacts = "".join(f'<pair geom1="floor" geom2="{name}" {how}/>' for name, how in pairs)
    return MjcfRobot(bodies, actuators, constraints, contacts)


def first(body: WheeledBody) -> dict[str, str]:
    """Return the first wheel that each motor drives."""
    found: dict[str, str] = {}
    for name, wheel in body.wheels.items():
        if wheel.motor:
            found.setdefault(wheel.motor, name)
    return found


def steered(body: WheeledBody) -> dict[str, str]:
    """Return the joint that each motor turns which steers."""
    found = {one.steer.motor: f"{name}_steer" for name, one in body.wheels.items() if one.steer}
    return found | {motor: f"{motor}_linkage" for motor in linkages(body)}


def linkages(body: WheeledBody) -> dict[str, list[str]]:
    """Return the wheels of each motor that steers several."""
    found: dict[str, list[str]] = {}
    for name, wheel in body.wheels.items():
        if wheel.steer:
            found.setdefault(wheel.steer.motor, []).append(name)
    return {motor: names for motor, names in found.items() if len(names) > 1}


def has_creep(body: WheeledBody, name: str) -> bool:
    """Return whether a wheel has a tyre that creeps."""
    return body.slip.sigma > 0.0 and body.wheels[name].roller is None


def dragged(body: WheeledBody) -> list[str]:
    """Return the plain tyres that cannot all roll when the base turns: those fixed on different axles."""
    fixed = {name: one for name, one in body.wheels.items() if one.steer is None and one.roller is None}
    axles = {
        (round(one.yaw % math.pi, 3), round(one.x * math.cos(one.yaw) + one.y * math.sin(one.yaw), 3))
        for one in fixed.values()
    }
    return list(fixed) if len(axles) > 1 else []


def _caster(caster: Caster) -> str:
    return (
        f'<geom type="sphere" size="{caster.radius}" pos="{caster.x} {caster.y} {caster.radius}" '
        f'mass="0.001" priority="1" friction="0.01 {ROLLING}" condim="1" {OF_ROBOT}/>'
    )


def _rack(body: WheeledBody, motor: str, names: Sequence[str]) -> str:
    """Return the arm of a linkage: an imagined wheel midway, whose angle is the motor's."""
    wheel = body.wheels[names[0]]
    assert wheel.steer is not None
    joint = f'<joint name="{motor}_linkage" axis="0 0 1" {_bearing(wheel.steer)}/>'
    inertia = '<inertial pos="0 0 0" mass="0.02" diaginertia="1e-5 1e-5 1e-5"/>'
    return f'<body pos="{wheel.x} 0 {body.wheel.radius}">{inertia}{joint}</body>'


def _linked(wheel: Wheel) -> str:
    """Return the angle of a wheel by that of its linkage, as a polynomial: the axis of the wheel meets that
    of the imagined one midway on the line x = 0."""
    assert wheel.steer is not None
    low, high = wheel.steer.range or (-0.7, 0.7)
    angles = np.linspace(low, high, 41)
    tangents = np.tan(angles)
    wanted = np.arctan2(wheel.x * tangents, wheel.x - wheel.y * tangents)
    return " ".join(f"{each:.9g}" for each in np.polynomial.polynomial.polyfit(angles, wanted, 4))


def _wheel(body: WheeledBody, name: str, wheel: Wheel) -> str:
    """Return a wheel; within a body that steers it, if one does."""
    figures, place = body.wheel, f'pos="{wheel.x} {wheel.y} {body.wheel.radius}" quat="{_about_z(wheel.yaw)}"'
    radius = figures.radius * (1.0 + wheel.radius_error)
    shaft = f'<joint name="{name}" axis="0 1 0" damping="{figures.damping}" armature="{figures.armature}"/>'
    if wheel.roller is not None:
        axis = f"{math.cos(wheel.roller)} {math.sin(wheel.roller)} 0"
        roller = f'<joint name="{name}_roller" axis="{axis}" damping="{figures.roller_damping}"/>'
        ball = f'<geom name="{name}" type="sphere" size="{radius}" mass="{figures.mass}" {ONLY_IN_PAIRS}/>'
        size = f'size="{0.95 * radius} {figures.width / 2.0}" quat="0.7071 0.7071 0 0"'
        hub = f'<geom type="cylinder" {size} mass="0" {OF_ROBOT}/>'
        return f"<body {place}>{hub}<body>{roller}{shaft}{ball}</body></body>"
    creep = f'<joint name="{name}_creep" axis="0 1 0"/>' if has_creep(body, name) else ""
    size = f'size="{radius} {figures.width / 2.0} {radius}"'
    geom = f'<geom name="{name}" type="ellipsoid" {size} mass="{figures.mass}" {OF_ROBOT}/>'
    if wheel.steer is None:
        return f"<body {place}>{shaft}{creep}{geom}</body>"
    linked = any(name in names for names in linkages(body).values())
    bearing = 'armature="1e-4"' if linked else _bearing(wheel.steer)
    return (
        f'<body {place}><inertial pos="0 0 0" mass="0.05" diaginertia="1e-4 1e-4 1e-4"/>'
        f'<joint name="{name}_steer" axis="0 0 1" {bearing}/>'
        f"<body>{shaft}{creep}{geom}</body></body>"
    )


def _bearing(steer: Steer) -> str:
    limits = f' range="{steer.range[0]} {steer.range[1]}" limited="true"' if steer.range else ""
    return f'damping="{steer.damping}" armature="{steer.armature}"{limits}'
