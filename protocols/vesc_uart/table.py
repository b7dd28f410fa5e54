"""The packets of VESC controllers, in the vendor's units, and how one stands on the line.

Rules. A packet is 2 and a length, or from 256 bytes on 3 and two bytes of it; the payload; CRC-16/XMODEM of
that; 3. A payload begins with a command; FORWARD_CAN and an id before it send it on to that controller, whose
answer comes back as it is. Nothing answers a command that sets. Every answer that is used has the id of who
sends it.

Source: vedderb/bldc@b9d287b3 `comm/packet.c`, `comm/commands.c`, `datatypes.h`.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cache

from protocols.plugin import FaultInfo
from protocols.toolkit.masked import Masked
from protocols.toolkit.packets import Packets
from protocols.toolkit.serial import CRC16_XMODEM, Envelope, Finds
from protocols.toolkit.table import Field, Row, const, fields, sint, uint
from protocols.vesc.table import ALIVE, ALL_FAULTS, GET_VALUES_SELECTIVE, NO_ANSWER, SETTERS, TUNNELLED

ADDRESSES = range(254)
DIRECT = 256
"""In the place of an address: the controller at the end of the line, whatever its id."""
FW_VERSION, GET_VALUES, REBOOT, FORWARD_CAN, PING_CAN, SET_CURRENT_REL = 0, 4, 29, 34, 62, 84


FORMAT = Envelope({2: range(1, 256), 3: range(255, 513)}, CRC16_XMODEM, 2, "big", b"\3")
"""How a payload of at most 512 bytes stands on the line."""


# -- packets to a controller -------------------------------------------------------------------------------


def pack(address: int, function: int, data: bytes) -> bytes:
    """Return the payload of a command to a controller."""
    if address == DIRECT:
        return b"%c%b" % (function, data)
    return b"%c%c%c%b" % (FORWARD_CAN, address, function, data)


def unpack(payload: bytes) -> tuple[int, int, bytes] | None:
    """Return for whom a payload is, command and data."""
    if payload[0] != FORWARD_CAN:
        return DIRECT, payload[0], payload[1:]
    return (payload[1], payload[2], payload[3:]) if len(payload) > 2 else None


def _row(name: str, function: int, *data: Field, read_only: bool = False) -> Row:
    return Row(name, (uint("address", 16), const(function)), data, order="big", read_only=read_only)


def _setter(name: str, function: int, unit: float) -> Row:
    return _row(name, function, sint("value", 32, unit))


PACKETS = Packets(
    (
        _row("FW_VERSION", FW_VERSION, read_only=True),
        _row("GET_VALUES", GET_VALUES, read_only=True),
        _row("GET_VALUES_SELECTIVE", GET_VALUES_SELECTIVE, uint("mask", 32), read_only=True),
        _row("PING_CAN", PING_CAN, read_only=True),
        *(_setter(name, number, SETTERS[name][1]) for number, name in TUNNELLED.items()),
        _setter("SET_CURRENT_REL", SET_CURRENT_REL, SETTERS["SET_CURRENT_REL"][1]),
        _row("ALIVE", ALIVE),
        _row("REBOOT", REBOOT),
    ),
    FORMAT,
    pack,
    unpack,
)


# -- values ------------------------------------------------------------------------------------------------

_BITS = """
temp_fet:i16*0.1|temp_motor:i16*0.1|avg_motor_current:i32*0.01|avg_input_current:i32*0.01|avg_id:i32*0.01
|avg_iq:i32*0.01|duty_cycle_now:i16*1e-3|rpm:i32|v_in:i16*0.1|amp_hours:i32*1e-4|amp_hours_charged:i32*1e-4
|watt_hours:i32*1e-4|watt_hours_charged:i32*1e-4|tachometer:i32|tachometer_abs:i32|fault_code:u8
|pid_pos_now:i32*1e-6|controller_id:u8|temp_mos1:i16*0.1 temp_mos2:i16*0.1 temp_mos3:i16*0.1
|avg_vd:i32*1e-3|avg_vq:i32*1e-3|status:u8"""
VALUES = Masked(tuple(fields(each) for each in _BITS.split("|")))
"""By the bit of a mask. The current since the last question is an average. `status`: whether the timeout has
passed (1) and a kill switch is on (2)."""
BIT = VALUES.bit
WHO = BIT["controller_id"]
MOTION = VALUES.mask(
    *("avg_motor_current", "duty_cycle_now", "rpm", "tachometer", "fault_code", "controller_id", "status")
)
SLOW = VALUES.mask("temp_fet", "temp_motor", "v_in", "controller_id")
EVERYTHING = 0xFFFFFFFF
"""What GET_VALUES asks for."""


def encode_values(mask: int, values: Mapping[str, float], *, selective: bool) -> bytes:
    """Return the payload of an answer; what is not given is 0. Numbers saturate."""
    head = bytes((GET_VALUES_SELECTIVE,)) + mask.to_bytes(4, "big") if selective else bytes((GET_VALUES,))
    return head + VALUES.encode(mask, values)


def decode_values(payload: bytes) -> tuple[int, dict[str, float | None]] | None:
    """Return the mask and the values of an answer; None if it is none. Older firmware has no `status`."""
    selective = payload[0] == GET_VALUES_SELECTIVE
    if payload[0] != GET_VALUES and not (selective and len(payload) >= 5):
        return None
    mask = int.from_bytes(payload[1:5], "big") if selective else EVERYTHING
    data = payload[5 if selective else 1 :]
    without = mask & BIT["status"] and len(data) == VALUES.size(mask) - 1
    values = VALUES.decode(mask & ~BIT["status"] if without else mask, data)
    return None if values is None else (mask, values)


def size_of(mask: int) -> int:
    """Return the bytes of the packet that answers a mask."""
    return 5 + 5 + VALUES.size(mask)


@dataclass(frozen=True, slots=True)
class Belongs:
    """Whether a payload answers a question: the same command and mask, and by whom it was asked."""

    sender: int | None
    """None: whoever it is."""

    def __call__(self, asked: bytes, payload: bytes) -> bool:
        """Return it."""
        question, _ = FORMAT.read(asked, 0)
        unpacked = unpack(question) if isinstance(question, bytes) else None
        if unpacked is None or payload[0] != unpacked[1]:
            return False
        if payload[0] != GET_VALUES_SELECTIVE:
            return True
        decoded = decode_values(payload) if payload[1:5] == unpacked[2] else None
        return decoded is not None and self.sender in (None, decoded[1].get("controller_id"))


@cache
def finds(sender: int | None) -> Finds:
    """Return how the answer of a controller is found; None: of whoever it is."""
    return Finds(FORMAT, Belongs(sender))


def decode_version(payload: bytes) -> tuple[str, int | None] | None:
    """Return firmware and hardware in words, and the serial number (the processor's); None if it is none."""
    if payload[0] != FW_VERSION or len(payload) < 3:
        return None
    name, _, rest = payload[3:].partition(b"\0")
    hardware = name.decode("ascii", "replace") if name.isascii() else ""
    serial = int.from_bytes(rest[:12], "big") if len(rest) >= 12 else None
    return f"firmware {payload[1]}.{payload[2]:02}" + f", hardware {hardware}" * bool(hardware), serial


OTHER_END = 0x105
FAULTS: Mapping[int, FaultInfo] = {
    **ALL_FAULTS,
    NO_ANSWER: FaultInfo(
        "does not tell its state",
        "its firmware is older than 5.3",
        "update its firmware",
    ),
    OTHER_END: FaultInfo(
        "another controller is at the end of the line",
        "its VESC ID is not uart_id",
        "write its VESC ID as uart_id, for all controllers of this line",
    ),
}
