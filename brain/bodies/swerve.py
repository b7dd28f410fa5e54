"""A base on modules that each drive and steer one wheel."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Annotated, ClassVar

from brain.bodies.omni import check_places
from brain.bodies.wheels import Contact, SteeredWheels, SteeringError
from protocols.bounds import Bounds, Invalid


@dataclass(frozen=True, slots=True, kw_only=True)
class Swerve(SteeredWheels):
    """Its origin is where the modules' places are measured from. A module steers to the nearest of the two
    directions that are alike, forward and backward."""

    kind: ClassVar[str] = "swerve"
    drive: tuple[str, ...]
    """Motors that turn the wheels; the lists have the same order"""
    steering: tuple[str, ...]
    """Motors that steer them"""
    places: tuple[tuple[float, float], ...]
    """m: x and y of each wheel's point of contact"""
    max_steering: Annotated[float, Bounds(math.pi / 2.0, 1e4, "rad")] | None = None
    steering_error: SteeringError = 0.8

    def __post_init__(self) -> None:
        if len(self.drive) != len(self.steering) or len(self.drive) < 2:
            raise Invalid(("steering", "steering must name as many motors as drive, two or more"))
        check_places(self.places, len(self.drive))
        SteeredWheels.__post_init__(self)

    @classmethod
    def motor_keys(cls) -> tuple[str, ...]:
        """Return the keys of both lists."""
        return "drive", "steering"

    @property
    def joints(self) -> tuple[str, ...]:
        """Those that drive, then those that steer."""
        return self.drive + self.steering

    @property
    def moves_sideways(self) -> bool:
        """It does."""
        return True

    @property
    def contacts(self) -> tuple[Contact, ...]:
        """The modules."""
        count = len(self.drive)
        return tuple(Contact(x, y, i, count + i) for i, (x, y) in enumerate(self.places))
