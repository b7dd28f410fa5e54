"""The settings: `Options` of the driver, and `Settings` configured on the device itself.

Rules. Options never repeat what the device reports; the driver does not read settings. Names and units of
settings are the vendor's own (turns, N·m, A, V, °C, ms), so that they can be compared with its tool.
"""

from __future__ import annotations

import math
import re
from collections.abc import Mapping
from contextlib import suppress
from dataclasses import dataclass, replace
from typing import Annotated, Literal

from protocols.bounds import Bounds, Wrong, check
from protocols.odrive_can.table import BROADCAST, MAX_EXTENDED_NODE, ControlMode, InputMode
from protocols.plugin import Device, Setting
from protocols.toolkit.options import configuration
from protocols.toolkit.registers import Register, Registers, Type

TYPES: Mapping[str, Type] = {
    "bool": "u8",
    "uint8": "u8",
    "uint16": "u16",
    "uint32": "u32",
    "int16": "i16",
    "int32": "i32",
    "float": "f32",
}
"""Types of endpoints, by the vendor's names."""
COMMANDS = ("requested_state", "control_mode", "input_mode", "input_pos", "input_vel", "input_torque")
"""Endpoints that arm or move the motor: there are messages for that, which are checked."""


@dataclass(frozen=True, slots=True)
class AxisOptions:
    """How the driver behaves, over any transport."""

    firmware: Literal["auto", "0.5", "0.6"] = "auto"
    """Firmware line of the device. "auto": identified by requests, and then used; a line that is given is
    checked in the same way, and another one is a fault."""
    watchdog: Literal["unknown", "acknowledged"] = "unknown"
    """"acknowledged": the author of the robot file knows that the device's watchdog is off."""
    feedback_ms: Annotated[int, Bounds(1, 1000)] = 10
    """Expected period of encoder estimates; the polling period of a device that does not send them
    cyclically."""
    poll_ms: Annotated[int, Bounds(0, 60_000)] = 200
    """Polling period of each of current, voltage, temperature and torque; 0: never."""
    offline_ms: Annotated[int, Bounds(20, 10_000)] = 250
    """Time without a frame after which the device counts as offline."""
    arm_retry_ms: Annotated[int, Bounds(50, 10_000)] = 250
    """Period of arming attempts. At least two heartbeats: the first one may be stale."""

    def registers(self) -> Registers:
        """Return the endpoints: none."""
        return Registers()

    def __post_init__(self) -> None:
        self.check()

    def check(self, *others: Wrong) -> None:
        """Raise Invalid with every mistake; `others`: more."""
        too_soon = f"offline_ms ({self.offline_ms}) must be at least twice feedback_ms ({self.feedback_ms})"
        check(self, *others, ("offline_ms", too_soon * (self.offline_ms < 2 * self.feedback_ms)))


@dataclass(frozen=True, slots=True)
class Options(AxisOptions):
    """How the driver behaves, over CAN."""

    is_extended: bool = False
    """The axis has 29-bit identifiers (`axis.config.can.is_extended`; 0.5.x only)."""
    position_input: Literal["passthrough", "pos_filter", "trap_traj"] = "passthrough"
    """How the device follows positions: at once, by its filter (`input_filter_bandwidth`), or by trapezoidal
    trajectories (`Traj_Vel_Limit` …). A filter takes no torque with them, a trajectory no velocity either."""
    endpoints: tuple[str, ...] = ()
    """Parameters that are read and written by endpoint (0.6.x), as "path id type" of its flat_endpoints.json:
    "axis0.controller.config.vel_integrator_limit 291 float"."""
    endpoints_version: str = ""
    """The `fw_version` of that file: endpoints of a device with another firmware are refused."""

    def registers(self) -> Registers:
        """Return the endpoints."""
        parts = (endpoint.split() for endpoint in self.endpoints)
        return Registers(*(Register(path, int(number), TYPES[kind]) for path, number, kind in parts))

    def __post_init__(self) -> None:
        others: list[Wrong] = []
        for endpoint in self.endpoints:
            if not re.fullmatch(rf"\S+ \d{{1,5}} ({'|'.join(TYPES)})", endpoint):
                text = f"endpoints: {endpoint!r} is not a path, a number and {', '.join(TYPES)}"
                others.append(("endpoints", text))
            elif endpoint.split()[0].endswith(COMMANDS):
                text = f"endpoints: {endpoint!r} is for commands, which have messages of their own"
                others.append(("endpoints", text))
        if self.endpoints and not re.fullmatch(r"0\.6\.\d{1,2}", self.endpoints_version):
            text = f"endpoints_version {self.endpoints_version!r} must be like 0.6.10"
            others.append(("endpoints_version", text))
        if self.is_extended and self.firmware != "0.5":
            text = 'is_extended needs firmware = "0.5": no other line has extended identifiers'
            others.append(("is_extended", text))
        self.check(*others)


