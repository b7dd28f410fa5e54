"""`Options` of the driver, and `Settings`: what is configured on the drive itself.

Rules. Options never repeat what the drive reports; the driver does not read settings. Settings are objects of
the drive's dictionary, in its own units (`objects` has them), so that they can be compared with an EDS or a
commissioning tool.
"""

from __future__ import annotations

from dataclasses import dataclass, field, fields
from typing import Literal

from protocols.canopen.services import MAX_NODE
from protocols.cia402 import objects as o
from protocols.cia402.objects import Key
from protocols.cia402.profile import Mode, mode_bit
from protocols.cia402.units import Units, units_of

NEVER_FOLLOWING = 0xFFFFFFFF
"""6065: the following error is not monitored."""


@dataclass(frozen=True, slots=True)
class Options:
    """Behaviour of the driver."""

    modes: Literal["cyclic", "profile"] = "cyclic"
    """The preferred family of modes: CSP, CSV, CST, or PP, PV, PT. If the drive lacks a mode of it, the other
    family's is used."""
    feedback: Literal["sync", "event", "sdo"] = "sync"
    """How a commanded drive reports: by TPDO on every SYNC, by TPDO on its own event timer, or polled by SDO.
    A drive that was not commanded is polled by SDO, unless it sends TPDOs by itself."""
    mapping: Literal["auto", "keep"] = "auto"
    """The PDO mapping that the drive has: "auto": read, kept if it fits, else rewritten; "keep": read and
    never written; what it lacks is transferred by SDO."""
    sync_ms: int = 10
    """Period of the SYNC that this host produces while it commands a drive; 0: another producer does. The
    same for all drives of one bus."""
    feedback_ms: int = 10
    """Period of the drive's event timer with feedback = "event", and of polling by SDO."""
    offline_ms: int = 500
    """Time without a frame after which the drive counts as offline. Longer than its heartbeat period."""
    heartbeat_ms: int = 100
    """Heartbeat producer time (1017) written to the drive if it has none; 0: never written."""
    watchdog_ms: int = 500
    """Heartbeat consumer time (1016) for this host's heartbeat written to the drive; 0: never written."""
    host_id: int = MAX_NODE
    """Node id of this host in its own heartbeat."""
    sdo_timeout_ms: int = 200
    """Time after which an SDO request without a response is repeated, in the end given up."""
    state_timeout_ms: int = 1000
    """Time without progress of arming that is a fault."""
    home_timeout_ms: int = 30_000
    """Time without an end of homing that is a fault."""
    rated_torque: float = 0.0
    """N·m of the motor, for drives without object 6076; 0: then they take no torque."""
    counts_per_turn: float = 0.0
    """Position units per turn of the device's shaft, for drives whose 608F, 6091, 6092 and 60A8 do not define
    them; 0: then they stay unknown, and the drive is not commanded."""
    velocity_per_turn: float = 0.0
    """Velocity units per turn of the device's shaft and second (60: rpm), for drives whose 60A9 or 6096 do not
    define them; 0: then they stay unknown, and the drive takes no velocity."""

    def __deepcopy__(self, _: dict[int, object]) -> Options:
        return self

    def __post_init__(self) -> None:
        errors = [_out_of_range(name, getattr(self, name), low, high) for name, low, high in _OPTION_RANGES]
        errors += [
            _not_an_amount(self, name) for name in ("rated_torque", "counts_per_turn", "velocity_per_turn")
        ]
        if self.watchdog_ms and self.watchdog_ms < 2 * WATCHDOG_SHARE:
            errors.append(f"watchdog_ms is {self.watchdog_ms}: it must be 0 or at least {2 * WATCHDOG_SHARE}")
        if self.feedback == "event" and self.offline_ms < 2 * self.feedback_ms:
            errors.append(f"offline_ms ({self.offline_ms}) must be at least twice feedback_ms")
        if self.heartbeat_ms and self.offline_ms < 2 * self.heartbeat_ms:
            errors.append(f"offline_ms ({self.offline_ms}) must be at least twice heartbeat_ms")
        _raise(errors)


WATCHDOG_SHARE = 4
"""Heartbeats of the host within a drive's watchdog time."""
_OPTION_RANGES = (
    ("sync_ms", 0, 1000),
    ("feedback_ms", 1, 1000),
    ("offline_ms", 20, 60_000),
    ("heartbeat_ms", 0, 0xFFFF),
    ("watchdog_ms", 0, 0xFFFF),
    ("host_id", 1, MAX_NODE),
    ("sdo_timeout_ms", 10, 10_000),
    ("state_timeout_ms", 100, 60_000),
    ("home_timeout_ms", 100, 600_000),
)


def _stored(key: Key, default: int) -> int:
    """A setting that is an object of the dictionary."""
    stored: int = field(default=default, metadata={"object": key})
    return stored


