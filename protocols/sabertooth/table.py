"""The messages of Sabertooth boards: address, command, 7 bits, and a checksum of 7 bits.

Source: pysabertooth 0.4.0; commands 2, 3, 6, 7, 12, 13 and 17 by memory of the datasheet, and never sent.
"""

from __future__ import annotations

import re

from protocols.toolkit.boards import Boards
from protocols.toolkit.motor_driver import Rx
from protocols.toolkit.packets import Packets
from protocols.toolkit.table import Row, const, uint

BOARDS = Boards(range(128, 136))
FULL = 127
TIMEOUT_UNIT_MS = 100
AUTOBAUD = 0xAA
"""The first byte after it is switched on, by which it finds the baud rate."""
BARE = bytes((AUTOBAUD,))
CHECKS = tuple(bytes((check,)) for check in range(FULL + 1))
SIZE = 4
_NAMES = (
    "M1FORWARD M1REVERSE MINVOLTAGE MAXVOLTAGE M2FORWARD M2REVERSE M17BIT M27BIT MIXEDFORWARD MIXEDREVERSE "
    "MIXEDRIGHT MIXEDLEFT MIXEDDRIVE MIXEDTURN SERIALTIMEOUT BAUD RAMP DEADBAND"
)
COMMANDS = tuple(_NAMES.split())
"""By number."""
_BEGINS = re.compile(rb"[\x80-\x87\xaa]")


class Format:
    """How messages stand on the line."""

    def frame(self, message: bytes) -> bytes:
        """Return a message, address, command and value, as it stands on the line."""
        if AUTOBAUD in message:  # without an address; no other byte has this value
            return BARE
        return message + CHECKS[sum(message) & FULL]

    def read(self, held: bytes, at: int) -> tuple[bytes | Rx | None, int]:
        """Return what begins here, and where the search goes on, as every `FrameFormat`."""
        if held[at] == AUTOBAUD:
            return held[at : at + 1], at + 1
        found = _BEGINS.search(held, at + 1)
        following = found.start() if found else len(held)
        if held[at] not in BOARDS.addresses:
            return Rx.IGNORED, following
        part = held[at + 1 : at + SIZE]
        if any(byte > FULL for byte in part) or (part and part[0] >= len(COMMANDS)):
            return Rx.IGNORED, following
        if len(part) < SIZE - 1:
            return None, at
        if sum(held[at : at + SIZE - 1]) & 0x7F != part[-1]:
            return Rx.MALFORMED, following
        return held[at : at + SIZE - 1], at + SIZE


PACKETS = Packets(
    (
        *(Row(name, (uint("address"), const(at)), (uint("value"),)) for at, name in enumerate(COMMANDS)),
        Row("AUTOBAUD", (uint("address"), const(AUTOBAUD)), (), read_only=True),
    ),
    Format(),
    unpack=lambda message: (message[0], message[1] if message[1:] else AUTOBAUD, message[2:]),
)
