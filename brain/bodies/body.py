"""What the brain knows of a body: `Body`, and `Base` for those that move in the plane.

Rules. A body is a frozen dataclass: its table in the robot file, below [brain], whose name is `kind`. It is a
description and pure functions: no state, no sensor, no clock. The brain asks it and never its class; a new
body is one file with one subclass, found by its entry point (group "motor_gateway.bodies").

Joints are named by their motors; `Body.joints` is their order everywhere; angles and speeds are at the
joints' output shafts. Motion between two sets of joint positions is taken as one constant twist, integrated
in closed form (`plane.arc`), never by Euler steps.
"""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Annotated, Any, ClassVar, NamedTuple, Protocol, TypeAlias

from brain.bodies.parts import Part, Wheel, of_base
from brain.bodies.plane import Twist
from protocols import messages as msg
from protocols.bounds import Bounds, Invalid, check
from protocols.messages import Command

CIRCLE, MOST_CORNERS = 16, 32
"""Corners of a circle's outline, and the most of a footprint."""
Corners: TypeAlias = tuple[tuple[float, float], ...]


class Setpoint(NamedTuple):
    """Where one joint should be, or how fast it should turn: exactly one of the two, in rad or rad/s."""

    velocity: float | None = None
    position: float | None = None


class Travel(NamedTuple):
    """Motion of a base between two sets of joint positions: a constant twist over unit time."""

    distance: float
    """m forward, in the moving frame,"""
    turn: float
    """rad to the left,"""
    sideways: float
    """m to the left"""
    by_distance: tuple[float, ...]
    """Derivative of `distance` by each joint's later position [m/rad],"""
    by_turn: tuple[float, ...]
    """of `turn` [rad/rad],"""
    by_sideways: tuple[float, ...]
    """and of `sideways`: with the joints' noise they give the covariance of the motion."""


class Placement(NamedTuple):
    """Where the tip of a linkage shall be, in the frame of its base: m, and roll, pitch, yaw [rad]."""

    x: float
    y: float
    z: float
    attitude: tuple[float, float, float] | None = None
    """None: any"""


