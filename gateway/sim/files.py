"""World files: the place behind the twins, as TOML; `gateway.sim.load` reads them.

Rules. A world is a bench with bare shafts, or a scene: a floor with walls, boxes and people, the same for
every robot, whose own truth is a plant file (`gateway.sim.plant_files`). All is SI, in the world's frame (z
up, the floor at z = 0). Invalid combinations raise Invalid in `__post_init__`, naming the field.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from itertools import pairwise
from typing import Annotated, Literal, TypeAlias

from protocols.bounds import Bounds, Invalid
from protocols.messages import MILLISECOND, Nanos

STEP: Nanos = MILLISECOND
"""Time step of every world: the wheels' contacts were tested with it, and it is short for a motor's loops."""

Fraction: TypeAlias = Annotated[float, Bounds(0.0, 0.9)]
Length: TypeAlias = Annotated[float, Bounds(1e-3, 1e3)]
Mass: TypeAlias = Annotated[float, Bounds(1e-3, 1e4)]
Inertia: TypeAlias = Annotated[float, Bounds(1e-7, 1e3)]
Torque: TypeAlias = Annotated[float, Bounds(-1e4, 1e4)]
Resistance: TypeAlias = Annotated[float, Bounds(0.0, 1e3)]
"""Of friction and damping"""
Place: TypeAlias = Annotated[float, Bounds(-1e3, 1e3)]
Angle: TypeAlias = Annotated[float, Bounds(-1e3, 1e3)]
Noise: TypeAlias = Annotated[float, Bounds(0.0, 10.0)]
Bias: TypeAlias = Annotated[float, Bounds(-10.0, 10.0)]
Seconds: TypeAlias = Annotated[float, Bounds(0.0, 1e5)]
Rate: TypeAlias = Annotated[float, Bounds(0.1, 1000.0)]
Point: TypeAlias = tuple[Place, Place]
Share: TypeAlias = Annotated[float, Bounds(0.0, 1.0)]
Vector: TypeAlias = tuple[Bias, Bias, Bias]


@dataclass(frozen=True, slots=True)
class Encoder:
    """The encoder on the device's own shaft, before the gear."""

    counts_per_turn: Annotated[int, Bounds(1, 2**31)] = 16384
    """Of the motor's shaft"""


# -- bench: bare shafts --------------------------------------------------------------------------------


@dataclass(frozen=True, slots=True)
class ShaftFile:
    """One joint's output shaft and its load."""

    inertia: Inertia = 0.006
    """kg·m², with the rotor's times gear²"""
    damping: Resistance = 0.002
    """N·m·s/rad"""
    friction: Resistance = 0.02
    """N·m, dry; holds a shaft at rest against any smaller torque"""
    load: Torque = 0.0
    """N·m, constant, as of a hanging weight; positive drives the shaft forward"""
    stops: tuple[Angle, Angle] | None = None
    """rad, hard stops below and above; the shaft starts at 0"""
    backlash: Annotated[float, Bounds(0.0, 1.0, "rad")] = 0.0
    """Of the gear: so far the motor turns at a reversal before it takes its load along"""
    rotor: Annotated[float, Bounds(0.01, 0.99)] = 0.2
    """Share of inertia, damping and friction on the motor's side of the backlash; the load itself is beyond
    it"""

    def __post_init__(self) -> None:
        if self.backlash and self.stops:
            raise Invalid(
                (
                    "backlash",
                    "backlash and stops exclude each other: where the load is at a stop is not known",
                )
            )
        if self.stops and not self.stops[0] < 0.0 < self.stops[1]:
            raise Invalid(("stops", "stops must be below and above 0, where the shaft starts"))


@dataclass(frozen=True, slots=True)
class BenchFile:
    """Motors clamped to a bench: every motor of the robot file has a shaft. Needs no MuJoCo."""

    kind: Literal["bench"] = "bench"
    """Bare shafts, no place"""
    name: str = "bench"
    """For reports"""
    encoder: Encoder = field(default_factory=Encoder)
    shaft: ShaftFile = field(default_factory=ShaftFile)
    """For every motor not in `shafts`."""
    shafts: dict[str, ShaftFile] = field(default_factory=dict)


# -- scene: a place ---------------------------------------------------------------------------------


@dataclass(frozen=True, slots=True)
class Start:
    """Pose of the body at time 0: m, m, rad."""

    x: Place = 0.0
    """m, in the world"""
    y: Place = 0.0
    """m, in the world"""
    yaw: Angle = 0.0
    """rad"""


