"""A base on four Mecanum wheels, whose rollers form an X seen from above."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Annotated, Any, ClassVar

from brain.bodies.from_urdf import wheels
from brain.bodies.parts import Wheel
from brain.bodies.wheels import FixedWheels, Row, roller_row
from protocols.bounds import Bounds


@dataclass(frozen=True, slots=True, kw_only=True)
class Mecanum(FixedWheels):
    """Its origin is the middle of the four points of contact. Positive angles roll each wheel forward."""

    kind: ClassVar[str] = "mecanum"
    front_left: str
    """Motor"""
    front_right: str
    """Motor"""
    rear_left: str
    """Motor"""
    rear_right: str
    """Motor"""
    wheelbase: Annotated[float, Bounds(0.01, 10.0, "m")]
    """m, between the front and the rear points of contact"""
    wheel_separation: Annotated[float, Bounds(0.01, 10.0, "m")]
    """m, between the left and the right ones"""

    @classmethod
    def motor_keys(cls) -> tuple[str, ...]:
        """Return the keys of the four wheels."""
        return "front_left", "front_right", "rear_left", "rear_right"

    @classmethod
    def from_urdf(cls, text: str, joints: Mapping[str, str], table: Mapping[str, Any]) -> dict[str, Any]:
        """Return the wheels' radius, and the distances between them."""
        wanted = "wheel_radius", "wheel_separation", "wheelbase"
        found = wheels(text, joints, table, cls.motor_keys(), *wanted)
        if not found:
            return {}
        left, right, rear, _ = found
        return dict(zip(wanted, (left.radius, left.y - right.y, left.x - rear.x), strict=True))

    @property
    def joints(self) -> tuple[str, ...]:
        """The wheels: front left, front right, rear left, rear right."""
        return self.front_left, self.front_right, self.rear_left, self.rear_right

    @property
    def moves_sideways(self) -> bool:
        """It does."""
        return True

    @property
    def stands_on(self) -> tuple[Wheel, ...]:
        """The four wheels."""
        x, y = self.wheelbase / 2.0, self.wheel_separation / 2.0
        places = ((x, y), (x, -y), (-x, y), (-x, -y))
        pairs = zip(places, self.joints, strict=True)
        return tuple(Wheel(*place, self.wheel_radius, motor) for place, motor in pairs)

    @property
    def rows(self) -> tuple[Row, ...]:
        """Each wheel moves freely across its rollers, at 45 degrees."""
        x, y = self.wheelbase / 2.0, self.wheel_separation / 2.0
        places = ((x, y, -1.0), (x, -y, 1.0), (-x, y, 1.0), (-x, -y, -1.0))
        return tuple(roller_row(px, py, 0.0, side * math.pi / 4.0) for px, py, side in places)