@dataclass(frozen=True, slots=True)
class Settings:
    """What is configured on the drive: a commissioned axis."""

    device_name: str = "twin402"
    """1008"""
    vendor_id: int = _stored(o.VENDOR_ID, 0)
    """0 is assigned to no vendor."""
    product_code: int = _stored(o.PRODUCT_CODE, 402)
    revision: int = _stored(o.REVISION, 0x0001_0000)
    serial_number: int = _stored(o.SERIAL_NUMBER, 0)
    """0: derived from the address"""
    supported_modes: int = _stored(
        o.SUPPORTED_MODES,
        sum(mode_bit(m) for m in (Mode.PP, Mode.PV, Mode.PT, Mode.HM, Mode.CSP, Mode.CSV, Mode.CST)),
    )

    encoder_increments: int = _stored(o.ENCODER_INCREMENTS, 16_384)
    """per turn of the motor"""
    gear_motor: int = _stored(o.GEAR_MOTOR, 1)
    gear_shaft: int = _stored(o.GEAR_SHAFT, 1)
    feed: int = _stored(o.FEED, 0)
    """position units per `feed_shaft` turns of the shaft; 0: positions are encoder increments"""
    feed_shaft: int = _stored(o.FEED_SHAFT, 1)
    position_unit: int = _stored(o.POSITION_UNIT, 0)
    velocity_unit: int = _stored(o.VELOCITY_UNIT, 0x00B5_0300)
    acceleration_unit: int = _stored(o.ACCELERATION_UNIT, 0)
    rated_torque: int = _stored(o.RATED_TORQUE, 1000)
    """mN·m of the motor"""
    rated_current: int = _stored(o.RATED_CURRENT, 5000)
    max_torque: int = _stored(o.MAX_TORQUE, 3000)
    max_motor_speed: int = _stored(o.MAX_MOTOR_SPEED, 6000)
    """rpm of the motor"""
    max_profile_velocity: int = _stored(o.MAX_PROFILE_VELOCITY, 0xFFFFFFFF)
    """position units per second, like all velocities"""
    profile_velocity: int = _stored(o.PROFILE_VELOCITY, 100_000)
    profile_acceleration: int = _stored(o.PROFILE_ACCELERATION, 1_000_000)
    profile_deceleration: int = _stored(o.PROFILE_DECELERATION, 1_000_000)
    quick_stop_deceleration: int = _stored(o.QUICK_STOP_DECELERATION, 2_000_000)
    torque_slope: int = _stored(o.TORQUE_SLOPE, 10_000)
    following_window: int = _stored(o.FOLLOWING_WINDOW, NEVER_FOLLOWING)
    """0xFFFFFFFF: not monitored"""
    following_time: int = _stored(o.FOLLOWING_TIME, 10)
    position_window: int = _stored(o.POSITION_WINDOW, 50)
    position_window_time: int = _stored(o.POSITION_WINDOW_TIME, 5)
    velocity_window: int = _stored(o.VELOCITY_WINDOW, 500)
    velocity_window_time: int = _stored(o.VELOCITY_WINDOW_TIME, 5)
    velocity_threshold: int = _stored(o.VELOCITY_THRESHOLD, 200)
    """below it the shaft is at standstill"""
    soft_limit_low: int = _stored(o.SOFT_LIMIT_LOW, 0)
    """both 0: no limits"""
    soft_limit_high: int = _stored(o.SOFT_LIMIT_HIGH, 0)
    home_offset: int = _stored(o.HOME_OFFSET, 0)
    homing_method: int = _stored(o.HOMING_METHOD, 35)
    """35 or 37: the present position; 33 or 34: the encoder's index"""
    homing_speed: int = _stored(o.HOMING_SPEED_ZERO, 10_000)
    homing_acceleration: int = _stored(o.HOMING_ACCELERATION, 1_000_000)
    interpolation_ms: int = _stored(o.INTERPOLATION_VALUE, 0)
    """time in which a new cyclic set-point is reached; 0: at once"""

    quick_stop_option: int = _stored(o.QUICK_STOP_OPTION, 2)
    """0 no torque; 1, 2, 3 slow down (6084, 6085, at the current limit), then no torque; 5, 6, 7 the same,
    and hold"""
    shutdown_option: int = _stored(o.SHUTDOWN_OPTION, 0)
    """0 no torque, 1 slow down first"""
    disable_option: int = _stored(o.DISABLE_OPTION, 0)
    """0 no torque, 1 slow down first"""
    halt_option: int = _stored(o.HALT_OPTION, 1)
    """1, 2, 3 slow down (6084, 6085, at the current limit)"""
    fault_option: int = _stored(o.FAULT_OPTION, 0)
    """0 no torque; 1, 2, 3 slow down (6084, 6085, at the current limit) first"""
    abort_connection: int = _stored(o.ABORT_CONNECTION, 1)
    """when the host's heartbeat is lost: 0 nothing, 1 fault, 2 disable voltage, 3 quick stop"""
    error_behaviour: int = _stored(o.ERROR_BEHAVIOUR, 0)
    """when the host's heartbeat is lost: 0 NMT pre-operational, 1 no change, 2 NMT stopped"""
    heartbeat_producer: int = _stored(o.PRODUCER_HEARTBEAT, 100)
    """0: none"""
    heartbeat_consumer: int = _stored(o.CONSUMER_HEARTBEAT, 0)
    """node << 16 | ms; 0: a lost host is not noticed"""
    pdos: Literal["none", "usual"] = "none"
    """How its PDOs are configured at power-on: all disabled, or a usual mapping on SYNC."""

    position_gain: float = 15.0
    """1/s, of the position controller; like all that follows not in the dictionary"""
    velocity_gain: float = 0.1
    """N·m·s/rad at the device's shaft"""
    velocity_integral: float = 0.2
    """N·m/rad"""
    torque_bandwidth: float = 1000.0
    """rad/s of the current loop"""
    velocity_bandwidth: float = 1000.0
    """rad/s of the velocity filter"""
    dc_voltage: float = 48.0
    """V"""
    sdo_delay_ms: int = 0
    """Least delay of an SDO response; 0: at the drive's next cycle."""
    boot_ms: int = 300
    """Time without communication after a reset."""

    def __deepcopy__(self, _: dict[int, object]) -> Settings:
        return self

    def __post_init__(self) -> None:
        errors = []
        for name, key in SETTING_OBJECTS.items():
            type_ = o.OBJECTS[key].type
            errors.append(_out_of_range(name, getattr(self, name), type_.low, type_.high))
        errors += [f"{name} must be above 0" for name in _POSITIVE if not getattr(self, name) > 0]
        errors += [_not_an_amount(self, name) for name in _GAINS]
        for name, key in SETTING_OBJECTS.items():
            known = SUPPORTED_VALUES.get(key)
            if known and getattr(self, name) not in known:
                errors.append(f"{name} is {getattr(self, name)}: the twin supports {known}")
        if self.soft_limit_low > self.soft_limit_high:
            errors.append("soft_limit_low must not be above soft_limit_high")
        if not self.device_name.isascii() or not self.device_name:
            errors.append("device_name must be ASCII text")
        _raise(errors)


