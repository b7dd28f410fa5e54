"""The messages and faults of MyActuator RMD motors, in the vendor's units: degrees, degrees per second, A.

Source: MyActuator "Servo Motor Control Protocol" V4.2 (2024.05), by its paragraphs; what V3.8 has alike, and
its gains (30h to 32h, of another form in V4), are in 2b-t/myactuator_rmd@c43980c.
"""

from __future__ import annotations

from collections.abc import Mapping
from functools import cache

from protocols.plugin import FaultInfo
from protocols.toolkit.mit import numbers
from protocols.toolkit.table import Field, Row, Table, const, sint, uint, unused

ADDRESSES = range(1, 33)
ALL_MOTORS, SET_ID = 0x280, 0x300
"""Ids that every motor obeys; never sent here."""
TURN = uint("fastest", 16), sint("position", 32, 0.01)
SET_POINTS: Mapping[str, tuple[int, tuple[Field, ...]]] = {
    "torque": (0xA1, (unused(24), sint("value", 16, 0.01), unused(16))),
    "speed": (0xA2, (unused(24), sint("value", 32, 0.01))),
    "position": (0xA4, (unused(8), *TURN)),
    "single turn": (0xA6, (uint("direction"), uint("fastest", 16), uint("position", 16, 0.01), unused(16))),
    "increment": (0xA8, (unused(8), *TURN)),
}
"""Command byte and numbers of what moves a motor: A, degrees per second, degrees."""
GAINS = ("current_kp", "current_ki", "speed_kp", "speed_ki", "position_kp", "position_ki")
_LOOPS = unused(8), *map(uint, GAINS)
WRITTEN: Mapping[str, tuple[int, tuple[Field, ...]]] = {
    "set acceleration": (0x43, (uint("index"), unused(16), uint("value", 32))),
    "set gains": (0x31, _LOOPS),
    "store gains": (0x32, _LOOPS),
    "set zero": (0x63, (unused(24), sint("value", 32))),
    "zero here": (0x64, (unused(24), sint("value", 32))),
    "set timeout": (0xB3, (unused(24), uint("value", 32))),
}
"""Command byte and numbers of what is written, which the answer repeats: degrees per second² (of the way to a
position: up, down; of a speed: up, down), counts, ms."""
ECHOED: Mapping[str, int] = {"shutdown": 0x80, "stop": 0x81, "release brake": 0x77, "lock brake": 0x78}
READ: Mapping[str, tuple[int, tuple[Field, ...]]] = {
    "angle": (0x92, (unused(24), sint("position", 32, 0.01))),
    "status 1": (
        0x9A,
        (sint("temperature", 8), unused(8), uint("released"), uint("voltage", 16, 0.1), uint("errors", 16)),
    ),
    "status 2": (
        0x9C,
        (sint("temperature", 8), sint("current", 16, 0.01), sint("velocity", 16), sint("angle", 16)),
    ),
    "runtime": (0xB1, (unused(24), uint("ms", 32))),
    "version": (0xB2, (unused(24), uint("date", 32))),
    # never asked here:
    "status 3": (0x9D, (sint("temperature", 8), *(sint(f"phase_{n}", 16, 0.01) for n in "abc"))),
    "gains": (0x30, _LOOPS),
    "acceleration": (0x42, (uint("index"), unused(16), uint("value", 32))),
    "encoder": (0x60, (unused(24), sint("counts", 32))),
    "raw encoder": (0x61, (unused(24), sint("counts", 32))),
    "zero": (0x62, (unused(24), sint("counts", 32))),
    "operating mode": (0x70, (unused(48), uint("running"))),
    "power": (0x71, (unused(40), uint("watts", 16, 0.1))),
    "turn encoder": (0x90, (unused(8), *(uint(f"{n}_counts", 16) for n in ("zeroed", "raw", "zero")))),
    "turn angle": (0x94, (unused(40), uint("degrees", 16, 0.01))),
    "model": (0xB5, (uint("text", 56),)),
}
"""Command byte, and numbers of the answer: °C, V, A, degrees per second, degrees, W, counts."""
CAN_ID = 0x79
MODEL = b"X8S2V10"
"""What a simulated motor says that it is: the manual's example."""
COUNTS = 65_536
"""Of a simulated encoder, in one turn of the output shaft."""
TURNS, FASTEST, STRONGEST = (2**31 - 2) * 0.01, 32766.0, 327.66
"""Degrees, degrees per second and A: the ends of what is measured, where a motor that saturates is not."""


def _id(base: int) -> tuple[Field, ...]:
    return const(base >> 6, 5), uint("address", 6)


TO, FROM, MOTION, MOVED = _id(0x140), _id(0x240), _id(0x400), _id(0x500)


