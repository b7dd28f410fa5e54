"""The messages and faults of the device.

FILL IN, this file first, from the manual: messages, ids, fields, units. The clauses "bytes", "counts",
"commands", "measurements" and "vectors" check them. The invented device takes a command (id 0x100 + address)
and sends its status (0x200 + address), asked or (on CAN) unasked; both have 8 bytes, little-endian.
"""

from __future__ import annotations

from protocols.messages import MILLISECOND, Nanos
from protocols.plugin import FaultInfo
from protocols.toolkit.table import Row, Table, const, f32, sint, uint, unused

NAME = "blank"
ADDRESSES = range(1, 0x40)
PERIOD: Nanos = 10 * MILLISECOND
"""Of the status."""
WATCHDOG, TOO_HOT = 1, 2
FAULTS = {
    WATCHDOG: FaultInfo("watchdog", "the host fell silent while the motor ran", "find out why, then clear"),
    TOO_HOT: FaultInfo("over temperature", "too much torque for too long", "let it cool down, then clear"),
}
"""FILL IN (clause "faults"): every code with the vendor's name, the likely cause and the remedy."""

_TO, _FROM = (const(1, 3), uint("address")), (const(2, 3), uint("address"))
TABLE = Table(
    (
        Row("stop", _TO, (const(0), unused(56))),
        Row("run", _TO, (const(1), unused(8), sint("velocity", 16, 0.01), unused(32))),
        Row("clear", _TO, (const(2), unused(56))),
        Row("ask", _TO, (const(3), unused(56)), read_only=True),
        Row(
            "status",
            _FROM,
            (uint("mode"), uint("fault"), sint("velocity", 16, 0.01), f32("position")),
            "from_device",
        ),
    )
)
"""Velocities [0.01 rad/s], position [rad]."""
