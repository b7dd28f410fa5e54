"""The faults of the device, as a person should read them.

FILL IN (clause "faults"): every code with the vendor's name, the likely cause and the remedy.
"""

from __future__ import annotations

from protocols.plugin import FaultInfo

from .codec import TOO_HOT, WATCHDOG

FAULTS = {
    WATCHDOG: FaultInfo(
        "watchdog",
        "the host fell silent while the motor ran",
        "find why it fell silent, then clear the fault",
    ),
    TOO_HOT: FaultInfo(
        "over temperature",
        "too much torque for too long",
        "let it cool down, command less, then clear the fault",
    ),
}
