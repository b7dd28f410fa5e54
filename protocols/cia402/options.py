"""`Options` of the driver. They never repeat what the drive reports."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, Literal

from protocols.bounds import Bounds, FileText, Wrong, check
from protocols.canopen.master import BEATS
from protocols.canopen.services import MAX_NODE
from protocols.toolkit.table import FLOAT_MAX


@dataclass(frozen=True, slots=True)
class Options:
    """Behaviour of the driver."""

    eds: FileText = ""
    """The drive's data sheet (EDS or DCF), beside the robot file: objects, modes, PDOs and limits are held
    against it. "": without one, the drive is asked all the same"""
    modes: Literal["cyclic", "profile"] = "cyclic"
    """The preferred family of modes: CSP, CSV, CST, or PP, PV, PT. If the drive lacks a mode of it, the other
    family's is used."""
    feedback: Literal["sync", "event", "sdo"] = "sync"
    """How a commanded drive reports: by TPDO on every SYNC, by TPDO on its own event timer, or polled by SDO.
    A drive that was not commanded is polled by SDO, unless it sends TPDOs by itself."""
    mapping: Literal["auto", "keep"] = "auto"
    """The PDO mapping that the drive has: "auto": read, kept if it fits, else rewritten; "keep": read and
    never written; what it lacks is transferred by SDO."""
    sync_ms: Annotated[int, Bounds(0, 1000)] = 10
    """Period of the SYNC that this host produces while it commands a drive; 0: another producer does. The
    same for all drives of one bus."""
    feedback_ms: Annotated[int, Bounds(1, 1000)] = 10
    """Period of the drive's event timer with feedback = "event", and of polling by SDO."""
    offline_ms: Annotated[int, Bounds(20, 60_000)] = 500
    """Time without a frame after which the drive counts as offline. Longer than its heartbeat period."""
    heartbeat_ms: Annotated[int, Bounds(0, 0xFFFF)] = 100
    """Heartbeat producer time (1017) written to the drive if it has none; 0: never written."""
    watchdog_ms: Annotated[int, Bounds(0, 0xFFFF)] = 500
    """Heartbeat consumer time (1016) for this host's heartbeat written to the drive; 0: never written."""
    host_id: Annotated[int, Bounds(1, MAX_NODE)] = MAX_NODE
    """Node id of this host in its own heartbeat."""
    sdo_timeout_ms: Annotated[int, Bounds(10, 10_000)] = 200
    """Time after which an SDO request without a response is repeated, in the end given up."""
    state_timeout_ms: Annotated[int, Bounds(100, 60_000)] = 1000
    """Time without progress of arming that is a fault."""
    home_timeout_ms: Annotated[int, Bounds(100, 600_000)] = 30_000
    """Time without an end of homing that is a fault."""
    rated_torque: Annotated[float, Bounds(0.0, FLOAT_MAX)] = 0.0
    """N·m of the motor, for drives without object 6076; 0: then they take no torque."""
    counts_per_turn: Annotated[float, Bounds(0.0, FLOAT_MAX)] = 0.0
    """Position units per turn of the device's shaft, for drives whose 608F, 6091, 6092 and 60A8 do not define
    them; 0: then they stay unknown, and the drive is not commanded."""
    velocity_per_turn: Annotated[float, Bounds(0.0, FLOAT_MAX)] = 0.0
    """Velocity units per turn of the device's shaft and second (60: rpm), for drives whose 60A9 and 6096 do
    not define them; 0: then they stay unknown, and the drive takes no velocity."""

    def __deepcopy__(self, _: dict[int, object]) -> Options:
        return self

    def __post_init__(self) -> None:
        errors: list[Wrong] = []
        if 0 < self.watchdog_ms < 2 * BEATS:
            text = f"watchdog_ms is {self.watchdog_ms}: it must be 0 or at least {2 * BEATS}"
            errors.append(("watchdog_ms", text))
        names = ("heartbeat_ms", *(["feedback_ms"] if self.feedback == "event" else []))
        errors += [
            ("offline_ms", f"offline_ms ({self.offline_ms}) must be at least twice {name}")
            for name in names
            if self.offline_ms < 2 * getattr(self, name)
        ]
        check(self, *errors)