class Search(Protocol):
    """A search in counted parts. Plain data."""

    done: bool
    found: tuple[float, ...] | None
    why: str
    """Why nothing was found."""

    def advance(self, iterations: int) -> bool:
        """Do some of the work; return whether it is done."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Body(ABC):
    """Any body."""

    kind: ClassVar[str] = ""
    """Its name in the robot file, and of its entry point."""
    bare: ClassVar[bool] = False
    """Whether it is independent motors, without any geometry."""

    @property
    @abstractmethod
    def joints(self) -> tuple[str, ...]:
        """The names of the motors that are parts of it."""

    @property
    def as_base(self) -> Base | None:
        """Itself, if it moves in the plane."""
        return None

    @property
    def as_linkage(self) -> Linkage | None:
        """Itself, if its joints carry one another."""
        return None

    @classmethod
    @abstractmethod
    def motor_keys(cls) -> tuple[str, ...]:
        """Return the keys of its table whose values are names of motors, or lists of them."""

    @classmethod
    def from_urdf(cls, text: str, joints: Mapping[str, str], table: Mapping[str, Any]) -> dict[str, Any]:
        """Return what the text of a URDF says of keys of its table. `joints`: what each motor moves in it;
        `table`: as it is in the robot file. Raises ValueError if it cannot be this body."""
        return {}

    def parts(self) -> list[Part]:
        """Return what it looks like by its own dimensions, in its own frame; []: it has none."""
        return []

    def check_motors(self) -> None:
        """Raise Invalid unless every motor has a name and appears once."""
        names = self.joints
        first, keys = self.motor_keys()[0], " and ".join(self.motor_keys())
        if not names or not all(names):
            raise Invalid((first, f"{keys} must name motors"))
        if len(set(names)) < len(names):
            raise Invalid((first, f"{keys} must each name another motor, not {', '.join(names)}"))


@dataclass(frozen=True, slots=True, kw_only=True)
class Linkage(Body):
    """A body whose joints carry one another, on a base that stands still: what falls if it is let go.

    Positions are rad (m of a joint that slides), torques N·m (N), in the order of `joints`."""

    @property
    def as_linkage(self) -> Linkage:
        """Itself."""
        return self

    @property
    @abstractmethod
    def ranges(self) -> tuple[tuple[float, float], ...]:
        """Lowest and highest position of each joint; infinite where it turns on."""

    @property
    @abstractmethod
    def of_tip(self) -> tuple[str, ...]:
        """The joints that move its tip."""

    @property
    @abstractmethod
    def limits(self) -> tuple[tuple[float, float, float], ...]:
        """Velocity, acceleration and jerk of each joint, at most: rad/s, rad/s², rad/s³."""

    def angles(self, positions: Sequence[float]) -> tuple[float, ...]:
        """Return how its links' joints stand [rad; m of one that slides]: as the motors, unless something is
        between them."""
        return tuple(positions)

    @abstractmethod
    def points(self, positions: Sequence[float]) -> tuple[tuple[float, float, float], ...]:
        """Return where its base, its joints and, last, its tip are [m]."""

    @abstractmethod
    def torques(
        self, positions: Sequence[float], velocities: Sequence[float], accelerations: Sequence[float]
    ) -> tuple[float, ...]:
        """Return the torques of a motion; at rest those that hold it against gravity."""

    @abstractmethod
    def command(self, motor: str, position: float, velocity: float, torque: float) -> Command:
        """Return the command that moves a joint through a state, with the torque that this takes."""

    @abstractmethod
    def push(self, motor: str, position: float, torque: float) -> Command:
        """Return the command that pushes with a torque, slowly while nothing resists. `position`: now."""

    @abstractmethod
    def search(self, positions: Sequence[float], place: Placement) -> Search:
        """Return a search for positions of the joints at which its tip is at a place."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Base(Body):
    """A body that moves in the plane: limits and footprint, SI; what it can do, by its subclass.

    Frames: x forward, y to the left, yaw counter-clockwise, about the robot's origin."""

    radius: Annotated[float, Bounds(0.01, 3.0, "m")]
    """m, of the circle about the origin that contains the whole robot"""
    footprint: Corners | None = None
    """m: corners of the robot's outline in its frame, convex, counter-clockwise about the origin; None: the
    circle of `radius`"""
    max_linear: Annotated[float, Bounds(1e-3, 20.0, "m/s")]
    """m/s, forward and backward"""
    max_lateral: Annotated[float, Bounds(1e-3, 20.0, "m/s")] | None = None
    """m/s, to both sides, of a base that moves sideways; None: max_linear"""
    max_angular: Annotated[float, Bounds(1e-3, 50.0, "rad/s")]
    """rad/s, both ways"""
    max_linear_acceleration: Annotated[float, Bounds(0.01, 100.0, "m/s²")]
    """m/s², in any direction"""
    max_angular_acceleration: Annotated[float, Bounds(0.01, 500.0, "rad/s²")]
    max_linear_jerk: Annotated[float, Bounds(0.1, 1e4, "m/s³")] = 10.0
    max_angular_jerk: Annotated[float, Bounds(0.1, 1e5, "rad/s³")] = 50.0
    stop_deceleration: Annotated[float, Bounds(0.01, 100.0, "m/s²")] | None = None
    """m/s² before an obstacle that appears too near for the ordinary one; None: max_linear_acceleration"""

    def __post_init__(self) -> None:
        check(self)
        _check_footprint(self.footprint, self.radius)
        self.check_motors()

    @property
    def as_base(self) -> Base:
        """Itself."""
        return self

    # -- what a body file provides ---------------------------------------------------------------

    @property
    def moves_sideways(self) -> bool:
        """Whether it can move in any direction without turning first."""
        return False

    @property
    def turning_radius(self) -> float:
        """Smallest radius [m] of a path of its origin; 0: it turns on the spot."""
        return 0.0

    @property
    def rests_idle(self) -> bool:
        """Whether its motors are disarmed at rest with nothing to do; False: it would fall, and stands."""
        return True

    @property
    def turn_slip(self) -> float:
        """Standard deviation of each side's slip when it turns, as a share of what its wheels roll; 0: a base
        that turns by rolling."""
        return 0.0

    @property
    @abstractmethod
    def top_speeds(self) -> tuple[float, ...]:
        """Largest speed of each joint [rad/s]; inf where only the joint's own limit counts."""

    @property
    @abstractmethod
    def rolling(self) -> tuple[float, ...]:
        """How far a wheel rolls on the floor per rad of each joint [m/rad], at least 0; 0: it does not."""

    @abstractmethod
    def inverse(self, twist: Twist, positions: Sequence[float | None]) -> tuple[Setpoint, ...]:
        """Return the joints' set-points for a twist. `positions`: the newest measured, None if unknown; what
        has several solutions (a wheel that steers by ± 180°) takes the nearest."""

    @abstractmethod
    def travel(self, before: Sequence[float], after: Sequence[float]) -> Travel:
        """Return the motion between two sets of joint positions [rad], with its derivatives."""

    # -- what follows ----------------------------------------------------------------------------

    def readiness(self, twist: Twist, positions: Sequence[float | None]) -> float:
        """Return the share of a twist, from 0 to 1, that may be driven now: less while wheels steer."""
        return 1.0

    def actuate(
        self, twist: Twist, positions: Sequence[float | None], dt: float, memory: Any
    ) -> tuple[tuple[Command, ...], Any]:
        """Return one command per joint for a twist, dt [s] after the last, and what to remember until the
        next: plain data, None at first and after the motors were disarmed."""
        return self.commands(self.inverse(twist, positions)), memory

    def commands(self, setpoints: Sequence[Setpoint]) -> tuple[Command, ...]:
        """Return the set-points as commands."""
        return tuple(
            msg.Velocity(motor, one.velocity) if one.velocity is not None else _position(motor, one)
            for motor, one in zip(self.joints, setpoints, strict=True)
        )

    @property
    def stands_on(self) -> tuple[Wheel, ...]:
        """Its wheels, as its dimensions place them; (): it has none, or they do not tell."""
        return ()

    def parts(self) -> list[Part]:
        """Return its outline and its wheels."""
        return of_base(self.outline, self.stands_on)

    @property
    def outline(self) -> Corners:
        """The footprint's corners [m]; without one, a polygon about the circle of `radius`."""
        if self.footprint is not None:
            return self.footprint
        far, step = self.radius / math.cos(math.pi / CIRCLE), 2.0 * math.pi / CIRCLE
        return tuple((far * math.cos(step * i), far * math.sin(step * i)) for i in range(CIRCLE))

    @property
    def inner_radius(self) -> float:
        """Radius [m] of the largest circle about the origin within the footprint."""
        if self.footprint is None:
            return self.radius
        corners = self.footprint
        pairs = zip(corners, (*corners[1:], corners[0]), strict=True)
        return min((ax * by - ay * bx) / math.dist((ax, ay), (bx, by)) for (ax, ay), (bx, by) in pairs)

    def limit(self, twist: Twist) -> Twist:
        """Return the twist scaled into all limits: all speeds by one factor, which keeps the curvature.

        Raises ValueError if the twist is not finite."""
        if not all(map(math.isfinite, twist)):
            raise ValueError(f"a twist must be finite, not {tuple(twist)!r}")
        lateral = twist.lateral if self.moves_sideways else 0.0
        able = Twist(twist.linear, twist.angular, lateral)
        across = lateral / (self.max_lateral or self.max_linear)
        excess = max(
            1.0, math.hypot(twist.linear / self.max_linear, across), abs(twist.angular) / self.max_angular
        )
        unknown = (None,) * len(self.top_speeds)
        for setpoint, most in zip(self.inverse(able, unknown), self.top_speeds, strict=True):
            if setpoint.velocity is not None:
                excess = max(excess, abs(setpoint.velocity) / most)
        return able.scaled(1.0 / excess)

    def to_rest(self, twist: Twist) -> float:
        """Return the time [s] to brake a twist along its arc, within the accelerations."""
        linear, angular = twist.speed / self.max_linear_acceleration, abs(twist.angular)
        return max(linear, angular / self.max_angular_acceleration)


def _position(motor: str, setpoint: Setpoint) -> Command:
    if setpoint.position is None:
        return msg.Hold(motor)
    return msg.Position(motor, setpoint.position)


def _check_footprint(corners: Corners | None, radius: float) -> None:
    """Raise Invalid unless the footprint is a convex polygon, counter-clockwise about the origin."""
    if corners is None:
        return
    if not isinstance(corners, tuple) or not 3 <= len(corners) <= MOST_CORNERS:
        raise Invalid(("footprint", f"footprint must have from 3 to {MOST_CORNERS} corners"))
    if far := [corner for corner in corners if not math.hypot(*corner) <= radius + 1e-9]:
        raise Invalid(("footprint", f"footprint: the corner {far[0]} is not within the radius, {radius:g} m"))
    following = (*corners[1:], *corners[:2])
    for (ax, ay), (bx, by), (cx, cy) in zip(corners, following, following[1:], strict=False):
        about_origin = ax * by - ay * bx
        turn = (bx - ax) * (cy - by) - (by - ay) * (cx - bx)
        if about_origin <= 0.0 or turn <= 0.0:
            raise ValueError(
                f"footprint must be convex and counter-clockwise about the origin, unlike at {(bx, by)}"
            )
