"""The moving joints of a URDF as a mechanism: where its links are, and what torques move it.

Rules. Pure functions of the joints' positions (rad; m of a prismatic joint), in the order of `Chain.joints`.
All vectors are in the frame of the base link, and velocities and forces are spatial ones about its origin:
then those of a chain are plain sums over the joints below and above. A link that hangs on the chain (a tool,
a gripper) counts with its mass; a joint that is not driven is locked at 0, or at the end of its range.

Sources: Featherstone 2008, "Rigid Body Dynamics Algorithms", chapters 2 and 5 (recursive Newton-Euler, here
in one fixed frame); Lynch and Park 2017, "Modern Robotics", sections 4.1 and 5.1.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, TypeAlias

import numpy as np
import numpy.typing as npt

from brain.bodies.urdf import Link, Origin, UrdfJoint, UrdfModel
from protocols.bounds import Invalid

Array: TypeAlias = npt.NDArray[np.float64]
Numbers: TypeAlias = Sequence[float] | Array
Place: TypeAlias = tuple[Array, Array]
"""A frame in another: its rotation (3×3) and its origin (3)."""

GRAVITY = 9.81
"""m/s², downwards along z of the model's root link."""


def rotation(roll: float, pitch: float, yaw: float) -> Array:
    """Return the rotation by these angles [rad] about the fixed axes x, y, z, in this order."""
    (a, b, c), (d, e, f) = np.cos((roll, pitch, yaw)), np.sin((roll, pitch, yaw))
    return np.array(
        (
            (b * c, d * e * c - a * f, a * e * c + d * f),
            (b * f, d * e * f + a * c, a * e * f - d * c),
            (-e, d * b, a * b),
        )
    )


def rotation_vector(turned: Array) -> Array:
    """Return axis times angle [rad, 0 to π] of a rotation matrix (Lynch and Park, equations 3.51 to 3.53)."""
    skew = 0.5 * np.array(
        (turned[2, 1] - turned[1, 2], turned[0, 2] - turned[2, 0], turned[1, 0] - turned[0, 1])
    )
    sine, cosine = float(np.sqrt(skew @ skew)), 0.5 * (float(np.trace(turned)) - 1.0)
    angle = float(np.arctan2(sine, cosine))
    if sine > 1e-3 or cosine > 0.0:
        return skew * (angle / sine if sine > 1e-12 else 1.0)
    square = 0.5 * (turned + turned.T) - cosine * np.eye(3)  # (1 − cos) axis axisᵀ
    column = square[:, int(np.argmax(np.diag(square)))]
    axis: Array = column / np.sqrt(column @ column)
    return axis * (angle if axis @ skew >= 0.0 else -angle)


def placed(origin: Origin) -> Place:
    """Return the frame of an origin."""
    return rotation(*origin.rpy), np.array(origin.xyz)


def _cross(a: Array, b: Array) -> Array:
    """Return the products of vectors in the last axis; np.cross takes five times as long."""
    return a[..., _NEXT] * b[..., _LAST] - a[..., _LAST] * b[..., _NEXT]


_NEXT, _LAST = [1, 2, 0], [2, 0, 1]


