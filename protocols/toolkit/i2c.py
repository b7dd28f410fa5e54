"""A transfer on an I²C bus, and what comes of it, as bytes: what a driver sends, and a bus answers.

Rules. A transfer is the address of the chip (7 bits), how many bytes are read, and the bytes that are written
before that, in one transaction with a repeated start. Each is answered: the address, the outcome, a checksum
of the transfer, and the bytes that were read. So a bus is a line on which devices speak only when asked
(`protocols.line`); and what comes late, from an adapter that hung, is not taken for the answer to another
transfer.
"""

from __future__ import annotations

from typing import NamedTuple

from protocols.frames import Frame
from protocols.line import Answer
from protocols.toolkit.serial import CRC8_MAXIM

DONE, NO_CHIP, FAILED = range(3)
"""Outcomes: acknowledged; nobody acknowledges this address; the transfer was not carried out."""
ADDRESSES = range(0x08, 0x78)
"""Those that a chip can have; the others are reserved (UM10204, 3.1.12)."""
GENERAL_CALL = 0x00
HEAD = 3
"""Bytes of an answer before those that were read"""


class Transfer(NamedTuple):
    """What is written to a chip, and how many bytes are then read from it."""

    address: int
    reads: int
    written: bytes


def transfer(address: int, written: bytes, reads: int = 0) -> bytes:
    """Return a transfer as a frame."""
    return bytes((address, reads)) + written


def parse(frame: Frame) -> Transfer | None:
    """Return the transfer in a frame; None if it is none."""
    if not isinstance(frame, bytes) or len(frame) < 3 or frame[0] > 0x7F:
        return None
    return Transfer(frame[0], frame[1], frame[2:])


def outcome(asked: bytes, result: int, read: bytes = b"") -> bytes:
    """Return what comes of a transfer as a frame."""
    return bytes((asked[0] if asked else 0, result, CRC8_MAXIM(asked))) + read


def find(asked: bytes, held: bytes) -> tuple[int, int] | None:
    """Return where the answer to a transfer is."""
    heads = [outcome(asked, result) for result in (DONE, NO_CHIP, FAILED)]
    for at in range(len(held) - HEAD + 1):
        if held[at : at + HEAD] in heads:
            end = at + HEAD + (asked[1] if held[at + 1] == DONE else 0)
            return (at, end) if end <= len(held) else None
    return None


def answer(frame: bytes, delay: int = 0) -> Answer:
    """Return what is expected to come of a transfer."""
    return Answer(HEAD + frame[1], find, delay, usual=HEAD)
