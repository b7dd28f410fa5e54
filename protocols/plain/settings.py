"""What is configured on a plain device, and what a plain motor may complain of. Values only."""

from __future__ import annotations

import math
from dataclasses import dataclass, fields

from protocols.plugin import FaultInfo


@dataclass(frozen=True, slots=True)
class Settings:
    """What is configured on a plain device. All but `serial` can be read and written while it runs."""

    serial: int = 0
    """Serial number, told to Scan."""
    watchdog_ms: float = 100.0
    """Silence of the host after which an armed motor faults; 0 is never."""
    feedback_ms: float = 5.0
    """Period of Feedback."""
    state_ms: float = 100.0
    """Period of State, which is told at every change too."""
    position_gain: float = 1.0
    """N·m/rad"""
    position_damping: float = 0.05
    """N·m·s/rad"""
    velocity_gain: float = 0.05
    """N·m·s/rad"""
    velocity_integral: float = 0.5
    """N·m/rad"""
    torque_limit: float = 2.0
    """N·m; whatever is commanded is cut to it"""
    torque_constant: float = 0.1
    """N·m/A"""
    supply: float = 24.0
    """V"""

    def __post_init__(self) -> None:
        for f in fields(self):
            value = getattr(self, f.name)
            if not math.isfinite(value) or value < 0:
                raise ValueError(f"{f.name} must be zero or more, not {value}")
        for name in ("feedback_ms", "state_ms", "torque_constant"):
            if getattr(self, name) < 1e-3:
                raise ValueError(f"{name} must be more than zero, not {getattr(self, name)}")


FAULT_TABLE = {
    1: FaultInfo(
        "watchdog expired", "no command came within watchdog_ms", "find why the host fell silent, then clear"
    ),
    2: FaultInfo("emergency stop", "asked for by the host", "clear when it is safe"),
}
"""What a motor may complain of, by code."""

WRITABLE = tuple(f.name for f in fields(Settings) if f.name != "serial")
