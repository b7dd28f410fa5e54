"""What can be set: `Options` for our driver, `Settings` for what is configured on the drive itself.

Rules. Options never repeat what the drive knows; the driver does not read settings. Settings are objects of
the drive's dictionary, in its own units (increments, ‰, ms), so that they can be compared with an EDS or a
commissioning tool; the comment names the object.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

from protocols.cia402 import objects as o
from protocols.cia402.codec import MAX_NODE
from protocols.cia402.objects import Key
from protocols.cia402.profile import Mode, mode_bit
from protocols.cia402.units import Units, units_of

NEVER_FOLLOWING = 0xFFFFFFFF
"""6065: the following error is not watched."""


@dataclass(frozen=True, slots=True)
class Options:
    """What the driver should do."""

    modes: Literal["cyclic", "profile"] = "cyclic"
    """The family that is preferred: CSP, CSV, CST, or PP, PV, PT. Where the drive lacks a mode of it, the
    other family's is taken."""
    feedback: Literal["sync", "event", "sdo"] = "sync"
    """How a commanded drive tells its state: by TPDO on every SYNC, by TPDO on its own event timer, or asked
    by SDO. A drive that was not commanded is asked by SDO, unless it tells by itself."""
    mapping: Literal["auto", "keep"] = "auto"
    """What becomes of the PDO mapping that the drive has: "auto": read, left if it fits, else written anew;
    "keep": read and never written; what it lacks goes by SDO."""
    sync_ms: int = 10
    """Period of the SYNC that this host produces while it commands a drive; 0: somebody else does. All drives
    of one bus must have the same."""
    feedback_ms: int = 10
    """Period of the drive's event timer with feedback = "event"; and how often a drive is asked by SDO."""
    offline_ms: int = 500
    """Silence after which the drive counts as offline. Longer than its heartbeat."""
    heartbeat_ms: int = 100
    """The drive is told to send its heartbeat so often (1017), if it has none; 0: it is left as it is."""
    watchdog_ms: int = 500
    """The drive is told to expect a heartbeat of this host within so long (1016); 0: it is left as it is."""
    host_id: int = MAX_NODE
    """Node id of this host in its own heartbeat."""
    sdo_timeout_ms: int = 200
    """An SDO request without an answer is given up after so long."""
    state_timeout_ms: int = 1000
    """A power state that is not reached after so long is a fault."""
    home_timeout_ms: int = 30_000
    """Homing that has not ended after so long is a fault."""
    rated_torque: float = 0.0
    """N·m of the motor, for drives without object 6076; 0: then they take no torque."""
    counts_per_turn: float = 0.0
    """Position units per turn of the device's shaft, for drives whose 608F, 6091 and 6092 do not say; 0: then
    they stay unknown, and the drive is not commanded."""

    def __deepcopy__(self, _: dict[int, object]) -> Options:
        return self

    def __post_init__(self) -> None:
        wrong = [_outside(name, getattr(self, name), low, high) for name, low, high in _OPTION_RANGES]
        wrong += [f"{name} must be finite and not negative" for name in _AMOUNTS if not _amount(self, name)]
        if self.watchdog_ms and self.watchdog_ms < 2 * WATCHDOG_SHARE:
            wrong.append(f"watchdog_ms is {self.watchdog_ms}: it must be 0 or at least {2 * WATCHDOG_SHARE}")
        if self.feedback == "event" and self.offline_ms < 2 * self.feedback_ms:
            wrong.append(f"offline_ms ({self.offline_ms}) must be at least twice feedback_ms")
        if self.heartbeat_ms and self.offline_ms < 2 * self.heartbeat_ms:
            wrong.append(f"offline_ms ({self.offline_ms}) must be at least twice heartbeat_ms")
        _raise(wrong)


WATCHDOG_SHARE = 4
"""The host's heartbeat comes so often within a drive's watchdog time."""
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
_AMOUNTS = ("rated_torque", "counts_per_turn")


