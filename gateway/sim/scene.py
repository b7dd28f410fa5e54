"""A place in MuJoCo with one robot in it: time, people, touches, beams, inertial quantities, the true pose.

Rules. Exact: noise is added by `gateway.sim.sensors`. No graphics: no display and no GL is needed. MuJoCo
gives the same bits for the same steps on one version and processor; elsewhere compare within a tolerance. A
robot's kind is a subclass (`rover.Rover`): it makes the model, in which the robot's base is the body "base"
and the robot's geoms are of group 1, and turns torques into `data.ctrl`.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

from brain.belief import Pose
from brain.bodies.cylinder import Cylinder
from brain.perception.mount import Mount
from gateway.sim.assembly_file import AssemblyPart
from gateway.sim.files import STEP, SceneFile
from gateway.sim.load import WorldError

if TYPE_CHECKING:
    from types import ModuleType
from protocols.messages import seconds

Floats = npt.NDArray[np.float64]

DT = seconds(STEP)
FLOOR = 0
"""MuJoCo's id of the floor's geom: the first one of the model."""
SOLIDS = np.array([1, 0, 0, 0, 0, 0], dtype=np.uint8)
"""Geom groups that beams hit: group 0, all but the robot."""
SETTLING = 300
"""Steps in which a robot settles into its contacts before time begins."""
STANDING = 0.05
"""m/s: a robot that moves no faster touches no person; people touch it."""
ELSEWHERE = (0.0, 0.0, -100.0)
"""m: where a wall is before it appears."""
HEAVY = 1e4
"""kg·m², added to a shaft whose motion is given: no torque of the world's changes it."""
CATCH_UP = 0.02
"""s, in which such a shaft makes up for what it is behind its given angle."""
FASTEST = 100.0
"""rad/s, at which it does so at most."""


def import_mujoco(world: str) -> ModuleType:
    """Import the library. Raises WorldError with the command that installs it."""
    try:
        import mujoco  # 0.3 s, and an extra: only where a scene is simulated
    except ImportError as error:
        hint = f"it needs MuJoCo ({error}): pip install 'motor-gateway[sim]'"
        raise WorldError.about(f"world {world!r}", [hint]) from error
    module: ModuleType = mujoco
    return module


