"""`Options` of the driver, `Settings` of the motor itself. SI units at the output shaft."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Annotated, Literal

from protocols.bounds import Bounds, check
from protocols.cubemars import table as cm
from protocols.toolkit.mit import KD_MAX, KP_MAX, ImpedanceGains, gains_of
from protocols.toolkit.table import Table

# fmt: off
Model = Literal[
    "AK10-9", "AK40-10", "AK45-10", "AK45-36", "AK60-6", "AK70-9", "AK70-10", "AK80-6", "AK80-6 V1.0",
    "AK80-6 V1.1", "AK80-8", "AK80-9", "AK80-9 V1.1", "AK80-9 V2", "AK80-64", "AKE60-8", "AKE80-8",
]
# fmt: on


@dataclass(frozen=True, slots=True)
class Options:
    """Configuration of the driver. What a motor does not tell must be as it is configured there."""

    mode: Literal["servo", "mit", "mit_v3"] = "servo"
    """The mode that the motor is set to with the vendor's tool; mit_v3: firmware V3, which has one for all,
    and is sent five numbers with 29-bit ids."""
    turns: bool = False
    """For wheels: position is counted on by velocity beyond what the motor reports (servo ±3200°, mit the
    model's). Commands are Velocity and Torque then."""
    # -- servo mode
    pole_pairs: Annotated[int, Bounds(1, 100)] = 21
    """Electrical revolutions in one of the rotor"""
    gear: Annotated[float, Bounds(1.0, 1000.0)] = 9.0
    """Turns of the rotor in one of the output shaft"""
    torque_constant: Annotated[float, Bounds(1e-3, 100.0)] = 0.82
    """N·m/A at the output shaft. Uncertain: 0.091 · gear (AK80-9, vendor); TMotorCANControl: 1.04."""
    max_current: Annotated[float, Bounds(0.1, 60.0)] = 20.0
    """A: largest that Torque is sent as"""
    idle_current: Annotated[float, Bounds(0.01, 10.0)] = 0.05
    """A: what is measured beyond it drives a motor that is not commanded here"""
    max_velocity: Annotated[float, Bounds(0.01, 100.0)] = 5.0
    """rad/s on the way to a Position"""
    max_acceleration: Annotated[float, Bounds(1.0, 150.0)] = 50.0
    """rad/s² on the way to a Position"""
    # -- modes mit and mit_v3
    model: Model = "AK80-9"
    """Decides the ranges of the five numbers."""
    stiffness: Annotated[float, Bounds(0.2, KP_MAX)] = 20.0
    """N·m/rad of Position and Hold"""
    damping: Annotated[float, Bounds(0.01, KD_MAX)] = 1.0
    """N·m·s/rad of Position, Hold and Velocity"""
    position_end: Annotated[float, Bounds(0.0, 100.0)] = 0.0
    """rad; 0: the model's. These depend on the firmware: see README."""
    velocity_end: Annotated[float, Bounds(0.0, 200.0)] = 0.0
    """rad/s; 0: the model's"""
    torque_end: Annotated[float, Bounds(0.0, 300.0)] = 0.0
    """N·m; 0: the model's"""
    reply_id: Annotated[int, Bounds(-1, 0x7FF)] = -1
    """Id of all replies; -1: the motor's own, as the vendor's manual has it, or 0, as early firmware"""
    sole_host: bool = False
    """A motor is asked where it is before its first command, too: by the frame that leaves motor mode, since
    there is no other. It would let go of what another host holds. Needed where a brain awaits feedback."""
    # -- both
    watchdog: Literal["unknown", "acknowledged"] = "unknown"
    """"acknowledged": the author of the robot file knows that none is known of the motor."""
    feedback_ms: Annotated[int, Bounds(1, 1000)] = 10
    """Servo: period of its reports, as set with the vendor's tool. Both: of releasing a motor that has been
    commanded, and is not."""
    offline_ms: Annotated[int, Bounds(20, 10_000)] = 100
    """Time without a frame after which the motor is offline."""

    def __post_init__(self) -> None:
        unknown = f"no {self.model} is known in mode {self.mode}: one of {', '.join(self._models)}"
        known = self.mode == "servo" or self.model in self._models
        check(self, ("model", "" if known else unknown))

    @property
    def _models(self) -> Mapping[str, tuple[float, float, float]]:
        return cm.V3_MODELS if self.mode == "mit_v3" else cm.MODELS

    @property
    def table(self) -> Table:
        """The messages of the mode."""
        if self.mode == "servo":
            return cm.SERVO
        p, v, t = self._models[self.model]
        table = cm.mit_table if self.mode == "mit" else cm.v3_table
        return table(self.position_end or p, self.velocity_end or v, self.torque_end or t)

    def replies(self, address: int) -> tuple[int, ...]:
        """Return the ids on which a motor with this address may answer in MIT mode, the manual's first."""
        return (address, 0) if self.reply_id < 0 else (self.reply_id,)

    @property
    def set_point(self) -> str:
        """The message of five numbers."""
        return "control" if self.mode == "mit" else "SET_MIT"

    @property
    def five(self) -> bool:
        """True if set-points are five numbers."""
        return self.mode != "servo"

    @property
    def gains(self) -> ImpedanceGains:
        """The gains of Position, Hold and Velocity, if set-points are five numbers."""
        return gains_of(self.table, self.set_point, self.stiffness, self.damping)

    @property
    def erpm(self) -> float:
        """rad/s of one electrical rpm"""
        return math.pi / 30.0 / self.pole_pairs / self.gear

    @property
    def end(self) -> float:
        """rad beyond which no position is reported"""
        if self.mode != "mit":
            return cm.LAST_DEGREES * cm.DEGREE
        return self.table.row("control").field("position").high


@dataclass(frozen=True, slots=True)
class Settings:
    """The motor in simulation; mode and model are those of the options."""

    temperature: Annotated[int, Bounds(-20, 120)] = 30
    """°C"""
    supply: Annotated[float, Bounds(5.0, 100.0)] = 24.0
    """V: how fast a duty cycle turns it"""

    def __post_init__(self) -> None:
        check(self)
