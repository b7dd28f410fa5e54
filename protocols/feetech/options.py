"""`Options` of the driver, and `Settings` of the servo as it is in simulation."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Literal

from protocols.feetech.table import MODELS, Model
from protocols.toolkit.options import bounded, check_bounds

Mode = Literal["position", "wheel", "pwm"]
MODES: dict[str, int] = {"position": 0, "wheel": 1, "pwm": 2}
RPM = math.pi / 30.0


@dataclass(frozen=True, slots=True)
class Options:
    """Configuration of the driver."""

    model: Literal["sts3215", "sts3250", "sm8512bl", "sts", "scs0009", "scs"] = "sts3215"
    """What a step is, and the order of bytes. sts, scs: others of the family; their number is not checked."""
    mode: Mode = "position"
    """position: within a turn (SCS: 300°). wheel: by velocity. pwm: by the share of the supply."""
    stall_torque: float = bounded(2.94, 0.01, 100.0)
    """N·m at standstill with the whole supply, in mode pwm; sts3215 at 12 V: 30 kg·cm."""
    max_velocity: float = bounded(0.0, 0.0, 50.0)
    """rad/s on the way to a position; 0: as fast as it can"""
    acceleration: float = bounded(0.0, 0.0, 39.0)
    """rad/s², on the way to a position or velocity; 0: none is limited"""
    torque_limit: float = bounded(0.0, 0.0, 1.0)
    """Share of the stall torque that it gives at most, until it is switched off; 0: as configured"""
    sync_read: bool = True
    """Ask all servos at once for their motion (SCS servos have no such instruction)."""
    feedback_ms: float = bounded(10.0, 1.0, 1000.0)
    """Period in which the motion is asked for"""
    offline_ms: float = bounded(100.0, 10.0, 10_000.0)
    """Time without an answer after which the servo is offline"""

    def __post_init__(self) -> None:
        modes = self.of_model.family.modes
        wrong = MODES[self.mode] not in modes
        check_bounds(self, [f"a {self.model} has no mode {self.mode}" if wrong else ""])

    @property
    def of_model(self) -> Model:
        """The model."""
        return MODELS[self.model]

    @property
    def written(self) -> dict[str, int]:
        """What is written before it is armed, in this order: with Lock, nothing of it is stored."""
        model, position = self.of_model, self.mode == "position"
        wanted = {"Lock": 1, "Return_Delay_Time": 0}
        if model.family.name == "sts":
            wanted["Operating_Mode"] = MODES[self.mode]
            wanted["Acceleration"] = min(254, round(self.acceleration / model.step / 100.0))
            wanted |= {"Torque_Limit": round(self.torque_limit * 1000.0)} if self.torque_limit else {}
        if position:
            wanted |= {"Goal_Time": 0, "Goal_Velocity": min(0x7FFF, round(self.max_velocity / model.step))}
        return wanted


@dataclass(frozen=True, slots=True)
class Settings:
    """Configuration of the servo in simulation."""

    mode: int = bounded(0, 0, 2)
    """Operating_Mode as stored"""
    full_angle: bool = True
    """Bit 4 of Phase: positions beyond a turn are reported as such (or else within one turn)"""
    offset: int = bounded(0, -2047, 2047)
    """Homing_Offset"""
    return_delay: int = bounded(250, 0, 254)
    """Return_Delay_Time: 2 µs"""
    stall_torque: float = bounded(2.94, 0.01, 100.0)
    """N·m at 12 V"""
    no_load_speed: float = bounded(45.0 * RPM, 0.1, 100.0)
    """rad/s at 12 V"""
    stall_current: float = bounded(2.7, 0.1, 100.0)
    """A"""
    stiffness: float = bounded(60.0, 0.1, 1e5)
    """N·m/rad of its loop for position, as delivered (P_Coefficient 32)"""
    supply: float = bounded(12.0, 4.0, 25.0)
    """V"""
    temperature: float = bounded(30.0, 0.0, 120.0)
    """°C"""

    def __post_init__(self) -> None:
        check_bounds(self)
