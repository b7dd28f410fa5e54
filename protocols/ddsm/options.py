"""`Options` of the driver, and `Settings` of the motor as it is in simulation."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, Literal

from protocols.bounds import Bounds, check
from protocols.ddsm import table as ds
from protocols.line import Answer
from protocols.messages import MILLISECOND, Nanos


@dataclass(frozen=True, slots=True)
class Options:
    """Configuration of the driver."""

    model: Literal["DDSM115", "DDSM210"] = "DDSM115"
    """The messages, the line (RS-485, or a UART), the scale of speeds, and whether it takes a torque"""
    torque_constant: Annotated[float, Bounds(0.0, 100.0)] = 0.0
    """N·m/A; 0: that of the model (0.75; of a DDSM210 it is not known, and no torque is reported)"""
    idle_current: Annotated[float, Bounds(0.0, 8.0)] = 0.2
    """A: what is measured beyond it drives the motor"""
    feedback_ms: Annotated[float, Bounds(1.0, 1000.0)] = 10.0
    """Period of queries, where no answer to a set-point tells as much"""
    offline_ms: Annotated[float, Bounds(10.0, 10_000.0)] = 250.0
    """Time without an answer after which it is offline"""
    answer_ms: Annotated[float, Bounds(0.1, 100.0)] = 2.5
    """How late an answer may begin: the vendor's code waits 4 ms, with the 1.7 ms of question and answer"""
    watchdog: Literal["unknown", "acknowledged"] = "unknown"
    """Acknowledge that none is known."""

    def __post_init__(self) -> None:
        check(self)

    @property
    def of_model(self) -> ds.Model:
        """What the model determines."""
        return ds.MODELS[self.model]

    @property
    def delay(self) -> Nanos:
        """How late an answer may begin"""
        return round(self.answer_ms * MILLISECOND)

    def answer(self, address: int) -> Answer:
        """Return what comes back from a motor. A DDSM115 does not say what it answers."""
        alike = f"{address}" if self.of_model.names_mode else ""
        return Answer(ds.SIZE, ds.FINDS[self.model], self.delay, alike=alike)

    @property
    def strongest(self) -> float:
        """N·m that can be commanded; 0: none"""
        return self.of_model.strongest * self.torque / ds.AMPERE

    @property
    def torque(self) -> float:
        """N·m of a count of current"""
        return ds.AMPERE * (self.torque_constant or self.of_model.torque_constant)


@dataclass(frozen=True, slots=True)
class Settings:
    """The motor in simulation."""

    start_mode: Literal["released", "speed"] = "released"
    """The mode in which it is switched on; the vendor does not say which."""
    answer_us: Annotated[float, Bounds(0.0, 100_000.0)] = 200.0
    """From the end of a question to its answer"""
    fault_ms: Annotated[float, Bounds(1.0, 100_000.0)] = 500.0
    """How long a fault lasts"""
    temperature: Annotated[float, Bounds(0.0, 255.0)] = 30.0
    """°C"""

    def __post_init__(self) -> None:
        check(self)
