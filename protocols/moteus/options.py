"""Configuration: `Options` of the driver, `Settings` of the device itself.

Rules. Options never repeat what the device knows, except to be stricter in each command; the driver does not
read settings. Options are SI; names and units of settings are the vendor's own (rev, N·m, A, V, °C, s),
so that they can be compared with `moteus_tool --dump-config`. No option switches a watchdog off.
"""

from __future__ import annotations

import math
import re
import struct
from dataclasses import dataclass, fields

from protocols.moteus.codec import BROADCAST
from protocols.moteus.messages import Limits
from protocols.moteus.registers import Mode
from protocols.plugin import Device


@dataclass(frozen=True, slots=True)
class Options:
    """Configuration of the driver."""

    host_id: int = 0
    """Our own id on the bus, to which devices reply: another one for each host on it."""
    can_prefix: int = 0
    """`can.prefix` of the device: the upper 13 bits of its identifiers. Set one where other protocols share
    the bus: a moteus obeys any identifier whose lower 7 bits are its id."""
    timeout_ms: int = 100
    """Watchdog timeout, written with every command: without another in time the device latches a timeout."""
    max_torque: float = 0.0
    """N·m, in every command; 0: as configured on the device."""
    velocity_limit: float = 0.0
    """rad/s of the device's own trajectories, in every command; 0: as configured on the device."""
    acceleration_limit: float = 0.0
    """rad/s², likewise."""
    feedback_ms: int = 10
    """Period of queries to a device that is not commanded; each command is a query too."""
    details_ms: int = 200
    """Period of queries for current, voltage and temperatures as well."""
    offline_ms: int = 200
    """Time without a reply after which the device is offline."""

    def __post_init__(self) -> None:
        wrong = [
            f"{name} is {getattr(self, name)}: it must lie between {low} and {high}"
            for name, low, high in (
                ("host_id", 0, 126),
                ("can_prefix", 0, 0x1FFF),
                ("timeout_ms", 10, 10_000),
                ("feedback_ms", 1, 1000),
                ("details_ms", 1, 60_000),
                ("offline_ms", 20, 10_000),
            )
            if not low <= getattr(self, name) <= high
        ]
        for name in ("max_torque", "velocity_limit", "acceleration_limit"):
            value = getattr(self, name)
            if not (math.isfinite(value) and value >= 0):
                wrong.append(f"{name} is {value}: it must be finite and not negative")
        if self.offline_ms < 2 * self.feedback_ms:
            wrong.append(
                f"offline_ms ({self.offline_ms}) must be at least twice feedback_ms ({self.feedback_ms})"
            )
        if wrong:
            raise ValueError("; ".join(wrong))


def limits_of(options: Options) -> Limits:
    """Return the limits in every command, in the device's units."""
    return Limits(
        options.timeout_ms / 1000,
        options.max_torque or None,
        options.velocity_limit / math.tau or None,
        options.acceleration_limit / math.tau or None,
    )


