"""A base on wheels in a scene: shafts, steering, tyres that creep, rollers.

Rules. The slip of the tyres is no noise but motion. A roller's joint is put back to angle 0 after each step
and keeps its speed: the wheel is a ball there, and the axis of the roller on the floor stays where it is.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from brain.perception.mount import Mount
from gateway.sim import mjcf
from gateway.sim.assembly_file import AssemblyPart
from gateway.sim.files import SceneFile
from gateway.sim.linked import carried
from gateway.sim.plant_files import Slip, WheeledBody, WheeledFile
from gateway.sim.scene import FLOOR, SimulatedScene, import_mujoco

HELD = 0.05
"""m/s, slip up to which a tyre that others drag is held in proportion to it: then Coulomb friction is
stable."""
STRETCHES = 20
"""Stretches of constant slip per correlation length."""


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


class Dragged:
    """A tyre that others drag sideways, on a contact without friction, and the friction instead.

    MuJoCo's own friction cone lifts what slips off the floor: such a base hops, and turns at half its
    speed."""

    def __init__(self, body: WheeledBody, name: str, geom: int, dofs: list[int]) -> None:
        wheel = body.wheels[name]
        self.x, self.y, self.geom, self.dofs = wheel.x, wheel.y, geom, dofs
        self.radius = body.wheel.radius * (1.0 + wheel.radius_error)
        self._c, self._s = math.cos(wheel.yaw), math.sin(wheel.yaw)

    def friction(
        self, twist: tuple[float, float, float], spin: float, most: float
    ) -> tuple[float, float, float]:
        """Return the force [N] on the base, forward and to the left, and that along the wheel's own
        direction, at the base's speed (m/s, rad/s, m/s to the left) and the wheel's [rad/s]: against the
        slip, `most` at most."""
        ahead, left = twist[0] - twist[1] * self.y, twist[2] + twist[1] * self.x
        along, across = (
            self._c * ahead + self._s * left - self.radius * spin,
            self._c * left - self._s * ahead,
        )
        share = -most / max(math.hypot(along, across), HELD)
        along, across = share * along, share * across
        return self._c * along - self._s * across, self._s * along + self._c * across, along


class Rover(SimulatedScene):
    """A base on wheels. `imus`: where each inertial sensor is mounted; `parts`: what it carries."""

    def __init__(
        self,
        file: SceneFile,
        plant: WheeledFile,
        imus: dict[str, Mount],
        seed: int,
        parts: Sequence[AssemblyPart] = (),
    ) -> None:
        body = plant.body
        robot = mjcf.joined(mjcf.wheeled(body, imus, file.friction), carried(parts))
        xml = mjcf.scene_xml(file, robot, imus)
        model: Any = import_mujoco(file.name).MjModel.from_xml_string(xml)
        super().__init__(file, model, imus)
        joints = {name: model.joint(name) for name in _joints(body)}
        at = {name: (int(one.qposadr[0]), int(one.dofadr[0])) for name, one in joints.items()}
        moved = (mjcf.first(body) | mjcf.steered(body)).items()
        self._shafts = {motor: (index, *at[joint]) for index, (motor, joint) in enumerate(moved)}
        self._rollers = [place for name, (place, _) in at.items() if name.endswith("_roller")]
        radius = body.wheel.radius
        streams = np.random.SeedSequence(seed).spawn(len(body.wheels))
        self._tyres = [
            (at[name][0], Tyre(radius, body.slip, np.random.Generator(np.random.PCG64(stream))))
            for name, stream in zip(body.wheels, streams, strict=True)
            if mjcf.has_creep(body, name)
        ]
        """With the index of the shaft in qpos; in the order of the constraints that hold them."""
        self._dragged = [
            Dragged(body, name, int(model.geom(name).id), [at[joint][1] for joint in axle])
            for name in mjcf.dragged(body)
            for axle in [[name, f"{name}_creep"] if mjcf.has_creep(body, name) else [name]]
        ]
        for part in parts:
            self._add_links(part)
        self.settle()
        for position, _ in at.values():
            self.data.qpos[position] = 0.0

    def step(self, torques: Mapping[str, float]) -> None:
        """Advance by one time step under torques [N·m] at the shafts."""
        data, places, corrections = self.data, self._places, self.model.eq_data
        self.drive(torques)
        for index, (position, tyre) in enumerate(self._tyres):
            tyre.turn(float(places[position]))
            corrections[index, 0] = -tyre.crept
        if self._dragged:
            self._drag()
        self.advance()
        if self._rollers:
            data.qpos[self._rollers] = 0.0

    def _drag(self) -> None:
        """Apply the friction of tyres that cannot all roll. The base is taken as level, as it is on a
        floor."""
        data = self.data
        speeds, forces = data.qvel.tolist(), data.efc_force.tolist()
        contacts = zip(data.contact.geom.tolist(), data.contact.efc_address.tolist(), strict=True)
        loads = {wheel: forces[row] for (floor, wheel), row in contacts if floor == FLOOR}
        applied = [0.0] * len(speeds)
        vx, vy, _, _, _, turn = speeds[:6]
        yaw = self.pose().yaw
        c, s = math.cos(yaw), math.sin(yaw)
        twist = c * vx + s * vy, turn, c * vy - s * vx
        for tyre in self._dragged:
            spin = sum(speeds[dof] for dof in tyre.dofs)
            ahead, left, along = tyre.friction(twist, spin, self.file.friction * loads.get(tyre.geom, 0.0))
            applied[0] += c * ahead - s * left
            applied[1] += s * ahead + c * left
            applied[5] += tyre.x * left - tyre.y * ahead
            for dof in tyre.dofs:
                applied[dof] = -tyre.radius * along
        data.qfrc_applied[:] = applied


def _joints(body: WheeledBody) -> list[str]:
    """Return the names of all joints of the wheels."""
    names: list[str] = []
    for name, wheel in body.wheels.items():
        names += [name]
        names += [f"{name}_creep"] if mjcf.has_creep(body, name) else []
        names += [f"{name}_roller"] if wheel.roller is not None else []
        names += [f"{name}_steer"] if wheel.steer else []
    return [*names, *(f"{motor}_linkage" for motor in mjcf.linkages(body))]
