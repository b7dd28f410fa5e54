"""`Options` of the driver, and `Settings` of the lidar as it is in simulation."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, Literal, NamedTuple, TypeAlias

from protocols.bounds import Bounds, Invalid, check


class Model(NamedTuple):
    """What a datasheet says of a model."""

    samples: int
    """Per second"""
    farthest: float
    """m"""
    baudrate: int


Name: TypeAlias = Literal["LD06", "LD19", "STL-19P", "STL-27L"]
MODELS: dict[str, Model] = {
    "LD06": Model(4500, 12.0, 230_400),
    "LD19": Model(4500, 12.0, 230_400),
    "STL-19P": Model(5000, 12.0, 230_400),
    "STL-27L": Model(21_600, 25.0, 921_600),
}
NEAREST = 0.02
"""m, of all of them"""
USUAL_HZ = 10.0


@dataclass(frozen=True, slots=True)
class Options:
    """Configuration of the driver."""

    model: Name = "LD06"
    """No packet tells it: it decides how far a reading is believed, and how many beams a scan has."""
    beams: Annotated[int, Bounds(0, 5000)] = 0
    """Of a scan, evenly spaced; 0: as many as it measures in a turn of 10 Hz"""
    slowest_hz: Annotated[float, Bounds(0.1, 20.0)] = 5.0
    """Turns per second below which its speed is a fault"""
    fastest_hz: Annotated[float, Bounds(0.1, 20.0)] = 13.0
    """Turns per second beyond which its speed is a fault"""
    unsteady_ms: Annotated[float, Bounds(1.0, 60_000.0)] = 500.0
    """Time for which its speed must be out of these bounds, to be one"""
    offline_ms: Annotated[float, Bounds(20.0, 10_000.0)] = 500.0
    """Time without a packet after which it is offline"""

    def __post_init__(self) -> None:
        check(self)
        if self.slowest_hz >= self.fastest_hz:
            raise Invalid(("slowest_hz", "slowest_hz must be less than fastest_hz"))

    @property
    def count(self) -> int:
        """Beams of a scan"""
        return self.beams or round(MODELS[self.model].samples / USUAL_HZ)

    @property
    def farthest(self) -> float:
        """m"""
        return MODELS[self.model].farthest


@dataclass(frozen=True, slots=True)
class Settings:
    """The lidar in simulation. Its plant turns it: `clockwise`, `rate_hz`, `beams` of a lidar in its file."""

    speed_hz: Annotated[float, Bounds(0.0, 20.0)] = 10.0
    """Turns per second that it reports where the plant gives whole scans"""
    intensity: Annotated[int, Bounds(0, 255)] = 200
    """Of every return"""

    def __post_init__(self) -> None:
        check(self)
