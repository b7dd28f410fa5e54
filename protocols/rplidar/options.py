"""`Options` of the driver, and `Settings` of the lidar as it is in simulation."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Annotated, Literal, NamedTuple, TypeAlias

from protocols.bounds import Bounds, check
from protocols.rplidar import table


class Model(NamedTuple):
    """What a datasheet says of a model."""

    farthest: float
    """m"""
    baudrate: int
    major: int
    """The high half of the number that it tells; 0: not known"""
    begins_ms: float
    """Time in which it begins to scan. An A1, A2, A3 turns before; the others turn for the scan."""


Name: TypeAlias = Literal["A1", "A2M7", "A2M8", "A2M12", "A3", "S1", "S2", "S3", "C1"]
MODELS: Mapping[str, Model] = {name: Model(*row) for name, row in table.FILE["models"].items()}
NEAREST = 0.05
"""m, of all of them"""
REACH = {"standard": 16.38, "express": 16.383, "ultra": 28.656, "dense": 65.535, "hq": 100.0}
"""m that the numbers of a scan can hold"""
MODES = {"dense": 1, "hq": 2, "ultra": 3}
"""Their usual numbers"""


@dataclass(frozen=True, slots=True)
class Options:
    """Configuration of the driver."""

    model: Name = "A1"
    """It decides how far a reading is believed, and the baud rate."""
    start: bool = False
    """The driver asks, and starts and stops the scan. False: it sends nothing at all."""
    scan: table.Scan = "express"
    """What is asked for; what comes is read, whichever it is."""
    scan_mode: Annotated[int, Bounds(0, 255)] = 0
    """The device's number of a scan; 0: the first express one; 1 for dense, 2 for HQ, 3 for ultra"""
    motor: Literal["none", "pwm"] = "none"
    """Whether its motor is turned by SET_MOTOR_PWM (A2, A3); else by itself, or by DTR (A1: `dtr` of its
    bus)"""
    pwm: Annotated[int, Bounds(1, table.PWM_MOST)] = 660
    """What SET_MOTOR_PWM sends: duty in 1/1023"""
    spin_up_ms: Annotated[float, Bounds(0.0, 10_000.0)] = 1000.0
    """Time for the motor, when it was started by PWM, before the scan is"""
    beams: Annotated[int, Bounds(8, 5000)] = 400
    """Of a scan, evenly spaced"""
    offline_ms: Annotated[float, Bounds(500.0, 60_000.0)] = 3000.0
    """Time without a message after which it is offline; it may be silent until its turn is stable."""

    def __post_init__(self) -> None:
        check(self)

    @property
    def farthest(self) -> float:
        """m"""
        return min(MODELS[self.model].farthest, REACH[self.scan])

    @property
    def mode(self) -> int:
        """The number of the scan"""
        return self.scan_mode or MODES.get(self.scan, 0)


@dataclass(frozen=True, slots=True)
class Settings:
    """The lidar in simulation. Its plant turns it: `clockwise`, `rate_hz`, `beams` of a lidar in its file."""

    model: Annotated[int, Bounds(0, 255)] = 0x18
    firmware: Annotated[int, Bounds(0, 0xFFFF)] = 0x011D
    """1.29"""
    hardware: Annotated[int, Bounds(0, 255)] = 7
    standard_us: Annotated[int, Bounds(10, 10_000)] = 508
    express_us: Annotated[int, Bounds(10, 10_000)] = 254
    """µs per sample, as it tells them"""
    dense_mode: Annotated[int, Bounds(1, 255)] = 1
    """The number of its dense scan,"""
    hq_mode: Annotated[int, Bounds(1, 255)] = 2
    """of that of HQ,"""
    ultra_mode: Annotated[int, Bounds(1, 255)] = 3
    """and of its ultra one; others are express"""
    typical_mode: Annotated[int, Bounds(0, 255)] = 1
    """The number of the scan that it recommends"""
    motor: Literal["turns", "pwm"] = "turns"
    """Whether its motor turns by itself, or by SET_MOTOR_PWM"""
    spin_up_ms: Annotated[float, Bounds(0.0, 10_000.0)] = 400.0
    """From when it is asked to scan, or its motor is started, until its turn is stable"""

    def __post_init__(self) -> None:
        check(self)
