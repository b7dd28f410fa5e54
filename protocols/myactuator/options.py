"""`Options` of the driver, `Settings` of the motor itself. SI units, at the motor's output shaft."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Annotated, Literal

from protocols.bounds import Bounds, check
from protocols.myactuator.table import table_of
from protocols.toolkit.mit import KD_MAX, KP_MAX, ImpedanceGains, gains_of
from protocols.toolkit.table import Table


@dataclass(frozen=True, slots=True)
class Options:
    """Configuration of the driver."""

    mode: Literal["servo", "motion"] = "servo"
    """The motor's own loops for current, speed and position, or five numbers (firmware of 2022 and later)."""
    torque_constant: Annotated[float, Bounds(1e-3, 100.0)] = 1.0
    """N·m/A at the output shaft, from the model's data sheet (mode servo)"""
    max_velocity: Annotated[float, Bounds(0.02, 1000.0)] = 5.0
    """rad/s on the way to a Position (mode servo), in steps of a degree per second"""
    stiffness: Annotated[float, Bounds(0.2, KP_MAX)] = 20.0
    """N·m/rad of Position and Hold (mode motion)"""
    damping: Annotated[float, Bounds(0.01, KD_MAX)] = 1.0
    """N·m·s/rad of Position, Hold and Velocity (mode motion)"""
    position_end: Annotated[float, Bounds(1.0, 100.0)] = 12.5
    """rad of the motion mode, which must be the firmware's: 12.5 in V4.2. Uncertain beyond."""
    velocity_end: Annotated[float, Bounds(1.0, 200.0)] = 45.0
    """rad/s of the motion mode, likewise"""
    torque_end: Annotated[float, Bounds(1.0, 500.0)] = 24.0
    """N·m of the motion mode, likewise"""
    brake: bool = False
    """It has a brake, which is released before it is driven, and locked when it is released."""
    idle_current: Annotated[float, Bounds(0.05, 50.0)] = 0.5
    """A: what is measured beyond it drives the motor"""
    timeout_ms: Annotated[int, Bounds(0, 5000)] = 200
    """Of the motor's watchdog, written into its ROM at the first command; 0: not written, and it counts as
    having none. Not less than `offline_ms`, so that a motor that let go is offline first."""
    scan: bool = True
    """A scan may ask all addresses. Set it to false where others on the bus obey ids 140h to 17Fh."""
    feedback_ms: Annotated[int, Bounds(1, 1000)] = 10
    """Period of questions to a motor that is not commanded."""
    offline_ms: Annotated[int, Bounds(20, 10_000)] = 100
    """Time without an answer after which the motor is offline."""

    def __post_init__(self) -> None:
        late = 0 < self.timeout_ms < self.offline_ms
        check(self, ("timeout_ms", "timeout_ms must not be less than offline_ms" if late else ""))

    @property
    def fastest(self) -> int:
        """Degrees per second on the way to a Position: 0 would be no limit."""
        return max(1, round(math.degrees(self.max_velocity)))

    @property
    def table(self) -> Table:
        """The messages with these ends."""
        return table_of(self.position_end, self.velocity_end, self.torque_end)

    @property
    def gains(self) -> ImpedanceGains:
        """Gains of the motion mode."""
        return gains_of(self.table, "motion", self.stiffness, self.damping)


@dataclass(frozen=True, slots=True)
class Settings:
    """What the motor is in simulation."""

    timeout_ms: Annotated[int, Bounds(0, 100_000)] = 0
    """Of its watchdog, as its ROM has it; as delivered 0: none"""
    torque_limit: Annotated[float, Bounds(0.01, 500.0)] = 10.0
    """N·m"""
    acceleration: Annotated[int, Bounds(100, 60_000)] = 10_000
    """Degrees per second² towards a speed and a position, and back (mode servo)"""
    version: Annotated[int, Bounds(20200101, 20991231)] = 20240528
    """Date of its firmware"""
    supply: Annotated[float, Bounds(5.0, 100.0)] = 48.0
    """V"""
    temperature: Annotated[float, Bounds(-40.0, 120.0)] = 30.0
    """°C"""

    def __post_init__(self) -> None:
        check(self)
