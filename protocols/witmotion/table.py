"""The packets and registers of WitMotion's sensors (WT901 and relatives, protocol 0x55), in their own units.

From the device, 11 bytes: `55 | type | four words of 16 bits | sum of all before it`. To it, 5 bytes without
a checksum or an answer: `FF AA | register | word`. All words are little-endian. A register is written only
within `OPEN` of its key; the answer to a read has four registers and does not say which.

Source: WITMOTION/WitStandardProtocol_JY901@e8f4e3a (`Linux_C/normal/REG.h`, `wit_c_sdk.c`); WT901 datasheet
v20-0702.
"""

from __future__ import annotations

import math
import struct
from collections.abc import Mapping, Sequence

from protocols.messages import SECOND, Nanos
from protocols.toolkit.serial import Framing, sum8

NAME = "witmotion"
WORDS = 4
"""Of a packet"""
PACKET_BYTES = 11
ACCELERATION, ANGULAR_RATE, ANGLE, QUATERNION, REGISTERS = 0x51, 0x52, 0x53, 0x59, 0x5F
TYPES = frozenset((*range(0x50, 0x5B), REGISTERS))
FULL = 32768
"""Counts at the end of each scale"""
GRAVITY = 9.80665
G_MOST, RATE_MOST, ANGLE_MOST = 16.0 * GRAVITY, math.radians(2000.0), math.pi
"""m/s², rad/s, rad at the end of each scale"""
ENDS = (-FULL, FULL - 1)
"""Counts of what may as well be beyond its scale"""

SAVE, CONTENT, RATE, BAUD, READ, KEY = 0x00, 0x02, 0x03, 0x04, 0x27, 0x69
UNLOCK = 0xB588
OPEN: Nanos = 10 * SECOND
"""Time for which the key opens the registers"""
RATES: Mapping[int, float] = {
    1: 0.2, 2: 0.5, 3: 1.0, 4: 2.0, 5: 5.0, 6: 10.0, 7: 20.0, 8: 50.0, 9: 100.0, 10: 125.0, 11: 200.0
}  # fmt: skip
"""Hz by the code of register RATE; any other one: it sends nothing by itself"""
NAMES: Mapping[int, str] = {
    SAVE: "SAVE",
    0x01: "CALSW",
    CONTENT: "RSW",
    RATE: "RRATE",
    BAUD: "BAUD",
    KEY: "KEY",
}
"""Registers by the vendor's names; others by their number"""


def _size(head: bytes) -> int | None:
    return 2 * WORDS if head[1] in TYPES else None


_WORDS, _COMMAND = struct.Struct("<2B4h"), struct.Struct("<3BH")
PACKETS = Framing(b"\x55", 2, _size, sum8, 1)
COMMANDS = Framing(b"\xff\xaa", 2, lambda _: 3, lambda _: 0, 0)


def packet(kind: int, words: Sequence[int]) -> bytes:
    """Return a packet as it stands on the line."""
    return PACKETS.frame(_WORDS.pack(0x55, kind, *words))


def words_of(message: bytes) -> tuple[int, ...]:
    """Return the words of a packet, with their signs."""
    return _WORDS.unpack(message)[2:]


def command_of(message: bytes) -> tuple[int, int]:
    """Return register and word of a command."""
    _, _, register, word = _COMMAND.unpack(message)
    return register, word


def register_name(register: int) -> str:
    """Return the vendor's name of a register, or its number."""
    return NAMES.get(register, f"0x{register:02X}")


def counts(value: float, most: float) -> int:
    """Return a number in counts of its scale, limited to it."""
    return max(ENDS[0], min(ENDS[1], round(value / most * FULL)))