class Chain:
    """The driven joints below a base link, and a tip link that they move. Never changed after it is made.

    Raises ValueError if the model has not these links and joints, or they do not fit each other."""

    def __init__(self, model: UrdfModel, base: str, tip: str, driven: Sequence[str]) -> None:
        _check(model, base, tip, driven)
        self.base, self.tip = base, tip
        bodies = _Bodies(model, base, frozenset(driven))
        joints = bodies.joints
        if far := [name for name in driven if name not in {one.name for one in joints}]:
            raise Invalid(("axes", f"joint {far[0]!r} is not below the base link, {base!r}"))
        self.joints = tuple(one.name for one in joints)
        """Parents before their children."""
        n = len(joints)
        self.low = np.array([one.range[0] if one.range else -np.inf for one in joints])
        self.high = np.array([one.range[1] if one.range else np.inf for one in joints])
        self._parents = bodies.parents
        self._above = np.eye(n)
        """Row i: 1 for joint i and all between it and the base."""
        for i, parent in enumerate(self._parents):
            if parent >= 0:
                self._above[i] += self._above[parent]
        self._turns = np.array([[one.kind != "prismatic"] for one in joints], dtype=float)
        self._axes = np.array([one.axis for one in joints])
        self._turned = np.array([place[0] for place in bodies.places])
        self._origins = np.array([place[1] for place in bodies.places])
        self._slides = (self._turned @ self._axes[:, :, None])[:, :, 0] * (1.0 - self._turns)
        zero, (x, y, z) = np.zeros(n), self._axes.T
        skew = np.array(((zero, -z, y), (z, zero, -x), (-y, x, zero))).transpose(2, 0, 1)
        self._by_sine = self._turned @ skew * self._turns[:, :, None]
        self._by_cosine = self._by_sine @ skew
        self._mass, self._centre, self._inertia = bodies.inertias()
        self._down = bodies.up * -GRAVITY
        self._tip = bodies.links[tip]

    @property
    def aside(self) -> tuple[int, ...]:
        """The joints that do not move the tip."""
        body = self._tip[0]
        moves = self._above[body] if body >= 0 else np.zeros(len(self.joints))
        return tuple(i for i, above in enumerate(moves) if not above)

    # -- where it is --------------------------------------------------------------------------------

    def _frames(self, positions: Numbers) -> Place:
        """Return the frames of the moving links: rotations (n×3×3) and origins (n×3)."""
        q = np.asarray(positions, dtype=float)[:, None]
        sine, versine = np.sin(q)[:, :, None], (1.0 - np.cos(q))[:, :, None]
        turned = self._turned + self._by_sine * sine + self._by_cosine * versine  # Rodrigues
        origins = self._origins + self._slides * q
        for i, parent in enumerate(self._parents):
            if parent >= 0:
                origins[i] = origins[parent] + turned[parent] @ origins[i]
                turned[i] = turned[parent] @ turned[i]
        return turned, origins

    def _screws(self, turned: Array, origins: Array) -> tuple[Array, Array]:
        """Return each joint's unit twist about the base's origin: angular and linear part (n×3 each)."""
        axes = (turned @ self._axes[:, :, None])[:, :, 0]
        angular = axes * self._turns
        return angular, _cross(origins, angular) + axes * (1.0 - self._turns)

    def _of_tip(self, turned: Array, origins: Array) -> Place:
        body, (rotation_, origin) = self._tip
        if body < 0:
            return rotation_, origin
        return turned[body] @ rotation_, origins[body] + turned[body] @ origin

    def forward(self, positions: Numbers) -> Place:
        """Return the tip's frame in the base's."""
        return self._of_tip(*self._frames(positions))

    def points(self, positions: Numbers) -> Array:
        """Return the origins [m] of the joints and, last, of the tip: (n + 1)×3."""
        turned, origins = self._frames(positions)
        return np.vstack((origins, self._of_tip(turned, origins)[1]))

    def jacobian(self, positions: Numbers) -> tuple[Place, Array]:
        """Return the tip's frame and its geometric Jacobian (6×n): velocity of the tip's origin, then its
        angular velocity, both along the base's axes."""
        turned, origins = self._frames(positions)
        angular, linear = self._screws(turned, origins)
        tip = self._of_tip(turned, origins)
        moves = self._above[self._tip[0]][:, None] if self._tip[0] >= 0 else np.zeros((len(self.joints), 1))
        both = np.hstack((linear + _cross(angular, tip[1]), angular)) * moves
        return tip, both.T

    # -- what moves it ------------------------------------------------------------------------------

    def gravity(self, positions: Numbers) -> Array:
        """Return the torques [N·m, or N] that hold it at rest."""
        turned, origins = self._frames(positions)
        angular, linear = self._screws(turned, origins)
        centres = origins + (turned @ self._centre[:, :, None])[:, :, 0]
        force = -self._mass * self._down
        return self._against(angular, linear, force, _cross(centres, force))

    def torques(self, positions: Numbers, velocities: Numbers, accelerations: Numbers) -> Array:
        """Return the torques [N·m, or N] of a motion: inverse dynamics."""
        turned, origins = self._frames(positions)
        angular, linear = self._screws(turned, origins)
        above, mass = self._above, self._mass
        rates, changes = np.asarray(velocities)[:, None], np.asarray(accelerations)[:, None]
        w, v = above @ (angular * rates), above @ (linear * rates)
        bent = _cross(w, linear) + _cross(v, angular)  # what a moving screw changes by (Featherstone 2.9)
        dw = above @ (angular * changes + _cross(w, angular) * rates)
        dv = above @ (linear * changes + bent * rates) - self._down
        centres = origins + (turned @ self._centre[:, :, None])[:, :, 0]
        inertia = turned @ self._inertia @ turned.transpose(0, 2, 1)
        push = mass * (dv + _cross(dw, centres))
        momentum = mass * (v + _cross(w, centres))
        spin = (inertia @ w[:, :, None])[:, :, 0] + _cross(centres, momentum)
        moment = (inertia @ dw[:, :, None])[:, :, 0] + _cross(centres, push)
        moment += _cross(w, spin) + _cross(v, momentum)
        return self._against(angular, linear, push + _cross(w, momentum), moment)

    def _against(self, angular: Array, linear: Array, force: Array, moment: Array) -> Array:
        """Return what each joint must give for the forces and moments of all that it carries."""
        carried = self._above.T
        torques: Array = ((carried @ moment) * angular + (carried @ force) * linear).sum(axis=1)
        return torques


