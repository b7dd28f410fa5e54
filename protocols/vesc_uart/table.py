"""The packets of VESC controllers, in the vendor's units, and how one stands on the line.

Rules. A packet is 2 and a length, or from 256 bytes on 3 and two bytes of it; the payload; CRC-16/XMODEM of
that; 3. A payload begins with a command; FORWARD_CAN and an id before it send it on to that controller, whose
answer comes back as it is. Nothing answers a command that sets. Every answer that is used has the id of who
sends it.

Source: vedderb/bldc@b9d287b3 `comm/packet.c`, `comm/commands.c`, `datatypes.h`.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cache, lru_cache
from struct import Struct

from protocols.plugin import FaultInfo
from protocols.toolkit.motor_driver import Rx
from protocols.toolkit.packets import Packets
from protocols.toolkit.serial import CRC16_XMODEM, Finds
from protocols.toolkit.table import Field, Row, const, sint, uint
from protocols.vesc.table import ALIVE, ALL_FAULTS, GET_VALUES_SELECTIVE, NO_ANSWER, SETTERS, TUNNELLED

ADDRESSES = range(254)
DIRECT = 256
"""In the place of an address: the controller at the end of the line, whatever its id."""
FW_VERSION, GET_VALUES, REBOOT, FORWARD_CAN, PING_CAN, SET_CURRENT_REL = 0, 4, 29, 34, 62, 84


# -- framing -----------------------------------------------------------------------------------------------

SHORT, LONG, STOP = 2, 3, 3
"""The first byte, by the bytes of the length; and the last."""
LONGEST = 512
"""Bytes of a payload"""
_START = re.compile(rb"[\2\3]")


@dataclass(frozen=True, slots=True)
class PacketFormat:
    """How a payload stands on the line. A packet that is damaged cannot be told from noise: any 2 or 3 in it
    may begin another."""

    def frame(self, message: bytes) -> bytes:
        """Return the packet of a payload. Raises ValueError if there is none of its length."""
        size = len(message)
        if not 0 < size <= LONGEST:
            raise ValueError(f"a payload has 1 to {LONGEST} bytes, not {size}")
        head = b"\2%c" % size if size < 256 else b"\3" + size.to_bytes(2, "big")
        return b"%b%b%b\3" % (head, message, CRC16_XMODEM(message).to_bytes(2, "big"))

    def read(self, held: bytes, at: int) -> tuple[bytes | Rx | None, int]:
        """Return what begins here, and where the search goes on, as every `FrameFormat`."""
        kind = held[at]
        start = at + kind
        if kind not in (SHORT, LONG):
            return Rx.IGNORED, _next(held, at)
        if len(held) < start:
            return None, at
        size = int.from_bytes(held[at + 1 : start], "big")
        if not (0 if kind == SHORT else 254) < size <= LONGEST:
            return Rx.IGNORED, _next(held, at)
        end = start + size
        if len(held) < end + 3:
            return None, at
        payload = held[start:end]
        if held[end + 2] != STOP or CRC16_XMODEM(payload) != int.from_bytes(held[end : end + 2], "big"):
            return Rx.IGNORED, _next(held, at)
        return payload, end + 3


def _next(held: bytes, at: int) -> int:
    """Return where a packet may begin, behind this byte."""
    found = _START.search(held, at + 1)
    return found.start() if found else len(held)


FORMAT = PacketFormat()


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


def _row(name: str, function: int, *fields: Field, read_only: bool = False) -> Row:
    return Row(name, (uint("address", 16), const(function)), fields, order="big", read_only=read_only)


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

_TEMPERATURES = tuple(sint(f"temp_mos{number}", 16, 0.1) for number in (1, 2, 3))
_ENERGY = ("amp_hours", "amp_hours_charged", "watt_hours", "watt_hours_charged")
FIELDS: tuple[tuple[Field, ...], ...] = (
    (sint("temp_fet", 16, 0.1),),
    (sint("temp_motor", 16, 0.1),),
    *((sint(name, 32, 0.01),) for name in ("avg_motor_current", "avg_input_current", "avg_id", "avg_iq")),
    (sint("duty_cycle_now", 16, 1e-3),),
    (sint("rpm", 32),),
    (sint("v_in", 16, 0.1),),
    *((sint(name, 32, 1e-4),) for name in _ENERGY),
    (sint("tachometer", 32),),
    (sint("tachometer_abs", 32),),
    (uint("fault_code"),),
    (sint("pid_pos_now", 32, 1e-6),),
    (uint("controller_id"),),
    _TEMPERATURES,
    (sint("avg_vd", 32, 1e-3),),
    (sint("avg_vq", 32, 1e-3),),
    (uint("status"),),
)
"""By the bit of a mask. The current since the last question is an average. `status`: whether the timeout has
passed (1) and a kill switch is on (2)."""
BIT: Mapping[str, int] = {each.name: 1 << bit for bit, fields in enumerate(FIELDS) for each in fields}
WHO = BIT["controller_id"]
_NEEDED = (
    "avg_motor_current",
    "duty_cycle_now",
    "rpm",
    "tachometer",
    "fault_code",
    "controller_id",
    "status",
)
MOTION = sum(BIT[name] for name in _NEEDED)
SLOW = BIT["temp_fet"] | BIT["temp_motor"] | BIT["v_in"] | WHO
EVERYTHING = 0xFFFFFFFF
"""What GET_VALUES asks for."""
_CODES = {("int", 16): "h", ("int", 32): "i", ("uint", 8): "B"}


@lru_cache(64)
def layout(mask: int) -> tuple[Struct, tuple[Field, ...]]:
    """Return how the values of a mask stand in an answer."""
    fields = tuple(each for bit, some in enumerate(FIELDS) if mask >> bit & 1 for each in some)
    return Struct(">" + "".join(_CODES[each.kind, each.bits] for each in fields)), fields


def encode_values(mask: int, values: Mapping[str, float], *, selective: bool) -> bytes:
    """Return the payload of an answer; what is not given is 0. Numbers saturate."""
    packed, fields = layout(mask)
    raw = []
    for each in fields:
        low, high = (round(end / each.unit) for end in each.ends())
        raw.append(max(low, min(high, round(values.get(each.name, 0) / each.unit))))
    head = bytes((GET_VALUES_SELECTIVE,)) + mask.to_bytes(4, "big") if selective else bytes((GET_VALUES,))
    return head + packed.pack(*raw)


def decode_values(payload: bytes) -> tuple[int, dict[str, float | None]] | None:
    """Return the mask and the values of an answer; None if it is none. A number of 32 bits is None at its
    ends, where it may as well be beyond; older firmware has no `status`."""
    selective = payload[0] == GET_VALUES_SELECTIVE
    if payload[0] != GET_VALUES and not (selective and len(payload) >= 5):
        return None
    mask = int.from_bytes(payload[1:5], "big") if selective else EVERYTHING
    packed, fields = layout(mask)
    start = 5 if selective else 1
    if len(payload) - start == packed.size - 1 and mask & BIT["status"]:
        packed, fields = layout(mask & ~BIT["status"])
    if len(payload) - start < packed.size:
        return None
    values: dict[str, float | None] = {}
    for each, raw in zip(fields, packed.unpack_from(payload, start), strict=True):
        beyond = each.bits == 32 and abs(raw) >= (1 << 31) - 1
        values[each.name] = None if beyond else raw if each.unit == 1.0 else raw * each.unit
    return mask, values


def size_of(mask: int) -> int:
    """Return the bytes of the packet that answers a mask."""
    return 5 + 5 + layout(mask)[0].size


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