SETTING_OBJECTS: dict[str, Key] = {
    each.name: each.metadata["object"] for each in fields(Settings) if "object" in each.metadata
}
"""The settings that are objects of the dictionary."""
SUPPORTED_VALUES: dict[Key, tuple[int, ...]] = {
    o.QUICK_STOP_OPTION: (0, 1, 2, 3, 5, 6, 7),
    o.SHUTDOWN_OPTION: (0, 1),
    o.DISABLE_OPTION: (0, 1),
    o.HALT_OPTION: (1, 2, 3),
    o.FAULT_OPTION: (0, 1, 2, 3),
    o.ABORT_CONNECTION: (0, 1, 2, 3),
    o.ERROR_BEHAVIOUR: (0, 1, 2),
    o.HOMING_METHOD: (33, 34, 35, 37),
}
"""The values that the twin supports of an object; others are refused. It has an index, and no switches."""
_POSITIVE = (
    "encoder_increments",
    "gear_motor",
    "gear_shaft",
    "feed_shaft",
    "rated_torque",
    "rated_current",
    "max_motor_speed",
    "max_profile_velocity",
    "profile_velocity",
    "profile_acceleration",
    "profile_deceleration",
    "quick_stop_deceleration",
    "torque_slope",
    "homing_speed",
    "homing_acceleration",
    "torque_bandwidth",
    "velocity_bandwidth",
    "dc_voltage",
)
_GAINS = (
    "position_gain",
    "velocity_gain",
    "velocity_integral",
    "torque_bandwidth",
    "velocity_bandwidth",
    "dc_voltage",
    "sdo_delay_ms",
    "boot_ms",
)


def units_of_settings(settings: Settings) -> Units:
    """Return the units of a drive with these settings."""
    units = units_of({key: getattr(settings, name) for name, key in SETTING_OBJECTS.items()})
    if isinstance(units, str) or not units.velocity_per_turn or not units.acceleration_per_turn:
        raise ValueError("the units of the settings are not known")
    return units


def _not_an_amount(of: object, name: str) -> str:
    value: float = getattr(of, name)
    return "" if 0.0 <= value < float("inf") else f"{name} must be finite and not negative"


def _out_of_range(name: str, value: int, low: int, high: int) -> str:
    """Return why a number is refused; "" if it is not."""
    return "" if low <= value <= high else f"{name} is {value}: it must lie between {low} and {high}"


def _raise(errors: list[str]) -> None:
    text = "; ".join(error for error in errors if error)
    if text:
        raise ValueError(text)
