"""A base on two driven wheels: exact kinematics both ways, and its limits.

Rules. Two wheels that turn at constant speeds move the base on an arc of a circle; the arc is integrated in
closed form (the exponential map of SE(2)), never by Euler steps. Wheel angles are those of the joints'
output shafts, positive when the wheel rolls the base forward. Frames: x forward, y to the left, yaw
counter-clockwise; the origin is midway between the wheels.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

from brain.belief import Pose
from brain.checks import within


def wrap(angle: float) -> float:
    """Return the same direction in (-pi, pi] [rad]."""
    turned = math.remainder(angle, 2.0 * math.pi)
    return math.pi if turned <= -math.pi else turned


def sinc(half: float) -> float:
    """Return sin(h) / h, and 1 at 0: the length of a chord over that of its arc, for half the turn [rad]."""
    if abs(half) < 1e-4:
        return 1.0 - half * half / 6.0
    return math.sin(half) / half


def arc(pose: Pose, distance: float, turn: float) -> Pose:
    """Return the pose at the end of an arc of this length [m] and turn [rad]; exact, also if straight."""
    half = turn / 2.0
    chord = distance * sinc(half)
    heading = pose.yaw + half
    return Pose(pose.x + chord * math.cos(heading), pose.y + chord * math.sin(heading), wrap(pose.yaw + turn))


CIRCLE, MOST_CORNERS = 16, 32
"""Corners of a circle's outline, and the most of a footprint."""


@dataclass(frozen=True, slots=True)
class Differential:
    """Geometry and limits of the base, SI."""

    left: str
    """Motor of the left wheel."""
    right: str
    """Motor of the right wheel."""
    wheel_radius: float
    """m"""
    wheel_separation: float
    """m, between the wheels' points of contact (track width)"""
    radius: float
    """m, of the circle about the origin that contains the whole robot (footprint)"""
    max_linear: float
    """m/s, forward and backward"""
    max_angular: float
    """rad/s, both ways"""
    max_linear_acceleration: float
    """m/s²"""
    max_angular_acceleration: float
    """rad/s²"""
    max_wheel_speed: float | None = None
    """rad/s of a wheel; None: what the largest linear and angular speed together need"""
    footprint: tuple[tuple[float, float], ...] | None = None
    """m: corners of the robot's outline in its frame, convex, counter-clockwise about the origin; None: the
    circle of `radius`. It decides what the robot would touch; paths are planned with the circle."""
    stop_deceleration: float | None = None
    """m/s² before an obstacle that appears too near for the ordinary one; None: max_linear_acceleration"""

    def __post_init__(self) -> None:
        within(
            self,
            wheel_radius=(0.005, 2.0, "m"),
            wheel_separation=(0.01, 5.0, "m"),
            radius=(0.01, 3.0, "m"),
            max_linear=(1e-3, 20.0, "m/s"),
            max_angular=(1e-3, 50.0, "rad/s"),
            max_linear_acceleration=(0.01, 100.0, "m/s²"),
            max_angular_acceleration=(0.01, 500.0, "rad/s²"),
            max_wheel_speed=(1e-3, 1e4, "rad/s"),
            stop_deceleration=(0.01, 100.0, "m/s²"),
        )
        _check_footprint(self.footprint, self.radius)
        if not self.left or not self.right or self.left == self.right:
            raise ValueError(f"left and right must name two motors, not {self.left!r} and {self.right!r}")

    @property
    def wheel_speed(self) -> float:
        """Largest speed of a wheel [rad/s]."""
        if self.max_wheel_speed is not None:
            return self.max_wheel_speed
        return (self.max_linear + self.max_angular * self.wheel_separation / 2.0) / self.wheel_radius

    @property
    def outline(self) -> tuple[tuple[float, float], ...]:
        """The footprint's corners [m]; without one, a polygon about the circle of `radius`."""
        if self.footprint is not None:
            return self.footprint
        far, step = self.radius / math.cos(math.pi / CIRCLE), 2.0 * math.pi / CIRCLE
        return tuple((far * math.cos(step * i), far * math.sin(step * i)) for i in range(CIRCLE))

    def forward(self, left_rad: float, right_rad: float) -> tuple[float, float]:
        """Return the base's motion (distance [m], turn [rad]) for these wheel angles [rad].

        The same function maps wheel speeds [rad/s] to the base's twist [m/s, rad/s]."""
        left, right = left_rad * self.wheel_radius, right_rad * self.wheel_radius
        return (left + right) / 2.0, (right - left) / self.wheel_separation

    def inverse(self, linear: float, angular: float) -> tuple[float, float]:
        """Return the wheel speeds [rad/s] (left, right) for a twist [m/s, rad/s]; wheel angles for an arc."""
        sideways = angular * self.wheel_separation / 2.0
        return (linear - sideways) / self.wheel_radius, (linear + sideways) / self.wheel_radius

    def limit(self, linear: float, angular: float) -> tuple[float, float]:
        """Return the twist scaled into all limits: both speeds by the same factor, which keeps the curvature.

        Raises ValueError if the twist is not finite."""
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


def _check_footprint(corners: tuple[tuple[float, float], ...] | None, radius: float) -> None:
    """Raise ValueError unless the footprint is a convex polygon, counter-clockwise about the origin."""
    if corners is None:
        return
    if not isinstance(corners, tuple) or not 3 <= len(corners) <= MOST_CORNERS:
        raise ValueError(f"footprint must have from 3 to {MOST_CORNERS} corners")
    if far := [corner for corner in corners if not math.hypot(*corner) <= radius + 1e-9]:
        raise ValueError(f"footprint: the corner {far[0]} is not within the radius, {radius:g} m")
    following = (*corners[1:], *corners[:2])
    for (ax, ay), (bx, by), (cx, cy) in zip(corners, following, following[1:], strict=False):
        about_origin = ax * by - ay * bx
        turn = (bx - ax) * (cy - by) - (by - ay) * (cx - bx)
        if about_origin <= 0.0 or turn <= 0.0:
            raise ValueError(
                f"footprint must be convex and counter-clockwise about the origin, unlike at {(bx, by)}"
            )
