"""The messages of Pololu's Maestro servo controllers, in quarters of a microsecond, with 7 bits in each byte.

Rules. A channel of a board that is alone on its line has its number as address: then messages are in the
compact protocol. A channel of one of several boards has 100 times the board's device number and its own,
1203: the channel 3 of board 12, in the Pololu protocol. With CRC each message to a board ends with its CRC-7;
answers have neither that nor a beginning: two bytes, the low one first.

Source: Pololu Maestro Servo Controller User's Guide (0J40), chapters 4.b, 4.e, 5.c to 5.f.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

from protocols.line import Answer
from protocols.toolkit.motor_driver import Rx
from protocols.toolkit.packets import Packets
from protocols.toolkit.table import Field, Row, const, uint, unused

POLOLU = 0xAA
BOARD = 100
"""Addresses of one board"""
CHANNELS = range(24)
QUARTER = 0.25
"""µs of a count"""
SPEED_UNIT, ACCELERATION_UNIT = QUARTER / 0.01, QUARTER / 0.01 / 0.08
"""µs/s and µs/s² of a count (5.e)"""
MOST = (1 << 14) - 1


def board(address: int) -> int:
    """Return the device number of an address; 0: the board is alone on its line."""
    return address // BOARD


def channel(address: int) -> int:
    """Return the channel of an address."""
    return address % BOARD


# name, command byte, whether it names a channel, bytes of its number, and whether it changes nothing
_COMMANDS = (
    ("SETTARGET", 0x84, True, 2, False),
    ("SETSPEED", 0x87, True, 2, False),
    ("SETACCELERATION", 0x89, True, 2, False),
    ("GETPOSITION", 0x90, True, 0, True),
    ("GETERRORS", 0xA1, False, 0, False),  # it clears them
    ("GOHOME", 0xA2, False, 0, False),
)
SIZES: Mapping[int, int] = {code: named + size for _, code, named, size, _ in _COMMANDS}
"""Data bytes by command byte."""
_NAMED = frozenset(code for _, code, named, _, _ in _COMMANDS if named)


def crc7(data: bytes) -> int:
    """Return the CRC-7 of a message, which begins with the lowest bit (5.d)."""
    value = 0
    for byte in data:
        value ^= byte
        for _ in range(8):
            value = (value ^ 0x91 if value & 1 else value) >> 1
    return value


@dataclass(frozen=True, slots=True)
class Format:
    """How messages stand on the line."""

    checked: bool
    """With a CRC"""

    def frame(self, message: bytes) -> bytes:
        """Return a message as it stands on the line."""
        return message + bytes((crc7(message),)) if self.checked else message

    def read(self, held: bytes, at: int) -> tuple[bytes | Rx | None, int]:
        """Return what begins here, and where the search goes on, as every `FrameFormat`."""
        if held[at] < 0x80:
            return Rx.IGNORED, _command(held, at + 1)
        start = at + 3 if held[at] == POLOLU else at + 1
        head = held[at:start]
        if any(byte >= 0x80 for byte in head[1:]):
            return Rx.IGNORED, _command(held, at + 1)
        if len(head) < start - at:
            return None, at
        size = SIZES.get(head[-1] | 0x80)
        if size is None:
            return Rx.IGNORED, _command(held, at + 1)
        end = start + size
        whole = end + self.checked
        if any(byte >= 0x80 for byte in held[start:whole]):
            return Rx.IGNORED, _command(held, at + 1)
        if len(held) < whole:
            return None, at
        if self.checked and crc7(held[at:end]) != held[end]:
            return Rx.MALFORMED, _command(held, at + 1)
        return held[at:end], whole


def _command(held: bytes, at: int) -> int:
    """Return where the next command byte is."""
    return next((place for place in range(at, len(held)) if held[place] >= 0x80), len(held))


def pack(address: int, function: int, data: bytes) -> bytes:
    """Return a message."""
    number = int.from_bytes(data, "little")
    parts = bytes((number & 0x7F, number >> 7 & 0x7F))[: len(data)]
    named = bytes((channel(address),)) if function in _NAMED else b""
    head = bytes((POLOLU, board(address), function & 0x7F)) if board(address) else bytes((function,))
    return head + named + parts


def unpack(message: bytes) -> tuple[int, int, bytes] | None:
    """Return address, function and data of a message."""
    of_board = message[0] == POLOLU
    number, function = (message[1], message[2] | 0x80) if of_board else (0, message[0])
    rest = message[3:] if of_board else message[1:]
    named = function in _NAMED
    parts = rest[named:]
    value = sum(byte << 7 * at for at, byte in enumerate(parts))
    return BOARD * number + (rest[0] if named else 0), function, value.to_bytes(len(parts), "little")


def _row(name: str, code: int, size: int, read_only: bool) -> Row:
    fields: tuple[Field, ...] = (uint("value", 14), unused(2)) if size else ()
    return Row(name, (uint("address", 16), const(code)), fields, read_only=read_only)


ROWS = [_row(name, code, size, reads) for name, code, _, size, reads in _COMMANDS]
PACKETS = {checked: Packets(ROWS, Format(checked), pack, unpack) for checked in (False, True)}
"""By whether the board is configured for CRC."""


# -- answers ------------------------------------------------------------------------------------------------


def number(_asked: bytes, held: bytes) -> tuple[int, int] | None:
    """Return where the answer to a question is: its first two bytes, which have 14 bits at most."""
    return (0, 2) if len(held) >= 2 and held[1] <= MOST >> 8 else None


def answer(delay: int) -> Answer:
    """Return what is expected to come back."""
    return Answer(2, number, delay, usual=2)


ERRORS = (
    "serial signal error (a wrong baud rate?)",
    "serial overrun",
    "serial buffer full",
    "serial CRC error",
    "serial protocol error",
    "serial timeout",
    "script stack error",
    "script call stack error",
    "script program counter error",
)
"""By the bit in the error register (4.e). Each sends all outputs of a board home, as that is configured."""
CRC_ERROR, TIMEOUT_ERROR = 1 << 3, 1 << 5


def errors(register: int) -> str:
    """Return the names of the errors in a register."""
    return ", ".join(name for bit, name in enumerate(ERRORS) if register >> bit & 1)
