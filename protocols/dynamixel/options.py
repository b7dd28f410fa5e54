"""`Options` of the driver, `Settings` of the device itself. SI units, but for settings that are registers."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

from protocols.dynamixel.table import MODELS, MODES, WATCHDOG_UNIT_MS, ControlTable, Model, modes_of, table_of
from protocols.suggest import did_you_mean
from protocols.toolkit.options import bounded, check_bounds

Mode = Literal["velocity", "position", "extended_position", "current", "current_position"]


@dataclass(frozen=True, slots=True)
class Options:
    """Configuration of the driver."""

    model: str = "XM430-W350"
    """As printed on it, without -T and -R: it decides units and limits, and is checked before the device is
    armed."""
    mode: Mode = "velocity"
    """Operating_Mode, written before it is armed if it is another one."""
    max_velocity: float = bounded(0.0, 0.0, 100.0)
    """rad/s of Velocity; 0: Velocity_Limit as delivered. The device's Velocity_Limit must not be lower."""
    max_current: float = bounded(0.0, 0.0, 30.0)
    """A of Torque, and of Position in current_position; 0: Current_Limit as delivered, which must not be
    lower."""
    torque_constant: float = bounded(0.0, 0.0, 30.0)
    """N·m/A; 0: the model's, from its stall torque and current: the true one differs by a fifth or so."""
    profile_velocity: float = bounded(0.0, 0.0, 100.0)
    """rad/s on the way to a Position; 0: as fast as it can"""
    profile_acceleration: int = bounded(0, 0, 32_767)
    """Profile_Acceleration, in the device's steps; 0: as fast as it can"""
    indirect: bool = False
    """Every feedback has the device's state, too: six more bytes, and no questions about it beside. Else the
    state is read every `state_ms`."""
    fast: bool = False
    """Fast sync read: one answer of all devices on a bus that have it, a quarter more of them a second.
    Firmware 45 or newer; noise in the answer of one costs those behind it their readings, too."""
    scan: bool = True
    """A scan may ask all ids."""
    timeout_ms: float = bounded(100.0, 0.0, 2540.0)
    """Bus_Watchdog, in steps of 20 ms, written before it is armed; 0: none"""
    feedback_ms: float = bounded(10.0, 0.2, 1000.0)
    """Period of its feedback"""
    state_ms: float = bounded(200.0, 10.0, 10_000.0)
    """Period in which torque, hardware errors, watchdog, voltage and temperature are read. Hardware errors
    show in every feedback before."""
    offline_ms: float = bounded(200.0, 20.0, 10_000.0)
    """Time without an answer after which it is offline"""

    def __post_init__(self) -> None:
        others = []
        if self.model not in MODELS:
            hint = did_you_mean(self.model, MODELS)
            others.append(f"no model {self.model!r}{hint}; there are {', '.join(MODELS)}")
        elif MODES[self.mode] not in modes_of(MODELS[self.model]):
            others.append(f"a {self.model} has no mode {self.mode}")
        check_bounds(self, others)

    @property
    def of(self) -> Model:
        """The model."""
        return MODELS[self.model]

    @property
    def table(self) -> ControlTable:
        """The model's control table."""
        return table_of(self.model)

    @property
    def operating_mode(self) -> int:
        """The value of Operating_Mode."""
        return MODES[self.mode]

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
    def newton_metre(self) -> float:
        """N·m of one step of the current"""
        return (self.torque_constant or self.of.torque) * self.of.ampere

    @property
    def set_up(self) -> dict[str, int]:
        """The registers that must be so before it is armed, by name."""
        wanted = {
            "Operating_Mode": self.operating_mode,
            "Bus_Watchdog": self.watchdog,
            "Profile_Acceleration": self.profile_acceleration,
            "Profile_Velocity": round(self.profile_velocity / self.of.step),
        }
        wanted |= {"Goal_Current": self.current} if self.mode == "current_position" else {}
        if self.indirect:
            wanted |= {f"Indirect_Address_{k + 1}": at for k, at in enumerate(self.table.indirect)}
        return wanted


@dataclass(frozen=True, slots=True)
class Settings:
    """Configuration of the device; its model is that of the options."""

    firmware: int = bounded(46, 1, 255)
    model_number: int = bounded(0, 0, 65_535)
    """0: that of the model"""
    # Registers of the same name, as stored. 0 of the limits: as the model is delivered.
    baud_rate: int = bounded(3, 0, 9)
    return_delay_time: int = bounded(250, 0, 254)
    """Steps of 2 µs. As delivered: half a millisecond for each device, which halves the rate of a line. Write
    0."""
    drive_mode: int = bounded(0, 0, 13)
    operating_mode: int = bounded(3, 0, 16)
    homing_offset: int = bounded(0, -1_044_479, 1_044_479)
    temperature_limit: int = bounded(80, 0, 100)
    max_voltage_limit: int = bounded(160, 60, 350)
    min_voltage_limit: int = bounded(95, 31, 350)
    pwm_limit: int = bounded(885, 0, 2009)
    current_limit: int = bounded(0, 0, 32_767)
    velocity_limit: int = bounded(0, 0, 32_767)
    max_position_limit: int = bounded(0, -(1 << 31), (1 << 31) - 1)
    min_position_limit: int = bounded(0, -(1 << 31), (1 << 31) - 1)
    shutdown: int = bounded(52, 0, 63)
    status_return_level: int = bounded(2, 0, 2)

    def __post_init__(self) -> None:
        check_bounds(self)


STORED = {
    register: register.lower()
    for register in (
        "Return_Delay_Time", "Drive_Mode", "Operating_Mode", "Homing_Offset", "Temperature_Limit",
        "Max_Voltage_Limit", "Min_Voltage_Limit", "PWM_Limit", "Current_Limit", "Velocity_Limit",
        "Max_Position_Limit", "Min_Position_Limit", "Shutdown", "Status_Return_Level", "Baud_Rate",
    )
}  # fmt: skip
"""The settings that are registers, by these."""