@dataclass(frozen=True, slots=True)
class AxisSettings:
    """The configuration of the device, over any transport: by default a commissioned axis, not the vendor's
    factory defaults."""

    serial_number: Annotated[int, Bounds(0, (1 << 48) - 1)] = 0
    """48 bits; 0: derived from the address."""
    firmware: str = ""
    """Firmware, e.g. "0.5.6" or "0.6.10"; "": the newest known of the line under options."""
    calibrated: bool = True
    """Motor and encoder are calibrated; without it the axis refuses to arm."""

    procedure_ms: Annotated[int, Bounds(0, 600_000)] = 2000
    """Duration of a calibration, which then has succeeded."""

    control_mode: Annotated[int, Bounds(0, 3)] = int(ControlMode.VELOCITY)
    input_mode: Annotated[int, Bounds(0, 8)] = int(InputMode.PASSTHROUGH)
    pos_gain: Annotated[float, Bounds(0.0, 1e4)] = 20.0
    """(turn/s)/turn"""
    vel_gain: Annotated[float, Bounds(0.0, 1e3)] = 0.16
    """N·m/(turn/s)"""
    vel_integrator_gain: Annotated[float, Bounds(0.0, 1e4)] = 0.32
    """N·m/turn"""
    vel_limit: Annotated[float, Bounds(1e-3, 1e4)] = 40.0
    """turn/s"""
    vel_limit_tolerance: Annotated[float, Bounds(0.0, 100.0)] = 1.2
    """Factor on vel_limit above which the axis disarms; 0: never."""
    enable_torque_mode_vel_limit: bool = True
    vel_ramp_rate: Annotated[float, Bounds(0.0, 1e5)] = 10.0
    """turn/s², input mode VEL_RAMP"""
    torque_ramp_rate: Annotated[float, Bounds(0.0, 1e4)] = 1.0
    """N·m/s, input mode TORQUE_RAMP"""
    input_filter_bandwidth: Annotated[float, Bounds(1e-3, 1e4)] = 20.0
    """rad/s, input mode POS_FILTER"""
    inertia: Annotated[float, Bounds(-1e3, 1e3)] = 0.0
    """N·m/(turn/s²): feed-forward of acceleration"""
    trap_vel_limit: Annotated[float, Bounds(1e-3, 1e4)] = 10.0
    """turn/s, input mode TRAP_TRAJ"""
    trap_accel_limit: Annotated[float, Bounds(1e-3, 1e5)] = 20.0
    trap_decel_limit: Annotated[float, Bounds(1e-3, 1e5)] = 20.0

    torque_constant: Annotated[float, Bounds(1e-5, 100.0)] = 8.27 / 270.0
    """N·m/A: a motor of 270 rpm/V"""
    current_soft_max: Annotated[float, Bounds(1e-3, 1e3)] = 30.0
    """A: limit of the controller's current command"""
    current_hard_max: Annotated[float, Bounds(1e-3, 1e3)] = 50.0
    """A: above it the axis disarms"""
    current_bandwidth: Annotated[float, Bounds(1.0, 1e5)] = 1000.0
    """rad/s of the current loop"""
    phase_resistance: Annotated[float, Bounds(1e-4, 100.0)] = 0.05
    """Ω"""
    encoder_cpr: Annotated[int, Bounds(1, 1 << 24)] = 16384
    """Counts per turn of the encoder on the motor's shaft."""
    encoder_bandwidth: Annotated[float, Bounds(1.0, 1e5)] = 1000.0
    """rad/s of the velocity estimate"""

    bus_voltage: Annotated[float, Bounds(1.0, 100.0)] = 24.0
    """V, without load"""
    bus_resistance: Annotated[float, Bounds(0.0, 100.0)] = 0.05
    """Ω of battery and cables"""
    dc_bus_undervoltage_trip_level: Annotated[float, Bounds(0.0, 100.0)] = 10.5
    dc_bus_overvoltage_trip_level: Annotated[float, Bounds(0.0, 1e3)] = 56.0
    dc_max_positive_current: Annotated[float, Bounds(0.0, 1e4)] = 60.0
    """A"""
    dc_max_negative_current: Annotated[float, Bounds(-1e4, 0.0)] = -30.0
    """A fed back that the supply or brake resistor can take"""
    ambient: Annotated[float, Bounds(-50.0, 200.0)] = 25.0
    """°C"""
    motor_thermal_resistance: Annotated[float, Bounds(1e-3, 1e3)] = 2.0
    """K/W from winding to ambient"""
    motor_thermal_capacity: Annotated[float, Bounds(1e-3, 1e5)] = 80.0
    """J/K"""
    motor_temp_limit_lower: Annotated[float, Bounds(-50.0, 1e3)] = 80.0
    """°C from which on the current limit falls"""
    motor_temp_limit_upper: Annotated[float, Bounds(-50.0, 1e3)] = 100.0
    """°C at which it is zero; 5 °C more disarm"""
    fet_temp_limit_lower: Annotated[float, Bounds(-50.0, 1e3)] = 80.0
    fet_temp_limit_upper: Annotated[float, Bounds(-50.0, 1e3)] = 100.0
    spinout_electrical_power_threshold: Annotated[float, Bounds(0.0, 1e6)] = 100.0
    """W; the factory's ±10 W trips on hard but honest braking of a loaded wheel"""
    spinout_mechanical_power_threshold: Annotated[float, Bounds(-1e6, 0.0)] = -100.0
    """W"""
    spinout_power_bandwidth: Annotated[float, Bounds(1e-3, 1e4)] = 20.0
    """rad/s of the filters of both powers"""

    enable_watchdog: bool = False
    watchdog_timeout: Annotated[float, Bounds(0.0, 3600.0)] = 0.0
    """s"""
    reboot_ms: Annotated[int, Bounds(0, 60_000)] = 800
    """Time without frames after a reboot."""
    initializing_ms: Annotated[int, Bounds(0, 60_000)] = 300
    """Time for which the axis then reports INITIALIZING."""

    def __post_init__(self) -> None:
        others: list[Wrong] = []
        if self.firmware and not re.fullmatch(r"0\.[56]\.\d{1,2}", self.firmware):
            others.append(("firmware", f"firmware {self.firmware!r} must be like 0.5.6 or 0.6.10"))
        if self.enable_watchdog and not self.watchdog_timeout > 0:
            text = "watchdog_timeout must be above 0 when enable_watchdog is true"
            others.append(("watchdog_timeout", text))
        check(self, *others)