@dataclass(frozen=True, slots=True)
class Wall:
    """A straight wall between two points of its centre line."""

    start: Point
    """m, the middle of one end"""
    end: Point
    """m, the middle of the other"""
    thickness: Length = 0.1
    """m"""
    height: Length = 0.5
    """m"""
    appears: Seconds = 0.0
    """s after the world began, when it is suddenly there"""

    def __post_init__(self) -> None:
        if math.dist(self.start, self.end) < self.thickness:
            raise Invalid(("end", "end must be farther from start than the wall is thick"))


@dataclass(frozen=True, slots=True)
class Box:
    """A box; size is its length along x, y and z before it is turned by yaw."""

    x: Place
    """m, its middle"""
    y: Place
    """m, its middle"""
    size: tuple[Length, Length, Length]
    """m: length, width, height"""
    yaw: Angle = 0.0
    """rad"""
    z: Annotated[float, Bounds(0.0, 100.0)] = 0.0
    """m, of its lower side above the floor"""
    mass: Mass | None = None
    """kg, of one that can be pushed and lifted; None: it is fixed"""


@dataclass(frozen=True, slots=True)
class Person:
    """Somebody who walks along a path and back again, for ever: an upright cylinder.

    People push nothing and are not pushed: that the robot touches one is counted."""

    path: tuple[Point, ...]
    """m, from the first point straight to the next; one point: stands there"""
    speed: Annotated[float, Bounds(0.01, 5.0)] = 0.8
    """m/s"""
    start: Seconds = 0.0
    """s, when the walk begins"""
    pause: Seconds = 0.0
    """s, standing at each end of the path"""
    radius: Annotated[float, Bounds(0.05, 1.0)] = 0.2
    """m"""
    height: Length = 1.7
    """m"""

    def __post_init__(self) -> None:
        if not self.path or any(a == b for a, b in pairwise(self.path)):
            raise Invalid(("path", "path must have a point, and no point twice in succession"))

    def place(self, t: float) -> Point:
        """Return where the person is t [s] after the world began."""
        ways = [math.dist(a, b) for a, b in pairwise(self.path)]
        length = sum(ways)
        walk = length / self.speed + self.pause
        if t <= self.start or not ways:
            return self.path[0]
        back, since = divmod(t - self.start, walk)
        done = min((since * self.speed), length)
        along = length - done if back % 2 else done
        for (ax, ay), (bx, by), way in zip(self.path, self.path[1:], ways, strict=False):
            if along <= way:
                share = along / way
                return ax + share * (bx - ax), ay + share * (by - ay)
            along -= way
        return self.path[-1]


@dataclass(frozen=True, slots=True)
class Tag:
    """An AprilTag of the family 36h11 that stands upright, on a plate with a white margin of one cell."""

    marker: Annotated[int, Bounds(0, 586)]
    """Its number in the family"""
    x: Place
    """m, of its centre"""
    y: Place
    """m, its middle"""
    z: Place
    """m above the floor"""
    yaw: Angle
    """rad: where its face looks to"""
    size: Annotated[float, Bounds(0.01, 5.0, "m")] = 0.16
    """Outer edge of its black border"""


@dataclass(frozen=True, slots=True)
class Ball:
    """A ball of one colour."""

    x: Place
    """m, of its centre"""
    y: Place
    """m, its middle"""
    z: Place
    """m above the floor"""
    diameter: Annotated[float, Bounds(0.01, 5.0, "m")] = 0.1
    colour: tuple[Share, Share, Share] = (0.9, 0.1, 0.1)
    """Red, green, blue"""


@dataclass(frozen=True, slots=True)
class SceneFile:
    """A floor with walls, boxes and people. Needs MuJoCo (the extra `sim`)."""

    kind: Literal["scene"]
    """A place with a floor"""
    name: str
    """For reports"""
    start: Start = field(default_factory=Start)
    friction: Annotated[float, Bounds(0.01, 10.0)] = 1.0
    """Coefficient, of all that touches"""
    walls: dict[str, Wall] = field(default_factory=dict)
    boxes: dict[str, Box] = field(default_factory=dict)
    people: dict[str, Person] = field(default_factory=dict)
    tags: dict[str, Tag] = field(default_factory=dict)
    """For cameras; so are `balls`."""
    balls: dict[str, Ball] = field(default_factory=dict)
    tour: tuple[Point, ...] = ()
    """m, goals for a demo, relative to where the robot starts"""
    mission: str = ""
    """A mission for a demo instead: a shipped one's name or a file's path"""


WorldFile: TypeAlias = SceneFile | BenchFile
