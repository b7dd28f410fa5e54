"""Targets for bare joints: what an operator wants of each motor, kept until it is told otherwise.

Rules. A target is said at every step, so its age on the wire is the step's period, until another target, or
a stop, or the motor's own silence ends it. A position stays; so do a velocity and a torque, since a person
types `velocity left 2` once: whoever wants them to end says so, or stops the robot. After a stop, a fault
or a silence every target is gone: nothing moves again by itself when the reason goes away.
What a device cannot do is made of what it can in this file, too, once such a device is there.
"""

from __future__ import annotations

from collections.abc import Sequence
from difflib import get_close_matches

from protocols.messages import Command, Idle


class Targets:
    """One target per motor; Idle until something is asked."""

    def __init__(self, motors: Sequence[str]) -> None:
        self._wanted: dict[str, Command] = {motor: Idle(motor) for motor in motors}

    def ask(self, command: Command) -> str:
        """Take up a target; "" or why it is not taken."""
        if command.motor not in self._wanted:
            known = ", ".join(self._wanted)
            near = get_close_matches(command.motor, self._wanted, 1)
            hint = f"; did you mean {near[0]!r}?" if near else ""
            return f"there is no motor {command.motor!r}; there are {known}{hint}"
        self._wanted[command.motor] = command
        return ""

    def drop(self, motor: str) -> bool:
        """End the target of a motor; whether it had one."""
        had = self.has(motor)
        self._wanted[motor] = Idle(motor)
        return had

    def has(self, motor: str) -> bool:
        """Whether the motor is to do anything but nothing."""
        return not isinstance(self._wanted[motor], Idle)

    def wanted(self) -> tuple[str, ...]:
        """The motors that are to do something, in the order of the robot file."""
        return tuple(motor for motor in self._wanted if self.has(motor))

    def commands(self) -> tuple[Command, ...]:
        """One command per motor, in the order of the robot file."""
        return tuple(self._wanted.values())
