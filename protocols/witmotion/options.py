"""`Options` of the driver, and `Settings` of the sensor as it is in simulation."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, Literal

from protocols.bounds import Bounds, check
from protocols.witmotion import table


@dataclass(frozen=True, slots=True)
class Options:
    """Configuration of the driver."""

    orientation: Literal["angle", "quaternion", "none"] = "angle"
    """Of which packet (53, 59) it is; a reading is complete with that, or else with the angular rates"""
    offline_ms: Annotated[float, Bounds(20.0, 60_000.0)] = 500.0
    """Time without a packet after which it is offline"""

    def __post_init__(self) -> None:
        check(self)


@dataclass(frozen=True, slots=True)
class Settings:
    """What is configured on the sensor, in simulation."""

    content: Annotated[int, Bounds(0, 0x7FF)] = 0x1E
    """RSW: bit n is packet 0x50 + n"""
    rate_hz: Annotated[float, Bounds(0.2, 200.0)] = 10.0
    """RRATE"""

    def __post_init__(self) -> None:
        rates = ", ".join(f"{rate:g}" for rate in table.RATES.values())
        wrong = "" if self.rate_hz in table.RATES.values() else f"rate_hz is {self.rate_hz:g}: it has {rates}"
        check(self, ("rate_hz", wrong))

    @property
    def rate(self) -> int:
        """The code of its rate"""
        return next(code for code, rate in table.RATES.items() if rate == self.rate_hz)
