"""`Options` of the driver, `Settings` of the motor itself. SI units at the output shaft."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Literal

from protocols.cubemars import table as cm
from protocols.toolkit.mit import KD_MAX, KP_MAX, ImpedanceGains, gains_of
from protocols.toolkit.options import bounded, check_bounds
from protocols.toolkit.table import Table

# fmt: off
Model = Literal[
    "AK10-9", "AK60-6", "AK70-10", "AK80-6", "AK80-6 V1.0", "AK80-6 V1.1", "AK80-9", "AK80-9 V1.1",
    "AK80-9 V2", "AK80-64",
]
# fmt: on


@dataclass(frozen=True, slots=True)
class Options:
    """Configuration of the driver. What a motor does not tell must be as it is configured there."""

    mode: Literal["servo", "mit"] = "servo"
    """The mode that the motor is set to with the vendor's tool."""
    turns: bool = False
    """For wheels: position is counted on by velocity beyond what the motor reports (servo ±3200°, mit the
    model's). Commands are Velocity and Torque then."""
    # -- servo mode
    pole_pairs: int = bounded(21, 1, 100)
    """Electrical revolutions in one of the rotor"""
    gear: float = bounded(9.0, 1.0, 1000.0)
    """Turns of the rotor in one of the output shaft"""
    torque_constant: float = bounded(0.82, 1e-3, 100.0)
    """N·m/A at the output shaft. Uncertain: 0.091 · gear (AK80-9, vendor); TMotorCANControl: 1.04."""
    max_current: float = bounded(20.0, 0.1, 60.0)
    """A: largest that Torque is sent as"""
    idle_current: float = bounded(0.05, 0.01, 10.0)
    """A: what is measured beyond it drives a motor that is not commanded here"""
    max_velocity: float = bounded(5.0, 0.01, 100.0)
    """rad/s on the way to a Position"""
    max_acceleration: float = bounded(50.0, 1.0, 150.0)
    """rad/s² on the way to a Position"""
    # -- MIT mode
    model: Model = "AK80-9"
    """Decides the ranges of all numbers in MIT mode."""
    stiffness: float = bounded(20.0, 0.2, KP_MAX)
    """N·m/rad of Position and Hold"""
    damping: float = bounded(1.0, 0.01, KD_MAX)
    """N·m·s/rad of Position, Hold and Velocity"""
    position_end: float = bounded(0.0, 0.0, 100.0)
    """rad; 0: the model's. These depend on the firmware: see README."""
    velocity_end: float = bounded(0.0, 0.0, 200.0)
    """rad/s; 0: the model's"""
    torque_end: float = bounded(0.0, 0.0, 300.0)
    """N·m; 0: the model's"""
    reply_id: int = bounded(0, 0, 0x7FF)
    """Id of all replies. Uncertain: 0 in the published firmware, the motor's own in the vendor's manual."""
    sole_host: bool = False
    """A motor is asked where it is before its first command, too: by the frame that leaves motor mode, since
    there is no other. It would let go of what another host holds. Needed where a brain awaits feedback."""
    # -- both
    watchdog: Literal["unknown", "acknowledged"] = "unknown"
    """"acknowledged": the author of the robot file knows that none is known of the motor."""
    feedback_ms: int = bounded(10, 1, 1000)
    """Servo: period of its reports, as set with the vendor's tool. Both: of releasing a motor that has been
    commanded, and is not."""
    offline_ms: int = bounded(100, 20, 10_000)
    """Time without a frame after which the motor is offline."""

    def __post_init__(self) -> None:
        check_bounds(self)

    @property
    def table(self) -> Table:
        """The messages of the mode."""
        if self.mode == "servo":
            return cm.SERVO
        p, v, t = cm.MODELS[self.model]
        return cm.mit_table(self.position_end or p, self.velocity_end or v, self.torque_end or t)

    @property
    def gains(self) -> ImpedanceGains:
        """The gains of Position, Hold and Velocity in MIT mode."""
        return gains_of(self.table, "control", self.stiffness, self.damping)

    @property
    def erpm(self) -> float:
        """rad/s of one electrical rpm"""
        return math.pi / 30.0 / self.pole_pairs / self.gear

    @property
    def end(self) -> float:
        """rad beyond which no position is reported"""
        if self.mode == "servo":
            return cm.LAST_DEGREES * cm.DEGREE
        return self.table.row("control").field("position").high


@dataclass(frozen=True, slots=True)
class Settings:
    """The motor in simulation; mode and model are those of the options."""

    temperature: int = bounded(30, -20, 120)
    """°C"""
    supply: float = bounded(24.0, 5.0, 100.0)
    """V: how fast a duty cycle turns it"""

    def __post_init__(self) -> None:
        check_bounds(self)