class _Bodies:
    """The links below the base, put together where nothing moves between them."""

    def __init__(self, model: UrdfModel, base: str, driven: frozenset[str]) -> None:
        still: Place = np.eye(3), np.zeros(3)
        self.joints: list[UrdfJoint] = []
        self.parents: list[int] = []
        self.places: list[Place] = []
        self.links: dict[str, tuple[int, Place]] = {base: (-1, still)}
        """By name: the moving body that a link is part of, -1 being the base, and its frame there."""
        self._model = model
        down = still[0]
        for joint in model.above(base):
            down = placed(joint.origin)[0] @ down
        self.up: Array = down.T @ np.array((0.0, 0.0, 1.0))
        """In the base's frame."""
        for joint in model.joints.values():
            if joint.parent not in self.links:
                continue
            body, place = self.links[joint.parent]
            at = _after(place, placed(joint.origin))
            if joint.name in driven:
                self.joints.append(joint)
                self.parents.append(body)
                self.places.append(at)
                self.links[joint.child] = len(self.joints) - 1, still
            else:
                self.links[joint.child] = body, _after(at, _locked(joint))

    def inertias(self) -> tuple[Array, Array, Array]:
        """Return masses (n×1), centres of mass (n×3), inertias about these (n×3×3), in the bodies' frames."""
        n = len(self.joints)
        mass, moment, about = np.zeros((n, 1)), np.zeros((n, 3)), np.zeros((n, 3, 3))
        for name, (body, place) in self.links.items():
            link = self._model.links[name]
            if body >= 0 and link.inertial is not None:
                if link.inertial.wrong:
                    raise ValueError(link.inertial.wrong)
                kg, centre, inertia = _mass(link, place)
                mass[body] += kg
                moment[body] += kg * centre
                about[body] += inertia + _displaced(kg, centre)
        centres = moment / np.where(mass > 0.0, mass, 1.0)
        for body in range(n):
            about[body] -= _displaced(mass[body, 0], centres[body])
        return mass, centres, about


def _after(place: Place, inner: Place) -> Place:
    """Return the frame `inner` of the frame `place`."""
    return place[0] @ inner[0], place[1] + place[0] @ inner[1]


def _locked(joint: UrdfJoint) -> Place:
    """Return the motion of a joint that is not driven."""
    low, high = joint.range or (0.0, 0.0)
    at, axis = max(low, min(high, 0.0)), np.array(joint.axis)
    if joint.kind == "prismatic":
        return np.eye(3), axis * at
    x, y, z = joint.axis
    skew = np.array(((0.0, -z, y), (z, 0.0, -x), (-y, x, 0.0)))
    return np.eye(3) + np.sin(at) * skew + (1.0 - np.cos(at)) * skew @ skew, np.zeros(3)


def _mass(link: Link, place: Place) -> tuple[float, Array, Array]:
    """Return mass, centre of mass and inertia about it of a link, in the body's frame."""
    if link.inertial is None:
        raise AssertionError("a link without mass was asked for its mass")
    turned, centre = _after(place, placed(link.inertial.origin))
    xx, xy, xz, yy, yz, zz = link.inertial.inertia
    inertia = np.array(((xx, xy, xz), (xy, yy, yz), (xz, yz, zz)))
    return link.inertial.mass, centre, turned @ inertia @ turned.T


def _displaced(mass: float, centre: Array) -> Array:
    """Return what a mass at a place adds to the inertia about the origin (parallel axes)."""
    added: Array = mass * (centre @ centre * np.eye(3) - np.outer(centre, centre))
    return added


def _check(model: UrdfModel, base: str, tip: str, driven: Sequence[str]) -> None:
    links = (("base", base), ("tip", tip))
    wrong = [(key, f"there is no link {name!r}") for key, name in links if name not in model.links]
    for name in driven:
        joint: Any = model.joints.get(name)
        if joint is None:
            wrong.append(("axes", f"there is no joint {name!r}; there are {', '.join(moving(model))}"))
        elif not joint.moves:
            wrong.append(("axes", f"joint {name!r} is {joint.kind}: it cannot be driven"))
    if not wrong:
        wrong = [
            ("base", f"joint {one.name!r} moves the base link, {base!r}")
            for one in model.above(base)
            if one.moves
        ]
        if base != tip and base not in (one.parent for one in model.above(tip)):
            wrong.append(("tip", f"the tip link, {tip!r}, is not below the base link, {base!r}"))
    if wrong:
        raise Invalid(*wrong)


def at_rest(model: UrdfModel, link: str) -> Place:
    """Return a link's frame in that of the root, with every joint at 0, or at the end of its range."""
    place: Place = np.eye(3), np.zeros(3)
    for joint in model.above(link):
        place = _after(_after(placed(joint.origin), _locked(joint)), place)
    return place


def moving(model: UrdfModel) -> tuple[str, ...]:
    """Return the names of the joints that can be driven."""
    return tuple(name for name, joint in model.joints.items() if joint.moves)
