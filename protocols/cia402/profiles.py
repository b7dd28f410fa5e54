"""The ramps of a drive: trapezoidal moves, changes of velocity, the way between cyclic set-points; timers.

Rules. Plain data; one call is one cycle of `dt` seconds. Quantities are SI. Nothing here knows of a drive.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

CLOSE = 1e-6
"""rad from its goal at which a trapezoidal move is over."""


def limited(value: float, most: float) -> float:
    """A value within ±most."""
    return max(-most, min(most, value))


def lag(dt: float, bandwidth: float) -> float:
    """How much of a step a first-order lag has followed after dt."""
    return -math.expm1(-bandwidth * dt)


@dataclass(slots=True)
class Ramp:
    """What a shaft is to do."""

    position: float = 0.0
    velocity: float = 0.0

    def start(self, position: float, velocity: float) -> None:
        """Begin here."""
        self.position, self.velocity = position, velocity

    def change(self, dt: float, velocity: float, up: float, down: float) -> None:
        """Towards a velocity: away from standstill with `up`, towards it with `down` [rad/s²]."""
        faster = abs(velocity) > abs(self.velocity) and velocity * self.velocity >= 0.0
        self.velocity += limited(velocity - self.velocity, (up if faster else down) * dt)

    def slow(self, dt: float, velocity: float, down: float) -> None:
        """Towards a lower velocity."""
        self.change(dt, velocity, down, down)

    def go(self, dt: float, goal: float, speed: float, up: float, down: float) -> bool:
        """A step of a trapezoidal move to a goal; whether it is there."""
        way = goal - self.position
        braking = math.sqrt(2.0 * down * abs(way))
        self.change(dt, math.copysign(min(speed, braking), way), up, down)
        slow = abs(self.velocity) <= (up + down) * dt
        if abs(way) <= abs(self.velocity) * dt + CLOSE and slow:
            self.position, self.velocity = goal, 0.0
            return True
        self.position += self.velocity * dt
        return False


@dataclass(slots=True)
class Interpolation:
    """The straight way from one cyclic set-point to the next (60C2)."""

    target: float | None = None
    left: float = 0.0
    """s until the target is reached."""
    turn: int | None = None
    """The turn that the motor was in, while an index is looked for."""

    def clear(self) -> None:
        """Begin anew."""
        self.target, self.left, self.turn = None, 0.0, None

    def follow(self, dt: float, position: float, target: float, period: float) -> float:
        """The position after dt, on the way to a target that is to be reached a period after it changed."""
        if target != self.target:
            self.target, self.left = target, period
        if self.left <= dt:
            self.left = 0.0
            return target
        position += (target - position) * dt / self.left
        self.left -= dt
        return position

    def crossed(self, turn: int) -> int | None:
        """The turn before, if the motor came into another one since the last call."""
        before, self.turn = self.turn, turn
        return before if before is not None and before != turn else None


@dataclass(slots=True)
class Timer:
    """How long something has been so."""

    span: float | None = None
    """s; None: it is not so."""

    def clear(self) -> None:
        """It is not so."""
        self.span = None

    def run(self, dt: float, so: bool) -> None:
        """A cycle in which it is so, or not."""
        self.span = (0.0 if self.span is None else self.span + dt) if so else None

    def lasts(self, milliseconds: int) -> bool:
        """Whether it has been so for that long."""
        return self.span is not None and self.span * 1000.0 >= milliseconds
