"""`Options` of the driver. They never repeat what the drive reports."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

from protocols.canopen.services import MAX_NODE
from protocols.cia402.settings import Settings as Settings
from protocols.cia402.settings import units_of_settings as units_of_settings


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
    """Velocity units per turn of the device's shaft and second (60: rpm), for drives whose 60A9 and 6096 do
    not define them; 0: then they stay unknown, and the drive takes no velocity."""

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
