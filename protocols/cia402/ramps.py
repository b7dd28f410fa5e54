"""Ramps and timers of the twin's motor control: trapezoidal moves, changes of velocity, interpolation.

Rules. Plain data; one call is one cycle of `dt` seconds. Quantities are SI. Nothing here depends on CiA 402.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

CLOSE = 1e-6
"""rad from its goal at which a trapezoidal move is complete."""


def clamp(value: float, most: float) -> float:
    """Limit a value to ±most."""
    return max(-most, min(most, value))


def lag(dt: float, bandwidth: float) -> float:
    """Return the share of a step that a first-order lag has followed after dt."""
    return -math.expm1(-bandwidth * dt)


@dataclass(slots=True)
class Ramp:
    """Demanded position and velocity of a shaft."""

    position: float = 0.0
    velocity: float = 0.0

    def start(self, position: float, velocity: float) -> None:
        """Begin here."""
        self.position, self.velocity = position, velocity

    def change_velocity(self, dt: float, velocity: float, up: float, down: float) -> None:
        """Approach a velocity: away from standstill with `up`, towards it with `down` [rad/s²]."""
        faster = abs(velocity) > abs(self.velocity) and velocity * self.velocity >= 0.0
        self.velocity += clamp(velocity - self.velocity, (up if faster else down) * dt)

    def move_to(self, dt: float, goal: float, speed: float, up: float, down: float) -> bool:
        """Make a step of a trapezoidal move; True if the goal is reached."""
        distance = goal - self.position
        braking = math.sqrt(2.0 * down * abs(distance))
        self.change_velocity(dt, math.copysign(min(speed, braking), distance), up, down)
        slow = abs(self.velocity) <= (up + down) * dt
        if abs(distance) <= abs(self.velocity) * dt + CLOSE and slow:
            self.position, self.velocity = goal, 0.0
            return True
        self.position += self.velocity * dt
        return False


@dataclass(slots=True)
class Interpolation:
    """Linear interpolation from one cyclic set-point to the next (60C2)."""

    target: float | None = None
    left: float = 0.0
    """s until the target is reached."""

    def clear(self) -> None:
        """Begin anew."""
        self.target, self.left = None, 0.0

    def follow(self, dt: float, position: float, target: float, period: float) -> float:
        """Return the position after dt, on the way to a target to be reached a period after it changed."""
        if target != self.target:
            self.target, self.left = target, period
        if self.left <= dt:
            self.left = 0.0
            return target
        position += (target - position) * dt / self.left
        self.left -= dt
        return position


@dataclass(slots=True)
class Timer:
    """Time for which a condition has held."""

    span: float | None = None
    """s; None: the condition does not hold."""

    def clear(self) -> None:
        """Begin anew."""
        self.span = None

    def run(self, dt: float, holds: bool) -> None:
        """Account for a cycle in which the condition holds, or not."""
        self.span = (0.0 if self.span is None else self.span + dt) if holds else None

    def lasts(self, milliseconds: int) -> bool:
        """True if the condition has held for that long."""
        return self.span is not None and self.span * 1000.0 >= milliseconds
