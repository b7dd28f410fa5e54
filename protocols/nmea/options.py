"""`Options` of the driver, and `Settings` of the receiver as it is in simulation."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, Literal, TypeAlias

from protocols.bounds import Bounds, check

Sigma: TypeAlias = Annotated[float, Bounds(1e-3, 1000.0, "m")]


@dataclass(frozen=True, slots=True)
class Options:
    """Configuration of the driver. The standard deviation of a fix is that of its quality times its HDOP."""

    fix_sigma: Sigma = 2.5
    dgps_sigma: Sigma = 1.0
    float_sigma: Sigma = 0.4
    rtk_sigma: Sigma = 0.02
    """m, horizontal, with an HDOP of 1"""
    worst: Literal["fix", "dgps", "float", "rtk"] = "fix"
    """The poorest quality that is reported"""
    latency_ms: Annotated[float, Bounds(0.0, 2000.0)] = 0.0
    """From the moment of a fix until its sentence begins, at the soonest"""
    offline_ms: Annotated[float, Bounds(100.0, 60_000.0)] = 3000.0
    """Time without a sentence after which it is offline"""

    def __post_init__(self) -> None:
        check(self)

    def sigma(self, quality: int) -> float | None:
        """Return the standard deviation [m] of a quality with an HDOP of 1; None if it is not reported."""
        order = ("fix", "dgps", "float", "rtk")
        name = {1: "fix", 3: "fix", 2: "dgps", 5: "float", 4: "rtk"}.get(quality)
        if name is None or order.index(name) < order.index(self.worst):
            return None
        sigma: float = getattr(self, f"{name}_sigma")
        return sigma


@dataclass(frozen=True, slots=True)
class Settings:
    """The receiver in simulation. Its plant gives its fixes: `rate_hz`, `noise` of a receiver in its file."""

    talker: Literal["GP", "GN", "GL", "GA", "GB"] = "GN"
    decimals: Annotated[int, Bounds(2, 9)] = 5
    """Of minutes: 5 are 2 cm"""
    satellites: Annotated[int, Bounds(0, 99)] = 12

    def __post_init__(self) -> None:
        check(self)
