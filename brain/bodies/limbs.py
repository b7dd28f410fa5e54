"""A body of several limbs, each a body of its own, and what a body can do, as a value.

Rules. A limb is what moves by itself: a base, a linkage, bare joints. Every body has limbs: one that is not
made of others is its own only one, named by its kind. `abilities` says what can be asked of a robot; nobody
asks for a class.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, field, replace
from math import cos, pi, sin
from typing import Annotated, ClassVar

from brain.bodies.body import Base, Body, Linkage, Placement
from protocols.bounds import Bounds, Invalid, check
from protocols.messages import Command


@dataclass(frozen=True, slots=True)
class LimbPlace:
    """Where a limb is mounted, upright, in the robot's frame: m, and rad about the vertical."""

    x: Annotated[float, Bounds(-10.0, 10.0, "m")] = 0.0
    y: Annotated[float, Bounds(-10.0, 10.0, "m")] = 0.0
    z: Annotated[float, Bounds(-10.0, 10.0, "m")] = 0.0
    yaw: Annotated[float, Bounds(-2.0 * pi, 2.0 * pi, "rad")] = 0.0

    def __post_init__(self) -> None:
        check(self)

    def inward(self, place: Placement) -> Placement:
        """Return a place of the robot's frame in that of the limb."""
        c, s = cos(self.yaw), sin(self.yaw)
        x, y = place.x - self.x, place.y - self.y
        attitude = place.attitude
        if attitude is not None:
            roll, pitch, yaw = attitude
            attitude = roll, pitch, yaw - self.yaw
        return Placement(c * x + s * y, c * y - s * x, place.z - self.z, attitude)

    def outward(self, x: float, y: float, z: float) -> tuple[float, float, float]:
        """Return a point of the limb's frame in that of the robot."""
        c, s = cos(self.yaw), sin(self.yaw)
        return self.x + c * x - s * y, self.y + s * x + c * y, self.z + z


@dataclass(frozen=True, slots=True)
class BodyAsLimb:
    """A body as one of a robot's limbs."""

    body: Body
    mounted_on: str = ""
    """The base that carries it; "": it stands where the robot stands"""
    at: LimbPlace = field(default_factory=LimbPlace)


@dataclass(frozen=True, slots=True, kw_only=True)
class Limbs(Body):
    """Several limbs under one brain: at most one base; linkages, bare joints."""

    kind: ClassVar[str] = "limbs"
    limbs: Mapping[str, BodyAsLimb]
    """By name."""

    def __post_init__(self) -> None:
        bases = [name for name, limb in self.limbs.items() if limb.body.as_base is not None]
        if len(bases) > 1:
            raise ValueError(f"a robot has one base at most, not {', '.join(bases)}")
        used: dict[str, str] = {}
        for name, limb in self.limbs.items():
            for motor in limb.body.joints:
                if motor in used:
                    raise Invalid((name, f"{motor!r} is a motor of {used[motor]!r} and of {name!r}"))
                used[motor] = name
            carrier = limb.mounted_on
            if carrier and carrier not in bases:
                there = f"the base is {bases[0]!r}" if bases else "there is no base"
                raise Invalid((f"{name}.mounted_on", f"{name}: mounted_on = {carrier!r} is no base; {there}"))
            if carrier == name:
                raise Invalid((f"{name}.mounted_on", f"{name}: it cannot be mounted on itself"))
            if limb.body.as_base is not None and limb.at != LimbPlace():
                raise Invalid(
                    (f"{name}.at", f"{name}: the robot's frame is that of its base; expected no place")
                )

    @property
    def joints(self) -> tuple[str, ...]:
        """The motors of all limbs."""
        return tuple(motor for limb in self.limbs.values() for motor in limb.body.joints)

    @classmethod
    def motor_keys(cls) -> tuple[str, ...]:
        """Return none: its limbs' tables have them."""
        return ()


def limbs(body: Body) -> Mapping[str, BodyAsLimb]:
    """Return the limbs of a body, by name."""
    return body.limbs if isinstance(body, Limbs) else {body.kind: BodyAsLimb(body)}


def with_limb(body: Body, name: str, limb: Body) -> Body:
    """Return the body with another one as the limb of this name."""
    if not isinstance(body, Limbs):
        return limb
    return Limbs(limbs={**body.limbs, name: replace(body.limbs[name], body=limb)})


@dataclass(frozen=True, slots=True)
class Abilities:
    """What can be asked of a robot."""

    base: Base | None
    """What drives; None if nothing does"""
    arms: Mapping[str, Linkage]
    """What brings a tool to a place, by the limb's name"""
    joints: tuple[str, ...]
    """The motors that take targets of their own: all but a base's"""
    takes: Mapping[str, Collection[type[Command]]] = field(default_factory=dict)
    """What each motor can be commanded, as far as that is known"""

    @property
    def wheels(self) -> tuple[str, ...]:
        """The motors that move the base."""
        return self.base.joints if self.base is not None else ()

    def arm_of(self, motor: str) -> Linkage | None:
        """Return the arm that a motor is part of."""
        return next((arm for arm in self.arms.values() if motor in arm.joints), None)

    def which_arm(self, name: str) -> str:
        """Return why this name is no arm's, or names none where there are several; "" if it is clear."""
        if not self.arms:
            return "there is no arm to bring the tool there"
        if not name and len(self.arms) > 1:
            return f"which arm? expected limb = {' or '.join(repr(one) for one in self.arms)}"
        if name and name not in self.arms:
            return f"there is no arm {name!r}; there {_are(self.arms)}"
        return ""


def _are(names: Mapping[str, object]) -> str:
    return f"{'are' if len(names) > 1 else 'is'} {', '.join(names)}"


def abilities(body: Body, motors: Sequence[str]) -> Abilities:
    """Return what a robot with this body and these motors can do."""
    parts = {name: limb.body for name, limb in limbs(body).items()}
    base = next((one.as_base for one in parts.values() if one.as_base is not None), None)
    arms = {name: one.as_linkage for name, one in parts.items() if one.as_linkage is not None}
    wheels = base.joints if base is not None else ()
    return Abilities(base, arms, tuple(motor for motor in motors if motor not in wheels))
