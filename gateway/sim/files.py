"""World files: the simulated world behind the twins, as TOML; `gateway.sim.load` reads them.

Rules. A world file names motors and sensors as the robot file does and knows nothing of how they are driven.
It is the ground truth: the brain has its own parameters and never reads these. All is SI, in the world's
frame (z up, the floor at z = 0) or the body's (x forward, y left, z up, origin on the floor below the middle
of the axle). Invalid combinations raise ValueError in `__post_init__`, naming the field.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import Annotated, Literal, TypeAlias

from gateway.core.bounds import Bounds
from protocols.messages import MILLISECOND, SECOND, Nanos

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
Rate: TypeAlias = Annotated[float, Bounds(0.1, 1000.0)]
Point: TypeAlias = tuple[Place, Place]
Vector: TypeAlias = tuple[Bias, Bias, Bias]


@dataclass(frozen=True, slots=True)
class Encoder:
    """The encoder on the device's own shaft, before the gear."""

    counts_per_turn: Annotated[int, Bounds(1, 2**31)] = 16384


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

    def __post_init__(self) -> None:
        if self.stops and not self.stops[0] < 0.0 < self.stops[1]:
            raise ValueError("stops must be below and above 0, where the shaft starts")


@dataclass(frozen=True, slots=True)
class BenchFile:
    """Motors clamped to a bench: every motor of the robot file has a shaft. Needs no MuJoCo."""

    kind: Literal["bench"] = "bench"
    name: str = "bench"
    encoder: Encoder = field(default_factory=Encoder)
    shaft: ShaftFile = field(default_factory=ShaftFile)
    """For every motor not in `shafts`."""
    shafts: dict[str, ShaftFile] = field(default_factory=dict)


# -- scene: a base with two wheels among walls ---------------------------------------------------------


@dataclass(frozen=True, slots=True)
class Start:
    """Pose of the body at time 0: m, m, rad."""

    x: Place = 0.0
    y: Place = 0.0
    yaw: Angle = 0.0


@dataclass(frozen=True, slots=True)
class Wall:
    """A straight wall between two points of its centre line."""

    start: Point
    end: Point
    thickness: Length = 0.1
    height: Length = 0.5

    def __post_init__(self) -> None:
        if math.dist(self.start, self.end) < self.thickness:
            raise ValueError("end must be farther from start than the wall is thick")


@dataclass(frozen=True, slots=True)
class Box:
    """A box on the floor; size is its length along x, y and z before it is turned by yaw."""

    x: Place
    y: Place
    size: tuple[Length, Length, Length]
    yaw: Angle = 0.0


@dataclass(frozen=True, slots=True)
class Wheel:
    """One driven wheel."""

    motor: str
    """Name of the motor in the robot file whose joint turns this wheel; forward is positive."""
    radius_error: Annotated[float, Bounds(-0.1, 0.1)] = 0.0
    """The wheel's true radius is wheel_radius × (1 + this): wear, pressure, load."""


@dataclass(frozen=True, slots=True)
class Slip:
    """Creep between tyre and floor: a Gauss-Markov process over the rolled distance, one for each wheel.

    That fraction of the rolled distance is lost (or gained). Besides, a wheel spins when its torque exceeds
    its grip."""

    sigma: Fraction = 0.0
    """Standard deviation, as a fraction of the rolled distance."""
    length: Length = 0.3
    """m, correlation length (to 1/e) in rolled distance"""


@dataclass(frozen=True, slots=True)
class Body:
    """A differential base: chassis, two wheels on one axle, low-friction casters at front and rear."""

    left: Wheel
    right: Wheel
    size: tuple[Length, Length, Length] = (0.4, 0.2, 0.1)
    mass: Mass = 5.0
    """kg, in total"""
    height: Length = 0.07
    """m, of the chassis' centre above the floor"""
    wheel_radius: Length = 0.05
    wheel_separation: Length = 0.22
    wheel_width: Length = 0.02
    wheel_mass: Mass = 0.2
    damping: Resistance = 0.002
    """N·m·s/rad, at the output shaft"""
    armature: Inertia = 0.002
    """kg·m², rotor and gear, reflected to the output shaft"""
    caster_offset: Length = 0.16
    """m, in front of and behind the axle"""
    caster_radius: Length = 0.02
    slip: Slip = field(default_factory=Slip)

    def __post_init__(self) -> None:
        if self.mass <= 2.0 * self.wheel_mass:
            raise ValueError("mass must be more than that of the two wheels, which it includes")
        if self.left.motor == self.right.motor:
            raise ValueError("right must be another motor than left")


@dataclass(frozen=True, slots=True)
class Lidar:
    """A planar lidar: beams evenly over a full turn, the first at -180 degrees, counter-clockwise."""

    beams: Annotated[int, Bounds(2, 10_000)] = 360
    rate_hz: Rate = 10.0
    range_min: Annotated[float, Bounds(0.0, 1e3)] = 0.1
    range_max: Length = 10.0
    noise: Noise = 0.0
    """m, standard deviation of one range"""
    resolution: Noise = 0.0
    """m; 0 is exact"""
    dropout: Fraction = 0.0
    """Fraction of the beams without a reading."""
    sweep: bool = True
    """Whether the beams of a scan are spread evenly over its period, as of a lidar that turns; otherwise all
    are taken at its beginning."""

    def __post_init__(self) -> None:
        if self.range_min >= self.range_max:
            raise ValueError("range_min must be less than range_max")
        _whole_steps(self.rate_hz)


@dataclass(frozen=True, slots=True)
class InertialUnit:
    """An IMU: noise per sample, constant bias, random walk of the gyro bias."""

    rate_hz: Rate = 200.0
    gyro_noise: Noise = 0.0
    """rad/s, standard deviation of one sample"""
    gyro_bias: Vector = (0.0, 0.0, 0.0)
    """rad/s"""
    gyro_walk: Noise = 0.0
    """rad/s per √s, random walk of the bias"""
    accel_noise: Noise = 0.0
    """m/s², standard deviation of one sample"""
    accel_bias: Vector = (0.0, 0.0, 0.0)
    """m/s²"""

    def __post_init__(self) -> None:
        _whole_steps(self.rate_hz)


def _whole_steps(rate_hz: float) -> None:
    if SECOND / rate_hz % STEP:
        raise ValueError(f"rate_hz must divide the world's {SECOND // STEP} steps a second, not {rate_hz:g}")


@dataclass(frozen=True, slots=True)
class SceneFile:
    """A base with two wheels on a floor with walls and boxes. Needs MuJoCo (the extra `sim`)."""

    kind: Literal["scene"]
    name: str
    body: Body
    start: Start = field(default_factory=Start)
    friction: Annotated[float, Bounds(0.01, 10.0)] = 1.0
    """Coefficient, of the wheels on the floor, and of walls, boxes and chassis."""
    encoder: Encoder = field(default_factory=Encoder)
    lidars: dict[str, Lidar] = field(default_factory=dict)
    """By the sensor's name in the robot file, which has its mount; so are `imus`."""
    imus: dict[str, InertialUnit] = field(default_factory=dict)
    shaft: ShaftFile = field(default_factory=ShaftFile)
    """For every motor that turns no wheel and is not in `shafts`: a joint carried by the base, on which it
    has no effect."""
    shafts: dict[str, ShaftFile] = field(default_factory=dict)
    walls: dict[str, Wall] = field(default_factory=dict)
    boxes: dict[str, Box] = field(default_factory=dict)
    tour: tuple[Point, ...] = ()
    """m, goals for a demo, relative to where the robot starts"""


WorldFile: TypeAlias = SceneFile | BenchFile
