"""A base that steers as a car: two front wheels with two different angles, the rear axle driven."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Annotated, ClassVar

from brain.bodies.body import Base
from brain.bodies.plane import Twist
from brain.bodies.wheels import Contact, SteeredWheels, SteeringError
from protocols.bounds import Bounds, Invalid


@dataclass(frozen=True, slots=True, kw_only=True)
class Ackermann(SteeredWheels):
    """Its origin is the middle of the rear axle. A steering angle is positive to the left."""

    kind: ClassVar[str] = "ackermann"
    steering: tuple[str, ...]
    """Motors of the left and the right front wheel; or one motor behind a linkage, whose angle is that of a
    wheel midway between them"""
    drive: tuple[str, ...]
    """Motors of the left and the right rear wheel; or one that drives the axle through a differential gear"""
    wheelbase: Annotated[float, Bounds(0.01, 10.0, "m")]
    """m, from the rear axle to the front one"""
    wheel_separation: Annotated[float, Bounds(0.01, 10.0, "m")]
    """m, between the rear wheels' points of contact"""
    steering_separation: Annotated[float, Bounds(0.01, 10.0, "m")] | None = None
    """m, between the front ones; None: wheel_separation"""
    max_steering: Annotated[float, Bounds(0.05, 1.5, "rad")] = 0.6
    """rad, of each steering motor, to either side"""
    steering_error: SteeringError = 0.3

    def __post_init__(self) -> None:
        for key in ("steering", "drive"):
            if len(getattr(self, key)) not in (1, 2):
                raise Invalid((key, f"{key} must name one motor, or the left and the right one"))
        SteeredWheels.__post_init__(self)

    @classmethod
    def motor_keys(cls) -> tuple[str, ...]:
        """Return the keys of both lists."""
        return "steering", "drive"

    @property
    def joints(self) -> tuple[str, ...]:
        """Those that steer, then those that drive."""
        return self.steering + self.drive

    @property
    def turning_radius(self) -> float:
        """Smallest radius [m] of the path of the rear axle's middle: the inner wheel is at its limit."""
        inner = max(y for _, y, _, steering in self.contacts if steering is not None)
        return self.wheelbase / math.tan(self.max_steering) + inner

    @property
    def contacts(self) -> tuple[Contact, ...]:
        """The front wheels, then the rear ones."""
        front = self.steering_separation or self.wheel_separation
        steered = [Contact(self.wheelbase, y, None, i) for i, y in enumerate(_sides(self.steering, front))]
        rear = enumerate(_sides(self.drive, self.wheel_separation), len(steered))
        return (*steered, *(Contact(0.0, y, i, None) for i, y in rear))

    def limit(self, twist: Twist) -> Twist:
        """Return the twist within all limits: a curve that is too tight becomes the tightest, and a turn on
        the spot rest; then all speeds are scaled by one factor. Raises ValueError if it is not finite."""
        tightest = abs(twist.linear) / self.turning_radius
        if tightest < abs(twist.angular) < math.inf:
            twist = twist._replace(angular=math.copysign(tightest, twist.angular))
        return Base.limit(self, twist)


def _sides(motors: tuple[str, ...], separation: float) -> tuple[float, ...]:
    """Return where the wheels of an axle are, to the left [m]."""
    return (0.0,) if len(motors) == 1 else (separation / 2.0, -separation / 2.0)
