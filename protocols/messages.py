"""Messages between the brain and the drivers: commands, requests, tasks and events.

Rules of this file. A message is a value, never changed, and nothing else: no method, no default that hides
a missing measurement (`None` means "not measured"). Everything is SI (rad, rad/s, N·m, m, s, kg, V, A,
degrees Celsius) at the *device's* shaft as a driver sees it; `gateway.core.joint` converts between
that shaft and the joint's output shaft. Time is `Nanos`: integer nanoseconds of one clock. No message
holds a value that is not finite. Messages of different types never compare equal.
"""

from __future__ import annotations

from dataclasses import dataclass
from enum import StrEnum
from typing import ClassVar, TypeAlias, TypeVar, dataclass_transform, get_args

Kind = TypeVar("Kind")


@dataclass_transform(frozen_default=True)
def value(kind: type[Kind]) -> type[Kind]:
    """Make a class a value that is never changed.

    The type checker enforces that; a dataclass frozen at run time takes three times as long to create, and
    some ten of these are created for every motor in every step. A copy of it is itself."""
    made = dataclass(slots=True, unsafe_hash=True)(kind)
    setattr(made, "__deepcopy__", _itself)  # noqa: B010 -- for the type checker it has none
    return made


def _itself(value: Kind, _: object) -> Kind:
    return value


Nanos: TypeAlias = int
"""Integer nanoseconds of one clock, whose zero is arbitrary."""

SECOND: Nanos = 1_000_000_000
MILLISECOND: Nanos = 1_000_000


def seconds(span: Nanos) -> float:
    """Return a span of time in seconds, for the few places where a `dt` is formed."""
    return span / SECOND


# -- commands: one per motor and step ------------------------------------------------------------------


@value
class Idle:
    """No torque: the device is disarmed. Sent only to devices that we armed, or when an operator stops."""

    motor: str


@value
class Hold:
    """Hold the position that the shaft has when this command is first given, with feed-forward of torque
    [N·m], where the device takes one, of a load that it carries."""

    motor: str
    torque: float = 0.0


@value
class Position:
    """Move to a position [rad], with feed-forward of velocity [rad/s] and torque [N·m].

    Given once, or again and again: come to rest there. Those that change step by step, with a velocity, are
    samples of a trajectory: each is followed as it is given where the limits allow it."""

    motor: str
    position: float
    velocity: float = 0.0
    torque: float = 0.0


@value
class Velocity:
    """Turn at a velocity [rad/s], with feed-forward of torque [N·m]."""

    motor: str
    velocity: float
    torque: float = 0.0


@value
class Torque:
    """Apply a torque [N·m]. Also what a twin reports to the simulated world as the torque on its shaft."""

    motor: str
    torque: float


@value
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
COMMANDS: tuple[type[Command], ...] = get_args(Command)


# -- requests: rare, made by a person or a tool --------------------------------------------------------


@value
class Stop:
    """Emergency stop, latched until Release: every joint gives its stop action. It is for every motor: a
    driver that gets this request also sends Idle, when commanded, to devices that it did not arm."""

    reason: str = ""


@value
class Release:
    """Release the latched Stop."""


@value
class Leave:
    """The run ends: every joint that was commanded gives its stop action."""

    reason: str = ""
    at_once: bool = False
    """Whether there is no time to brake: Idle in its place."""
    last: bool = False
    """Whether no step follows: motors that are still armed are noted."""


@value
class ClearFault:
    """Clear the latched faults of one motor, on the device and in its joint."""

    motor: str


@value
class Estop:
    """Trigger the device's own emergency stop, where it has one; it stays in fault until ClearFault."""

    motor: str


@value
class Scan:
    """Search a bus for devices, with frames that neither enable nor clear anything."""

    bus: str


@value
class SetId:
    """Give the device with this serial number a new address."""

    bus: str
    serial: int
    address: int


@value
class SetAddress:
    """Give the device of a motor another address, where nothing but the present one tells which it is. Its
    driver does not follow it there: the robot file has to."""

    motor: str
    address: int


@value
class Zero:
    """Make the present position of the shaft the zero position."""

    motor: str


@value
class Home:
    """Run the device's own homing procedure."""

    motor: str


@value
class Confirm:
    """The position that the motor reports is the true one: a person has looked, after it had jumped."""

    motor: str


@value
class ReadParameter:
    """Read a parameter of the device, by the device's name for it."""

    motor: str
    parameter: str


@value
class WriteParameter:
    """Write a parameter of the device, by the device's name for it."""

    motor: str
    parameter: str
    value: float


@value
class Reboot:
    """Restart the device."""

    motor: str


@value
class Set:
    """Set a gain or limit of the gateway while it runs, by its dotted name in the robot file."""

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
    | SetAddress
    | Zero
    | Home
    | Confirm
    | ReadParameter
    | WriteParameter
    | Reboot
    | Set
)


# -- what a device obeys ---------------------------------------------------------------------------------


@value
class Arm:
    """The device is armed by this frame, if it is not armed already. Only ever decoded, never sent."""

    motor: str


