"""Plant files: robots as they truly are, as TOML; `gateway.sim.load` reads them.

Rules. A plant file names motors and sensors as the robot file does and knows nothing of how they are driven.
It is the ground truth: the brain has its own parameters and never reads these. It names no kind of body: a
base on wheels is where its wheels are, how they roll and steer, and which motors turn them. All is SI, in the
body's frame (x forward, y left, z up, origin on the floor). Invalid combinations raise Invalid in
`__post_init__`, naming the field.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Annotated, Literal, TypeAlias

from gateway.sim.files import (
    STEP,
    Angle,
    Bias,
    Encoder,
    Fraction,
    Inertia,
    Length,
    Mass,
    Noise,
    Place,
    Rate,
    Resistance,
    ShaftFile,
)
from gateway.vision.detectors import CameraSettings
from protocols.bounds import Bounds, Invalid
from protocols.messages import SECOND

Vector: TypeAlias = tuple[Bias, Bias, Bias]

# -- sensors -------------------------------------------------------------------------------------------


@dataclass(frozen=True, slots=True)
class Lidar:
    """A planar lidar: beams evenly over a full turn, the first at -180 degrees."""

    beams: Annotated[int, Bounds(2, 10_000)] = 360
    """Of a scan"""
    rate_hz: Rate = 10.0
    """Scans per second"""
    range_min: Annotated[float, Bounds(0.0, 1e3)] = 0.1
    """m: nearer, a beam has no reading"""
    range_max: Length = 10.0
    """m: farther, a beam has no reading"""
    noise: Noise = 0.0
    """m, standard deviation of one range"""
    resolution: Noise = 0.0
    """m; 0 is exact"""
    dropout: Fraction = 0.0
    """Fraction of the beams without a reading."""
    sweep: bool = True
    """Whether the beams of a scan are spread evenly over its period, as of a lidar that turns; otherwise all
    are taken at its beginning."""
    clockwise: bool = False
    """Whether it turns clockwise, and hands on its beams as they come, in each time step, as a lidar that
    streams does; otherwise counter-clockwise, and a scan when it is complete."""

    def __post_init__(self) -> None:
        if self.clockwise and not self.sweep:
            raise Invalid(("clockwise", "what hands on its beams as they come has a sweep"))
        if self.range_min >= self.range_max:
            raise Invalid(("range_min", "range_min must be less than range_max"))
        _whole_steps(self.rate_hz)


@dataclass(frozen=True, slots=True)
class InertialUnit:
    """An IMU: noise per sample, constant bias, random walk of the gyro bias."""

    rate_hz: Rate = 200.0
    """Samples per second"""
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


@dataclass(frozen=True, slots=True)
class Receiver:
    """A satellite receiver: where its antenna is, with an error of each fix."""

    rate_hz: Rate = 5.0
    """Fixes per second"""
    latitude: Annotated[float, Bounds(-89.0, 89.0, "degrees")] = 48.0
    longitude: Annotated[float, Bounds(-180.0, 180.0, "degrees")] = 11.0
    altitude: Place = 500.0
    """m: of the place's origin; its x axis points east"""
    noise: Noise = 0.02
    """m, standard deviation to the east, and to the north"""

    def __post_init__(self) -> None:
        _whole_steps(self.rate_hz)


@dataclass(frozen=True, slots=True)
class ShaftEncoder:
    """An encoder on the output shaft of a motor's joint, of which the motor knows nothing."""

    motor: str
    """The NAME of a table [motors.NAME] of the robot file"""
    rate_hz: Rate = 1000.0
    """Readings per second"""

    def __post_init__(self) -> None:
        _whole_steps(self.rate_hz)


@dataclass(frozen=True, slots=True)
class Camera(CameraSettings):
    """A camera without distortion, and what it looks for."""

    rate_hz: Rate = 5.0
    """Pictures per second"""
    noise: Noise = 0.0
    """Grey levels of 255: standard deviation of each pixel's colours"""

    def __post_init__(self) -> None:
        _whole_steps(self.rate_hz)


def _whole_steps(rate_hz: float) -> None:
    if SECOND / rate_hz % STEP:
        text = f"rate_hz must divide the world's {SECOND // STEP} steps a second, not {rate_hz:g}"
        raise Invalid(("rate_hz", text))


@dataclass(frozen=True, slots=True, kw_only=True)
class PlantFile:
    """What every robot has."""

    name: str
    """For reports"""
    encoder: Encoder = field(default_factory=Encoder)
    lidars: dict[str, Lidar] = field(default_factory=dict)
    """By the sensor's name in the robot file, which has its mount; so are the others."""
    imus: dict[str, InertialUnit] = field(default_factory=dict)
    cameras: dict[str, Camera] = field(default_factory=dict)
    receivers: dict[str, Receiver] = field(default_factory=dict)
    shaft_encoders: dict[str, ShaftEncoder] = field(default_factory=dict)
    shaft: ShaftFile = field(default_factory=ShaftFile)
    """For every motor that moves no part of the body and is not in `shafts`: a joint carried by the body, on
    which it has no effect."""
    shafts: dict[str, ShaftFile] = field(default_factory=dict)

    @property
    def motors(self) -> tuple[str, ...]:
        """The motors that move a part of the body."""
        raise NotImplementedError


# -- a base on wheels ----------------------------------------------------------------------------------


