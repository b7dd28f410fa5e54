"""A base on two driven wheels: exact kinematics both ways, its limits, its distance to stop.

Rules of this file. Two wheels that turn at constant speeds move the base on an arc of a circle, and
the arc is integrated in closed form (the exponential map of SE(2)), never by Euler steps. Angles of
the wheels are those of the joints' output shafts, positive when the wheel rolls the base forward.
Frames: x forward, y to the left, yaw counter-clockwise; the origin is midway between the wheels.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, fields

from brain.belief import Pose


def wrap(angle: float) -> float:
    """The same direction in (-pi, pi]."""
    turned = math.remainder(angle, 2.0 * math.pi)
    return math.pi if turned <= -math.pi else turned


def sinc(half: float) -> float:
    """sin(h) / h, and 1 at 0: a chord's length over its arc's, for half the turn."""
    if abs(half) < 1e-4:
        return 1.0 - half * half / 6.0
    return math.sin(half) / half


def arc(pose: Pose, distance: float, turn: float) -> Pose:
    """Where an arc of this length [m] and turn [rad] leads: exact, straight lines included."""
    half = turn / 2.0
    chord = distance * sinc(half)
    heading = pose.yaw + half
    return Pose(pose.x + chord * math.cos(heading), pose.y + chord * math.sin(heading), wrap(pose.yaw + turn))


@dataclass(frozen=True, slots=True)
class Differential:
    """The base's geometry and limits, SI."""

    left: str
    """Motor of the left wheel."""
    right: str
    """Motor of the right wheel."""
    wheel_radius: float
    """m"""
    wheel_separation: float
    """m, between the wheels' points of contact"""
    radius: float
    """m, of the circle about the origin that holds the whole robot"""
    max_linear: float
    """m/s, forward and backward"""
    max_angular: float
    """rad/s, both ways"""
    max_linear_acceleration: float
    """m/s²"""
    max_angular_acceleration: float
    """rad/s²"""
    max_wheel_speed: float | None = None
    """rad/s of a wheel; None: whatever the largest linear and angular speed together need"""

    def __post_init__(self) -> None:
        if not self.left or not self.right or self.left == self.right:
            raise ValueError(f"left and right must name two motors, not {self.left!r} and {self.right!r}")
        for field in fields(self)[2:]:
            value = getattr(self, field.name)
            if value is not None and not (math.isfinite(value) and value > 0.0):
                raise ValueError(f"{field.name} must be a number above 0, not {value!r}")

    @property
    def wheel_speed(self) -> float:
        """The fastest that a wheel may turn [rad/s]."""
        if self.max_wheel_speed is not None:
            return self.max_wheel_speed
        return (self.max_linear + self.max_angular * self.wheel_separation / 2.0) / self.wheel_radius

    def forward(self, left_rad: float, right_rad: float) -> tuple[float, float]:
        """How far [m] and by how much [rad] the base goes when its wheels turn by these angles.

        The same function gives the base's speeds [m/s, rad/s] from the wheels' [rad/s]."""
        left, right = left_rad * self.wheel_radius, right_rad * self.wheel_radius
        return (left + right) / 2.0, (right - left) / self.wheel_separation

    def inverse(self, linear: float, angular: float) -> tuple[float, float]:
        """The wheels' speeds [rad/s] (left, right) for the base's [m/s, rad/s]; angles for an arc."""
        sideways = angular * self.wheel_separation / 2.0
        return (linear - sideways) / self.wheel_radius, (linear + sideways) / self.wheel_radius

    def arc(self, pose: Pose, distance: float, turn: float) -> Pose:
        """Where an arc of this length [m] and turn [rad] leads from the pose: exact."""
        return arc(pose, distance, turn)

    def limit(self, linear: float, angular: float) -> tuple[float, float]:
        """The largest part of a twist within all limits: both speeds shrink by the same factor, so
        the curvature (and hence the path) stays. Raises ValueError for what is not finite."""
        if not (math.isfinite(linear) and math.isfinite(angular)):
            raise ValueError(f"a twist must be finite, not {linear!r} m/s and {angular!r} rad/s")
        left, right = self.inverse(linear, angular)
        excess = max(
            1.0,
            abs(linear) / self.max_linear,
            abs(angular) / self.max_angular,
            max(abs(left), abs(right)) / self.wheel_speed,
        )
        return linear / excess, angular / excess

    def stop_distance(self, linear: float, latency: float = 0.0) -> float:
        """How far [m] the base still goes when told to stop at this speed [m/s]: the latency [s]
        unbraked, then with the largest deceleration."""
        speed = abs(linear)
        return speed * latency + speed * speed / (2.0 * self.max_linear_acceleration)

    def stop_turn(self, angular: float, latency: float = 0.0) -> float:
        """How far [rad] the base still turns when told to stop at this speed [rad/s]."""
        speed = abs(angular)
        return speed * latency + speed * speed / (2.0 * self.max_angular_acceleration)
