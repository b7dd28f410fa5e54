"""What is configured on a moteus: by default a commissioned servo.

Rules. Names and units are the vendor's own (rev, N·m, A, V, °C, s), so that they can be compared with
`moteus_tool --dump-config`.
"""

from __future__ import annotations

import re
from dataclasses import dataclass
from math import nan

from protocols.moteus.table import Mode
from protocols.toolkit.options import bounded, check_bounds


@dataclass(frozen=True, slots=True)
class Settings:
    """Configuration of the device: by default a commissioned servo."""

    uuid: str = ""
    """32 hexadecimal digits, as on the packaging; "": generated from the address and the twin's seed."""
    firmware: str = "1.3.4"
    model: int = bounded(0x030404, 0, 0x7FFFFFFF)
    register_map: int = bounded(5, 0, 0x7FFFFFFF)

    kp: float = bounded(10.0, 0.0, 1e6)
    """servo.pid_position.kp, N·m/rev"""
    ki: float = bounded(10.0, 0.0, 1e6)
    """N·m/(rev·s)"""
    kd: float = bounded(0.4, 0.0, 1e6)
    """N·m/(rev/s)"""
    ilimit: float = bounded(0.3, 0.0, 1e6)
    """N·m"""
    position_min: float = bounded(nan, -1e6, 1e6, nan="none")
    """servopos.position_min, rev"""
    position_max: float = bounded(nan, -1e6, 1e6, nan="none")
    position_derate: float = bounded(0.02, 1e-6, 1e6)
    """rev beyond a limit in which the torque outwards falls to zero"""
    default_velocity_limit: float = bounded(nan, -1e6, 1e6, nan="none")
    """rev/s"""
    default_accel_limit: float = bounded(nan, -1e9, 1e9, nan="none")
    """rev/s²"""
    default_timeout_s: float = bounded(0.1, 0.0, 1e6, nan="no watchdog unless a command has one")
    timeout_mode: int = bounded(int(Mode.ZERO_VELOCITY), 0, 15)
    timeout_max_torque: float = bounded(5.0, 0.0, 1e6)
    fault_position_error: float = bounded(nan, 0.0, 1e6, nan="not watched")
    """rev"""
    fault_velocity_error: float = bounded(nan, 0.0, 1e6, nan="not watched")
    """rev/s"""

    motor_kv: float = bounded(304.0, 1e-3, 1e6)
    """rpm/V; a motor gives 8.27/Kv N·m/A"""
    max_current: float = bounded(40.0, 1e-3, 1e6)
    max_velocity: float = bounded(500.0, 1e-3, 1e6)
    """rev/s above which the torque falls"""
    max_velocity_derate: float = bounded(2.0, 1e-3, 1e6)
    current_bandwidth: float = bounded(2000.0, 1e-3, 1e6)
    """rad/s of the current loop"""
    phase_resistance: float = bounded(0.05, 1e-6, 1e6)
    """Ω"""
    encoder_cpr: int = bounded(16384, 1, 1 << 31)
    """Counts per revolution of the output."""
    encoder_bandwidth: float = bounded(1500.0, 1e-3, 1e6)
    """rad/s of the velocity's filter"""
    enable_ms: int = bounded(5, 0, 1_000_000)
    """Time from stopped to a mode with torque: the gate driver is enabled, the current sensors are zeroed."""
    reply_delay_us: int = bounded(0, 0, 1_000_000_000)
    """Time from the end of a frame to the beginning of its reply."""

    bus_voltage: float = bounded(24.0, 1e-3, 1e6)
    """V, without load"""
    bus_resistance: float = bounded(0.05, 0.0, 1e6)
    """Ω of battery and cables"""
    max_voltage: float = bounded(46.0, 1e-3, 1e6)
    min_voltage: float = bounded(4.0, 0.0, 1e6)
    ambient: float = bounded(25.0, -273.0, 1e6)
    """°C"""
    fault_temperature: float = bounded(75.0, -273.0, 1e6)
    temperature_margin: float = bounded(20.0, 1e-3, 1e6)
    """K below a fault's temperature from which on the current is limited"""

    def __post_init__(self) -> None:
        others = []
        if self.uuid and not re.fullmatch(r"[0-9a-f]{32}", self.uuid):
            others.append("uuid must be 32 hexadecimal digits (0-9, a-f), without dashes")
        if not re.fullmatch(r"\d{1,2}\.\d{1,2}\.\d{1,2}", self.firmware):
            others.append(f"firmware {self.firmware!r} must be like 1.3.4")
        if self.timeout_mode not in (Mode.STOPPED, Mode.POSITION, Mode.ZERO_VELOCITY, Mode.BRAKE):
            others.append("timeout_mode must be 0, 10, 12 or 15")
        check_bounds(self, others)


def torque_constant(motor_kv: float) -> float:
    """Return the torque constant [N·m/A] of a motor with this Kv [rpm/V]."""
    return 8.27 / motor_kv