@dataclass(frozen=True, slots=True)
class Settings(AxisSettings):
    """The configuration of the device over CAN."""

    other_axis: Annotated[int, Bounds(-1, MAX_EXTENDED_NODE)] = -1
    """Node id of the other axis on the same board (0.5.x): clearing or restarting the board affects both."""
    hw_line: Annotated[int, Bounds(0, 0xFF)] = 5
    """Product line 5: ODrive S1 (only reported, never used)."""

    # Periods of cyclic messages; 0: never. Firmware 0.5.x calls them heartbeat_rate_ms, encoder_rate_ms,
    # iq_rate_ms and bus_vi_rate_ms, and has those with its own names below instead of version, error,
    # temperature and torques.
    version_msg_rate_ms: Annotated[int, Bounds(0, 60_000)] = 0
    heartbeat_msg_rate_ms: Annotated[int, Bounds(0, 60_000)] = 100
    encoder_msg_rate_ms: Annotated[int, Bounds(0, 60_000)] = 10
    iq_msg_rate_ms: Annotated[int, Bounds(0, 60_000)] = 0
    error_msg_rate_ms: Annotated[int, Bounds(0, 60_000)] = 0
    temperature_msg_rate_ms: Annotated[int, Bounds(0, 60_000)] = 0
    bus_voltage_msg_rate_ms: Annotated[int, Bounds(0, 60_000)] = 0
    torques_msg_rate_ms: Annotated[int, Bounds(0, 60_000)] = 0
    motor_error_rate_ms: Annotated[int, Bounds(0, 60_000)] = 0
    encoder_error_rate_ms: Annotated[int, Bounds(0, 60_000)] = 0
    controller_error_rate_ms: Annotated[int, Bounds(0, 60_000)] = 0
    sensorless_error_rate_ms: Annotated[int, Bounds(0, 60_000)] = 0
    encoder_count_rate_ms: Annotated[int, Bounds(0, 60_000)] = 0
    sensorless_rate_ms: Annotated[int, Bounds(0, 60_000)] = 0


