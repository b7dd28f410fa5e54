"""`Settings`: what is configured on the drive itself, as a commissioned axis has it.

Rules. A setting that is an object of the dictionary is a row of (object, default, bounds), in the drive's own
units, so that it can be compared with an EDS or a commissioning tool; the driver does not read settings.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, fields, replace
from typing import Literal

from protocols.canopen import objects as co
from protocols.canopen.objects import Key
from protocols.cia402 import objects as o
from protocols.cia402.objects import OBJECTS
from protocols.cia402.profile import Mode, mode_bit
from protocols.cia402.units import Units, units_of
from protocols.toolkit.options import bounded, check_bounds

NEVER_FOLLOWING = 0xFFFFFFFF
"""6065: the following error is not monitored."""
MILLI_RPM = 0xFDB44700
"""60A9: 0.001 turns a minute."""
MILLI_RPM_PER_SECOND = 0xFDC00300
"""60AA"""
ALL_MODES = sum(mode_bit(m) for m in (Mode.PP, Mode.PV, Mode.PT, Mode.HM, Mode.CSP, Mode.CSV, Mode.CST))


def stored(key: Key, default: int, low: int | None = None, only: Sequence[int] = ()) -> int:
    """Declare a setting that is an object: its values are those of its type, at least `low`, or `only` these;
    the drive refuses others by SDO, too."""
    type_ = OBJECTS[key].type
    bounds = {"low": type_.low if low is None else low, "high": type_.high, "nan": ""}
    declared: int = field(default=default, metadata=bounds | {"object": key, "only": only})
    return declared


@dataclass(frozen=True, slots=True)
class Settings:
    """What is configured on the drive. Velocities are in units of 60A9, accelerations in those of 60AA."""

    device_name: str = "twin402"  # 1008
    vendor_id: int = stored(co.VENDOR_ID, 0)  # 0 is assigned to no vendor
    product_code: int = stored(co.PRODUCT_CODE, 402)
    revision: int = stored(co.REVISION, 0x0001_0000)
    serial_number: int = stored(co.SERIAL_NUMBER, 0)  # 0: derived from the address
    supported_modes: int = stored(o.SUPPORTED_MODES, ALL_MODES)
    lacks: str = ""
    """Objects that it does not have, as indices: "60A9 60B1"."""

    encoder_increments: int = stored(o.ENCODER_INCREMENTS, 16_384, 1)  # per turn of the motor
    gear_motor: int = stored(o.GEAR_MOTOR, 1, 1)
    gear_shaft: int = stored(o.GEAR_SHAFT, 1, 1)
    feed: int = stored(o.FEED, 0)
    """position units per `feed_shaft` turns of the shaft; 0: positions are encoder increments"""
    feed_shaft: int = stored(o.FEED_SHAFT, 1, 1)
    position_unit: int = stored(o.POSITION_UNIT, 0)  # 0: as `feed` has it
    velocity_unit: int = stored(o.VELOCITY_UNIT, MILLI_RPM)  # 0: position units per second times the factor
    velocity_numerator: int = stored(o.VELOCITY_NUMERATOR, 1)
    velocity_divisor: int = stored(o.VELOCITY_DIVISOR, 1, 1)
    acceleration_unit: int = stored(o.ACCELERATION_UNIT, MILLI_RPM_PER_SECOND)
    """0: velocity units per second times the factor"""
    acceleration_numerator: int = stored(o.ACCELERATION_NUMERATOR, 1, 1)
    acceleration_divisor: int = stored(o.ACCELERATION_DIVISOR, 1, 1)
    rated_torque: int = stored(o.RATED_TORQUE, 1000, 1)  # mN·m of the motor
    rated_current: int = stored(o.RATED_CURRENT, 5000, 1)  # mA
    max_torque: int = stored(o.MAX_TORQUE, 3000)  # ‰
    max_motor_speed: int = stored(o.MAX_MOTOR_SPEED, 6000, 1)  # rpm of the motor
    max_profile_velocity: int = stored(o.MAX_PROFILE_VELOCITY, 0xFFFFFFFF, 1)
    profile_velocity: int = stored(o.PROFILE_VELOCITY, 400_000, 1)
    profile_acceleration: int = stored(o.PROFILE_ACCELERATION, 4_000_000, 1)
    profile_deceleration: int = stored(o.PROFILE_DECELERATION, 4_000_000, 1)
    quick_stop_deceleration: int = stored(o.QUICK_STOP_DECELERATION, 8_000_000, 1)
    torque_slope: int = stored(o.TORQUE_SLOPE, 10_000, 1)  # ‰ per second
    following_window: int = stored(o.FOLLOWING_WINDOW, NEVER_FOLLOWING)
    following_time: int = stored(o.FOLLOWING_TIME, 10)  # ms
    position_window: int = stored(o.POSITION_WINDOW, 50)
    position_window_time: int = stored(o.POSITION_WINDOW_TIME, 5)  # ms
    velocity_window: int = stored(o.VELOCITY_WINDOW, 2000)
    velocity_window_time: int = stored(o.VELOCITY_WINDOW_TIME, 5)  # ms
    velocity_threshold: int = stored(o.VELOCITY_THRESHOLD, 800)  # below it the shaft is at standstill
    soft_limit_low: int = stored(o.SOFT_LIMIT_LOW, 0)  # both 0: no limits
    soft_limit_high: int = stored(o.SOFT_LIMIT_HIGH, 0)
    home_offset: int = stored(o.HOME_OFFSET, 0)
    homing_method: int = stored(o.HOMING_METHOD, 35, only=(33, 34, 35, 37))
    """35 or 37: the present position; 33 or 34: the encoder's index; it has no switches"""
    homing_speed: int = stored(o.HOMING_SPEED_ZERO, 40_000, 1)
    homing_acceleration: int = stored(o.HOMING_ACCELERATION, 4_000_000, 1)
    interpolation_ms: int = stored(o.INTERPOLATION_VALUE, 0)
    """time in which a new cyclic set-point is reached; 0: at once"""
    digital_inputs: int = stored(o.DIGITAL_INPUTS, 0)

    quick_stop_option: int = stored(o.QUICK_STOP_OPTION, 2, only=(0, 1, 2, 3, 5, 6, 7))
    """0 no torque; 1, 2, 3 slow down (6084, 6085, at the current limit), then no torque; 5, 6, 7 the same,
    and hold"""
    shutdown_option: int = stored(o.SHUTDOWN_OPTION, 0, only=(0, 1))  # 0 no torque, 1 slow down first
    disable_option: int = stored(o.DISABLE_OPTION, 0, only=(0, 1))  # 0 no torque, 1 slow down first
    halt_option: int = stored(o.HALT_OPTION, 1, only=(1, 2, 3))  # slow down, as for a quick stop
    fault_option: int = stored(o.FAULT_OPTION, 0, only=(0, 1, 2, 3))  # the same; 0 no torque
    abort_connection: int = stored(o.ABORT_CONNECTION, 1, only=(0, 1, 2, 3))
    """when the host's heartbeat is lost: 0 nothing, 1 fault, 2 disable voltage, 3 quick stop"""
    error_behaviour: int = stored(co.ERROR_BEHAVIOUR, 0, only=(0, 1, 2))
    """when the host's heartbeat is lost: 0 NMT pre-operational, 1 no change, 2 NMT stopped"""
    heartbeat_producer: int = stored(co.PRODUCER_HEARTBEAT, 100)  # ms; 0: none
    heartbeat_consumer: int = stored(co.CONSUMER_HEARTBEAT, 0)
    """node << 16 | ms; 0: a lost host is not noticed"""
    pdos: Literal["none", "usual"] = "none"
    """How its PDOs are configured at power-on: all disabled, or a usual mapping on SYNC."""

    position_gain: float = bounded(15.0, 0.0, 1e6)  # 1/s; like all that follows not in the dictionary
    velocity_gain: float = bounded(0.1, 0.0, 1e6)  # N·m·s/rad at the device's shaft
    velocity_integral: float = bounded(0.2, 0.0, 1e6)  # N·m/rad
    torque_bandwidth: float = bounded(1000.0, 1e-3, 1e6)  # rad/s of the current loop
    velocity_bandwidth: float = bounded(1000.0, 1e-3, 1e6)  # rad/s of the velocity filter
    dc_voltage: float = bounded(48.0, 1e-3, 1e6)  # V
    sdo_delay_ms: int = bounded(0, 0, 60_000)
    """Time in which it serves an SDO request, one after the other; 0: at its next cycle."""
    sdo_waiting: int = bounded(100, 0, 1000)  # requests that wait while it serves one; others are lost
    boot_ms: int = bounded(300, 0, 60_000)  # without communication after a reset

    def __deepcopy__(self, _: dict[int, object]) -> Settings:
        return self

    def __post_init__(self) -> None:
        others = [
            f"{name} is {getattr(self, name)}: the twin supports {ONLY[key]}"
            for name, key in SETTING_OBJECTS.items()
            if key in ONLY and getattr(self, name) not in ONLY[key]
        ]
        if self.soft_limit_low > self.soft_limit_high:
            others.append("soft_limit_low must not be above soft_limit_high")
        if not self.device_name.isascii() or not self.device_name:
            others.append("device_name must be ASCII text")
        if wrong := [index for index in self.lacks.split() if co.parse(index) is None]:
            others.append(f"lacks: {' '.join(wrong)} is no index of four hexadecimal digits")
        check_bounds(self, others)


