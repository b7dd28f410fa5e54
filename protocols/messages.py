"""The words: what a brain may say to a body, and what a body may answer.

Rules of this file. A word is a frozen value and nothing else: no method, no default that hides a
missing measurement (`None` says "not measured"). Everything is SI (rad, rad/s, N·m, m, s, kg, V, A,
degrees Celsius) at the *device's* shaft as a driver sees it; `gateway.core.joint` moves words between
that shaft and the joint's output shaft. Time is `Nanos`: integer nanoseconds of one clock. No word
holds a value that is not finite. Words of different kinds never compare equal.
"""

from __future__ import annotations

from dataclasses import dataclass
from enum import StrEnum
from typing import TypeAlias

Nanos: TypeAlias = int
"""Integer nanoseconds of one clock, whose zero is arbitrary."""

SECOND: Nanos = 1_000_000_000
MILLISECOND: Nanos = 1_000_000


def seconds(span: Nanos) -> float:
    """A span of time in seconds, for the few places where a `dt` is formed."""
    return span / SECOND


# -- commands: one per motor and step ----------------------------------------------------------


@dataclass(frozen=True, slots=True)
class Idle:
    """No torque: the device is disarmed. Goes out only to what we armed, or when an operator stops."""

    motor: str


@dataclass(frozen=True, slots=True)
class Hold:
    """Stay where the shaft is measured to be at the moment this word is first said."""

    motor: str


@dataclass(frozen=True, slots=True)
class Position:
    """Go to a position [rad], with feed-forward of velocity [rad/s] and torque [N·m]."""

    motor: str
    position: float
    velocity: float = 0.0
    torque: float = 0.0


@dataclass(frozen=True, slots=True)
class Velocity:
    """Turn at a velocity [rad/s], with feed-forward of torque [N·m]."""

    motor: str
    velocity: float
    torque: float = 0.0


@dataclass(frozen=True, slots=True)
class Torque:
    """Give a torque [N·m]. Also what a twin tells the world that its shaft feels."""

    motor: str
    torque: float


@dataclass(frozen=True, slots=True)
class Impedance:
    """A spring and damper around a set-point: torque + stiffness·Δposition + damping·Δvelocity."""

    motor: str
    position: float
    velocity: float
    torque: float
    stiffness: float
    """N·m/rad"""
    damping: float
    """N·m·s/rad"""


Command: TypeAlias = Idle | Hold | Position | Velocity | Torque | Impedance
COMMANDS: tuple[type[Command], ...] = (Idle, Hold, Position, Velocity, Torque, Impedance)


# -- requests: rare, asked by a person or a tool -----------------------------------------------


@dataclass(frozen=True, slots=True)
class Stop:
    """Latch above every joint: each says its safe word until Release. An operator's stop is for every
    motor: a driver that hears this word says Idle, when told to, also to devices that it did not arm."""

    reason: str = ""


@dataclass(frozen=True, slots=True)
class Release:
    """Take back Stop."""


@dataclass(frozen=True, slots=True)
class Leave:
    """The run ends: every joint that we commanded says its safe word."""

    reason: str = ""


@dataclass(frozen=True, slots=True)
class ClearFault:
    """Clear the latched faults of one motor, on the device and in its joint."""

    motor: str


@dataclass(frozen=True, slots=True)
class Estop:
    """The device's own emergency stop, where it has one; it stays in fault until ClearFault."""

    motor: str


@dataclass(frozen=True, slots=True)
class Scan:
    """Look for devices on a bus, with frames that neither enable nor clear anything."""

    bus: str


@dataclass(frozen=True, slots=True)
class SetId:
    """Give the device with this serial number a new address."""

    bus: str
    serial: int
    address: int


@dataclass(frozen=True, slots=True)
class Zero:
    """Call the present position of the shaft zero."""

    motor: str


@dataclass(frozen=True, slots=True)
class Home:
    """Run the device's own homing procedure."""

    motor: str


@dataclass(frozen=True, slots=True)
class ReadParameter:
    """Read a parameter of the device by its own name."""

    motor: str
    parameter: str


@dataclass(frozen=True, slots=True)
class WriteParameter:
    """Write a parameter of the device by its own name."""

    motor: str
    parameter: str
    value: float


@dataclass(frozen=True, slots=True)
class Reboot:
    """Restart the device."""

    motor: str


@dataclass(frozen=True, slots=True)
class Set:
    """Set a gain or limit of ours while running, by its dotted name in the robot file."""

    key: str
    value: float