@value
class Kept:
    """A device keeps or does something by this frame that is neither a command nor a request: a set-point
    that waits until it is armed, a mode, a message of the vendor's. Only ever decoded, never sent; it is held
    against `Spec.set_up`."""

    motor: str
    name: str
    """Of a number of a command as in `Spec.ranges` ("Velocity.velocity"), of a parameter, or of a message."""
    value: float


Obeyed: TypeAlias = Command | Request | Arm | Kept
"""What a command decoder makes of a frame: if it arms, Arm first, then what the device obeys from then on."""


# -- tasks: what a person wants the brain to do --------------------------------------------------------


@value
class Goal:
    """Drive to a point on the map [m], and there turn to yaw [rad] if one is given."""

    x: float
    y: float
    yaw: float | None = None
    near: bool = False
    """Whether a place as near to it as the robot can get will do, if it cannot get there."""


@value
class Drive:
    """Drive the base by hand with a twist: m/s forward, rad/s to the left, m/s to the left."""

    linear: float
    angular: float
    lateral: float = 0.0


@value
class Locate:
    """Take it that the robot is at this place on the map [m], heading yaw [rad]: who asks has seen it."""

    x: float
    y: float
    yaw: float
    sigma: float = 0.5
    """m: standard deviation of the place, in any direction"""
    sigma_yaw: float = 0.26
    """rad"""


@value
class Grid:
    """Plan on this grid, in place of a map of the robot's own: who sends it perceives for the robot."""

    x: float
    """m: its lower left corner,"""
    y: float
    yaw: float
    """and where its rows point to [rad], in the frame "map","""
    odom: bool
    """or in the frame "odom" """
    resolution: float
    """m per cell"""
    columns: int
    cells: bytes
    """Row by row: 0 not known, 1 free, 2 occupied"""


# -- missions: steps as data; a Goal is a step, too -----------------------------------------------------


@value
class Move:
    """Drive at a speed, straight or on an arc, until one of `seconds` and `distance` is over."""

    linear: float
    """m/s, forward"""
    lateral: float = 0.0
    """m/s, to the left"""
    angular: float = 0.0
    """rad/s, to the left"""
    seconds: float | None = None
    distance: float | None = None
    """m along its path"""


@value
class Turn:
    """Turn by an angle [rad] to the left from the present heading, several times around if it is large."""

    angle: float


@value
class Follow:
    """Drive along points on the map [m], past each but the last, where the robot comes to rest."""

    points: tuple[tuple[float, float], ...]


@value
class Wait:
    """Stand still for a time [s]."""

    seconds: float


@value
class Dock:
    """Stand before a marker that a camera sees, facing it."""

    marker: int
    """Its id"""
    distance: float = 0.5
    """m, from the marker to the robot's origin"""
    lateral: float = 0.0
    """m, of the robot to its left of the marker's normal"""


@value
class Reach:
    """Give joints targets, all at once; they keep them when the step is done."""

    targets: tuple[Command, ...]
    """Of positions: the joints move together and arrive together, and stand there when the step is done."""
    seconds: float = 0.0
    """Time of the motion; of targets other than positions: how long before the step is done"""
    contact: bool = False
    """Whether the step is done when every joint is held up by something, and fails if one is not"""


@value
class MoveTool:
    """Bring the tip of an arm to a place in the robot's frame [m]; an arm alone stands at its origin."""

    x: float
    y: float
    z: float
    attitude: tuple[float, float, float] | None = None
    """Roll, pitch and yaw of the tip [rad], or None for any"""
    seconds: float = 0.0
    """Time of the motion, if the arm needs no more"""
    limb: str = ""
    """Which arm, of a robot with several"""


@value
class Repeat:
    """Do steps several times."""

    times: int
    """0: without an end"""
    steps: tuple[Step, ...]


@value
class Try:
    """Do steps; if one of them fails, leave out the rest of them and do others."""

    steps: tuple[Step, ...]
    otherwise: tuple[Step, ...] = ()


Plain: TypeAlias = "bool | int | float | str | tuple[Plain, ...] | None"
"""What a field of another distribution's skill may hold."""


@value
class Perform:
    """Do what a skill of another distribution does."""

    skill: str
    """Its name"""
    values: tuple[tuple[str, Plain], ...] = ()
    """Of its fields, by name"""


Step: TypeAlias = Goal | Move | Turn | Follow | Wait | Dock | Reach | MoveTool | Repeat | Try | Perform
STEPS: dict[int, type[Step]] = {
    50: Goal,
    56: Move,
    57: Turn,
    58: Follow,
    59: Wait,
    60: Dock,
    61: Reach,
    64: MoveTool,
    62: Repeat,
    63: Try,
    65: Perform,
}
"""By the code with which each is packed (`protocols.message_codec`), in the order in which a person reads of
them. A field that is added to one has a default and stands last: older recordings lack it."""


@value
class Mission:
    """Do steps, one after the other. A step that fails, outside of every Try, ends it."""

    name: str
    steps: tuple[Step, ...]


@value
class Pause:
    """Stand, and keep the mission."""