class SimulatedScene:
    """A scene with a robot. `imus`: the names of its inertial sensors, in the order of the model's."""

    def __init__(self, file: SceneFile, model: Any, imus: Iterable[str]) -> None:  # noqa: ANN401
        mujoco = import_mujoco(file.name)
        self.file = file
        self.model: Any = model
        self.data: Any = mujoco.MjData(model)
        self._mj_step, self._mj_multi_ray = mujoco.mj_step, mujoco.mj_multiRay
        self._mj_distance = mujoco.mj_geomDistance
        self._base = int(model.body("base").id)
        self._open_windows()
        self._mounted: dict[Mount, tuple[Floats, Floats]] = {}
        """Place and axes of mounts, in the frame of the base."""
        joint = int(model.body_jntadr[self._base])
        free = joint >= 0 and model.jnt_type[joint] == mujoco.mjtJoint.mjJNT_FREE
        self._free: int | None = int(model.jnt_qposadr[joint]) if free else None
        """Index in qpos of the base's free joint; None: it is fixed."""
        self._imus = {name: int(model.sensor_adr[2 * index]) for index, name in enumerate(imus)}
        self._people = [
            (one, int(model.body(f"person_{name}").mocapid[0])) for name, one in file.people.items()
        ]
        self._people_geoms = frozenset(int(model.geom(f"person_{name}").id) for name in file.people)
        self._walls = [
            (wall.appears, int(model.body(f"wall_{name}").mocapid[0]))
            for name, wall in file.walls.items()
            if wall.appears
        ]
        """Those that are not there from the beginning"""
        later = {int(model.geom(f"wall_{name}").id) for name, wall in file.walls.items() if wall.appears}
        own = (model.geom_group == 1).tolist()
        fixed = [geom for geom in range(model.ngeom) if not own[geom] and model.geom_bodyid[geom] == 0]
        self._hard = frozenset(fixed) - {FLOOR} | self._people_geoms | later
        """Geoms that a robot should not touch,"""
        self._own = frozenset(geom for geom in range(model.ngeom) if own[geom])
        """and the robot's."""
        self._contacts: list[list[int]] = []
        """The pairs of geoms that were in contact after the last step,"""
        self._touching: frozenset[int] = frozenset()
        """and what of it is to be touched by nobody."""
        self.touches = 0
        """How often walls and fixed boxes were newly touched, each counted separately."""
        self.touches_by_people = 0
        """How often a person was newly touched while the robot moved."""
        self._shafts: dict[str, tuple[int, int, int]] = {}
        """Index of each motor in ctrl, and of its shaft in qpos and qvel. Filled by the robot's kind,"""
        self._cylinders: dict[str, Cylinder] = {}
        """Those of motors that move no axis themselves,"""
        self._starts: list[tuple[int, int, float]] = []
        """and of what falls without its motors: indices of its joint, and where that is at time 0."""
        self._height = 0.0
        """m, of a base that is free, at time 0"""
        self._given: dict[str, tuple[float, float]] = {}
        """The angle [rad] and the velocity [rad/s] of the shafts whose motion is given."""
        self._move_people()

    def _open_windows(self) -> None:
        """Keep arrays that show MuJoCo's memory: a look at `data` for each takes longer than what is read."""
        self._controls: Floats = self.data.ctrl
        self._places: Floats = self.data.qpos
        self._speeds: Floats = self.data.qvel
        self._base_place: Floats = self.data.xpos[self._base]
        self._base_axes: Floats = self.data.xmat[self._base].reshape(3, 3)

    def __setstate__(self, state: dict[str, Any]) -> None:
        """Make a copy that shows its own memory, not copies of what the other's showed."""
        self.__dict__.update(state)
        self._open_windows()

    # -- what a kind of robot may do otherwise -----------------------------------------------------------

    def step(self, torques: Mapping[str, float]) -> None:
        """Advance by one time step under torques [N·m] at its motors' output shafts."""
        self.drive(torques)
        self.advance()

    # -- what is the same for all ----------------------------------------------------------------

    @property
    def motors(self) -> Iterable[str]:
        """The motors that move it."""
        return tuple(self._shafts)

    def drive(self, torques: Mapping[str, float]) -> None:
        """Apply torques [N·m] at the output shafts; of a cylinder a force [N], by its lever now."""
        controls, cylinders = self._controls, self._cylinders
        for motor, (index, place, _) in self._shafts.items():
            torque = torques.get(motor, 0.0)
            if motor in cylinders:
                torque *= cylinders[motor].lever(float(self._places[place]))
            controls[index] = torque

    def shaft(self, motor: str) -> tuple[float, float]:
        """Return position [rad] and velocity [rad/s] of a motor's output shaft; length [m] and its change of
        a cylinder."""
        _, place, speed = self._shafts[motor]
        position, velocity = float(self._places[place]), float(self._speeds[speed])
        if (cylinder := self._cylinders.get(motor)) is None:
            return position, velocity
        return cylinder.length(position), velocity * cylinder.lever(position)

    def settle(self) -> None:
        """Settle into the contacts at the start pose, then begin time with the base at rest there."""
        data, start = self.data, self.file.start
        base = self._free
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
        for position, velocity, angle in self._starts:
            self.data.qpos[position], self.data.qvel[velocity] = angle, 0.0

    def _add_links(self, part: AssemblyPart) -> None:
        """Add the joints of a robot of links that is in the model, after those of its motors before."""
        for motor, (name, joint) in zip(part.motors, part.plant.joints.items(), strict=True):
            at = self.model.joint(part.named(name))
            position, velocity = int(at.qposadr[0]), int(at.dofadr[0])
            self._shafts[motor] = len(self._shafts), position, velocity
            self._starts.append((position, velocity, joint.start))
            if joint.cylinder is not None:
                self._cylinders[motor] = joint.cylinder

    def follow(self, motor: str, position: float, velocity: float) -> None:
        """Give a shaft its motion from now on: at this angle [rad], turning at this velocity [rad/s]."""
        if motor not in self._given:
            self.model.dof_armature[self._shafts[motor][2]] += HEAVY
        self._given[motor] = position, velocity

    def let_go(self, motor: str) -> None:
        """Let torques move it again."""
        if self._given.pop(motor, None) is not None:
            self.model.dof_armature[self._shafts[motor][2]] -= HEAVY

    def resistance(self, motor: str) -> float:
        """Return the torque [N·m] that contacts, friction and gravity put on a shaft, in the last step."""
        data, at = self.data, self._shafts[motor][2]
        torque = data.qfrc_constraint[at] + data.qfrc_passive[at] + data.qfrc_applied[at] - data.qfrc_bias[at]
        return float(torque)

    def _turn_given(self) -> None:
        """Let the shafts whose motion is given have it."""
        for motor, (wanted, velocity) in self._given.items():
            _, position, speed = self._shafts[motor]
            behind = (wanted - float(self.data.qpos[position])) / CATCH_UP
            self.data.qvel[speed] = velocity + max(-FASTEST, min(FASTEST, behind))
            self._given[motor] = wanted + velocity * DT, velocity

    def clearance(self, most: float) -> float:
        """Return the distance [m] from the robot to the nearest wall, fixed box or person, `most` at most."""
        return min((self._distance(a, b, most) for a in self._own for b in self._hard), default=most)

    def _distance(self, one: int, other: int, most: float) -> float:
        return float(self._mj_distance(self.model, self.data, one, other, most, None))

    def advance(self) -> None:
        """Advance by one time step under `data.ctrl`."""
        data = self.data
        if self._people or self._walls:
            self._move_people()
        if self._given:
            self._turn_given()
        self._mj_step(self.model, data)
        if data.ncon:
            self._count_touches(data.contact.geom.tolist())

    def _move_people(self) -> None:
        for one, index in self._people:
            self.data.mocap_pos[index] = (*one.place(self.data.time), 0.0)
        for appears, index in self._walls:
            self.data.mocap_pos[index] = ELSEWHERE if self.data.time < appears else (0.0, 0.0, 0.0)

    def _count_touches(self, pairs: list[list[int]]) -> None:
        """Count what is touched now and was not touched before the step; `pairs` of geoms are in contact."""
        if pairs == self._contacts:
            return
        self._contacts = pairs
        off_floor = [pair for pair in pairs if FLOOR not in pair]
        if not off_floor and not self._touching:
            return
        hard, own = self._hard, self._own
        both = [(a, b) if a in hard else (b, a) for a, b in off_floor]
        now = frozenset(solid for solid, part in both if solid in hard and part in own)
        new = now - self._touching
        people = len(new & self._people_geoms)
        self.touches += len(new) - people
        if people and self.speed() > STANDING:
            self.touches_by_people += people
        self._touching = now

    def speed(self) -> float:
        """Return the speed [m/s] of the base in the plane; 0 of one that is fixed."""
        return math.hypot(*self.twist()[:2])

    def pose(self) -> Pose:
        """Return the true pose, now."""
        data, base = self.data, self._free
        if base is None:
            (x, y, _), (w, i, j, k) = data.xpos[self._base].tolist(), data.xquat[self._base].tolist()
        else:
            x, y, _, w, i, j, k = data.qpos[base : base + 7].tolist()
        return Pose(x, y, math.atan2(2.0 * (w * k + i * j), 1.0 - 2.0 * (j * j + k * k)))

    def twist(self) -> tuple[float, float, float]:
        """Return how fast the base moves forward and to the left [m/s] and turns [rad/s], now; 0 of one that
        is fixed."""
        if self._free is None:
            return 0.0, 0.0, 0.0
        start = int(self.model.jnt_dofadr[int(self.model.body_jntadr[self._base])])
        vx, vy, _, _, _, angular = self.data.qvel[start : start + 6].tolist()
        yaw = self.pose().yaw
        cos, sin = math.cos(yaw), math.sin(yaw)
        return vx * cos + vy * sin, vy * cos - vx * sin, angular

    def people(self) -> list[tuple[float, float, float]]:
        """Return x, y and radius [m] of everybody, now."""
        t = self.data.time
        return [(*one.place(t), one.radius) for one, _ in self._people]

    def box(self, name: str) -> tuple[float, float, float]:
        """Return where the middle of a box is that can be moved [m], now."""
        joint = self.model.body(f"box_{name}").jntadr[0]
        start = int(self.model.jnt_qposadr[joint])
        x, y, z = self.data.qpos[start : start + 3].tolist()
        return x, y, z

    def inertial(self, imu: str) -> tuple[list[float], list[float]]:
        """Return rad/s and m/s² (gravity included) in the sensor's frame, at the beginning of the last
        step."""
        start = self._imus[imu]
        measured: list[float] = self.data.sensordata[start : start + 6].tolist()
        return measured[:3], measured[3:]

    def frame(self, mount: Mount) -> tuple[Floats, Floats]:
        """Return where a sensor is [m], and its axes as columns, at the beginning of the last step."""
        if (mounted := self._mounted.get(mount)) is None:
            mounted = np.array([mount.x, mount.y, mount.z]), np.array(mount.rotation())
            self._mounted[mount] = mounted
        axes = self._base_axes
        return self._base_place + axes.dot(mounted[0]), axes.dot(mounted[1])

    def rays(self, mount: Mount, directions: Floats, farthest: float) -> Floats:
        """Return the lengths [m] of beams from a mount, at the beginning of the last step.

        `directions`: n × 3 unit vectors in the sensor's frame. `farthest` where they hit nothing."""
        found = np.empty(len(directions))
        self.cast(mount, directions, farthest, found)
        return cut(found, farthest)

    def cast(self, mount: Mount, directions: Floats, farthest: float, into: Floats) -> None:
        """Write the lengths of the same beams to an array, as `cut` takes them."""
        count = len(into)
        origin, axes = self.frame(mount)
        turned = directions.dot(axes.T).ravel()
        hit = np.empty(count, dtype=np.int32)
        self._mj_multi_ray(
            self.model, self.data, origin, turned, SOLIDS, True, -1, hit, into, None, count, farthest
        )


def cut(found: Floats, farthest: float) -> Floats:
    """Return lengths [m] of beams as MuJoCo has found them: `farthest` of those that hit nothing nearer."""
    return np.where(found < 0.0, farthest, np.minimum(found, farthest))
