"""The one gate per motor: gear, sign, limits, age, latched faults, finiteness, claim.

Rules. Between this file and the wire nobody looks at limits again but the guard; between this file and
the brain nobody knows of gears. A joint gives exactly one command a step (`allow`), whatever the
brain said or did not say. Faults latch here until an operator clears them. Nothing can be switched
off: every limit and timeout is a positive finite number. Inside, all is at the output shaft.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

from protocols.words import MILLISECOND, Nanos


@dataclass(frozen=True, slots=True)
class Limits:
    """At the joint's output shaft; all magnitudes."""

    velocity: float
    """rad/s"""
    acceleration: float
    """rad/s²"""
    torque: float
    """N·m"""
    position: tuple[float, float] | None = None
    """rad, lowest and highest; None for a wheel"""


@dataclass(frozen=True, slots=True)
class JointSettings:
    """A motor's part of the robot file that concerns every protocol alike."""

    limits: Limits
    gear: float = 1.0
    """Turns of the device's shaft per turn of the joint."""
    sign: Literal[1, -1] = 1
    silent: Literal["idle", "hold"] = "idle"
    """What a silent brain means."""
    safe: Literal["idle", "hold"] = "idle"
    """The last word on stop, fault and exit."""
    on_fault: Literal["stop", "continue"] = "stop"
    """A fault or blindness of this joint stops the whole robot, or only this joint."""
    command_timeout: Nanos = 100 * MILLISECOND
    feedback_timeout: Nanos = 100 * MILLISECOND
