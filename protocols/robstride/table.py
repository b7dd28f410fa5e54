"""The messages, registers, models and faults of RobStride actuators and of their dialect, the CyberGear.

Sources: RobStride/Product_Information@ba7236b (user manuals of 2026-04-28, §3.3 and §4), robstride-dynamics
0.0.1, robstride 0.1.0; of the CyberGear belovictor/cybergear-docs@22c05e2 (the manual), pycybergear 1.0.0,
python-cybergear 0.1.2.
Numbers are scaled by the ends of the model's ranges, so each model has a table of its own.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from functools import cache
from typing import NamedTuple

from protocols.plugin import FaultInfo
from protocols.toolkit.mit import numbers
from protocols.toolkit.registers import Register, Registers, Type
from protocols.toolkit.table import Field, Row, Table, const, uint, unused

HOST = 0xFD
"""Our address, that of the manual's examples. Motors answer any, and never need it before they run."""
CYBERGEAR = "cybergear"
PER_MS = 20
"""Counts of the watchdog's register."""
REDUCTION = 7.75
"""Turns of a CyberGear's rotor in one of its output shaft: register rotation counts them."""


class Model(NamedTuple):
    """The ends of the ranges of a model: rad/s, N·m, A, N·m/rad, N·m·s/rad, rad."""

    velocity: float
    torque: float
    current: float
    stiffness: float = 500.0
    damping: float = 5.0
    position: float = 12.57
    timeout: str = "canTimeout"
    """Register of the watchdog; "": it has none."""
    goto: int = 5
    """run_mode of positions"""


MODELS: Mapping[str, Model] = {
    "RS00": Model(33.0, 14.0, 16.0),
    "RS01": Model(44.0, 17.0, 23.0),
    "RS02": Model(44.0, 17.0, 23.0),
    "RS03": Model(20.0, 60.0, 43.0, 5000.0, 100.0),
    "RS04": Model(15.0, 120.0, 90.0, 5000.0, 100.0),
    "RS05": Model(50.0, 5.5, 11.0),
    "RS06": Model(50.0, 36.0, 57.0, 5000.0, 100.0),
    "EL05": Model(50.0, 6.0, 11.0),
    CYBERGEAR: Model(30.0, 12.0, 23.0, 500.0, 5.0, 12.5, "", 1),
}


# -- registers -----------------------------------------------------------------------------------------


def _registers(kind: Type, names: str, *, writable: bool = True) -> list[Register]:
    pairs = (each.split(":") for each in names.split())
    return [Register(name, int(number, 16), kind, writable) for number, name in pairs]


REGISTERS = Registers(
    *_registers("u8", "7005:run_mode 7029:zero_sta"),
    *_registers("u32", "7028:canTimeout"),
    *_registers("f32", "7006:iq_ref 700A:spd_ref 7016:loc_ref 700B:limit_torque 7017:limit_spd"),
    *_registers("f32", "7018:limit_cur 7010:cur_kp 7011:cur_ki 7014:cur_filt_gain 701E:loc_kp 701F:spd_kp"),
    *_registers("f32", "7020:spd_ki 7021:spd_filt_gain 7022:acc_rad 7024:vel_max 7025:acc_set"),
    *_registers("f32", "7019:mechPos 701A:iqf 701B:mechVel 701C:VBUS", writable=False),
    *_registers("i16", "701D:rotation", writable=False),
)
SET_POINT = {1: "loc_ref", 2: "spd_ref", 3: "iq_ref", 5: "loc_ref"}
"""The register that a run_mode obeys; 0 obeys set-points of five numbers."""
SAVE = "save_parameters"
"""A parameter: written with 1, the motor saves its configuration. To a CyberGear the same message is a new
bit rate."""
_NOT_CYBERGEAR = {SAVE, *(name for name, each in REGISTERS.by_name.items() if each.number > 0x7020)}


def parameters_of(model: str) -> tuple[str, ...]:
    """Return the names of the registers that a model has, and SAVE if it can."""
    missing = _NOT_CYBERGEAR if model == CYBERGEAR else {"rotation"}
    return tuple(name for name in (*REGISTERS.by_name, SAVE) if name not in missing)


# -- faults --------------------------------------------------------------------------------------------

