"""A scene in MuJoCo's modelling language (MJCF). Text in, text out; imports no MuJoCo.

Rules. Wheels touch the floor as ellipsoids, since a cylinder makes two contacts and scrubs when it turns on
the spot; casters have priority, little friction and no tangential contact dimension, or they drag. Each wheel
has two joints on one axle: the shaft, which the motor turns and the encoder measures, and the creep of the
tyre against it, which an equality constraint holds at the angle given by the slip. Walls and boxes are in
geom group 0, the robot in group 1, so that beams hit only the former.
"""

from __future__ import annotations

import math
from typing import TypeAlias

from brain.perception.mount import Mount
from gateway.sim.files import STEP, Body, SceneFile, Wall, Wheel
from protocols.messages import seconds

Polygon: TypeAlias = tuple[tuple[float, float], ...]

ROLLING = "0.005 0.0001"
"""Torsional and rolling friction [m] of a contact with the floor."""
CREEP_SOLREF = "0.004 1"
"""s, damping ratio: how closely a tyre is held to the angle that it has crept."""


def scene_xml(file: SceneFile, imus: dict[str, Mount]) -> str:
    """Return the model: floor, walls and boxes, the body with joints `left` and `right`, a site for each
    IMU."""
    body = file.body
    sites = "".join(f'<site name="{name}" {_pose(mount)}/>' for name, mount in imus.items())
    sensors = "".join(f'<gyro site="{name}"/><accelerometer site="{name}"/>' for name in imus)
    half = [size / 2.0 for size in body.size]
    chassis = body.mass - 2.0 * body.wheel_mass
    return f"""
<mujoco model="{"".join(c for c in file.name if c.isalnum())}">
 <option timestep="{seconds(STEP)}" integrator="implicitfast" cone="elliptic" impratio="10"/>
 <default><geom friction="{file.friction} {ROLLING}"/></default>
 <worldbody>
  <geom name="floor" type="plane" size="0 0 1"/>
  {"".join(_solids(file))}
  <body name="base">
   <freejoint/>
   {sites}
   <geom type="box" size="{half[0]} {half[1]} {half[2]}" pos="0 0 {body.height}" mass="{chassis}" group="1"/>
   {_caster(body, body.caster_offset)}
   {_caster(body, -body.caster_offset)}
   {_wheel(body, "left", body.left, body.wheel_separation / 2.0)}
   {_wheel(body, "right", body.right, -body.wheel_separation / 2.0)}
  </body>
 </worldbody>
 <actuator>
  <motor joint="left"/><motor joint="right"/>
 </actuator>
 <equality>
  <joint joint1="left_creep" solref="{CREEP_SOLREF}"/><joint joint1="right_creep" solref="{CREEP_SOLREF}"/>
 </equality>
 <sensor>{sensors}</sensor>
</mujoco>"""


def _solids(file: SceneFile) -> list[str]:
    """Return walls and boxes, in the order of `outlines`."""
    walls = [_solid(*_middle(wall), wall.thickness, wall.height) for wall in file.walls.values()]
    boxes = [_solid(box.x, box.y, box.yaw, *box.size) for box in file.boxes.values()]
    return walls + boxes


def _solid(x: float, y: float, yaw: float, length: float, width: float, height: float) -> str:
    size = f"{length / 2.0} {width / 2.0} {height / 2.0}"
    turned = f"{math.cos(yaw / 2.0)} 0 0 {math.sin(yaw / 2.0)}"
    return f'<geom type="box" size="{size}" pos="{x} {y} {height / 2.0}" quat="{turned}"/>'


def _caster(body: Body, x: float) -> str:
    return (
        f'<geom type="sphere" size="{body.caster_radius}" pos="{x} 0 {body.caster_radius}" mass="0.001" '
        f'priority="1" friction="0.01 {ROLLING}" condim="1" group="1"/>'
    )


def _wheel(body: Body, name: str, wheel: Wheel, y: float) -> str:
    radius = body.wheel_radius * (1.0 + wheel.radius_error)
    return (
        f'<body pos="0 {y} {body.wheel_radius}">'
        f'<joint name="{name}" axis="0 1 0" damping="{body.damping}" armature="{body.armature}"/>'
        f'<joint name="{name}_creep" axis="0 1 0"/>'
        f'<geom type="ellipsoid" size="{radius} {body.wheel_width / 2.0} {radius}" mass="{body.wheel_mass}" '
        f'group="1"/></body>'
    )


def _pose(mount: Mount) -> str:
    """Return position and rotation of a mount in MJCF: the x and the y axis of its frame."""
    rows = mount.rotation()
    axes = " ".join(str(rows[row][column]) for column in (0, 1) for row in range(3))
    return f'pos="{mount.x} {mount.y} {mount.z}" xyaxes="{axes}"'


def outlines(file: SceneFile) -> list[Polygon]:
    """Return walls and boxes seen from above, as polygons of four corners [m] in the world's frame."""
    walls = [_rectangle(*_middle(wall), wall.thickness) for wall in file.walls.values()]
    boxes = [_rectangle(box.x, box.y, box.yaw, box.size[0], box.size[1]) for box in file.boxes.values()]
    return walls + boxes


def _middle(wall: Wall) -> tuple[float, float, float, float]:
    """Return x, y, yaw and length of a wall."""
    (x0, y0), (x1, y1) = wall.start, wall.end
    return (x0 + x1) / 2.0, (y0 + y1) / 2.0, math.atan2(y1 - y0, x1 - x0), math.dist(wall.start, wall.end)


def _rectangle(x: float, y: float, yaw: float, length: float, width: float) -> Polygon:
    c, s = math.cos(yaw) / 2.0, math.sin(yaw) / 2.0
    corners = ((length, width), (-length, width), (-length, -width), (length, -width))
    return tuple((x + c * a - s * b, y + s * a + c * b) for a, b in corners)
