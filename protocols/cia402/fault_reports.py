"""What our end finds wrong with a device by itself, in the form of a device's own complaints.

Rules. Codes lie above 16 bits, where no error code of a drive is. The cause is filled in where it is found.
"""

from __future__ import annotations

from protocols.plugin import FaultInfo

NOT_ARMED = 0x1_0001
DUPLICATE_NODE = 0x1_0002
WRONG_DEVICE = 0x1_0003
QUICK_STOPPED = 0x1_0004
NOT_CONFIGURED = 0x1_0005
HOMING_FAILED = 0x1_0006

FINDINGS: dict[int, FaultInfo] = {
    NOT_ARMED: FaultInfo(
        "operation not enabled",
        "the drive did not follow the controlword in time: no supply, safe torque off, or another host",
        "look at its statusword with the maker's tool, then clear",
    ),
    DUPLICATE_NODE: FaultInfo(
        "node id is held twice",
        "two devices answer to it",
        "take one off the bus, or give it another node id",
    ),
    WRONG_DEVICE: FaultInfo(
        "no CiA 402 drive that can be commanded",
        "what it tells of itself does not suffice",
        "check the node id and the options in the robot file",
    ),
    QUICK_STOPPED: FaultInfo(
        "quick stop", "an operator asked for the emergency stop", "clear it when it is safe"
    ),
    NOT_CONFIGURED: FaultInfo(
        "not configured",
        "the drive refused what it must be told before it is armed",
        'set it with the maker\'s tool, or say mapping = "keep" under options; then clear',
    ),
    HOMING_FAILED: FaultInfo(
        "homing did not end",
        "no switch, no index, or a speed of zero",
        "check 6098, 6099 and the switches; then clear",
    ),
}
