"""Bases whose two sides roll at two speeds, and that slip sideways when they turn: on four wheels or more."""

from __future__ import annotations

from abc import abstractmethod
from dataclasses import dataclass
from typing import Annotated, ClassVar

from brain.bodies.parts import Wheel
from brain.bodies.wheels import FixedWheels, Row
from protocols.bounds import Bounds


@dataclass(frozen=True, slots=True, kw_only=True)
class TwoSides(FixedWheels):
    """The origin is where it turns about on the spot, midway between the sides.

    It turns as a base on two wheels that stand further apart: by the centres of rotation of its sides
    (Mandow et al. 2007, "Experimental kinematics for wheeled skid-steer mobile robots"). How far depends on
    the floor, so the turn by its wheels is uncertain; a gyro should tell it."""

    effective_separation: Annotated[float, Bounds(0.01, 10.0, "m")]
    """m, between the sides' centres of rotation: the distance between wheels or tracks times some 1.3 to 2"""
    turn_slip: Annotated[float, Bounds(0.0, 1.0)] = 0.3
    """Standard deviation of each side's slip when it turns, as a share of what it rolls"""

    @classmethod
    def motor_keys(cls) -> tuple[str, ...]:
        """Return the keys of both sides."""
        return "left", "right"

    @property
    @abstractmethod
    def sides(self) -> tuple[tuple[str, ...], tuple[str, ...]]:
        """The motors on the left and on the right."""

    @property
    def joints(self) -> tuple[str, ...]:
        """The motors on the left, then those on the right."""
        left, right = self.sides
        return left + right

    @property
    def stands_on(self) -> tuple[Wheel, ...]:
        """A wheel for each motor, spread along the outline: the robot file does not say where they are."""
        far, aside = (max(corner[i] for corner in self.outline) for i in (0, 1))
        ends, radius = max(0.0, far - self.wheel_radius), self.wheel_radius
        return tuple(
            Wheel(ends * (1.0 - 2.0 * i / (len(side) - 1)) if len(side) > 1 else 0.0, y, radius, motor)
            for side, y in zip(self.sides, (aside, -aside), strict=True)
            for i, motor in enumerate(side)
        )

    @property
    def rows(self) -> tuple[Row, ...]:
        """Each motor rolls as its side does."""
        left, right = self.sides
        half = self.effective_separation / 2.0
        return ((1.0, -half, 0.0),) * len(left) + ((1.0, half, 0.0),) * len(right)


@dataclass(frozen=True, slots=True, kw_only=True)
class SkidSteer(TwoSides):
    """A base on wheels that do not steer, two or more on each side, each with a motor."""

    kind: ClassVar[str] = "skid_steer"
    left: tuple[str, ...]
    """Motors of the wheels on the left,"""
    right: tuple[str, ...]
    """and on the right."""

    @property
    def sides(self) -> tuple[tuple[str, ...], tuple[str, ...]]:
        """Both lists."""
        return self.left, self.right