@dataclass(frozen=True, slots=True)
class Settings:
    """Configuration of the device: by default a commissioned servo."""

    uuid: str = ""
    """32 hexadecimal digits, as on the packaging; "": generated from the address and the twin's seed."""
    firmware: str = "1.3.4"
    model: int = 0x030404
    register_map: int = 5

    kp: float = 10.0
    """servo.pid_position.kp, N·m/rev"""
    ki: float = 10.0
    """N·m/(rev·s)"""
    kd: float = 0.4
    """N·m/(rev/s)"""
    ilimit: float = 0.3
    """N·m"""
    position_min: float = math.nan
    """servopos.position_min, rev; NaN: none"""
    position_max: float = math.nan
    position_derate: float = 0.02
    """rev beyond a limit in which the torque outwards falls to zero"""
    default_velocity_limit: float = math.nan
    """rev/s; NaN: none"""
    default_accel_limit: float = math.nan
    """rev/s²; NaN: none"""
    default_timeout_s: float = 0.1
    """NaN: no watchdog unless a command has one"""
    timeout_mode: int = int(Mode.ZERO_VELOCITY)
    timeout_max_torque: float = 5.0
    fault_position_error: float = math.nan
    """rev; NaN: not watched"""
    fault_velocity_error: float = math.nan
    """rev/s; NaN: not watched"""

    motor_kv: float = 304.0
    """rpm/V; a motor gives 8.27/Kv N·m/A"""
    max_current: float = 40.0
    max_velocity: float = 500.0
    """rev/s above which the torque falls"""
    max_velocity_derate: float = 2.0
    current_bandwidth: float = 2000.0
    """rad/s of the current loop"""
    phase_resistance: float = 0.05
    """Ω"""
    encoder_cpr: int = 16384
    """Counts per revolution of the output."""
    encoder_bandwidth: float = 1500.0
    """rad/s of the velocity's filter"""
    enable_ms: int = 5
    """Time from stopped to a mode with torque: the gate driver is enabled, the current sensors are zeroed."""
    reply_delay_us: int = 0
    """Time from the end of a frame to the beginning of its reply."""

    bus_voltage: float = 24.0
    """V, without load"""
    bus_resistance: float = 0.05
    """Ω of battery and cables"""
    max_voltage: float = 46.0
    min_voltage: float = 4.0
    ambient: float = 25.0
    """°C"""
    fault_temperature: float = 75.0
    motor_fault_temperature: float = math.nan
    """NaN: no motor thermistor"""
    temperature_margin: float = 20.0
    """K below a fault's temperature from which on the current is limited"""

    def __post_init__(self) -> None:
        values = {f.name: getattr(self, f.name) for f in fields(self)}
        floats = {name: value for name, value in values.items() if isinstance(value, float)}
        wrong = [f"{name} must not be infinite" for name, value in floats.items() if math.isinf(value)]
        wrong += [
            f"{name} must be a number"
            for name, value in floats.items()
            if math.isnan(value) and name not in _MAY_BE_NAN
        ]
        wrong += [f"{name} must be above 0" for name in _POSITIVE if not getattr(self, name) > 0]
        wrong += [f"{name} must not be negative" for name in _NOT_NEGATIVE if getattr(self, name) < 0]
        if self.uuid and not re.fullmatch(r"[0-9a-f]{32}", self.uuid):
            wrong.append("uuid must be 32 hexadecimal digits (0-9, a-f), without dashes")
        if not re.fullmatch(r"\d{1,2}\.\d{1,2}\.\d{1,2}", self.firmware):
            wrong.append(f"firmware {self.firmware!r} must be like 1.3.4")
        if self.timeout_mode not in (Mode.STOPPED, Mode.POSITION, Mode.ZERO_VELOCITY, Mode.BRAKE):
            wrong.append("timeout_mode must be 0, 10, 12 or 15")
        if wrong:
            raise ValueError("; ".join(wrong))


_MAY_BE_NAN = {"default_timeout_s"} | {
    f.name for f in fields(Settings) if isinstance(f.default, float) and math.isnan(f.default)
}
_POSITIVE = (
    "motor_kv",
    "max_current",
    "max_velocity",
    "max_velocity_derate",
    "position_derate",
    "current_bandwidth",
    "phase_resistance",
    "encoder_cpr",
    "encoder_bandwidth",
    "bus_voltage",
    "max_voltage",
    "temperature_margin",
)
_NOT_NEGATIVE = (
    "kp",
    "ki",
    "kd",
    "ilimit",
    "timeout_max_torque",
    "enable_ms",
    "reply_delay_us",
    "bus_resistance",
    "min_voltage",
    "model",
    "register_map",
)
ADDRESS_MAX = BROADCAST - 1


def torque_constant(settings: Settings) -> float:
    """Return the torque constant [N·m/A] of a motor with this Kv."""
    return 8.27 / settings.motor_kv


def firmware_number(settings: Settings) -> int:
    """Return the content of the firmware register: 1.3.4 is 0x010304."""
    major, minor, micro = (int(part) for part in settings.firmware.split("."))
    return major << 16 | minor << 8 | micro


def uuid_of(device: Device, seed: int) -> bytes:
    """Return the 16 bytes of the UUID, as configured or generated."""
    settings: Settings = device.settings
    if settings.uuid:
        return bytes.fromhex(settings.uuid)
    mixed = (device.address * 0x9E3779B97F4A7C15 + seed * 0xBF58476D1CE4E5B9 + 0x94D049BB133111EB) % 2**64
    return struct.pack(">QII", mixed, 0x6D6F7465, device.address << 16 | seed & 0xFFFF)


SERIAL_BYTES = 8
"""A serial number is the first 8 bytes of a UUID, its first 16 digits as printed."""


def serial_of(uuid: bytes) -> int:
    """Return the serial number in messages."""
    return int.from_bytes(uuid[:SERIAL_BYTES], "big")