_HOT = "too much torque for too long, or no way for the heat to leave", "let it cool, then clear"
_SUPPLY = "the supply sags or is off", "check supply and cables, then clear"
_BLOCKED = "the shaft is blocked, or the torque too large", "free it, then clear"
_CALIBRATE = "the encoder was never calibrated on this motor", "calibrate it with the vendor's tool"
_REPLACE = "electronics, or the encoder and its magnet", "switch off and on; if it stays, replace the motor"
_STATUS: Mapping[int, FaultInfo] = {
    0x01: FaultInfo("under-voltage", *_SUPPLY),
    0x02: FaultInfo("over-current", *_BLOCKED),
    0x04: FaultInfo("over-temperature", *_HOT),
    0x08: FaultInfo("magnetic encoder", *_REPLACE),
    0x10: FaultInfo("stall overload", *_BLOCKED),
    0x20: FaultInfo("not calibrated", *_CALIBRATE),
}
"""By bit of the status."""
HALL = 0x40
"""Code of bit 0x10 of a CyberGear's status."""
DETAIL = 0x100
"""Code of bit 0 of the fault message; the others follow."""
_DETAILS: Mapping[int, FaultInfo] = {
    0: FaultInfo("motor over-temperature", *_HOT),
    1: FaultInfo("driver chip", *_REPLACE),
    2: FaultInfo("supply under-voltage", *_SUPPLY),
    3: FaultInfo("supply over-voltage", "braking feeds back more than the supply takes", "brake more slowly"),
    4: FaultInfo("over-current of phase B", *_BLOCKED),
    5: FaultInfo("over-current of phase C", *_BLOCKED),
    7: FaultInfo("encoder not calibrated", *_CALIBRATE),
    8: FaultInfo("hardware identification", *_REPLACE),
    9: FaultInfo("position initialization", *_REPLACE),
    14: FaultInfo("overload", *_BLOCKED),
    16: FaultInfo("over-current of phase A", *_BLOCKED),
    31: FaultInfo("another fault", "a bit that the manual does not list", "ask the vendor's tool, clear"),
}
"""By bit of the fault message."""
NOT_ENABLED, DUPLICATE = 0x200, 0x201
"""Faults that the driver finds."""
ALL_FAULTS: Mapping[int, FaultInfo] = {
    **_STATUS,
    HALL: FaultInfo("HALL encoder", *_REPLACE),
    **{DETAIL + bit: info for bit, info in _DETAILS.items()},
    NOT_ENABLED: FaultInfo("did not enable", "it answers, but does not run", "check its supply, then clear"),
    DUPLICATE: FaultInfo("duplicate address", "two motors answer at one address", "change one of them"),
}


def faults_of(model: str) -> Mapping[int, FaultInfo]:
    """Return the faults that a model reports, by code."""
    others = {0x10, DETAIL + 8, DETAIL + 9} if model == CYBERGEAR else {HALL}
    return {code: info for code, info in ALL_FAULTS.items() if code < NOT_ENABLED and code not in others}


def faults_in_status(model: str, bits: int) -> frozenset[int]:
    """Return the codes of the faults in a status."""
    if not bits:
        return frozenset()
    codes = frozenset(bit for bit in _STATUS if bits & bit)
    return (codes - {0x10}) | {HALL} if model == CYBERGEAR and 0x10 in codes else codes


def faults_in_message(model: str, word: int) -> frozenset[int]:
    """Return the codes of the faults in a fault message."""
    if model == CYBERGEAR and word & 0xFF00:  # all of these are its overload
        word = word & ~0xFF00 | 1 << 14
    bits = {bit if bit in _DETAILS else 31 for bit in range(32) if word >> bit & 1}
    return frozenset(DETAIL + bit for bit in bits)


def warnings_in_message(word: int) -> str:
    """Return the warnings in a fault message in words, to be put behind a state."""
    warning = "over-temperature" if word & 1 else "one that the manual does not list"
    return f", warning: {warning}" if word else ""


# -- messages ------------------------------------------------------------------------------------------


def _to(kind: int) -> tuple[Field, ...]:
    """Return the id of a message to a motor."""
    return const(kind, 5), unused(8), unused(8, HOST), uint("address")


def _from(kind: int, *carried: Field, to: Field | None = None) -> tuple[Field, ...]:
    """Return the id of a message of a motor, which carries 8 bits of data; `to`: whom it is for."""
    return const(kind, 5), *carried, uint("address"), to or uint("host")


@cache
def table_of(model: str, position: float = 0.0, velocity: float = 0.0, torque: float = 0.0) -> Table:
    """Return the messages of a model; ends that are not 0 are in the place of the model's."""
    ends = MODELS[model]
    most = position or ends.position, velocity or ends.velocity, torque or ends.torque
    (*four, force), measured = numbers(*most, ends.stiffness, ends.damping, bits=16)
    state, status = (uint("mode", 2), uint("faults", 6)), (*measured, uint("temperature", 16, 0.1))
    register = uint("number", 16), unused(16), uint("value", 32)
    version = const(0x00C4, 16), const(0x56), uint("version", 32), unused(8)

    rows = (
        Row("get_id", _to(0), (unused(64),), fewest=0, read_only=True),
        Row("control", (const(1, 5), force, uint("address")), tuple(four), order="big"),
        Row("enable", _to(3), (unused(64),)),
        Row("clear", _to(4), (const(1), unused(56))),
        Row("disable", _to(4), (unused(64),)),
        Row("zero", _to(6), (const(1), unused(56))),
        Row("set_id", (const(7, 5), uint("id"), unused(8, HOST), uint("address")), (unused(64),), fewest=0),
        Row("read", _to(17), register, read_only=True),
        Row("write", _to(18), register),
        Row("id", _from(0, unused(8), to=const(0xFE)), (uint("serial", 64),), "from_device"),
        Row("version", _from(2, *state), version, "from_device", "big"),
        Row("status", _from(2, *state), status, "from_device", "big"),
        Row("register", _from(17, uint("failed")), register, "from_device"),
        Row("fault", _from(21, unused(8)), (uint("faults", 32), uint("warnings", 32)), "from_device"),
        Row("report", _from(24, *state), status, "from_device", "big"),
    )
    # To a CyberGear, type 22 is a bit rate; type 20, which its manual does not have, is python-cybergear's.
    save = Row("save", _to(22), (const(0x0102030405060708, 64),), order="big")
    brake = Row("emergency_stop", _to(20), (unused(64),), fewest=0)
    return Table(replace(row, extended=True) for row in (*rows, brake if model == CYBERGEAR else save))


ANY = table_of("RS01")
"""For messages that are the same in all models."""
