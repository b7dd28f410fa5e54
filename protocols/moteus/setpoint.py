"""The set-point of the firmware's position loop: where it stands, how fast it goes, where it leads.

Rules. Units are the firmware's: rev, rev/s, s. Without limits of velocity or acceleration the set-point is
where the command says, and goes on with the command's velocity; with them it goes there along a trajectory,
found step by step. Sources: mjbots/moteus@1f4a195 `fw/bldc_servo_control.h`; mjbots/moteus@db1a762
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
    """Where the position loop is led. Plain data."""

    position: float | None = None
    """None: it begins where the shaft is."""
    velocity: float = 0.0
    fresh: float | None = None
    """A position that was commanded and is still to be taken."""
    goal: float | None = None
    """Where a limited trajectory leads; None: nowhere, it keeps its velocity."""
    done: bool = True
    """The trajectory has come to its end."""

    def take(self, position: float) -> None:
        """A command names a position; NaN: none, it goes on from where it is."""
        self.fresh = None if math.isnan(position) else position
        self.goal = self.goal if math.isnan(position) else position

    def clear(self) -> None:
        """Nothing is controlled: the next one begins where the shaft is then."""
        self.position, self.velocity = None, 0.0

    def follow(
        self, dt: float, settings: Settings, command: Mapping[int, float], shaft: float, speed: float
    ) -> None:
        """It moves: at once where nothing limits it, else along a trajectory. `shaft`, `speed`: measured."""
        fastest, hardest = limits_of(settings, command)
        wanted = or_else(command[Register.COMMAND_VELOCITY], 0.0)
        at = shaft if self.position is None else self.position
        if fastest is None and hardest is None:
            at = at if self.fresh is None else self.fresh
            self.velocity, self.done = wanted, True
            self.position = self._stopped_at(at + wanted * dt, command[Register.COMMAND_STOP_POSITION])
        else:
            self.velocity = speed if self.position is None else self.velocity
            goal = None if math.isnan(command[Register.COMMAND_POSITION]) else self.goal
            self.position = self._travelled(dt, at, goal, wanted, fastest, hardest)
        self.fresh = None
        if not command[Register.COMMAND_IGNORE_POSITION_BOUNDS]:
            self.position = _between(self.position, settings.position_min, settings.position_max)

    def come_to_rest(self, dt: float, hardest: float, shaft: float) -> None:
        """It slows down with this acceleration [rev/s²]; NaN: at once."""
        change = abs(self.velocity) if math.isnan(hardest) else hardest * dt
        at = shaft if self.position is None else self.position
        self.velocity -= math.copysign(min(change, abs(self.velocity)), self.velocity)
        self.position = at + self.velocity * dt

    def _stopped_at(self, at: float, stop: float) -> float:
        """Not beyond the stop position that is commanded, if one is."""
        if math.isnan(stop) or self.velocity == 0.0:
            return at
        reached = (at - stop) * self.velocity >= 0.0
        self.velocity = 0.0 if reached else self.velocity
        return stop if reached else at

    def _travelled(
        self,
        dt: float,
        at: float,
        goal: float | None,
        wanted: float,
        fastest: float | None,
        hardest: float | None,
    ) -> float:
        """A step towards x = goal + wanted·t, or to a velocity where no position was commanded."""
        aim = wanted
        if goal is not None:
            self.goal = goal = goal + wanted * dt
            way = goal - at
            room = abs(way) / dt if hardest is None else math.sqrt(2.0 * hardest * abs(way))
            aim = wanted + math.copysign(min(room, abs(way) / dt), way)
        if fastest is not None:
            aim = max(-fastest, min(fastest, aim))
        change = aim - self.velocity
        if hardest is not None:
            change = max(-hardest * dt, min(hardest * dt, change))
        self.velocity += change
        at += self.velocity * dt
        self.done = abs(self.velocity - wanted) <= (hardest or math.inf) * dt
        if goal is None:
            return at
        self.done = self.done and abs(goal - at) <= abs(change) * dt + 1e-6
        if not self.done:
            return at
        self.velocity = wanted
        return goal


def limits_of(settings: Settings, command: Mapping[int, float]) -> tuple[float | None, float | None]:
    """Of velocity and acceleration; None: none. A negative one in a command switches it off."""
    pairs = (
        (command[Register.COMMAND_VELOCITY_LIMIT], settings.default_velocity_limit),
        (command[Register.COMMAND_ACCEL_LIMIT], settings.default_accel_limit),
    )
    chosen = [or_else(said, default) for said, default in pairs]
    fastest, hardest = (None if math.isnan(x) or x < 0 else x for x in chosen)
    return fastest, hardest


def or_else(value: float, other: float) -> float:
    """A register that may be "not given"."""
    return other if math.isnan(value) else value


def _between(value: float, low: float, high: float) -> float:
    """Within bounds, where there are some."""
    if value < low:
        return low
    return high if value > high else value