@dataclass(frozen=True, slots=True)
class Settings:
    """What is configured on the drive: a commissioned axis."""

    device_name: str = "twin402"
    """1008"""
    vendor_id: int = 0
    """1018:01; 0 is nobody's"""
    product_code: int = 402
    """1018:02"""
    revision: int = 0x0001_0000
    """1018:03"""
    serial_number: int = 0
    """1018:04; 0: made up from the address"""
    supported_modes: int = sum(
        mode_bit(m) for m in (Mode.PP, Mode.PV, Mode.PT, Mode.HM, Mode.CSP, Mode.CSV, Mode.CST)
    )
    """6502"""

    encoder_increments: int = 16_384
    """608F:01, per turn of the motor"""
    gear_motor: int = 1
    """6091:01"""
    gear_shaft: int = 1
    """6091:02"""
    feed: int = 0
    """6092:01, position units per turns of the shaft; 0: positions are encoder increments"""
    feed_shaft: int = 1
    """6092:02"""
    rated_torque: int = 1000
    """6076, mN·m of the motor"""
    rated_current: int = 5000
    """6075, mA"""
    max_torque: int = 3000
    """6072, ‰ of rated torque"""
    max_motor_speed: int = 6000
    """6080, rpm of the motor"""
    max_profile_velocity: int = 0xFFFFFFFF
    """607F, position units per second"""
    profile_velocity: int = 100_000
    """6081"""
    profile_acceleration: int = 1_000_000
    """6083"""
    profile_deceleration: int = 1_000_000
    """6084"""
    quick_stop_deceleration: int = 2_000_000
    """6085"""
    torque_slope: int = 10_000
    """6087, ‰ of rated torque per second"""
    following_window: int = NEVER_FOLLOWING
    """6065, position units; 0xFFFFFFFF: not watched"""
    following_time: int = 10
    """6066, ms"""
    position_window: int = 50
    """6067, position units"""
    position_window_time: int = 5
    """6068, ms"""
    velocity_window: int = 500
    """606D"""
    velocity_window_time: int = 5
    """606E, ms"""
    velocity_threshold: int = 200
    """606F: below it the shaft stands"""
    soft_limit_low: int = 0
    """607D:01; both 0: no limits"""
    soft_limit_high: int = 0
    """607D:02"""
    home_offset: int = 0
    """607C"""
    homing_method: int = 35
    """6098: 35 or 37, where the shaft is; 33 or 34, the encoder's index"""
    homing_speed: int = 10_000
    """6099:02"""
    homing_acceleration: int = 1_000_000
    """609A"""
    interpolation_ms: int = 0
    """60C2: a new cyclic set-point is reached in so long; 0: at once"""

    quick_stop_option: int = 2
    """605A: 0 no torque; 1, 2, 3 slow down (6084, 6085, at the current limit), then no torque; 5, 6, 7 the
    same, and hold"""
    shutdown_option: int = 0
    """605B: 0 no torque, 1 slow down first"""
    disable_option: int = 0
    """605C: 0 no torque, 1 slow down first"""
    halt_option: int = 1
    """605D: 1, 2, 3 slow down (6084, 6085, at the current limit)"""
    fault_option: int = 0
    """605E: 0 no torque; 1, 2, 3 slow down (6084, 6085, at the current limit) first"""
    abort_connection: int = 1
    """6007, when the host falls silent: 0 nothing, 1 fault, 2 disable voltage, 3 quick stop"""
    error_behaviour: int = 0
    """1029:01, when the host falls silent: 0 NMT pre-operational, 1 no change, 2 NMT stopped"""
    heartbeat_producer: int = 100
    """1017, ms; 0: none"""
    heartbeat_consumer: int = 0
    """1016:01: node << 16 | ms; 0: the host's silence is not noticed"""
    pdos: Literal["none", "usual"] = "none"
    """How its PDOs are configured when it starts: all disabled, or a usual mapping on SYNC."""

    position_gain: float = 15.0
    """1/s, of the position controller; like all that follows not in the dictionary"""
    velocity_gain: float = 0.1
    """N·m·s/rad at the device's shaft"""
    velocity_integral: float = 0.2
    """N·m/rad"""
    torque_bandwidth: float = 1000.0
    """rad/s of the current loop"""
    velocity_bandwidth: float = 1000.0
    """rad/s of the velocity's filter"""
    dc_voltage: float = 48.0
    """V"""
    sdo_delay_ms: int = 0
    """How long the drive takes for an SDO answer, at least; 0: it answers at its next cycle."""
    boot_ms: int = 300
    """How long a reset is silent."""

    def __deepcopy__(self, _: dict[int, object]) -> Settings:
        return self

    def __post_init__(self) -> None:
        wrong = []
        for name, key in SETTING_OBJECTS.items():
            type_ = o.OBJECTS[key].type
            wrong += [_outside(name, getattr(self, name), type_.low, type_.high)]
        wrong += [f"{name} must be above 0" for name in _POSITIVE if not getattr(self, name) > 0]
        wrong += [f"{name} must be finite and not negative" for name in _GAINS if not _amount(self, name)]
        wrong += [
            f"{name} is {getattr(self, name)}: the twin knows {known}"
            for name, known in _CODES
            if getattr(self, name) not in known
        ]
        if self.soft_limit_low > self.soft_limit_high:
            wrong.append("soft_limit_low must not be above soft_limit_high")
        if not self.device_name.isascii() or not self.device_name:
            wrong.append("device_name must be ASCII text")
        _raise(wrong)


