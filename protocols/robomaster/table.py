"""The messages of RoboMaster C610, C620 and GM6020 motor controllers, in the vendor's units: counts of angle
and current, rpm of the rotor.

Source: RoboMaster/Development-Board-C-Examples@59d12b1 `20.standard_robot/application/CAN_receive.c`,
uw-advanced-robotics/taproot@5018c3c `dji_motor`, mjforan/rm_motors_can@16c97a0 (GM6020).
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass

from protocols.plugin import FaultInfo
from protocols.toolkit.table import Row, Table, const, sint, uint

COUNTS = 8192
"""Of a turn of the rotor."""
RPM = math.pi / 30.0
"""rad/s"""
PERIOD_MS = 1
"""Of the feedback."""
SLOTS = ("first", "second", "third", "fourth")
"""Of a group: four controllers that share a frame."""
GROUPS: Mapping[str, int] = {"0x200": 0x200, "0x1FF": 0x1FF, "0x1FE": 0x1FE, "0x2FE": 0x2FE}
"""Identifier of the frame of a group: the manuals have no other names."""


@dataclass(frozen=True, slots=True)
class Model:
    """A controller and the motor that is sold with it."""

    full: int
    """Counts of its largest current,"""
    current: float
    """A"""
    torque_constant: float
    """N·m/A at the rotor: that of the motor's manual, divided by its gear"""
    groups: tuple[str, str] = ("0x200", "0x1FF")
    """Of the IDs 1 to 4, and of the others"""
    last: int = 8
    """ID"""
    feedback: int = 0
    """What is added to an ID for the number of its feedback."""

    def group_of(self, address: int) -> tuple[str, str]:
        """Return the frame that has a controller's current, and its place in it."""
        return self.groups[(address - 1) // len(SLOTS)], SLOTS[(address - 1) % len(SLOTS)]


MODELS: Mapping[str, Model] = {
    "C620": Model(16384, 20.0, 0.3 * 187 / 3591),
    "C610": Model(10000, 10.0, 0.18 / 36),
    "GM6020": Model(16384, 3.0, 0.741, ("0x1FE", "0x2FE"), 7, 4),
}

TABLE = Table(
    (
        *(
            Row(name, (const(number, 11),), tuple(sint(slot) for slot in SLOTS), order="big")
            for name, number in GROUPS.items()
        ),
        Row(
            "feedback",
            (const(0x20, 7), uint("number", 4)),
            (uint("angle", 16), sint("velocity"), sint("current"), uint("temperature"), uint("error")),
            "from_device",
            "big",
        ),
    )
)


ERROR = 1
FAULTS: Mapping[int, FaultInfo] = {
    ERROR: FaultInfo(
        "reports an error",
        "a number in byte 7, which its state shows: heat, supply, a phase or the sensor of the rotor",
        "look the number up in the manual of its firmware; if it is no error there: error_byte = false",
        latching=False,
    )
}
