"""The messages, registers, models and faults of Damiao DM-J motors.

Sources: damiao-motor 1.0.6 (`core/motor.py`, `core/controller.py`); cmjang/DM_Control_Python@7da9387
`DM_CAN.py`; which ids and lengths a motor takes, discovery and the answer to a save:
umeow0716/damiao_firmware@3a0647b, made from shipped firmware. Numbers are scaled by the ends of the motor's
ranges, so each model has a table of its own.
"""

from __future__ import annotations

from collections.abc import Mapping
from functools import cache

from protocols.frames import CanFrame
from protocols.messages import ClearFault, Request, Zero
from protocols.plugin import FaultInfo
from protocols.toolkit.mit import numbers, words
from protocols.toolkit.registers import Register, Registers
from protocols.toolkit.table import Field, Order, Row, Table, const, f32, uint, unused

ADDRESSES = range(1, 16)
"""ESC_ID; a feedback carries its lower four bits only."""
REPLY_BASE = 0x10
"""Added to ESC_ID for the MST_ID that vendors' tools suggest."""
ALL_MOTORS = 0x7FF
"""Id of what is about registers, and of discovery."""
TIMEOUT_UNIT_MS = 0.05
"""Of register TIMEOUT."""
MODES: Mapping[str, int] = {"mit": 1, "pos_vel": 2, "vel": 3, "force_pos": 4}
"""Values of register CTRL_MODE."""
MODE_OF = {"MIT": 1, "POS_VEL": 2, "VEL": 3, "FORCE_POS": 4}
"""The mode in which a motor obeys a message."""
SPECIAL = {"clear": 0xFB, "enable": 0xFC, "disable": 0xFD, "zero": 0xFE}
SPECIAL_DATA = frozenset(b"\xff" * 7 + bytes((last,)) for last in SPECIAL.values())
REQUESTS: Mapping[type[Request], str] = {ClearFault: "clear", Zero: "zero"}
OPERATIONS = {"read": 0x33, "write": 0x55, "save": 0xAA, "refresh": 0xCC}
REPLIES = ("read", "write", "save")
"""Operations that have an answer of their own; the others are answered by a feedback."""
ABOUT = frozenset({*OPERATIONS, "discover"})
"""Messages that feed no watchdog."""
DISABLED, ENABLED, LOST, UNKNOWN = 0, 1, 0xD, 0xF
"""Values of the status in a feedback; the others are faults."""

# fmt: off
MODELS: Mapping[str, tuple[float, float, float]] = {
    "4310": (12.5, 30.0, 10.0), "4310P": (12.5, 50.0, 10.0), "4340": (12.5, 10.0, 28.0),
    "6006": (12.5, 45.0, 20.0), "8006": (12.5, 45.0, 40.0), "8009": (12.5, 45.0, 54.0),
    "10010L": (12.5, 25.0, 200.0), "10010": (12.5, 20.0, 200.0), "H3510": (12.5, 280.0, 1.0),
    "G6215": (12.5, 45.0, 10.0), "H6220": (12.5, 45.0, 10.0), "3507": (12.566, 50.0, 5.0),
    "4340P": (12.5, 10.0, 28.0), "JH11": (12.5, 10.0, 12.0), "6248P": (12.566, 20.0, 120.0),
}
# fmt: on
"""PMAX [rad], VMAX [rad/s] and TMAX [N·m] by model."""
RANGES: Mapping[str, str] = {"PMAX": "position_end", "VMAX": "velocity_end", "TMAX": "torque_end"}
"""Registers that hold the ends of the ranges, and the options that name others than the model's."""


def _numbered(first: int, names: str) -> tuple[tuple[int, str], ...]:
    return tuple(enumerate(names.split(), first))


_FLOATS = (
    *_numbered(0, "UV_Value KT_Value OT_Value OC_Value ACC DEC MAX_SPD"),
    *_numbered(21, "PMAX VMAX TMAX I_BW KP_ASR KI_ASR KP_APR KI_APR OV_Value GREF Deta V_BW IQ_c1 VL_c1"),
)
_MEASURED = (
    *_numbered(11, "Damp Inertia"),
    *_numbered(17, "Rs Ls Flux Gr"),
    *_numbered(59, "Imax VBus Tpcb Tmtr Iu_off Iv_off Iw_off"),
    *_numbered(80, "p_m xout"),
)
# Ids and bit rate are the vendor's tool's business: a mistake there ends all communication.
_FIXED = (
    *_numbered(7, "MST_ID ESC_ID"),
    *_numbered(13, "hw_ver sw_ver SN NPP"),
    *_numbered(35, "can_br sub_ver"),
)
IDS = ("MST_ID", "ESC_ID")
"""Registers that a motor lets anybody write, and that are never written here."""
REGISTERS = Registers(
    *(Register(name, number, "f32") for number, name in _FLOATS),
    *(Register(name, number, "f32", writable=False) for number, name in _MEASURED),
    *(Register(name, number, "u32") for number, name in _numbered(9, "TIMEOUT CTRL_MODE")),
    *(Register(name, number, "u32", writable=False) for number, name in _FIXED),
)
SAVE = "save_parameters"
"""A parameter: written with 1, the motor saves its configuration."""

