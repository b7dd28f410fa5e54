"""`Settings`: what is configured on the drive itself, as a commissioned axis has it.

Rules. A setting that is an object of the dictionary is a row of (object, default, bounds), in the drive's own
units, so that it can be compared with an EDS or a commissioning tool; the driver does not read settings.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Annotated, Literal

from protocols.bounds import Bounds, bounds_of, check, hints
from protocols.canopen import objects as co
from protocols.canopen.objects import Key
from protocols.cia402 import objects as o
from protocols.cia402.objects import OBJECTS
from protocols.cia402.profile import Mode, mode_bit
from protocols.cia402.units import Units, units_of

NEVER_FOLLOWING = 0xFFFFFFFF
"""6065: the following error is not monitored."""
MILLI_RPM = 0xFDB44700
"""60A9: 0.001 turns a minute."""
MILLI_RPM_PER_SECOND = 0xFDC00300
"""60AA"""
ALL_MODES = sum(mode_bit(m) for m in (Mode.PP, Mode.PV, Mode.PT, Mode.HM, Mode.CSP, Mode.CSV, Mode.CST))


@dataclass(frozen=True, slots=True, kw_only=True)
class Stored(Bounds):
    """The bounds of a setting that is an object."""

    key: Key
    only: Sequence[int]
    """The values that the twin supports; (): all."""


def stored(key: Key, low: int | None = None, only: Sequence[int] = ()) -> Stored:
    """Return the bounds of an object: its values are those of its type, at least `low`, or `only` these; the
    drive refuses others by SDO, too."""
    type_ = OBJECTS[key].type
    return Stored(type_.low if low is None else low, type_.high, key=key, only=only)


@dataclass(frozen=True, slots=True)
class Settings:
    """What is configured on the drive. Velocities are in units of 60A9, accelerations in those of 60AA."""

    device_name: str = "twin402"
    """1008"""
    vendor_id: Annotated[int, stored(co.VENDOR_ID)] = 0
    """0 is assigned to no vendor"""
    product_code: Annotated[int, stored(co.PRODUCT_CODE)] = 402
    revision: Annotated[int, stored(co.REVISION)] = 0x0001_0000
    serial_number: Annotated[int, stored(co.SERIAL_NUMBER)] = 0
    """0: derived from the address"""
    has_node_id: bool = True
    """False: as from some makers, it has none yet, and answers LSS alone until it is given one"""
    supported_modes: Annotated[int, stored(o.SUPPORTED_MODES)] = ALL_MODES
    lacks: str = ""
    """Objects that it does not have, as indices: "60A9 60B1"."""

    encoder_increments: Annotated[int, stored(o.ENCODER_INCREMENTS, 1)] = 16_384
    """Per turn of the motor"""
    gear_motor: Annotated[int, stored(o.GEAR_MOTOR, 1)] = 1
    gear_shaft: Annotated[int, stored(o.GEAR_SHAFT, 1)] = 1
    feed: Annotated[int, stored(o.FEED)] = 0
    """position units per `feed_shaft` turns of the shaft; 0: positions are encoder increments"""
    feed_shaft: Annotated[int, stored(o.FEED_SHAFT, 1)] = 1
    position_unit: Annotated[int, stored(o.POSITION_UNIT)] = 0
    """0: as `feed` has it"""
    velocity_unit: Annotated[int, stored(o.VELOCITY_UNIT)] = MILLI_RPM
    """0: position units per second times the factor"""
    velocity_numerator: Annotated[int, stored(o.VELOCITY_NUMERATOR)] = 1
    velocity_divisor: Annotated[int, stored(o.VELOCITY_DIVISOR, 1)] = 1
    acceleration_unit: Annotated[int, stored(o.ACCELERATION_UNIT)] = MILLI_RPM_PER_SECOND
    """0: velocity units per second times the factor"""
    acceleration_numerator: Annotated[int, stored(o.ACCELERATION_NUMERATOR, 1)] = 1
    acceleration_divisor: Annotated[int, stored(o.ACCELERATION_DIVISOR, 1)] = 1
    rated_torque: Annotated[int, stored(o.RATED_TORQUE, 1)] = 1000
    """mN·m of the motor"""
    rated_current: Annotated[int, stored(o.RATED_CURRENT, 1)] = 5000
    """mA"""
    max_torque: Annotated[int, stored(o.MAX_TORQUE)] = 3000
    """‰"""
    max_motor_speed: Annotated[int, stored(o.MAX_MOTOR_SPEED, 1)] = 6000
    """rpm of the motor"""
    max_profile_velocity: Annotated[int, stored(o.MAX_PROFILE_VELOCITY, 1)] = 0xFFFFFFFF
    profile_velocity: Annotated[int, stored(o.PROFILE_VELOCITY, 1)] = 400_000
    profile_acceleration: Annotated[int, stored(o.PROFILE_ACCELERATION, 1)] = 4_000_000
    profile_deceleration: Annotated[int, stored(o.PROFILE_DECELERATION, 1)] = 4_000_000
    quick_stop_deceleration: Annotated[int, stored(o.QUICK_STOP_DECELERATION, 1)] = 8_000_000
    torque_slope: Annotated[int, stored(o.TORQUE_SLOPE, 1)] = 10_000
    """‰ per second"""
    following_window: Annotated[int, stored(o.FOLLOWING_WINDOW)] = NEVER_FOLLOWING
    following_time: Annotated[int, stored(o.FOLLOWING_TIME)] = 10
    """ms"""
    position_window: Annotated[int, stored(o.POSITION_WINDOW)] = 50
    position_window_time: Annotated[int, stored(o.POSITION_WINDOW_TIME)] = 5
    """ms"""
    velocity_window: Annotated[int, stored(o.VELOCITY_WINDOW)] = 2000
    velocity_window_time: Annotated[int, stored(o.VELOCITY_WINDOW_TIME)] = 5
    """ms"""
    velocity_threshold: Annotated[int, stored(o.VELOCITY_THRESHOLD)] = 800
    """below it the shaft is at standstill"""
    soft_limit_low: Annotated[int, stored(o.SOFT_LIMIT_LOW)] = 0
    """Both 0: no limits"""
    soft_limit_high: Annotated[int, stored(o.SOFT_LIMIT_HIGH)] = 0
    home_offset: Annotated[int, stored(o.HOME_OFFSET)] = 0
    homing_method: Annotated[int, stored(o.HOMING_METHOD, only=(33, 34, 35, 37))] = 35
    """35 or 37: the present position; 33 or 34: the encoder's index; it has no switches"""
    homing_speed: Annotated[int, stored(o.HOMING_SPEED_ZERO, 1)] = 40_000
    homing_acceleration: Annotated[int, stored(o.HOMING_ACCELERATION, 1)] = 4_000_000
    interpolation_ms: Annotated[int, stored(o.INTERPOLATION_VALUE)] = 0
    """time in which a new cyclic set-point is reached; 0: at once"""
    digital_inputs: Annotated[int, stored(o.DIGITAL_INPUTS)] = 0

    quick_stop_option: Annotated[int, stored(o.QUICK_STOP_OPTION, only=(0, 1, 2, 3, 5, 6, 7))] = 2
    """0 no torque; 1, 2, 3 slow down (6084, 6085, at the current limit), then no torque; 5, 6, 7 the same,
    and hold"""
    shutdown_option: Annotated[int, stored(o.SHUTDOWN_OPTION, only=(0, 1))] = 0
    """0 no torque, 1 slow down first"""
    disable_option: Annotated[int, stored(o.DISABLE_OPTION, only=(0, 1))] = 0
    """0 no torque, 1 slow down first"""
    halt_option: Annotated[int, stored(o.HALT_OPTION, only=(1, 2, 3))] = 1
    """Slow down, as for a quick stop"""
    fault_option: Annotated[int, stored(o.FAULT_OPTION, only=(0, 1, 2, 3))] = 0
    """The same; 0 no torque"""
    abort_connection: Annotated[int, stored(o.ABORT_CONNECTION, only=(0, 1, 2, 3))] = 1
    """when the host's heartbeat is lost: 0 nothing, 1 fault, 2 disable voltage, 3 quick stop"""
    error_behaviour: Annotated[int, stored(co.ERROR_BEHAVIOUR, only=(0, 1, 2))] = 0
    """when the host's heartbeat is lost: 0 NMT pre-operational, 1 no change, 2 NMT stopped"""
    heartbeat_producer: Annotated[int, stored(co.PRODUCER_HEARTBEAT)] = 100
    """ms; 0: none"""
    heartbeat_consumer: Annotated[int, stored(co.CONSUMER_HEARTBEAT)] = 0
    """node << 16 | ms; 0: a lost host is not noticed"""
    pdos: Literal["none", "usual"] = "none"
    """How its PDOs are configured at power-on: all disabled, or a usual mapping on SYNC."""

    position_gain: Annotated[float, Bounds(0.0, 1e6)] = 15.0
    """1/s; like all that follows not in the dictionary"""
    velocity_gain: Annotated[float, Bounds(0.0, 1e6)] = 0.1
    """N·m·s/rad at the device's shaft"""
    velocity_integral: Annotated[float, Bounds(0.0, 1e6)] = 0.2
    """N·m/rad"""
    torque_bandwidth: Annotated[float, Bounds(1e-3, 1e6)] = 1000.0
    """rad/s of the current loop"""
    velocity_bandwidth: Annotated[float, Bounds(1e-3, 1e6)] = 1000.0
    """rad/s of the velocity filter"""
    dc_voltage: Annotated[float, Bounds(1e-3, 1e6)] = 48.0
    """V"""
    sdo_delay_ms: Annotated[int, Bounds(0, 60_000)] = 0
    """Time in which it serves an SDO request, one after the other; 0: at its next cycle."""
    sdo_waiting: Annotated[int, Bounds(0, 1000)] = 100
    """requests that wait while it serves one; others are lost"""
    boot_ms: Annotated[int, Bounds(0, 60_000)] = 300
    """Without communication after a reset"""

    def __deepcopy__(self, _: dict[int, object]) -> Settings:
        return self

    def __post_init__(self) -> None:
        others = [
            (name, f"{name} is {getattr(self, name)}: the twin supports {ONLY[key]}")
            for name, key in SETTING_OBJECTS.items()
            if key in ONLY and getattr(self, name) not in ONLY[key]
        ]
        if self.soft_limit_low > self.soft_limit_high:
            others.append(("soft_limit_low", "soft_limit_low must not be above soft_limit_high"))
        if not self.device_name.isascii() or not self.device_name:
            others.append(("device_name", "device_name must be ASCII text"))
        if wrong := [index for index in self.lacks.split() if co.parse(index) is None]:
            others.append(("lacks", f"lacks: {' '.join(wrong)} is no index of four hexadecimal digits"))
        check(self, *others)


_STORED = {
    name: bounds for name, hint in hints(Settings).items() if isinstance(bounds := bounds_of(hint), Stored)
}
SETTING_OBJECTS: dict[str, Key] = {name: bounds.key for name, bounds in _STORED.items()}
"""The settings that are objects of the dictionary."""
ONLY: dict[Key, Sequence[int]] = {row.key: row.only for row in _STORED.values() if row.only}
"""The values that the twin supports of an object; others are refused."""
LOWEST: dict[Key, int] = {row.key: int(row.least) for row in _STORED.values() if row.least > 0} | {
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
