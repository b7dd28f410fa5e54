"""An arm of six axes and a gripper (fixtures/robots/arm.urdf): ours, MuJoCo, Pinocchio.

Rules. Everybody has the same links and is given the same joints. The inverse starts from one posture and
must come within 0.1 mm and 1 mrad: neither MuJoCo nor Pinocchio has an inverse of its own, so each is asked
for the Jacobian in a plain loop of damped least squares, without the restarts and ranges that ours has.
"""

from __future__ import annotations

import random
from collections.abc import Callable
from importlib.resources import files
from typing import Any

import numpy as np

from benchmarks.measure import Call, Effort, in_turn, rival
from benchmarks.rows import Row, against
from brain.bodies import urdf
from brain.bodies.chain import Array, Chain, moving, rotation_vector
from brain.bodies.reach import CLOSE, CLOSE_TURN, LEVER, ReachSearch

GROUP = "an arm of six axes and a gripper"
POSTURE = np.array((0.3, 0.4, 1.2, -0.4, 0.9, 0.2, 0.25))
PLACES, SEED, DAMPING, MOST = 20, 5, 1e-3, 1000

WHAT = "frame and Jacobian of the tip", "inverse dynamics", f"inverse kinematics of {PLACES} places"


def arms(effort: Effort) -> list[Row]:
    """Forward kinematics with the Jacobian, inverse dynamics, and inverse kinematics."""
    text = (files("gateway.fixtures") / "robots" / "arm.urdf").read_text("utf-8")
    model = urdf.parse(text)
    chain = Chain(model, "base", "tool", moving(model))
    goals = [chain.forward(q) for q in places()]
    mujoco, pin = rival("mujoco", "mujoco"), rival("pinocchio", "pin")
    forward: dict[str, Call] = {"ours": lambda: chain.jacobian(POSTURE)}
    dynamics: dict[str, Call] = {"ours": lambda: chain.torques(POSTURE, POSTURE, POSTURE)}
    inverse: dict[str, Call] = {"ours": lambda: solved(chain, goals)}
    if not mujoco.why_not:
        theirs = InMujoco(mujoco.module, text)
        forward[mujoco.name] = lambda: theirs.jacobian(POSTURE)
        dynamics[mujoco.name] = lambda: theirs.torques(POSTURE)
        inverse[mujoco.name] = lambda: [damped(theirs.jacobian, goal) for goal in goals]
    if not pin.why_not:
        other = InPinocchio(pin.module, text)
        forward[pin.name] = lambda: other.jacobian(POSTURE)
        dynamics[pin.name] = lambda: other.torques(POSTURE)
        inverse[pin.name] = lambda: [damped(other.jacobian, goal) for goal in goals]
    rows = []
    for name, contestants, rounds in (
        (WHAT[0], forward, 2000),
        (WHAT[1], dynamics, 2000),
        (WHAT[2], inverse, 10),
    ):
        found = in_turn(contestants, effort.of(rounds, 1))
        beside = against(found, mujoco.name, pin.name, missing=(mujoco, pin))
        rows.append(Row(GROUP, name, found["ours"], beside))
    return rows


def places() -> list[Array]:
    """Return joints not far from the posture."""
    rng = random.Random(SEED)  # noqa: S311
    return [POSTURE + np.array([rng.uniform(-0.6, 0.6) for _ in POSTURE]) for _ in range(PLACES)]


def solved(chain: Chain, goals: list[tuple[Array, Array]]) -> list[Array]:
    """Return the joints for each place; raise if one is not found."""
    found = []
    for attitude, place in goals:
        search = ReachSearch(chain, POSTURE.tolist(), place.tolist(), attitude, chain.aside)
        while not search.advance(50):
            pass
        if search.found is None:
            raise AssertionError(search.why)
        found.append(np.array(search.found))
    return found


def damped(
    jacobian: Callable[[Array], tuple[tuple[Array, Array], Array]], goal: tuple[Array, Array]
) -> Array:
    """Return joints for a place, by damped least squares in a loop."""
    q = POSTURE.copy()
    for _ in range(MOST):
        (turned, at), rows = jacobian(q)
        near, about = goal[1] - at, rotation_vector(goal[0] @ turned.T)
        if np.linalg.norm(near) <= CLOSE and np.linalg.norm(about) <= CLOSE_TURN:
            return q
        error = np.concatenate((near, LEVER * about))
        weighted = rows * np.array([[1.0]] * 3 + [[LEVER]] * 3)
        q = q + weighted.T @ np.linalg.solve(weighted @ weighted.T + DAMPING * np.eye(6), error)
    raise AssertionError("not found")


class InMujoco:
    """The same arm in MuJoCo."""

    def __init__(self, mujoco: Any, text: str) -> None:  # noqa: ANN401 -- a module
        kept = '<mujoco><compiler fusestatic="false"/></mujoco></robot>'
        self._mujoco, self.model = mujoco, mujoco.MjModel.from_xml_string(text.replace("</robot>", kept))
        self.data = mujoco.MjData(self.model)
        self._tip = self.model.body("tool").id
        self._rows = np.zeros((6, self.model.nv))

    def jacobian(self, q: Array) -> tuple[tuple[Array, Array], Array]:
        """Return the tip's frame, and its Jacobian."""
        self.data.qpos[:] = q
        self._mujoco.mj_kinematics(self.model, self.data)
        self._mujoco.mj_comPos(self.model, self.data)
        self._mujoco.mj_jacBody(self.model, self.data, self._rows[:3], self._rows[3:], self._tip)
        return (self.data.xmat[self._tip].reshape(3, 3), self.data.xpos[self._tip]), self._rows

    def torques(self, q: Array) -> Array:
        """Return the torques of a motion."""
        self.data.qpos[:], self.data.qvel[:], self.data.qacc[:] = q, q, q
        self._mujoco.mj_inverse(self.model, self.data)
        found: Array = self.data.qfrc_inverse
        return found


class InPinocchio:
    """The same arm in Pinocchio."""

    def __init__(self, pin: Any, text: str) -> None:  # noqa: ANN401 -- a module
        self._pin, self.model = pin, pin.buildModelFromXML(text)
        self.data, self._tip = self.model.createData(), self.model.getFrameId("tool")

    def jacobian(self, q: Array) -> tuple[tuple[Array, Array], Array]:
        """Return the tip's frame, and its Jacobian."""
        pin = self._pin
        rows: Array = pin.computeFrameJacobian(self.model, self.data, q, self._tip, pin.LOCAL_WORLD_ALIGNED)
        at = pin.updateFramePlacement(self.model, self.data, self._tip)
        return (at.rotation, at.translation), rows

    def torques(self, q: Array) -> Array:
        """Return the torques of a motion."""
        found: Array = self._pin.rnea(self.model, self.data, q, q, q)
        return found