def own_ids(address: int) -> tuple[int, int]:
    """Return the ids that one motor alone obeys."""
    return 0x140 | address, 0x400 | address


@cache
def table_of(position: float, velocity: float, torque: float) -> Table:
    """Return the messages; the ends [rad, rad/s, N·m] are those of the motion mode."""
    five, moved = numbers(position, velocity, torque, floor=False)
    of_all, its_id = (const(SET_ID, 11),), (unused(24), uint("id", 16))

    def about_id(to: tuple[Field, ...], which: str) -> tuple[Row, Row]:
        reads = const(CAN_ID), unused(8), const(1), unused(40)
        sets = const(CAN_ID), unused(8), const(0), *its_id
        return Row(f"read {which}", to, reads, read_only=True), Row(f"set {which}", to, sets)

    return Table(
        (
            *(Row(name, TO, (const(code), *fields)) for name, (code, fields) in SET_POINTS.items()),
            *(Row(name, TO, (const(code), unused(56))) for name, code in ECHOED.items()),
            *(Row(name, TO, (const(code), *fields)) for name, (code, fields) in WRITTEN.items()),
            *about_id(TO, "id"),
            *about_id(of_all, "every id"),
            Row("reset", TO, (const(0x76), unused(56))),
            Row("motion", MOTION, tuple(five), order="big"),
            *(
                Row(f"read {n}", TO, (const(code), unused(56)), read_only=True)
                for n, (code, _) in READ.items()
            ),
            *(
                Row(f"{name} reply", FROM, (const(code), *READ["status 2"][1]), "from_device")
                for name, (code, _) in SET_POINTS.items()
            ),
            *(
                Row(f"{n} reply", FROM, (const(code), unused(56)), "from_device")
                for n, code in ECHOED.items()
            ),
            *(Row(n, FROM, (const(code), *fields), "from_device") for n, (code, fields) in READ.items()),
            *(
                Row(f"{n} reply", FROM, (const(code), *fields), "from_device")
                for n, (code, fields) in WRITTEN.items()
            ),
            Row("id", FROM, (const(CAN_ID), unused(8), uint("reading"), *its_id), "from_device"),
            Row("motion reply", MOVED, (uint("motor"), *moved), "from_device", "big", sent=8, fewest=6),
        )
    )


ANY = table_of(12.5, 45.0, 24.0)
"""For messages that are the same in all firmware; its ends are those of V4.2."""

_RESTART = "find the cause, then clear: the motor restarts"
_PASSES = "it passes by itself; then clear"
LASTING: Mapping[int, FaultInfo] = {
    0x0002: FaultInfo("motor stall", "the shaft is blocked, or the load too large", _RESTART),
    0x0010: FaultInfo("over-current", "a short circuit, a missing phase, or a blocked shaft", _RESTART),
    0x0080: FaultInfo("calibration parameter", "its parameters could not be written or read", _RESTART),
}
"""Of the vendor's level 1, which only a restart ends."""
PASSING: Mapping[int, FaultInfo] = {
    0x0004: FaultInfo("low voltage", "the supply sags or is off", _PASSES, latching=False),
    0x0008: FaultInfo(
        "over-voltage", "braking feeds back more than the supply takes", _PASSES, latching=False
    ),
    0x0040: FaultInfo("power overrun", "too much load, or too fast", _PASSES, latching=False),
    0x0100: FaultInfo("speeding", "the load drags it, or its speed loop overshot", _PASSES, latching=False),
    0x1000: FaultInfo("over-temperature", "overload for long, or a short circuit", _PASSES, latching=False),
    0x2000: FaultInfo("encoder calibration", "encoder and magnet do not agree", _PASSES, latching=False),
}
"""Of level 2: the motor recovers by itself."""
UNKNOWN, NOT_ARMED, DUPLICATE = 0x10000, 0x10001, 0x10002
"""Codes of ours: other bits; and what the driver finds."""
FAULTS: Mapping[int, FaultInfo] = {
    **LASTING,
    **PASSING,
    UNKNOWN: FaultInfo("unknown error", "a bit that its manual does not list", _RESTART),
}
ALL_FAULTS: Mapping[int, FaultInfo] = {
    **FAULTS,
    NOT_ARMED: FaultInfo(
        "does not obey",
        "it confirms neither its timeout nor its brake, or answers no set-point",
        "check its supply, its firmware (V3.8 or later), that active replies (0xB6) are off; clear",
    ),
    DUPLICATE: FaultInfo("duplicate address", "two motors answer at one CAN ID", "change one of them"),
}


def faults_in(errors: int) -> frozenset[int]:
    """Return the codes of the faults in an error state."""
    bits = {1 << at for at in range(16) if errors >> at & 1}
    return frozenset(bit if bit in FAULTS else UNKNOWN for bit in bits)
