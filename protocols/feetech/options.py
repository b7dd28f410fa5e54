"""`Options` of the driver, and `Settings` of the servo as it is in simulation."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Annotated, Literal

from protocols.bounds import Bounds, check
from protocols.feetech.table import AMPERE, MODELS, Model
from protocols.messages import Position, Torque, Velocity
from protocols.toolkit.memory_map import GoalRegister, MemoryMap

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
    stall_torque: Annotated[float, Bounds(0.01, 100.0)] = 2.94
    """N·m at standstill with the whole supply, in mode pwm; sts3215 at 12 V: 30 kg·cm."""
    max_velocity: Annotated[float, Bounds(0.0, 50.0)] = 0.0
    """rad/s on the way to a position; 0: as fast as it can"""
    acceleration: Annotated[float, Bounds(0.0, 39.0)] = 0.0
    """rad/s², on the way to a position or velocity; 0: none is limited"""
    torque_limit: Annotated[float, Bounds(0.0, 1.0)] = 0.0
    """Share of the stall torque that it gives at most, until it is switched off; 0: as configured"""
    sync_read: bool = True
    """Ask all servos at once for their motion (SCS servos have no such instruction)."""
    feedback_ms: Annotated[float, Bounds(1.0, 1000.0)] = 10.0
    """Period in which the motion is asked for"""
    offline_ms: Annotated[float, Bounds(10.0, 10_000.0)] = 100.0
    """Time without an answer after which the servo is offline"""

    def __post_init__(self) -> None:
        modes = self.of.modes
        wrong = MODES[self.mode] not in modes
        check(self, ("mode", f"a {self.model} has no mode {self.mode}" if wrong else ""))

    @property
    def of(self) -> Model:
        """The model."""
        return MODELS[self.model]

    @property
    def table(self) -> MemoryMap:
        """Its registers."""
        return self.of.table

    @property
    def operating_mode(self) -> int:
        """The value of Operating_Mode."""
        return MODES[self.mode]

    ampere, newton_metre = AMPERE, 0.0
    """What one step of the current is; its torque is not known."""

    def goal_in(self, mode: int) -> GoalRegister | None:
        """Return the register of the set-point in an Operating_Mode."""
        model = self.of
        match mode:
            case 0:
                return GoalRegister("Goal_Position", Position, model.step, model.middle, (0, model.steps - 1))
            case 1:
                return GoalRegister("Goal_Velocity", Velocity, model.step)
            case 2:
                # A positive share turns it towards smaller positions (measured on STS3215: servolab 1.0.0,
                # huggingface/lerobot#4547).
                return GoalRegister("Goal_Time", Torque, -self.stall_torque / 1000.0)
        return None

    @property
    def set_up(self) -> dict[str, int]:
        """What is written before it is armed, in this order: with Lock, nothing of it is stored."""
        model, position = self.of, self.mode == "position"
        wanted = {"Lock": 1, "Return_Delay_Time": 0}
        if "Operating_Mode" in self.table.by_name:
            wanted["Operating_Mode"] = self.operating_mode
            wanted["Acceleration"] = min(254, round(self.acceleration / model.step / 100.0))
            wanted |= {"Torque_Limit": round(self.torque_limit * 1000.0)} if self.torque_limit else {}
        if position:
            wanted |= {"Goal_Time": 0, "Goal_Velocity": min(0x7FFF, round(self.max_velocity / model.step))}
        return wanted


@dataclass(frozen=True, slots=True)
class Settings:
    """Configuration of the servo in simulation."""

    mode: Annotated[int, Bounds(0, 2)] = 0
    """Operating_Mode as stored"""
    full_angle: bool = True
    """Bit 4 of Phase: positions beyond a turn are reported as such (or else within one turn)"""
    offset: Annotated[int, Bounds(-2047, 2047)] = 0
    """Homing_Offset"""
    return_delay: Annotated[int, Bounds(0, 254)] = 250
    """Return_Delay_Time: 2 µs"""
    stall_torque: Annotated[float, Bounds(0.01, 100.0)] = 2.94
    """N·m at 12 V"""
    no_load_speed: Annotated[float, Bounds(0.1, 100.0)] = 45.0 * RPM
    """rad/s at 12 V"""
    stall_current: Annotated[float, Bounds(0.1, 100.0)] = 2.7
    """A"""
    stiffness: Annotated[float, Bounds(0.1, 1e5)] = 60.0
    """N·m/rad of its loop for position, as delivered (P_Coefficient 32)"""
    supply: Annotated[float, Bounds(4.0, 25.0)] = 12.0
    """V"""
    temperature: Annotated[float, Bounds(0.0, 120.0)] = 30.0
    """°C"""

    def __post_init__(self) -> None:
        check(self)
