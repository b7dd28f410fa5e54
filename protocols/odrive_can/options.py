"""The settings: `Options` of the driver, and `Settings` configured on the device itself.

Rules. Options never repeat what the device reports; the driver does not read settings. Names and units of
settings are the vendor's own (turns, N·m, A, V, °C, ms), so that they can be compared with its tool.
"""

from __future__ import annotations

import math
import re
from dataclasses import dataclass, fields
from typing import Literal

from protocols.odrive_can.codec import BROADCAST, EXTENDED, MAX_EXTENDED_NODE
from protocols.odrive_can.messages import ControlMode, InputMode
from protocols.plugin import Device


@dataclass(frozen=True, slots=True)
class Options:
    """How the driver behaves."""

    firmware: Literal["auto", "0.5", "0.6"] = "auto"
    """Firmware line of the device. "auto": identified by requests, and then used; a line that is given is
    checked in the same way, and another one is a fault."""
    is_extended: bool = False
    """The axis has 29-bit identifiers (`axis.config.can.is_extended`; 0.5.x only)."""
    watchdog: Literal["unknown", "acknowledged"] = "unknown"
    """"acknowledged": the author of the robot file knows that the device's watchdog is off."""
    feedback_ms: int = 10
    """Expected period of encoder estimates; the polling period of a device that does not send them
    cyclically."""
    poll_ms: int = 200
    """Polling period of each of current, voltage, temperature and torque; 0: never."""
    offline_ms: int = 250
    """Time without a frame after which the device counts as offline."""
    arm_retry_ms: int = 250
    """Period of arming attempts. At least two heartbeats: the first one may be stale."""

    def __post_init__(self) -> None:
        for name, low, high in (
            ("feedback_ms", 1, 1000),
            ("poll_ms", 0, 60_000),
            ("offline_ms", 20, 10_000),
            ("arm_retry_ms", 50, 10_000),
        ):
            value = getattr(self, name)
            if not low <= value <= high:
                raise ValueError(f"{name} is {value}: it must lie between {low} and {high}")
        if self.is_extended and self.firmware != "0.5":
            raise ValueError('is_extended needs firmware = "0.5": no other line has extended identifiers')
        if self.offline_ms < 2 * self.feedback_ms:
            raise ValueError(
                f"offline_ms ({self.offline_ms}) must be at least twice feedback_ms ({self.feedback_ms})"
            )


