"""What the device may complain of, as a person should read it.

FILL IN (clause "faults"): every code in the vendor's words, with the likely cause and what to do.
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
        "over temperature", "too much torque for too long", "let it cool, ask for less, then clear the fault"
    ),
}