_STORED = [each for each in fields(Settings) if "object" in each.metadata]
SETTING_OBJECTS: dict[str, Key] = {each.name: each.metadata["object"] for each in _STORED}
"""The settings that are objects of the dictionary."""
_ROWS = [each.metadata for each in _STORED]
ONLY: dict[Key, Sequence[int]] = {row["object"]: row["only"] for row in _ROWS if row["only"]}
"""The values that the twin supports of an object; others are refused."""
LOWEST: dict[Key, int] = {row["object"]: row["low"] for row in _ROWS if row["low"] > 0} | {
    o.ENCODER_REVOLUTIONS: 1,
    o.HOMING_SPEED_SWITCH: 1,
}
"""The lowest value that the twin takes of an object, where its type has lower ones."""


def units_of_settings(settings: Settings) -> Units:
    """Return the units of a drive with these settings."""
    return twin_units({key: getattr(settings, name) for name, key in SETTING_OBJECTS.items()})


def twin_units(values: Mapping[Key, int]) -> Units:
    """Return the units in which the twin runs: rpm where its objects do not define a unit of velocity."""
    units = units_of(values)
    if isinstance(units, Units) and units.doubt:
        units = units_of(values, velocity_per_turn=60.0)
    assert isinstance(units, Units), "settings and dictionary keep 608F and 6091 above 0"
    per_turn = units.acceleration_per_turn or units.velocity_per_turn
    return replace(units, acceleration_per_turn=per_turn)