@dataclass(frozen=True, slots=True)
class Steer:
    """What turns a wheel about the vertical through its centre; angle 0 is the wheel's `yaw`. Wheels with one
    motor are joined by a linkage, by which their axes meet on the axle at x = 0, as far as a real one
    does."""

    motor: str
    """The NAME of a table [motors.NAME] of the robot file"""
    range: tuple[Angle, Angle] | None = None
    """rad, stops to the right and to the left; None: it turns freely"""
    damping: Resistance = 0.05
    """N·m·s/rad"""
    armature: Inertia = 0.01
    """kg·m², rotor and gear, reflected to the output shaft"""

    def __post_init__(self) -> None:
        if self.range and not self.range[0] < 0.0 < self.range[1]:
            raise Invalid(("range", "range must be below and above 0, where the wheel starts"))


@dataclass(frozen=True, slots=True)
class Wheel:
    """One wheel."""

    motor: str | None = None
    """Name of the motor in the robot file whose joint turns this wheel; forward is positive. Wheels of one
    motor turn together, as those of a track. None: it rolls freely."""
    x: Place = 0.0
    """m, its centre in the robot's frame"""
    y: Place = 0.0
    """m, its centre"""
    yaw: Angle = 0.0
    """rad, the direction in which it rolls"""
    radius_error: Annotated[float, Bounds(-0.1, 0.1)] = 0.0
    """The wheel's true radius, without load, is that of `wheel` × (1 + this): wear, pressure. Its tyre
    sinks into the floor as MuJoCo's contacts do, and rolls less: by 0.1 to 0.4 % on a robot of 5 kg."""
    roller: Annotated[float, Bounds(-1.4, 1.4)] | None = None
    """rad, from the direction in which the wheel rolls to the axis of the roller that is on the floor: 0 of
    an omni wheel, ±45° of a mecanum wheel; None: a plain tyre"""
    steer: Steer | None = None


@dataclass(frozen=True, slots=True)
class WheelFigures:
    """What all wheels of a body have in common."""

    radius: Length = 0.05
    """m"""
    width: Length = 0.02
    """m"""
    mass: Mass = 0.2
    """kg"""
    damping: Resistance = 0.002
    """N·m·s/rad, at the output shaft"""
    armature: Inertia = 0.002
    """kg·m², rotor and gear, reflected to the output shaft"""
    roller_damping: Resistance = 1e-4
    """N·m·s/rad, of a roller's bearing"""


@dataclass(frozen=True, slots=True)
class Caster:
    """A ball that slides on the floor almost without friction."""

    x: Place
    """m, in the robot's frame"""
    y: Place = 0.0
    """m, in the robot's frame"""
    radius: Length = 0.02
    """m"""


@dataclass(frozen=True, slots=True)
class Slip:
    """Creep between tyre and floor: a Gauss-Markov process over the rolled distance, one for each plain tyre.

    That fraction of the rolled distance is lost (or gained). Besides, a wheel spins when its torque exceeds
    its grip, and is dragged sideways where the others force it."""

    sigma: Fraction = 0.0
    """Standard deviation, as a fraction of the rolled distance."""
    length: Length = 0.3
    """m, correlation length (to 1/e) in rolled distance"""


@dataclass(frozen=True, slots=True)
class WheeledBody:
    """A chassis on wheels, and casters if it would tip over without."""

    wheels: dict[str, Wheel]
    size: tuple[Length, Length, Length] = (0.4, 0.2, 0.1)
    """m, of the chassis, a box"""
    x: Place = 0.0
    """m, of its centre in front of the origin"""
    mass: Mass = 5.0
    """kg, in total"""
    height: Length = 0.07
    """m, of the chassis' centre above the floor"""
    wheel: WheelFigures = field(default_factory=WheelFigures)
    casters: dict[str, Caster] = field(default_factory=dict)
    slip: Slip = field(default_factory=Slip)

    def __post_init__(self) -> None:
        if not self.wheels:
            raise Invalid(("wheels", "wheels must have at least one"))
        if self.mass <= len(self.wheels) * self.wheel.mass:
            raise Invalid(("mass", "mass must be more than that of the wheels, which it includes"))
        steering = [wheel.steer.motor for wheel in self.wheels.values() if wheel.steer]
        drives = {wheel.motor for wheel in self.wheels.values() if wheel.motor}
        if drives & set(steering):
            raise Invalid(("wheels", "wheels: a motor that steers one must do nothing else"))
        for motor in set(steering):
            axles = {one.x for one in self.wheels.values() if one.steer and one.steer.motor == motor}
            if len(axles) > 1 or (steering.count(motor) > 1 and axles == {0.0}):
                text = f"wheels: those that {motor} steers by a linkage must be on one axle, not at x = 0"
                raise Invalid(("wheels", text))
        for name, wheel in self.wheels.items():
            if not name.isidentifier():
                raise Invalid(("wheels", f"wheels: {name!r} must be a name of letters, digits and _"))
            if wheel.steer and wheel.roller is not None:
                raise Invalid((f"wheels.{name}.steer", f"wheels: {name} has rollers and cannot be steered"))


@dataclass(frozen=True, slots=True, kw_only=True)
class WheeledFile(PlantFile):
    """A base on wheels."""

    kind: Literal["wheels"]
    """A base on wheels"""
    body: WheeledBody

    @property
    def motors(self) -> tuple[str, ...]:
        """The motors that turn or steer a wheel."""
        wheels = self.body.wheels.values()
        steering = [wheel.steer.motor for wheel in wheels if wheel.steer]
        return tuple(dict.fromkeys([*(wheel.motor for wheel in wheels if wheel.motor), *steering]))
