"""`Options` of the driver, `Settings` of the device itself. SI units, but for settings that are registers."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, Literal

from protocols.bounds import Bounds, Wrong, check
from protocols.dynamixel.table import MODELS, MODES, TABLES, WATCHDOG_UNIT_MS, ControlTable, Model, modes_of
from protocols.messages import Position, Torque, Velocity
from protocols.suggest import did_you_mean
from protocols.toolkit.memory_map import GoalRegister

Mode = Literal["velocity", "position", "extended_position", "current", "current_position"]


@dataclass(frozen=True, slots=True)
class Options:
    """Configuration of the driver."""

    model: str = "XM430-W350"
    """As printed on it, without -T and -R: it decides units and limits, and is checked before the device is
    armed."""
    mode: Mode = "velocity"
    """Operating_Mode, written before it is armed if it is another one."""
    max_velocity: Annotated[float, Bounds(0.0, 100.0)] = 0.0
    """rad/s of Velocity; 0: Velocity_Limit as delivered. The device's Velocity_Limit must not be lower."""
    max_current: Annotated[float, Bounds(0.0, 30.0)] = 0.0
    """A of Torque, and of Position in current_position; 0: Current_Limit as delivered, which must not be
    lower."""
    torque_constant: Annotated[float, Bounds(0.0, 30.0)] = 0.0
    """N·m/A; 0: the model's, from its stall torque and current: the true one differs by a fifth or so."""
    profile_velocity: Annotated[float, Bounds(0.0, 100.0)] = 0.0
    """rad/s on the way to a Position; 0: as fast as it can"""
    profile_acceleration: Annotated[int, Bounds(0, 32_767)] = 0
    """Profile_Acceleration, in the device's steps; 0: as fast as it can"""
    indirect: bool = False
    """Every feedback has the device's state, too: six more bytes, and no questions about it beside. Else the
    state is read every `state_ms`."""
    fast: bool = False
    """Fast sync read: one answer of all devices on a bus that have it, a quarter more of them a second.
    Firmware 45 or newer; noise in the answer of one costs those behind it their readings, too."""
    scan: bool = True
    """A scan may ask all ids."""
    timeout_ms: Annotated[float, Bounds(0.0, 2540.0)] = 100.0
    """Bus_Watchdog, in steps of 20 ms, written before it is armed; 0: none"""
    feedback_ms: Annotated[float, Bounds(0.2, 1000.0)] = 10.0
    """Period of its feedback"""
    state_ms: Annotated[float, Bounds(10.0, 10_000.0)] = 200.0
    """Period in which torque, hardware errors, watchdog, voltage and temperature are read. Hardware errors
    show in every feedback before."""
    offline_ms: Annotated[float, Bounds(20.0, 10_000.0)] = 200.0
    """Time without an answer after which it is offline"""

    def __post_init__(self) -> None:
        others: list[Wrong] = []
        if self.model not in MODELS:
            hint = did_you_mean(self.model, MODELS)
            others.append(("model", f"no model {self.model!r}{hint}; there are {', '.join(MODELS)}"))
        elif MODES[self.mode] not in modes_of(MODELS[self.model]):
            others.append(("mode", f"a {self.model} has no mode {self.mode}"))
        check(self, *others)

    @property
    def of(self) -> Model:
        """The model."""
        return MODELS[self.model]

    @property
    def table(self) -> ControlTable:
        """The model's control table."""
        return self.of.table

    @property
    def operating_mode(self) -> int:
        """The value of Operating_Mode."""
        return MODES[self.mode]

    def goal_in(self, mode: int) -> GoalRegister | None:
        """Return the register of the set-point in an Operating_Mode."""
        model = self.of
        match mode:
            case 0:
                return GoalRegister("Goal_Current", Torque, self.newton_metre)
            case 1:
                return GoalRegister("Goal_Velocity", Velocity, model.step)
            case 3:
                least = model.zero - model.counts // 2
                ends = least, least + model.counts - 1
                return GoalRegister("Goal_Position", Position, model.count, model.zero, ends)
            case 4 | 5:
                return GoalRegister("Goal_Position", Position, model.count, model.zero)
        return None

    @property
    def watchdog(self) -> int:
        """The value of Bus_Watchdog."""
        return -int(-self.timeout_ms // WATCHDOG_UNIT_MS)

    @property
    def velocity(self) -> int:
        """Steps of the largest velocity."""
        return int(self.max_velocity / self.of.step + 1e-6) if self.max_velocity else self.of.velocity

    @property
    def current(self) -> int:
        """Steps of the largest current."""
        return int(self.max_current / self.of.ampere + 1e-6) if self.max_current else self.of.current

    @property
    def ampere(self) -> float:
        """A of one step of the current"""
        return self.of.ampere

    @property
    def newton_metre(self) -> float:
        """N·m of one step of the current"""
        return (self.torque_constant or self.of.torque) * self.of.ampere

    @property
    def set_up(self) -> dict[str, int]:
        """The registers that must be so before it is armed, by name, in the order of their addresses."""
        wanted = {"Operating_Mode": self.operating_mode, "Bus_Watchdog": self.watchdog}
        wanted |= {"Goal_Current": self.current} if self.mode == "current_position" else {}
        wanted |= {
            "Profile_Acceleration": self.profile_acceleration,
            "Profile_Velocity": round(self.profile_velocity / self.of.step),
        }
        if self.indirect:
            wanted |= {f"Indirect_Address_{k + 1}": at for k, at in enumerate(self.table.indirect)}
        return wanted


@dataclass(frozen=True, slots=True)
class Settings:
    """Configuration of the device; its model is that of the options."""

    firmware: Annotated[int, Bounds(1, 255)] = 46
    model_number: Annotated[int, Bounds(0, 65_535)] = 0
    """0: that of the model"""
    # Registers of the same name, as stored. 0 of the limits: as the model is delivered.
    baud_rate: Annotated[int, Bounds(0, 9)] = 3
    return_delay_time: Annotated[int, Bounds(0, 254)] = 250
    """Steps of 2 µs. As delivered: half a millisecond for each device, which halves the rate of a line. Write
    0."""
    drive_mode: Annotated[int, Bounds(0, 13)] = 0
    operating_mode: Annotated[int, Bounds(0, 16)] = 3
    homing_offset: Annotated[int, Bounds(-1_044_479, 1_044_479)] = 0
    temperature_limit: Annotated[int, Bounds(0, 100)] = 80
    max_voltage_limit: Annotated[int, Bounds(60, 350)] = 160
    min_voltage_limit: Annotated[int, Bounds(31, 350)] = 95
    pwm_limit: Annotated[int, Bounds(0, 2009)] = 885
    current_limit: Annotated[int, Bounds(0, 32_767)] = 0
    velocity_limit: Annotated[int, Bounds(0, 32_767)] = 0
    max_position_limit: Annotated[int, Bounds(-(1 << 31), (1 << 31) - 1)] = 0
    min_position_limit: Annotated[int, Bounds(-(1 << 31), (1 << 31) - 1)] = 0
    shutdown: Annotated[int, Bounds(0, 63)] = 52
    status_return_level: Annotated[int, Bounds(0, 2)] = 2

    def __post_init__(self) -> None:
        check(self)


STORED = {
    each.name: each.name.lower()
    for table in TABLES
    for each in table.by_name.values()
    if each.writable and each.name.lower() in Settings.__annotations__
}
"""The settings that are registers, by these."""
