"""A planar base with two wheels in MuJoCo: shafts, tyres, contacts, lidar ranges and inertial quantities.

Rules. Exact: noise is added by `gateway.sim.sensors`, except for the slip of the tyres, which is motion. No
graphics: no display and no GL is needed. MuJoCo gives the same bits for the same steps on one version and
processor; elsewhere compare within a tolerance.
Fields of the model: qpos = x, y, z, quaternion w x y z, left, left creep, right, right creep.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

from brain.belief import Pose
from brain.perception.mount import Mount
from gateway.sim.files import SceneFile, Slip, Start
from gateway.sim.load import WorldError
from gateway.sim.mjcf import scene_xml

if TYPE_CHECKING:
    from types import ModuleType

Floats = npt.NDArray[np.float64]

FLOOR = 0
"""MuJoCo's id of the floor's geom: the first one of the model."""
LEFT, RIGHT = (0, 7, 6), (1, 9, 8)
"""Indices of each wheel (motor in ctrl, creep in eq_data), and of its shaft in qpos and in qvel."""
SOLIDS = np.array([1, 0, 0, 0, 0, 0], dtype=np.uint8)
"""Geom groups that beams hit: group 0, the floor, walls and boxes."""
SETTLING = 300
"""Steps in which the base settles into its contacts before time begins."""
STRETCHES = 20
"""Stretches of constant slip per correlation length."""


def import_mujoco(world: str) -> ModuleType:
    """Import the library. Raises WorldError with the command that installs it."""
    try:
        import mujoco  # 0.3 s, and an extra: only where a scene is simulated
    except ImportError as error:
        hint = f"it needs MuJoCo ({error}): pip install 'motor-gateway[sim]'"
        raise WorldError.about(f"world {world!r}", [hint]) from error
    module: ModuleType = mujoco
    return module


class Tyre:
    """One tyre and its slip: a Gauss-Markov process over the rolled distance, constant over short
    stretches."""

    def __init__(self, radius: float, slip: Slip, rng: np.random.Generator) -> None:
        self._sigma, self._rng = slip.sigma, rng
        self._stretch = slip.length / STRETCHES / radius
        self._kept = math.exp(-1.0 / STRETCHES)
        self._slip = self._sigma * float(rng.standard_normal())
        self._turned = self._drawn = 0.0
        self.crept = 0.0
        """rad, by which the tyre has fallen behind the shaft; negative if it is ahead"""

    def turn(self, shaft: float) -> None:
        """Update for the shaft's new angle [rad]."""
        self.crept += self._slip * (shaft - self._turned)
        self._turned = shaft
        if abs(shaft - self._drawn) >= self._stretch:
            self._drawn = shaft
            drawn = math.sqrt(1.0 - self._kept**2) * self._sigma * float(self._rng.standard_normal())
            self._slip = self._kept * self._slip + drawn


class Rover:
    """The base of a scene. `imus`: where each inertial sensor is mounted."""

    def __init__(self, file: SceneFile, imus: dict[str, Mount], seed: int) -> None:
        mujoco = import_mujoco(file.name)
        self._model: Any = mujoco.MjModel.from_xml_string(scene_xml(file, imus))
        self._data: Any = mujoco.MjData(self._model)
        self._mj_step, self._mj_multi_ray = mujoco.mj_step, mujoco.mj_multiRay
        self._wheels = {file.body.left.motor: LEFT, file.body.right.motor: RIGHT}
        self._imus = {name: 6 * index for index, name in enumerate(imus)}
        self._tyres = [
            Tyre(file.body.wheel_radius, file.body.slip, np.random.Generator(np.random.PCG64(stream)))
            for stream in np.random.SeedSequence(seed).spawn(2)
        ]
        self._touching: frozenset[int] = frozenset()
        self.touches = 0
        """How often walls and boxes were newly touched, each counted separately."""
        self._settle(file.start)

    def _settle(self, start: Start) -> None:
        """Settle into the contacts with the wheels still, at the start pose."""
        data = self._data
        data.qpos[0:2] = start.x, start.y
        data.qpos[3:7] = math.cos(start.yaw / 2.0), 0.0, 0.0, math.sin(start.yaw / 2.0)
        self._mj_step(self._model, data, SETTLING)
        data.qpos[0:2] = start.x, start.y
        data.qpos[7:11] = 0.0
        data.qvel[:] = 0.0
        data.time = 0.0

    def step(self, torques: Mapping[str, float]) -> None:
        """Advance by one time step under torques [N·m] at the wheels' shafts."""
        data = self._data
        for motor, (wheel, position, _) in self._wheels.items():
            tyre = self._tyres[wheel]
            tyre.turn(data.qpos[position])
            data.ctrl[wheel] = torques.get(motor, 0.0)
            self._model.eq_data[wheel, 0] = -tyre.crept
        self._mj_step(self._model, data)
        if data.ncon:
            self._count_touches(data.contact.geom.tolist())

    def _count_touches(self, pairs: list[list[int]]) -> None:
        """Count what is touched now and was not touched before the step; `pairs` of geoms are in contact."""
        solid = [pair for pair in pairs if FLOOR not in pair]
        if not solid and not self._touching:
            return
        # Solids come before the robot's geoms in the model, so the smaller number is the solid's.
        now = frozenset(min(pair) for pair in solid)
        self.touches += len(now - self._touching)
        self._touching = now

    def shaft(self, motor: str) -> tuple[float, float]:
        """Return position [rad] and velocity [rad/s] of the output shaft, inside the creeping tyre."""
        _, position, velocity = self._wheels[motor]
        return float(self._data.qpos[position]), float(self._data.qvel[velocity])

    def pose(self) -> Pose:
        """Return the true pose, now."""
        x, y, _, w, i, j, k = self._data.qpos[0:7].tolist()
        return Pose(x, y, math.atan2(2.0 * (w * k + i * j), 1.0 - 2.0 * (j * j + k * k)))

    def inertial(self, imu: str) -> tuple[Floats, Floats]:
        """Return rad/s and m/s² (gravity included) in the sensor's frame, at the beginning of the last
        step."""
        start = self._imus[imu]
        data: Floats = self._data.sensordata
        return data[start : start + 3].copy(), data[start + 3 : start + 6].copy()

    def rays(self, mount: Mount, directions: Floats, farthest: float) -> Floats:
        """Return the lengths [m] of beams from a mount, at the beginning of the last step.

        `directions`: n × 3 unit vectors in the sensor's frame. `farthest` where they hit nothing."""
        data, count = self._data, len(directions)
        base = data.xmat[1].reshape(3, 3)
        origin = data.xpos[1] + base @ np.array([mount.x, mount.y, mount.z])
        turned = directions @ (base @ np.array(mount.rotation())).T
        geoms, found = np.empty(count, dtype=np.int32), np.empty(count)
        self._mj_multi_ray(
            self._model, data, origin, turned.ravel(), SOLIDS, True, -1, geoms, found, None, count, farthest
        )
        hit: Floats = np.where((found < 0.0) | (found > farthest), farthest, found)
        return hit
