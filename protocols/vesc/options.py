"""`Options` of the driver, and `Settings` of the controller as it is in simulation."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Annotated

from protocols.bounds import Bounds, check
from protocols.vesc.table import STATUS, STEPS


@dataclass(frozen=True, slots=True)
class MotorOptions:
    """Configuration of the driver, over any transport. What a controller does not tell must be as it is
    configured there."""

    pole_pairs: Annotated[int, Bounds(1, 100)] = 7
    """Electrical revolutions in one of the shaft: the number of magnets, halved."""
    torque_constant: Annotated[float, Bounds(1e-4, 100.0)] = 0.05
    """N·m/A: 1.5 · pole pairs · flux linkage"""
    max_current: Annotated[float, Bounds(0.1, 1000.0)] = 20.0
    """A: Motor Current Max"""
    max_erpm: Annotated[float, Bounds(100.0, 1e6)] = 100_000.0
    """ERPM: Max ERPM"""
    min_erpm: Annotated[float, Bounds(0.0, 1e6)] = 0.0
    """ERPM: Minimum ERPM (as delivered 900). At slower set-points a controller that drives shorts its phases:
    that damps the shaft, and holds nothing; one that does not drive stays so."""
    idle_current: Annotated[float, Bounds(0.0, 10.0)] = 0.15
    """A: what is measured beyond it drives the motor"""
    timeout_ms: Annotated[int, Bounds(20, 3000)] = 300
    """Timeout of the controller (as delivered 1000, or 500 by the vendor's page): a longer one is a fault."""
    offline_ms: Annotated[int, Bounds(20, 10_000)] = 200
    """Time without a frame after which the controller is offline."""

    def __post_init__(self) -> None:
        check(self)

    @property
    def erpm(self) -> float:
        """rad/s of one ERPM"""
        return math.pi / 30.0 / self.pole_pairs

    @property
    def step(self) -> float:
        """rad of one step of the tachometer"""
        return 2.0 * math.pi / (STEPS * self.pole_pairs)


@dataclass(frozen=True, slots=True)
class Options(MotorOptions):
    """Configuration of the driver over CAN."""

    host_id: Annotated[int, Bounds(0, 254)] = 254
    """Address to which controllers reply; no controller may have it."""
    scan: bool = True
    """A scan may ask all addresses. Set it to false for all controllers on a bus where others obey its ids
    (11xxh of 29 bits)."""
    feedback_ms: Annotated[int, Bounds(1, 1000)] = 20
    """Period of STATUS_1, 4 and 5: 1000 / CAN Status Messages Rate 1."""
    poll_ms: Annotated[int, Bounds(5, 200)] = 50
    """Period in which fault and timeout are asked for."""


@dataclass(frozen=True, slots=True)
class MotorSettings:
    """Configuration of the controller in simulation, where it is not that of the options."""

    timeout_ms: Annotated[int, Bounds(0, 1_000_000)] = 0
    """0: that of the options"""
    min_erpm: Annotated[float, Bounds(0.0, 1e6)] = 0.0
    """0: that of the options"""
    supply: Annotated[float, Bounds(5.0, 1000.0)] = 24.0
    """V"""
    resistance: Annotated[float, Bounds(1e-3, 100.0)] = 0.1
    """Ω of the motor"""
    temperature: Annotated[float, Bounds(-40.0, 120.0)] = 30.0
    """°C"""

    def __post_init__(self) -> None:
        check(self)


@dataclass(frozen=True, slots=True)
class Settings(MotorSettings):
    """Configuration of the controller in simulation, on CAN."""

    status_messages: Annotated[int, Bounds(0, (1 << len(STATUS)) - 1)] = 0b011001
    """A bit for each of STATUS_1, 2 …; as delivered 0: none is sent"""
