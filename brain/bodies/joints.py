"""A body without a base: independent motors."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

from brain.bodies.body import Body


@dataclass(frozen=True, slots=True, kw_only=True)
class Joints(Body):
    """Motors, in the order of the robot file."""

    kind: ClassVar[str] = "joints"
    bare: ClassVar[bool] = True
    motors: tuple[str, ...]
    """The names of [motors.NAME] that it commands"""

    def __post_init__(self) -> None:
        self.check_motors()

    @classmethod
    def motor_keys(cls) -> tuple[str, ...]:
        """Return the key of the list."""
        return ("motors",)

    @property
    def joints(self) -> tuple[str, ...]:
        """The motors."""
        return self.motors