_GROUPS = {
    "axis0.config": "enable_watchdog watchdog_timeout encoder_bandwidth",
    "axis0.config.can": " ".join(name for name in Settings.__slots__ if name.endswith("_msg_rate_ms")),
    "axis0.config.motor": "torque_constant current_soft_max current_hard_max phase_resistance"
    " current_control_bandwidth=current_bandwidth",
    "axis0.controller.config": "pos_gain vel_gain vel_integrator_gain vel_limit vel_limit_tolerance"
    " enable_torque_mode_vel_limit vel_ramp_rate torque_ramp_rate input_filter_bandwidth"
    " inertia spinout_electrical_power_threshold spinout_mechanical_power_threshold",
    "axis0.trap_traj.config": "vel_limit=trap_vel_limit accel_limit=trap_accel_limit"
    " decel_limit=trap_decel_limit",
    "config": "dc_bus_undervoltage_trip_level dc_bus_overvoltage_trip_level dc_max_positive_current"
    " dc_max_negative_current",
}
SETTING_OF: Mapping[str, str] = {
    f"{group}.{item.partition('=')[0]}": item.rpartition("=")[2]
    for group, items in _GROUPS.items()
    for item in items.split()
}
"""The settings by the paths of their endpoints (the vendor's reference of 0.6.x)."""
RELIED_ON = ("enable_watchdog", "watchdog_timeout", "encoder_msg_rate_ms", "heartbeat_msg_rate_ms")
_PROTECTED = {
    r"\.node_id$|baud_rate|can\.config\.protocol": "address or bit rate: a mistake ends all communication",
    r"phase_(resistance|inductance)|motor_model|flux_linkage": "it was measured of the motor",
    r"offset|direction|index|mapper|_valid$|pole_pairs|cpr|harmonic": "it is the encoder's calibration",
}


def configured(options: Options, settings: Settings) -> dict[str, Setting]:
    """Return the endpoints of the robot file that are configuration: their paths contain `config`."""
    paths = {path: each for path, each in options.registers().by_name.items() if "config" in path.split(".")}
    known = {path: SETTING_OF[path] for path in paths if path in SETTING_OF}
    found = {path: Setting() for path in paths} | configuration(settings, known, RELIED_ON)
    for path, setting in found.items():
        why = next((why for pattern, why in _PROTECTED.items() if re.search(pattern, path)), "")
        found[path] = replace(setting, protected=why)
    limits: dict[str, tuple[Literal["velocity", "torque"], float]] = {
        "axis0.controller.config.vel_limit": ("velocity", math.tau),
        "axis0.config.motor.current_soft_max": ("torque", settings.torque_constant),
        "axis0.config.torque_soft_max": ("torque", 1.0),
    }
    for path in limits.keys() & found.keys():
        found[path] = replace(found[path], limit=limits[path][0], unit=limits[path][1])
    return found


def saved(options: AxisOptions, settings: AxisSettings) -> dict[int, int]:
    """Return what the endpoints of the robot file hold as configured, in bits."""
    registers = options.registers()
    held = {
        path: float(getattr(settings, SETTING_OF[path])) for path in registers.by_name if path in SETTING_OF
    }
    return {registers.by_name[path].number: registers.raw(path, value) for path, value in held.items()}


def used(options: AxisOptions, settings: AxisSettings, endpoints: Mapping[int, int]) -> AxisSettings:
    """Return the settings of a device whose endpoints hold this (bits); impossible ones change nothing."""
    registers, before = options.registers(), saved(options, settings)
    changed = (
        registers.value(number, bits) for number, bits in endpoints.items() if before.get(number) != bits
    )
    held = {SETTING_OF[path]: value for path, value in changed if path in SETTING_OF and value is not None}
    for name in sorted(held, key="enable_watchdog".__eq__):  # which needs a timeout
        with suppress(ValueError):
            settings = replace(settings, **{name: type(getattr(settings, name))(held[name])})
    return settings


def serial_of(settings: AxisSettings, address: int) -> int:
    """Return the serial number of a device: as configured, or derived from its address."""
    return settings.serial_number or 0x385F_3473_3300 + (address & BROADCAST)


NEWEST = {"auto": "0.6.10", "0.6": "0.6.10", "0.5": "0.5.6"}


def firmware_of(device: Device) -> str:
    """Return the firmware of a device: as configured, or the newest of the line that the driver expects."""
    settings: AxisSettings = device.settings
    options: AxisOptions = device.options
    return settings.firmware or NEWEST[options.firmware]


def line_of(device: Device) -> str:
    """Return its firmware line: "0.5" or "0.6"."""
    return firmware_of(device)[:3]
