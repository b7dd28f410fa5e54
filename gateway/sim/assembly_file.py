"""Plant files of robots that are made of others: a base with arms on it, or arms that stand on the floor.

Rules. A part is a plant of its own, placed in the frame of the base (without one, of the start). `prefix`
goes before the names that its plant has for its motors, so that two equal parts differ in the robot file. The
sensors are those of the base, and the assembly's own. `fixtures/plants/mobile_arm.toml` is one.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Annotated, Literal, TypeAlias

from gateway.sim.files import Angle
from gateway.sim.linked_file import LinkedFile
from gateway.sim.plant_files import PlantFile, WheeledFile
from protocols.bounds import Bounds, Invalid

Near: TypeAlias = Annotated[float, Bounds(-10.0, 10.0)]


@dataclass(frozen=True, slots=True)
class At:
    """Where a part stands, upright: m, rad."""

    x: Near = 0.0
    """m"""
    y: Near = 0.0
    """m"""
    z: Near = 0.0
    """m"""
    yaw: Angle = 0.0
    """rad"""


@dataclass(frozen=True, slots=True)
class PartFile:
    """One part."""

    plant: str
    """A file's path, or the name of one that ships."""
    at: At = field(default_factory=At)
    prefix: str = ""
    """Of the names of its motors in the robot file."""


@dataclass(frozen=True, slots=True, kw_only=True)
class AssemblyFile(PlantFile):
    """A robot as its file has it: its parts are named."""

    kind: Literal["assembly"]
    """Several plants that are one robot"""
    parts: dict[str, PartFile]

    def __post_init__(self) -> None:
        if not self.parts:
            raise Invalid(("parts", "parts must have at least one"))
        if wrong := next((name for name in self.parts if not name.isidentifier()), ""):
            raise Invalid(("parts", f"parts: {wrong!r} must be a name of letters, digits and _"))

    @property
    def motors(self) -> tuple[str, ...]:
        """None before its parts are read."""
        return ()


@dataclass(frozen=True, slots=True)
class AssemblyPart:
    """A robot of links, where it stands."""

    name: str
    plant: LinkedFile
    at: At = field(default_factory=At)
    prefix: str = ""

    def named(self, name: str) -> str:
        """Return the name in the model of what its URDF calls so; a robot of its own keeps its names."""
        return f"{self.name}/{name}" if self.name else name

    @property
    def motors(self) -> tuple[str, ...]:
        """The motors that move its joints, in the order of the plant's."""
        return tuple(self.prefix + motor for motor in self.plant.motors)


@dataclass(frozen=True, slots=True, kw_only=True)
class Assembly(PlantFile):
    """A robot with its parts read: a base on wheels, if there is one, and what stands on it."""

    base: WheeledFile | None
    parts: tuple[AssemblyPart, ...]

    def __post_init__(self) -> None:
        motors = self.motors
        if twice := sorted({motor for motor in motors if motors.count(motor) > 1}):
            raise ValueError(
                f"parts: {', '.join(twice)} would move two joints; a part's `prefix` tells them apart"
            )

    @property
    def motors(self) -> tuple[str, ...]:
        """The motors that move a part of the body."""
        wheels = self.base.motors if self.base is not None else ()
        return (*wheels, *(motor for part in self.parts for motor in part.motors))