SETTING_OBJECTS: dict[str, Key] = {
    "vendor_id": o.VENDOR_ID,
    "product_code": o.PRODUCT_CODE,
    "revision": o.REVISION,
    "serial_number": o.SERIAL_NUMBER,
    "supported_modes": o.SUPPORTED_MODES,
    "encoder_increments": o.ENCODER_INCREMENTS,
    "gear_motor": o.GEAR_MOTOR,
    "gear_shaft": o.GEAR_SHAFT,
    "feed": o.FEED,
    "feed_shaft": o.FEED_SHAFT,
    "rated_torque": o.RATED_TORQUE,
    "rated_current": o.RATED_CURRENT,
    "max_torque": o.MAX_TORQUE,
    "max_motor_speed": o.MAX_MOTOR_SPEED,
    "max_profile_velocity": o.MAX_PROFILE_VELOCITY,
    "profile_velocity": o.PROFILE_VELOCITY,
    "profile_acceleration": o.PROFILE_ACCELERATION,
    "profile_deceleration": o.PROFILE_DECELERATION,
    "quick_stop_deceleration": o.QUICK_STOP_DECELERATION,
    "torque_slope": o.TORQUE_SLOPE,
    "following_window": o.FOLLOWING_WINDOW,
    "following_time": o.FOLLOWING_TIME,
    "position_window": o.POSITION_WINDOW,
    "position_window_time": o.POSITION_WINDOW_TIME,
    "velocity_window": o.VELOCITY_WINDOW,
    "velocity_window_time": o.VELOCITY_WINDOW_TIME,
    "velocity_threshold": o.VELOCITY_THRESHOLD,
    "soft_limit_low": o.SOFT_LIMIT_LOW,
    "soft_limit_high": o.SOFT_LIMIT_HIGH,
    "home_offset": o.HOME_OFFSET,
    "homing_method": o.HOMING_METHOD,
    "homing_speed": o.HOMING_SPEED_ZERO,
    "homing_acceleration": o.HOMING_ACCELERATION,
    "interpolation_ms": o.INTERPOLATION_VALUE,
    "quick_stop_option": o.QUICK_STOP_OPTION,
    "shutdown_option": o.SHUTDOWN_OPTION,
    "disable_option": o.DISABLE_OPTION,
    "halt_option": o.HALT_OPTION,
    "fault_option": o.FAULT_OPTION,
    "abort_connection": o.ABORT_CONNECTION,
    "error_behaviour": o.ERROR_BEHAVIOUR,
    "heartbeat_producer": o.PRODUCER_HEARTBEAT,
    "heartbeat_consumer": o.CONSUMER_HEARTBEAT,
}
"""The settings that are objects of the dictionary."""
HOMING_METHODS = (33, 34, 35, 37)
"""What the twin can do: it has an index, and no switches."""
OPTION_CODES: dict[Key, tuple[int, ...]] = {
    o.QUICK_STOP_OPTION: (0, 1, 2, 3, 5, 6, 7),
    o.SHUTDOWN_OPTION: (0, 1),
    o.DISABLE_OPTION: (0, 1),
    o.HALT_OPTION: (1, 2, 3),
    o.FAULT_OPTION: (0, 1, 2, 3),
    o.ABORT_CONNECTION: (0, 1, 2, 3),
    o.ERROR_BEHAVIOUR: (0, 1, 2),
    o.HOMING_METHOD: HOMING_METHODS,
}
"""The values that the twin knows of an object; others are refused."""
_CODES = tuple((name, OPTION_CODES[key]) for name, key in SETTING_OBJECTS.items() if key in OPTION_CODES)
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
    """How a drive with these settings counts."""
    units = units_of({key: getattr(settings, name) for name, key in SETTING_OBJECTS.items()})
    if units is None:
        raise ValueError("encoder_increments must be above 0")
    return units


def serial_of(settings: Settings, address: int) -> int:
    """The serial number of a drive: its own, or one made up from its address."""
    return settings.serial_number or 0x0402_0000 + address


def _amount(of: object, name: str) -> bool:
    value: float = getattr(of, name)
    return 0.0 <= value < float("inf")


def _outside(name: str, value: int, low: int, high: int) -> str:
    """What is wrong with a number; "" if nothing is."""
    return "" if low <= value <= high else f"{name} is {value}: it must lie between {low} and {high}"


def _raise(wrong: list[str]) -> None:
    said = "; ".join(text for text in wrong if text)
    if said:
        raise ValueError(said)