@dataclass(frozen=True, slots=True)
class Settings:
    """The configuration of the device: by default a commissioned axis, not the vendor's factory defaults."""

    serial_number: int = 0
    """48 bits; 0: derived from the address."""
    firmware: str = ""
    """Firmware, e.g. "0.5.6" or "0.6.10"; "": the newest known of the line under options."""
    other_axis: int = -1
    """Node id of the other axis on the same board (0.5.x): clearing or restarting the board affects both."""
    hw_line: int = 5
    """Product line 5: ODrive S1 (only reported, never used)."""
    calibrated: bool = True
    """Motor and encoder are calibrated; without it the axis refuses to arm."""

    control_mode: int = ControlMode.VELOCITY
    input_mode: int = InputMode.PASSTHROUGH
    pos_gain: float = 20.0
    """(turn/s)/turn"""
    vel_gain: float = 0.16
    """N·m/(turn/s)"""
    vel_integrator_gain: float = 0.32
    """N·m/turn"""
    vel_limit: float = 40.0
    """turn/s"""
    vel_limit_tolerance: float = 1.2
    """Factor on vel_limit above which the axis disarms; 0: never."""
    enable_torque_mode_vel_limit: bool = True
    vel_ramp_rate: float = 10.0
    """turn/s², input mode VEL_RAMP"""
    torque_ramp_rate: float = 1.0
    """N·m/s, input mode TORQUE_RAMP"""
    input_filter_bandwidth: float = 20.0
    """rad/s, input mode POS_FILTER"""
    inertia: float = 0.0
    """N·m/(turn/s²): feed-forward of acceleration"""
    trap_vel_limit: float = 10.0
    """turn/s, input mode TRAP_TRAJ"""
    trap_accel_limit: float = 20.0
    trap_decel_limit: float = 20.0

    torque_constant: float = 8.27 / 270.0
    """N·m/A: a motor of 270 rpm/V"""
    current_soft_max: float = 30.0
    """A: limit of the controller's current command"""
    current_hard_max: float = 50.0
    """A: above it the axis disarms"""
    current_bandwidth: float = 1000.0
    """rad/s of the current loop"""
    phase_resistance: float = 0.05
    """Ω"""
    encoder_cpr: int = 16384
    """Counts per turn of the encoder on the motor's shaft."""
    encoder_bandwidth: float = 1000.0
    """rad/s of the velocity estimate"""

    bus_voltage: float = 24.0
    """V, without load"""
    bus_resistance: float = 0.05
    """Ω of battery and cables"""
    dc_bus_undervoltage_trip_level: float = 10.5
    dc_bus_overvoltage_trip_level: float = 56.0
    dc_max_positive_current: float = 60.0
    """A"""
    dc_max_negative_current: float = -30.0
    """A fed back that the supply or brake resistor can take"""
    ambient: float = 25.0
    """°C"""
    motor_thermal_resistance: float = 2.0
    """K/W from winding to ambient"""
    motor_thermal_capacity: float = 80.0
    """J/K"""
    motor_temp_limit_lower: float = 80.0
    """°C from which on the current limit falls"""
    motor_temp_limit_upper: float = 100.0
    """°C at which it is zero; 5 °C more disarm"""
    fet_temp_limit_lower: float = 80.0
    fet_temp_limit_upper: float = 100.0
    spinout_electrical_power_threshold: float = 100.0
    """W; the factory's ±10 W trips on hard but honest braking of a loaded wheel"""
    spinout_mechanical_power_threshold: float = -100.0
    """W"""
    spinout_power_bandwidth: float = 20.0
    """rad/s of the filters of both powers"""

    enable_watchdog: bool = False
    watchdog_timeout: float = 0.0
    """s"""
    reboot_ms: int = 800
    """Time without frames after a reboot."""
    initializing_ms: int = 300
    """Time for which the axis then reports INITIALIZING."""

    # Periods of cyclic messages; 0: never. Firmware 0.5.x calls them heartbeat_rate_ms, encoder_rate_ms,
    # iq_rate_ms and bus_vi_rate_ms, and has those with its own names below instead of version, error,
    # temperature and torques.
    version_msg_rate_ms: int = 0
    heartbeat_msg_rate_ms: int = 100
    encoder_msg_rate_ms: int = 10
    iq_msg_rate_ms: int = 0
    error_msg_rate_ms: int = 0
    temperature_msg_rate_ms: int = 0
    bus_voltage_msg_rate_ms: int = 0
    torques_msg_rate_ms: int = 0
    motor_error_rate_ms: int = 0
    encoder_error_rate_ms: int = 0
    controller_error_rate_ms: int = 0
    sensorless_error_rate_ms: int = 0
    encoder_count_rate_ms: int = 0
    sensorless_rate_ms: int = 0

    def __post_init__(self) -> None:
        values = {field.name: getattr(self, field.name) for field in fields(self)}
        floats = {name: value for name, value in values.items() if isinstance(value, float)}
        wrong = [f"{name} must be finite" for name, value in floats.items() if not math.isfinite(value)]
        wrong += [f"{name} must be above 0" for name in _POSITIVE if not values[name] > 0]
        not_negative = (*_NOT_NEGATIVE, *(name for name in values if name.endswith("_rate_ms")))
        wrong += [f"{name} must not be negative" for name in not_negative if values[name] < 0]
        if self.firmware and not re.fullmatch(r"0\.[56]\.\d{1,2}", self.firmware):
            wrong.append(f"firmware {self.firmware!r} must be like 0.5.6 or 0.6.10")
        if not -1 <= self.other_axis <= MAX_EXTENDED_NODE:
            wrong.append(f"other_axis must lie between -1 and {MAX_EXTENDED_NODE}")
        if not 0 <= self.hw_line <= 0xFF:
            wrong.append("hw_line must fit into 8 bits")
        if not 0 <= self.serial_number < 1 << 48:
            wrong.append("serial_number must fit into 48 bits")
        if self.enable_watchdog and not self.watchdog_timeout > 0:
            wrong.append("watchdog_timeout must be above 0 when enable_watchdog is true")
        if wrong:
            raise ValueError("; ".join(wrong))


_POSITIVE = (
    "vel_limit",
    "torque_constant",
    "current_soft_max",
    "current_hard_max",
    "current_bandwidth",
    "phase_resistance",
    "encoder_cpr",
    "encoder_bandwidth",
    "bus_voltage",
    "motor_thermal_resistance",
    "motor_thermal_capacity",
    "trap_vel_limit",
    "trap_accel_limit",
    "trap_decel_limit",
    "input_filter_bandwidth",
    "spinout_power_bandwidth",
)
_NOT_NEGATIVE = (
    "pos_gain",
    "vel_gain",
    "vel_integrator_gain",
    "vel_limit_tolerance",
    "bus_resistance",
    "watchdog_timeout",
    "reboot_ms",
    "initializing_ms",
)


def serial_of(settings: Settings, address: int) -> int:
    """Return the serial number of a device: as configured, or derived from its address."""
    return settings.serial_number or 0x385F_3473_3300 + (address & BROADCAST)


NEWEST = {"auto": "0.6.10", "0.6": "0.6.10", "0.5": "0.5.6"}


def firmware_of(device: Device) -> str:
    """Return the firmware of a device: as configured, or the newest of the line that the driver expects."""
    settings: Settings = device.settings
    options: Options = device.options
    return settings.firmware or NEWEST[options.firmware]


def line_of(device: Device) -> str:
    """Return its firmware line: "0.5" or "0.6"."""
    return firmware_of(device)[:3]


def node_of_device(device: Device, address: int) -> int:
    """Return a node id of a device's board as a node in the sense of `codec`."""
    options: Options = device.options
    return address | EXTENDED if options.is_extended else address