Request: TypeAlias = (
    Stop
    | Release
    | Leave
    | ClearFault
    | Estop
    | Scan
    | SetId
    | Zero
    | Home
    | ReadParameter
    | WriteParameter
    | Reboot
    | Set
)


# -- tasks: what a person wants of the brain ---------------------------------------------------


@dataclass(frozen=True, slots=True)
class Goal:
    """Go to a place on the map [m], and there turn to yaw [rad] if one is given."""

    x: float
    y: float
    yaw: float | None = None


@dataclass(frozen=True, slots=True)
class Drive:
    """Drive the base by hand with a twist: linear [m/s] forward, angular [rad/s] to the left."""

    linear: float
    angular: float


Task: TypeAlias = Goal | Drive
Instruction: TypeAlias = Request | Task | Command
"""Whatever may be asked from outside while the robot runs. A Command is asked of bare joints."""


# -- events: what the body answers -------------------------------------------------------------


class Mode(StrEnum):
    """The state of a device, as its driver knows it."""

    INITIALISING = "initialising"
    READY = "ready"
    ARMED = "armed"
    FAULT = "fault"
    OFFLINE = "offline"


@dataclass(frozen=True, slots=True)
class Feedback:
    """What a motor measured at time t; None is "not measured in this message"."""

    motor: str
    t: Nanos
    position: float | None = None
    """rad"""
    velocity: float | None = None
    """rad/s"""
    torque: float | None = None
    """N·m"""
    current: float | None = None
    """A, torque-producing"""
    voltage: float | None = None
    """V, of the supply"""
    temperature: float | None = None
    """degrees Celsius, the hottest that the device tells"""


@dataclass(frozen=True, slots=True)
class State:
    """The device changed its state, or tells it again."""

    motor: str
    t: Nanos
    mode: Mode
    detail: str = ""
    """The vendor's own word for the state."""


@dataclass(frozen=True, slots=True)
class Fault:
    """The device complains: one event per bit or code. Latches in the joint until cleared."""

    motor: str
    t: Nanos
    code: int
    name: str
    """In the vendor's words."""
    cause: str = ""
    """The likely cause."""
    remedy: str = ""
    """What to do."""


@dataclass(frozen=True, slots=True)
class Found:
    """A device answered on a bus, whether the robot file knows it or not."""

    t: Nanos
    protocol: str
    address: int
    serial: int | None = None
    detail: str = ""
    """Hardware and firmware as the device tells them."""
    duplicate_address: bool = False
    """More than one device holds this address: they answer over each other, and obey together."""


@dataclass(frozen=True, slots=True)
class Done:
    """A request was carried out."""

    t: Nanos
    request: str
    """The request's class name."""
    name: str = ""
    """The motor or bus it was about."""
    detail: str = ""


@dataclass(frozen=True, slots=True)
class Refused:
    """A request was not carried out, and why."""

    t: Nanos
    request: str
    name: str
    reason: str


@dataclass(frozen=True, slots=True)
class Parameter:
    """The value of a device's parameter, asked for by ReadParameter."""

    motor: str
    t: Nanos
    parameter: str
    value: float


@dataclass(frozen=True, slots=True)
class Imu:
    """An inertial measurement in the sensor's own frame."""

    sensor: str
    t: Nanos
    angular_velocity: tuple[float, float, float]
    """rad/s about x, y, z"""
    linear_acceleration: tuple[float, float, float]
    """m/s² along x, y, z, gravity included (at rest, level: +9.81 along z)"""
    orientation: tuple[float, float, float, float] | None = None
    """Quaternion x, y, z, w from the sensor's frame to the world's, if the sensor tells it."""


@dataclass(frozen=True, slots=True)
class LaserScan:
    """One turn of a planar lidar in the sensor's own frame."""

    sensor: str
    t: Nanos
    """When the scan was taken (a whole scan has one time)."""
    angle_min: float
    """rad, of the first beam; beams go counter-clockwise"""
    angle_increment: float
    """rad"""
    range_min: float
    """m; a smaller range means that the beam gave no reading"""
    range_max: float
    """m; a range at or above it means that nothing was hit up to there"""
    ranges: tuple[float, ...]
    """m, one per beam, finite"""


@dataclass(frozen=True, slots=True)
class Fix:
    """A position on the earth (WGS 84): degrees, degrees, m, and its horizontal variance in m²."""

    sensor: str
    t: Nanos
    latitude: float
    longitude: float
    altitude: float | None = None
    variance: float | None = None


Event: TypeAlias = Feedback | State | Fault | Found | Done | Refused | Parameter | Imu | LaserScan | Fix
Message: TypeAlias = Command | Request | Task | Event
