"""`Options` of the driver, and `Settings` of the board as it is in simulation."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, ClassVar, Literal

from protocols.bounds import Bounds, check
from protocols.hoverboard import table as hb


@dataclass(frozen=True, slots=True)
class Options:
    """Configuration of the driver: it must be as the firmware was built, the same for both motors."""

    control: Literal["duty", "speed", "torque"] = "duty"
    """CTRL_MOD_REQ: VLT_MODE (as delivered: a share of the voltage), SPD_MODE or TRQ_MODE"""
    full_scale: Annotated[float, Bounds(1.0, 1000.0)] = 70.0
    """rad/s of a wheel without a load at 1000, of VLT_MODE: measure it, with the battery half full"""
    torque_full: Annotated[float, Bounds(0.1, 1000.0)] = 7.5
    """N·m at 1000, of TRQ_MODE: I_MOT_MAX (15 A) times the torque constant (0.5 N·m/A)"""
    tank: bool = False
    """TANK_STEERING; without it the firmware mixes steer and speed (coefficients as delivered), and a motor
    can be given half of the full scale."""
    mirrored: bool = True
    """The right motor's reported speed has the other sign (a build without INVERT_R_DIRECTION)."""
    left_mirrored: bool = False
    """The left motor's reported speed has the other sign (a build with INVERT_L_DIRECTION)."""
    offline_ms: Annotated[float, Bounds(20.0, 10_000.0)] = 100.0
    """Time without feedback after which it is offline"""
    feedback_ms: ClassVar[int] = hb.PERIOD_MS

    def __post_init__(self) -> None:
        check(self)

    @property
    def unit(self) -> float:
        """rad/s or N·m of a count"""
        units = {"duty": self.full_scale / hb.MOST, "speed": hb.RPM, "torque": self.torque_full / hb.MOST}
        return units[self.control]

    @property
    def most(self) -> int:
        """Counts to which any pair of motors can be given"""
        return hb.MOST if self.tank else hb.MOST // 2

    @property
    def least(self) -> int:
        """Counts that keep a motor commanded: 0 lets go of it, but in SPD_MODE, where it holds 0 rpm."""
        return 0 if self.control == "speed" else 1

    def sign(self, address: int) -> int:
        """Return the sign of a motor's reported speed, forwards."""
        return -1 if (self.mirrored if address == hb.RIGHT else self.left_mirrored) else 1


@dataclass(frozen=True, slots=True)
class Settings:
    """The board in simulation."""

    torque_constant: Annotated[float, Bounds(1e-3, 100.0)] = 0.5
    """N·m/A"""
    resistance: Annotated[float, Bounds(1e-3, 100.0)] = 0.3
    """Ω of a motor, its cables and the battery"""
    current_most: Annotated[float, Bounds(0.1, 100.0)] = 15.0
    """A, I_MOT_MAX"""
    voltage: Annotated[float, Bounds(1.0, 300.0)] = 36.0
    temperature: Annotated[float, Bounds(-40.0, 150.0)] = 30.0
    """°C of the board"""

    def __post_init__(self) -> None:
        check(self)
