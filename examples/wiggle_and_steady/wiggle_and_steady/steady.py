"""A brain for two wheels and a gyro: it drives as a hand says, and turns as fast as it says on any floor."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Annotated

from brain.other_brain import BrainKind, Moment
from protocols.bounds import Bounds, check
from protocols.messages import MILLISECOND, Command, Drive, Idle, Imu, Nanos, Velocity

HELD: Nanos = 300 * MILLISECOND
"""How long a hand's twist counts."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Settings:
    """[brain.steady] of the robot file: SI, with bounds."""

    left: str
    right: str
    gyro: str
    wheel_radius: Annotated[float, Bounds(0.01, 1.0, "m")]
    track: Annotated[float, Bounds(0.05, 5.0, "m")]
    """m between the wheels"""
    gain: Annotated[float, Bounds(0.0, 2.0)] = 0.5
    """Share of the error of the turn rate that is added to it"""

    def __post_init__(self) -> None:
        check(self)


class Steady:
    """Makes the commands. Plain data: a copy goes on as the original."""

    def __init__(self, settings: Settings, motors: Sequence[str]) -> None:
        if missing := {settings.left, settings.right} - set(motors):
            raise ValueError(f"there is no motor {', '.join(sorted(missing))}")
        self.settings = settings
        self.hand: Drive | None = None
        self.until: Nanos = 0

    def step(self, moment: Moment) -> Iterable[Command]:
        """Return a command for each wheel. Called at every step, so it computes little."""
        for task in moment.tasks:
            if isinstance(task, Drive):
                self.hand, self.until = task, moment.now + HELD
        own, reading = self.settings, moment.readings[self.settings.gyro]
        if self.hand is None or not isinstance(reading, Imu):
            return Idle(own.left), Idle(own.right)
        if moment.now > self.until:
            self.hand = Drive(0.0, 0.0)
        turn = self.hand.angular + own.gain * (self.hand.angular - reading.angular_velocity[2])
        left, right = (self.hand.linear + side * turn * own.track / 2.0 for side in (-1.0, 1.0))
        return Velocity(own.left, left / own.wheel_radius), Velocity(own.right, right / own.wheel_radius)


kind = BrainKind(name="steady", settings=Settings, make=Steady, takes=(Drive,))
