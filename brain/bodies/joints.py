"""A body without a base: independent motors."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True, slots=True)
class Joints:
    """Motors, in the order of the robot file."""

    motors: tuple[str, ...]

    def __post_init__(self) -> None:
        if not self.motors or any(not name for name in self.motors):
            raise ValueError("a body of joints needs at least one motor, each with a name")
        if len(set(self.motors)) < len(self.motors):
            raise ValueError("a body of joints names each motor once")
