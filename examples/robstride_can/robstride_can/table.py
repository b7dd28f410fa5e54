"""The messages, registers and faults of a RobStride 01, as in the vendor's robstride-dynamics 0.0.1."""

from __future__ import annotations

from dataclasses import replace

from protocols.messages import ClearFault, Request, Zero
from protocols.plugin import FaultInfo
from protocols.toolkit.registers import Register, Registers
from protocols.toolkit.table import Field, Row, Table, const, span, uint, unused

IMPEDANCE = 0
"""The run_mode that we use; in the others a motor is moved by writing registers."""
TIMEOUT_UNIT_MS = 0.05
"""Of canTimeout."""
REGISTERS = Registers(
    Register("run_mode", 0x7005, "u8"),
    Register("canTimeout", 0x7028, "u32"),
    Register("mechPos", 0x7019, "f32", writable=False),
    Register("VBUS", 0x701C, "f32", writable=False),
)
FAULTS = {
    0x01: FaultInfo("under-voltage", "the supply sags or is off", "check supply and cables, then clear"),
    0x02: FaultInfo("over-current", "the shaft is blocked, or the torque too large", "free it, then clear"),
    0x04: FaultInfo("over-temperature", "too much torque for too long", "let it cool, then clear"),
    0x08: FaultInfo("magnetic encoder", "the encoder or its magnet", "switch off and on; else replace it"),
    0x10: FaultInfo("stall", "the shaft is blocked", "free it, then clear"),
    0x20: FaultInfo("not calibrated", "it was never calibrated", "calibrate it with the vendor's tool"),
}
"""By bit of the status."""
NOT_ENABLED = 0x100
"""A fault that the driver finds."""
ALL_FAULTS = FAULTS | {
    NOT_ENABLED: FaultInfo("did not enable", "it answers, but does not run", "check its supply, then clear")
}
REQUESTS: dict[type[Request], str] = {ClearFault: "clear", Zero: "zero"}

ENDS = {"position": 12.566, "velocity": 44.0, "torque": 17.0}
"""rad, rad/s, N·m"""
POSITION, VELOCITY, TORQUE = (span(name, 16, -most, most) for name, most in ENDS.items())
GAINS = span("stiffness", 16, 0.0, 500.0), span("damping", 16, 0.0, 5.0)
MEASURED = tuple(span(name, 16, -most, most, measured=True) for name, most in ENDS.items())
STATUS = (*MEASURED, uint("temperature", 16, 0.1))
REGISTER = (uint("number", 16), unused(16), uint("value", 32))


def _to(kind: int) -> tuple[Field, ...]:
    """Return the id of a message to a motor; the lower 8 of its unused bits are our address, 0."""
    return const(kind, 5), unused(16), uint("address")


def _from(kind: int, *carried: Field) -> tuple[Field, ...]:
    """Return the id of a message of a motor, which carries 8 bits of data."""
    return const(kind, 5), *carried, uint("address"), unused(8)


ROWS = (
    Row("control", (const(1, 5), TORQUE, uint("address")), (POSITION, VELOCITY, *GAINS), order="big"),
    Row("enable", _to(3), (unused(64),)),
    Row("disable", _to(4), (const(0), unused(56))),
    Row("clear", _to(4), (const(1), unused(56))),
    Row("zero", _to(6), (const(1), unused(56))),
    Row("read", _to(17), REGISTER, read_only=True),
    Row("write", _to(18), REGISTER),
    Row("status", _from(2, uint("mode", 2), uint("faults", 6)), STATUS, "from_device", "big"),
    Row("register", _from(17, unused(8)), REGISTER, "from_device"),
)
TABLE = Table(replace(row, extended=True) for row in ROWS)