_HOT = "too much torque for too long", "let it cool, then clear"
FAULTS: Mapping[int, FaultInfo] = {
    0x8: FaultInfo("over-voltage", "braking feeds back more than the supply takes", "brake more slowly"),
    0x9: FaultInfo("under-voltage", "the supply sags or is off", "check supply and cables, then clear"),
    0xA: FaultInfo("over-current", "the shaft is blocked, or the torque too large", "free it, then clear"),
    0xB: FaultInfo("MOS over-temperature", *_HOT),
    0xC: FaultInfo("rotor over-temperature", *_HOT),
    LOST: FaultInfo("communication lost", "no frame within TIMEOUT while enabled", "find the reason, clear"),
    0xE: FaultInfo("overload", "more load than the motor can turn", "take load off, then clear"),
    UNKNOWN: FaultInfo("unknown fault", "it is of later firmware", "read it with the vendor's tool, clear"),
}
"""By status; one that is not listed is unknown."""
NOT_ENABLED, DUPLICATE = 0x100, 0x101
"""Faults that the driver finds."""
ALL_FAULTS: Mapping[int, FaultInfo] = {
    **FAULTS,
    NOT_ENABLED: FaultInfo("did not enable", "it answers, but stays disabled", "check its supply, clear"),
    DUPLICATE: FaultInfo("duplicate address", "two motors answer at one ESC_ID", "change one of them"),
}


@cache
def table_of(model: str, position: float = 0.0, velocity: float = 0.0, torque: float = 0.0) -> Table:
    """Return the messages of a model; ends that are not 0 are in the place of the model's."""
    p, v, t = MODELS[model]
    five, measured = numbers(position or p, velocity or v, torque or t)
    reply, all_motors = (uint("address", 11),), (const(ALL_MOTORS, 11),)
    own, any_page = (const(0, 3), uint("address", 8)), (unused(3), uint("address", 8))

    def set_point(name: str, page: int, *fields: Field, order: Order = "little") -> Row:
        return Row(name, (const(page, 3), uint("address", 8)), fields, order=order, fewest=0)

    def to_all(name: str) -> Row:  # what names no value is often sent without its bytes
        reads = name in ("read", "refresh")
        return Row(name, all_motors, register(OPERATIONS[name]), fewest=4, read_only=reads)

    def register(operation: int) -> tuple[Field, ...]:
        return uint("motor", 16), *about(operation)

    def about(operation: int) -> tuple[Field, ...]:
        return const(operation), uint("number"), uint("value", 32)

    def answer(name: str) -> Row:
        asked = uint("motor", 4), const(0, 12)  # these zeros alone tell an answer from most feedbacks
        size = 4 if name == "save" else 8
        return Row(f"{name} reply", reply, (*asked, *about(OPERATIONS[name])), "from_device", fewest=size)

    status = (uint("status", 4), uint("motor", 4), *measured, uint("mos"), uint("rotor"))
    found = const(0x55), uint("found"), uint("reply"), const(0xAA)
    return Table(
        (
            # A motor looks at the lower eight bits of an id alone, and obeys these on any page;
            *words(any_page, SPECIAL),
            *words(own, SPECIAL),
            set_point("MIT", 0, *five, order="big"),
            set_point("POS_VEL", 1, f32("position"), f32("fastest")),
            set_point("VEL", 2, f32("velocity"), unused(32)),
            set_point("FORCE_POS", 3, f32("position"), uint("fastest", 16, 0.01), uint("force", 16, 1e-4)),
            # all else there it answers, and it feeds its watchdog.
            Row("other", any_page, (), fewest=0),
            *map(to_all, OPERATIONS),
            Row("discover", all_motors, (const(0xAA000055, 32),), fewest=4, read_only=True),
            *map(answer, REPLIES),
            Row("found", all_motors, found, "from_device"),
            Row("feedback", reply, status, "from_device", order="big"),
        )
    )


ANY = table_of("4310")
"""For messages that are the same in all models."""


def about_register(operation: str, address: int, name: str, value: float = 0.0) -> CanFrame:
    """Return the frame that reads or writes a register, or saves all."""
    if operation == "save":
        return ANY.encode(operation, motor=address, number=1, value=0)
    raw = REGISTERS.raw(name, value)
    return ANY.encode(operation, motor=address, number=REGISTERS.by_name[name].number, value=raw)


REGISTER_BYTES = [bytes((OPERATIONS[name],)) for name in REPLIES]
"""Third byte of an answer about a register."""


def register_in(frame: CanFrame) -> tuple[str, float | None, bool]:
    """Return name and value of the register that a frame may be the answer about, and whether it was written.
    A save is answered as if its parameter were written."""
    decoded = ANY.decode(frame, "from_device")
    if decoded is None or not decoded.name.endswith(" reply"):
        return "", None, False
    if decoded.name == "save reply":
        return SAVE, 1.0, True
    return *REGISTERS.value(decoded.values["number"], decoded.values["value"]), decoded.name == "write reply"
