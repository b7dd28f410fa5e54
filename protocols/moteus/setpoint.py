"""The set-point of the firmware's position loop, and its trajectory.

Rules. Units are the firmware's: rev, rev/s, s. Without limits of velocity or acceleration the set-point is
the commanded position, and goes on with the commanded velocity; with them it goes there along a trajectory,
computed step by step. Sources: mjbots/moteus@1f4a195 `fw/bldc_servo_control.h`; mjbots/moteus@db1a762
`docs/protocol/registers.md`, `docs/reference/configuration.md` (servo.default_velocity_limit).
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass

from protocols.moteus.options import Settings
from protocols.moteus.registers import Register


@dataclass(slots=True)
class Setpoint:
    """Set-point of the position loop. Plain data."""

    position: float | None = None
    """None: it begins at the measured position."""
    velocity: float = 0.0
    fresh: float | None = None
    """A commanded position that was not used yet."""
    goal: float | None = None
    """End of a limited trajectory; None: it keeps its velocity."""
    done: bool = True
    """The trajectory is complete."""

    def take(self, position: float) -> None:
        """Take a commanded position; NaN: none, the set-point goes on from where it is."""
        self.fresh = None if math.isnan(position) else position
        self.goal = self.goal if math.isnan(position) else position

    def clear(self) -> None:
        """Forget the set-point: the next one begins at the position measured then."""
        self.position, self.velocity = None, 0.0

    def follow(
        self, dt: float, settings: Settings, command: Mapping[int, float], shaft: float, speed: float
    ) -> None:
        """Advance: at once where nothing limits it, else along a trajectory. `shaft`, `speed`: measured."""
        max_velocity, max_acceleration = trajectory_limits(settings, command)
        commanded = or_default(command[Register.COMMAND_VELOCITY], 0.0)
        at = shaft if self.position is None else self.position
        if max_velocity is None and max_acceleration is None:
            at = at if self.fresh is None else self.fresh
            self.velocity, self.done = commanded, True
            self.position = self._stopped_at(at + commanded * dt, command[Register.COMMAND_STOP_POSITION])
        else:
            self.velocity = speed if self.position is None else self.velocity
            goal = None if math.isnan(command[Register.COMMAND_POSITION]) else self.goal
            self.position = self._next_position(dt, at, goal, commanded, max_velocity, max_acceleration)
        self.fresh = None
        if not command[Register.COMMAND_IGNORE_POSITION_BOUNDS]:
            self.position = _clamp(self.position, settings.position_min, settings.position_max)

    def come_to_rest(self, dt: float, max_acceleration: float, shaft: float) -> None:
        """Slow down with this acceleration [rev/s²]; NaN: at once."""
        change = abs(self.velocity) if math.isnan(max_acceleration) else max_acceleration * dt
        at = shaft if self.position is None else self.position
        self.velocity -= math.copysign(min(change, abs(self.velocity)), self.velocity)
        self.position = at + self.velocity * dt

    def _stopped_at(self, at: float, stop: float) -> float:
        """Return the position, not beyond a commanded stop position."""
        if math.isnan(stop) or self.velocity == 0.0:
            return at
        reached = (at - stop) * self.velocity >= 0.0
        self.velocity = 0.0 if reached else self.velocity
        return stop if reached else at

    def _next_position(
        self,
        dt: float,
        at: float,
        goal: float | None,
        commanded: float,
        max_velocity: float | None,
        max_acceleration: float | None,
    ) -> float:
        """Return the next position towards goal + commanded·t; without a goal, at the commanded velocity."""
        aim = commanded
        if goal is not None:
            self.goal = goal = goal + commanded * dt
            distance = goal - at
            speed = abs(distance) / dt
            if max_acceleration is not None:
                speed = min(speed, math.sqrt(2.0 * max_acceleration * abs(distance)))
            aim = commanded + math.copysign(speed, distance)
        if max_velocity is not None:
            aim = max(-max_velocity, min(max_velocity, aim))
        change = aim - self.velocity
        if max_acceleration is not None:
            change = max(-max_acceleration * dt, min(max_acceleration * dt, change))
        self.velocity += change
        at += self.velocity * dt
        self.done = abs(self.velocity - commanded) <= (max_acceleration or math.inf) * dt
        if goal is None:
            return at
        self.done = self.done and abs(goal - at) <= abs(change) * dt + 1e-6
        if not self.done:
            return at
        self.velocity = commanded
        return goal


def trajectory_limits(settings: Settings, command: Mapping[int, float]) -> tuple[float | None, float | None]:
    """Return the limits of velocity and acceleration, or None; a negative one in a command is off."""
    pairs = (
        (command[Register.COMMAND_VELOCITY_LIMIT], settings.default_velocity_limit),
        (command[Register.COMMAND_ACCEL_LIMIT], settings.default_accel_limit),
    )
    chosen = [or_default(value, default) for value, default in pairs]
    max_velocity, max_acceleration = (None if math.isnan(x) or x < 0 else x for x in chosen)
    return max_velocity, max_acceleration


def or_default(value: float, other: float) -> float:
    """Return the value of a register, or a default where it is "not given" (NaN)."""
    return other if math.isnan(value) else value


def _clamp(value: float, low: float, high: float) -> float:
    """Return the value within bounds; NaN is no bound."""
    if value < low:
        return low
    return high if value > high else value
