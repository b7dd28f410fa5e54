"""A base on two driven wheels on one axle."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Annotated, Any, ClassVar

from brain.bodies.body import Base, Setpoint, Travel
from brain.bodies.from_urdf import wheels
from brain.bodies.parts import Wheel
from brain.bodies.plane import Twist
from protocols.bounds import Bounds


@dataclass(frozen=True, slots=True, kw_only=True)
class Differential(Base):
    """Its origin is midway between the wheels; a wheel's angle is positive when it rolls the base forward."""

    kind: ClassVar[str] = "differential"
    left: str
    """Motor of the left wheel."""
    right: str
    """Motor of the right wheel."""
    wheel_radius: Annotated[float, Bounds(0.005, 2.0, "m")]
    wheel_separation: Annotated[float, Bounds(0.01, 5.0, "m")]
    """m, between the wheels' points of contact (track width)"""
    max_wheel_speed: Annotated[float, Bounds(1e-3, 1e4, "rad/s")] | None = None
    """rad/s of a wheel; None: what the largest linear and angular speed together need"""

    @classmethod
    def motor_keys(cls) -> tuple[str, ...]:
        """Return the keys of both wheels."""
        return "left", "right"

    @classmethod
    def from_urdf(cls, text: str, joints: Mapping[str, str], table: Mapping[str, Any]) -> dict[str, Any]:
        """Return the wheels' radius and separation."""
        found = wheels(text, joints, table, cls.motor_keys(), "wheel_radius", "wheel_separation")
        if not found:
            return {}
        left, right = found
        return {"wheel_radius": left.radius, "wheel_separation": left.y - right.y}

    @property
    def joints(self) -> tuple[str, ...]:
        """The left and the right wheel."""
        return self.left, self.right

    @property
    def top_speeds(self) -> tuple[float, ...]:
        """Largest speed of a wheel [rad/s], twice."""
        most = self.max_wheel_speed
        if most is None:
            most = (self.max_linear + self.max_angular * self.wheel_separation / 2.0) / self.wheel_radius
        return most, most

    @property
    def rolling(self) -> tuple[float, ...]:
        """The wheels' radius [m], twice."""
        return self.wheel_radius, self.wheel_radius

    @property
    def stands_on(self) -> tuple[Wheel, ...]:
        """Both wheels."""
        y, radius = self.wheel_separation / 2.0, self.wheel_radius
        return Wheel(0.0, y, radius, self.left), Wheel(0.0, -y, radius, self.right)

    def inverse(self, twist: Twist, positions: Sequence[float | None] = ()) -> tuple[Setpoint, ...]:
        """Return the wheels' speeds [rad/s]."""
        sideways = twist.angular * self.wheel_separation / 2.0
        left, right = twist.linear - sideways, twist.linear + sideways
        return Setpoint(left / self.wheel_radius), Setpoint(right / self.wheel_radius)

    def travel(self, before: Sequence[float], after: Sequence[float]) -> Travel:
        """Return the arc that both wheels roll; exact."""
        radius = self.wheel_radius
        left, right = (after[0] - before[0]) * radius, (after[1] - before[1]) * radius
        half, lever = radius / 2.0, radius / self.wheel_separation
        turn = (right - left) / self.wheel_separation
        return Travel((left + right) / 2.0, turn, 0.0, (half, half), (-lever, lever), (0.0, 0.0))
