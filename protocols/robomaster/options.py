"""`Options` of the driver, and `Settings` of the controller as it is in simulation."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, ClassVar, Literal

from protocols.bounds import Bounds, check
from protocols.robomaster.table import MODELS, PERIOD_MS, Model


@dataclass(frozen=True, slots=True)
class Options:
    """Configuration of the driver."""

    model: Literal["C620", "C610", "GM6020"] = "C620"
    """C620 with M3508, C610 with M2006, GM6020 in its current mode: the frames, and the scale of currents"""
    current_end: Annotated[float, Bounds(0.0, 100.0)] = 0.0
    """A of the largest current, in commands and feedback; 0: that of the model. Uncertain for a GM6020: 3
    here, 1.62 by others. Too large a number makes it weaker than commanded, not stronger."""
    torque_constant: Annotated[float, Bounds(0.0, 100.0)] = 0.0
    """N·m/A at the rotor; 0: that of the motor that is sold with the model"""
    idle_current: Annotated[float, Bounds(0.0, 10.0)] = 0.3
    """A: what is measured beyond it drives the motor"""
    timeout_ms: Annotated[int, Bounds(20, 3000)] = 500
    """Silence after which the controller stops the motor. Uncertain: no document has it. Until then, at
    worst, a motor that was let go is not."""
    error_byte: bool = True
    """Byte 7 of the feedback is an error (C620, newer firmware). Uncertain: false, if it is not."""
    offline_ms: Annotated[int, Bounds(5, 10_000)] = 100
    """Time without feedback after which the controller is offline."""
    feedback_ms: ClassVar[int] = PERIOD_MS

    def __post_init__(self) -> None:
        check(self)

    @property
    def of_model(self) -> Model:
        """What the model determines."""
        return MODELS[self.model]

    @property
    def ampere(self) -> float:
        """A of one count of current"""
        return (self.current_end or self.of_model.current) / self.of_model.full

    @property
    def torque(self) -> float:
        """N·m of one count of current"""
        return self.ampere * (self.torque_constant or self.of_model.torque_constant)


@dataclass(frozen=True, slots=True)
class Settings:
    """The controller in simulation."""

    timeout_ms: Annotated[int, Bounds(0, 1_000_000)] = 0
    """0: that of the options"""
    temperature: Annotated[float, Bounds(0.0, 255.0)] = 30.0
    """°C of the motor"""

    def __post_init__(self) -> None:
        check(self)
