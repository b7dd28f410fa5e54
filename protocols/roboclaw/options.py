"""`Options` of the driver, and `Settings` of the board as it is in simulation."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Annotated

from protocols.bounds import Bounds, check
from protocols.line import Answer
from protocols.messages import MILLISECOND
from protocols.roboclaw import table as rt
from protocols.roboclaw.table import TIMEOUT_UNIT_MS

MOST = (1 << 31) - 1


@dataclass(frozen=True, slots=True)
class Options:
    """Configuration of the driver."""

    counts: Annotated[int, Bounds(1, 100_000_000)] = 4096
    """Of the encoder in one revolution of the shaft at which the gateway counts: four times its lines."""
    max_qpps: Annotated[int, Bounds(1, MOST)] = 44_000
    """counts/s: largest speed that is commanded; not more than the board's QPPS, its speed at full power."""
    acceleration: Annotated[int, Bounds(1, MOST)] = 200_000
    """counts/s², on the way to a position."""
    timeout_ms: Annotated[int, Bounds(TIMEOUT_UNIT_MS, 255 * TIMEOUT_UNIT_MS)] = 200
    """Serial timeout, in steps of 100 ms, written before a motor is armed: the same for both of a board."""
    feedback_ms: Annotated[int, Bounds(2, 1000)] = 20
    """Period in which position and speed are asked for."""
    poll_ms: Annotated[int, Bounds(5, 500)] = 50
    """Period in which status and duty are asked for; all else is asked for ten times less often."""
    offline_ms: Annotated[int, Bounds(20, 10_000)] = 250
    """Time without an answer after which the motor is offline."""
    answer_ms: Annotated[float, Bounds(0.1, 50.0)] = 3.0
    """The longest time that the board waits before it answers, its USB port or adapter included."""
    scan: bool = True
    """A scan may ask all addresses."""

    def __post_init__(self) -> None:
        rest = self.timeout_ms % TIMEOUT_UNIT_MS
        wrong = f"timeout_ms is {self.timeout_ms}: it has steps of {TIMEOUT_UNIT_MS}"
        check(self, ("timeout_ms", wrong if rest else ""))

    def answer(self, frame: bytes) -> Answer:
        """Return what comes back to a message."""
        delay = round(self.answer_ms * MILLISECOND)
        return Answer(rt.size_of_answer(frame), rt.find_answer, delay)

    @property
    def timeout(self) -> int:
        """The serial timeout in the board's unit"""
        return self.timeout_ms // TIMEOUT_UNIT_MS

    @property
    def unit(self) -> float:
        """rad of one count"""
        return math.tau / self.counts


@dataclass(frozen=True, slots=True)
class Settings:
    """Configuration of the board, and its motor."""

    timeout: Annotated[int, Bounds(0, 255)] = 0
    """Serial timeout as saved, in 0.1 s; 0: off"""
    velocity_p: Annotated[int, Bounds(0, MOST)] = 65536
    """1/65536"""
    velocity_i: Annotated[int, Bounds(0, MOST)] = 32768
    velocity_d: Annotated[int, Bounds(0, MOST)] = 16384
    qpps: Annotated[int, Bounds(0, MOST)] = 44_000
    """Speed at full power; as delivered 44000"""
    max_current: Annotated[int, Bounds(0, MOST)] = 1500
    """0.01 A"""
    min_current: Annotated[int, Bounds(0, MOST)] = 0
    older_status: bool = False
    """Its firmware is older than 4.1.3x: a status of 16 bits."""
    max_torque: Annotated[float, Bounds(0.01, 1000.0)] = 5.0
    """N·m"""
    torque_constant: Annotated[float, Bounds(1e-4, 100.0)] = 0.05
    """N·m/A"""
    resistance: Annotated[float, Bounds(1e-3, 100.0)] = 0.1
    """Ω"""
    supply: Annotated[float, Bounds(6.0, 60.0)] = 24.0
    """V"""
    temperature: Annotated[float, Bounds(0.0, 150.0)] = 30.0
    """°C"""

    def __post_init__(self) -> None:
        check(self)
