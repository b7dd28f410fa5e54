"""`Options` of the driver, and `Settings` of the valve and its cylinder as they are in simulation.

A cylinder is a joint that slides: what is rad elsewhere is m here, what is N·m is N."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated

from protocols.bounds import Bounds, Invalid, check
from protocols.j1939_valve import table as jt

Node = Annotated[int, Bounds(0, jt.NODES.stop - 1)]


@dataclass(frozen=True, slots=True)
class Options:
    """Configuration of the driver."""

    ecu: Node = 0x80
    """Address of the valve's controller, by which it reports"""
    host: Node = 0x27
    """Our address, which is claimed before anything is commanded: 0 to 127 and 248 to 253 may send at once,
    the others 250 ms later"""
    name: Annotated[int, Bounds(1, 2**64 - 1)] = 0x2000_8400_FFE0_0001
    """Our NAME: of two that claim an address the lower one has it"""
    full_flow: Annotated[float, Bounds(1e-3, 1e3)] = 5.0
    """m/s of the cylinder (or rad/s) at full flow: measure it, nothing checks it"""
    dead_band: Annotated[float, Bounds(0.0, 0.5)] = 0.0
    """Share of the flow that is commanded up to which nothing flows: it is passed over"""
    stroke: Annotated[float, Bounds(1e-3, 100.0)] = 1.0
    """m of the cylinder (or rad) from 0 to 100 % of its position"""
    retracted: Annotated[float, Bounds(-1e3, 1e3)] = 0.0
    """m (or rad) at 0 %"""
    tight: bool = False
    """Its closed ports hold the load, or a valve on the cylinder does: nothing falls when it is disarmed"""
    timeout_ms: Annotated[int, Bounds(50, 3000)] = 300
    """Time without a command after which the valve's controller closes it, as it is configured there"""
    feedback_ms: Annotated[float, Bounds(5.0, 1000.0)] = 100.0
    """Period of its reports"""
    offline_ms: Annotated[float, Bounds(10.0, 10_000.0)] = 500.0
    """Time without one after which it is offline"""

    def __post_init__(self) -> None:
        check(self)
        if self.host == self.ecu:
            raise Invalid(("host", f"host is {self.host}, the address of the valve's controller"))

    def flow(self, velocity: float) -> int:
        """Return the counts of flow for a velocity, without its sign."""
        share = min(1.0, abs(velocity) / self.full_flow)
        opened = self.dead_band + (1.0 - self.dead_band) * share if share else 0.0
        return round(opened * jt.MOST)

    def velocity(self, flow: int) -> float:
        """Return the velocity of some counts of flow, without its sign."""
        share = (min(flow, jt.MOST) / jt.MOST - self.dead_band) / (1.0 - self.dead_band)
        return self.full_flow * max(0.0, share)


@dataclass(frozen=True, slots=True)
class Settings:
    """What valve and cylinder truly are."""

    dead_band: Annotated[float, Bounds(0.0, 0.5)] = 0.0
    """Share of the spool's way up to which nothing flows"""
    lag_ms: Annotated[float, Bounds(0.0, 1000.0)] = 5.0
    """Time constant of the spool"""
    flow: Annotated[float, Bounds(0.2, 2.0)] = 1.0
    """Its full flow, of what `full_flow` says"""
    force: Annotated[float, Bounds(0.01, 1e7)] = 10.0
    """N (or N·m) at the relief valve's pressure, either way"""
    stiffness: Annotated[float, Bounds(1e-3, 1e7)] = 0.5
    """N·s/m (or N·m·s/rad): how much force a difference of the velocity makes"""
    oil: Annotated[float, Bounds(0.0, 1e9)] = 3.0
    """N/m (or N·m/rad) of the column of oil"""
    tight: bool = False
    """Closed ports hold the load; if not, they leak so much that they hold none"""
    fault_ms: Annotated[float, Bounds(1.0, 100_000.0)] = 500.0
    """How long an error lasts"""

    def __post_init__(self) -> None:
        check(self)
