"""Plant files of robots made of links: a URDF, on a base that is fixed or free."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Annotated, Literal

from brain.bodies.cylinder import Cylinder
from gateway.sim.files import Angle, Inertia, Resistance
from gateway.sim.plant_files import PlantFile
from protocols.bounds import Bounds, Invalid


@dataclass(frozen=True, slots=True)
class JointFigures:
    """What all joints have in common; at the output shaft."""

    damping: Resistance = 0.05
    """N·m·s/rad"""
    friction: Resistance = 0.1
    """N·m, dry"""
    armature: Inertia = 0.01
    """kg·m², rotor and gear, as felt at the output shaft"""


@dataclass(frozen=True, slots=True)
class LinkedJoint:
    """One joint of the URDF that a motor moves."""

    motor: str = ""
    """Its motor in the robot file; "": the one of the joint's name."""
    start: Angle = 0.0
    """rad (m, of a prismatic joint), where it is at time 0"""
    damping: Resistance | None = None
    """N·m·s/rad"""
    friction: Resistance | None = None
    """N·m"""
    armature: Inertia | None = None
    """Of this one, in place of `joint`'s; kg and N·s/m of a prismatic joint."""
    cylinder: Cylinder | None = None
    """What moves it in place of a motor on its axis: then the motor's shaft is the cylinder's length [m]."""


@dataclass(frozen=True, slots=True, kw_only=True)
class LinkedFile(PlantFile):
    """A robot as its URDF has it: links with mass, joints with range and effort, shapes that touch.

    The body's frame is that of the root link."""

    kind: Literal["linked"]
    """Links and joints of a URDF"""
    urdf: str
    """A file's path, or the name of one that ships with the robots."""
    base: Literal["fixed", "free"]
    """Whether the root link is screwed to the floor (or to a table: `height`), or moves."""
    height: Annotated[float, Bounds(0.0, 100.0)] = 0.0
    """m, of the root link's frame above the floor at time 0; one that is free falls to its feet from there"""
    joint: JointFigures = field(default_factory=JointFigures)
    joints: dict[str, LinkedJoint]
    """By the joint's name in the URDF; all other joints turn freely."""

    def __post_init__(self) -> None:
        if not self.joints:
            raise Invalid(("joints", "joints must have at least one"))
        if len(set(self.motors)) < len(self.joints):
            raise Invalid(("joints", "joints: each must have a motor of its own"))

    @property
    def motors(self) -> tuple[str, ...]:
        """The motors that move a joint."""
        return tuple(joint.motor or name for name, joint in self.joints.items())