@value
class Resume:
    """Go on with the mission that was paused, by an operator or by a stop, from the step it was at."""


@value
class Drop:
    """Drop the mission, and every goal."""


Task: TypeAlias = Goal | Drive | Locate | Grid | Mission | Pause | Resume | Drop
Instruction: TypeAlias = Request | Task | Command
"""What may be asked of a running robot from outside; a Command only of a joint that is no wheel of a base."""


# -- events: what drivers report -----------------------------------------------------------------------


class Mode(StrEnum):
    """The state of a device, as its driver knows it."""

    INITIALISING = "initialising"
    READY = "ready"
    ARMED = "armed"
    FAULT = "fault"
    OFFLINE = "offline"


@value
class Feedback:
    """Measurements of a motor at time t; None: not measured in this message."""

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
    """degrees Celsius, the hottest that the device reports"""


@value
class State:
    """The state of a device, when it changes or is reported again."""

    motor: str
    t: Nanos
    mode: Mode
    detail: str = ""
    """The vendor's name for the state."""


@value
class Fault:
    """A fault of the device: one event per bit or code. Latches in the joint until cleared."""

    motor: str
    t: Nanos
    code: int
    name: str
    """The vendor's name for the fault."""
    cause: str = ""
    """The likely cause."""
    remedy: str = ""
    """What to do."""


@value
class Found:
    """A device answered on a bus, whether the robot file knows it or not."""

    t: Nanos
    protocol: str
    address: int
    serial: int | None = None
    detail: str = ""
    """Hardware and firmware, as reported by the device."""
    duplicate_address: bool = False
    """Several devices have this address: their replies collide, and all of them obey."""


@value
class Done:
    """A request was carried out."""

    t: Nanos
    request: str
    """The request's class name."""
    name: str = ""
    """The motor or bus that the request was for."""
    detail: str = ""


@value
class Refused:
    """A request or command was not carried out, and why."""

    t: Nanos
    request: str
    name: str
    reason: str


@value
class Parameter:
    """The value of a device's parameter: the answer to ReadParameter."""

    motor: str
    t: Nanos
    parameter: str
    value: float


@value
class Measurement:
    """What a sensor reports. Each kind of sensor has a class of its own, here or in another's package;
    `protocols.sensors` has what is known of each."""

    noun: ClassVar[str] = "reading"
    """What one is called in a sentence."""
    sensor: str
    t: Nanos


@value
class Imu(Measurement):
    """An inertial measurement in the sensor's own frame."""

    angular_velocity: tuple[float, float, float]
    """rad/s about x, y, z"""
    linear_acceleration: tuple[float, float, float]
    """m/s² along the sensor's axes, gravity included: at rest and level (0, 0, +9.81)"""
    orientation: tuple[float, float, float, float] | None = None
    """Quaternion x, y, z, w from the sensor's frame to the world's, if the sensor estimates it."""


@value
class LaserScan(Measurement):
    """One revolution of a planar lidar in the sensor's own frame; `t` is that of its first beam."""

    noun: ClassVar[str] = "scan"
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
    duration: Nanos = 0
    """From the first beam to the last, which are evenly spaced in time; negative if the last one was measured
    first, as by a lidar that turns clockwise; 0: all at one instant"""


@value
class Fix(Measurement):
    """A position on the earth (WGS 84): degrees, degrees, m, and its horizontal variance in m²."""

    noun: ClassVar[str] = "fix"
    latitude: float
    longitude: float
    altitude: float | None = None
    variance: float | None = None


@value
class PoseReading(Measurement):
    """The robot's pose in the frame "map", measured from outside: motion capture, markers."""

    noun: ClassVar[str] = "pose"
    x: float
    """m"""
    y: float
    yaw: float | None = None
    """rad"""
    variance: float | None = None
    """m², of x and of y"""
    yaw_variance: float | None = None
    """rad²"""


@value
class ShaftReading(Measurement):
    """Where a shaft stands that no motor reports: of a passive wheel, a steering column, a hitch."""

    noun: ClassVar[str] = "angle"
    position: float
    """rad; an absolute encoder begins anew at the end of its range"""


@value
class Marker(Measurement):
    """A marker (a tag, or a target of a known size) in an image of a camera, in the sensor's own frame: x
    along the optical axis, y to the left, z up. An image without any is reported as one without a number; `t`
    is that of the image."""

    noun: ClassVar[str] = "image"
    marker: int | None
    """Number of the marker; None: the image shows none"""
    position: tuple[float, float, float] | None = None
    """m, of its centre"""
    orientation: tuple[float, float, float, float] | None = None
    """Quaternion x, y, z, w from the marker's frame (x out of its face, z up) to the sensor's; None:
    not known, as of a ball"""
    variance: tuple[float, float] | None = None
    """m², of the centre: along the line of sight, and across it"""
    turn_variance: float | None = None
    """rad², of the orientation"""


Event: TypeAlias = Feedback | State | Fault | Found | Done | Refused | Parameter | Measurement
Message: TypeAlias = Obeyed | Task | Step | Event
