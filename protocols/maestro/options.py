"""`Options` of the driver and of the servo on a channel, and `Settings` of the servo as it is in
simulation."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, ClassVar

from protocols.bounds import Bounds
from protocols.maestro import table as mt
from protocols.toolkit.pulses import ServoOptions, ServoSettings

TIMEOUT_UNIT_MS = 10


@dataclass(frozen=True, slots=True, kw_only=True)
class Options(ServoOptions):
    """Configuration of the driver, and what is configured on the board."""

    speed: Annotated[float, Bounds(0.0, 100.0)] = 0.0
    """rad/s at most by the board's own ramp, written before the first pulse; 0: none, the joint's limits
    alone"""
    acceleration: Annotated[float, Bounds(0.0, 1000.0)] = 0.0
    """rad/s² of that ramp; 0: at once"""
    crc: bool = False
    """The board is configured for CRC ("Enable CRC"): it ignores messages without one, and this with a line
    that damages some is the better way"""
    timeout_ms: Annotated[int, Bounds(0, 655_350)] = 0
    """The serial timeout that the board is configured for; its outputs go home then, as that is configured.
    0: none"""

    offline_ms: ClassVar[int] = 250

    def __post_init__(self) -> None:
        rest = self.timeout_ms % TIMEOUT_UNIT_MS
        wrong = f"timeout_ms is {self.timeout_ms}: it has steps of {TIMEOUT_UNIT_MS}"
        self.check(("timeout_ms", wrong if rest else ""))

    @property
    def set_up(self) -> dict[str, int]:
        """What the board's own ramp is set to, by message."""
        speed, acceleration = self.speed * self.rate, self.acceleration * self.rate
        return {
            "SETSPEED": _counts(speed / mt.SPEED_UNIT, mt.MOST),
            "SETACCELERATION": _counts(acceleration / mt.ACCELERATION_UNIT, 255),
        }


def _counts(value: float, most: int) -> int:
    """Return a limit in counts: 1 at least, since 0 is none."""
    return min(most, max(1, round(value))) if value else 0


Settings = ServoSettings
