"""Messages on a byte stream: between sync bytes and a checksum, however the stream was cut.

Rules. A `Framing` is a constant; a `Stream` holds at most one message's bytes. Any bytes are accepted, and
nothing raises.
"""

from __future__ import annotations

import binascii
import zlib
from collections.abc import Callable
from dataclasses import dataclass
from functools import cache, reduce
from typing import Literal, TypeAlias

Checksum: TypeAlias = Callable[[bytes], int]


def crc(width: int, polynomial: int, start: int = 0, *, reflected: bool = True, end: int = 0) -> Checksum:
    """Return a cyclic redundancy check. `polynomial` without its highest bit, as printed (not reflected);
    `end` is combined with the result by XOR. (Williams, A Painless Guide to CRC Error Detection, 1993.)"""
    table = _crc_table(width, polynomial, reflected)
    ones, top = (1 << width) - 1, width - 8

    def check(data: bytes) -> int:
        value = start
        for byte in data:
            if reflected:
                value = value >> 8 ^ table[(value ^ byte) & 0xFF]
            else:
                value = (value << 8 & ones) ^ table[(value >> top ^ byte) & 0xFF]
        return value ^ end

    return check


@cache
def _crc_table(width: int, polynomial: int, reflected: bool) -> tuple[int, ...]:
    ones, high = (1 << width) - 1, 1 << width - 1
    if reflected:
        polynomial = int(f"{polynomial:0{width}b}"[::-1], 2)
    table = []
    for value in range(256):
        value = value if reflected else value << width - 8
        for _ in range(8):
            if reflected:
                value = value >> 1 ^ polynomial * (value & 1)
            else:
                value = (value << 1 ^ (polynomial if value & high else 0)) & ones
        table.append(value)
    return tuple(table)


CRC8_MAXIM = crc(8, 0x31)
CRC16_MODBUS = crc(16, 0x8005, 0xFFFF)
CRC32: Checksum = zlib.crc32


def crc16_xmodem(data: bytes) -> int:
    """CRC-16/XMODEM: 0x1021, from 0 (what most vendors call CCITT)."""
    return binascii.crc_hqx(data, 0)


def inverted_sum8(data: bytes) -> int:
    """Complement of the sum, in 8 bits."""
    return ~sum(data) & 0xFF


def xor8(data: bytes) -> int:
    """XOR of all bytes."""
    return reduce(lambda one, other: one ^ other, data, 0)


@dataclass(frozen=True, slots=True)
class Framing:
    """How a message stands on the line: head (with the sync bytes), body, checksum."""

    sync: bytes
    head: int
    """Bytes up to the body, sync included."""
    body: Callable[[bytes], int | None]
    """From the head: bytes of the body; None if it is no head."""
    checksum: Checksum
    checksum_size: int
    order: Literal["little", "big"] = "little"
    """Of the checksum's bytes."""
    covers: int = 0
    """The checksum covers the message from this byte on."""

    def frame(self, head: bytes, body: bytes) -> bytes:
        """Return a message."""
        message = head + body
        return message + self.checksum(message[self.covers :]).to_bytes(self.checksum_size, self.order)


@dataclass(slots=True)
class Stream:
    """Splits a byte stream into messages.

    What is not a message is skipped and counted: `bad` once for each message whose checksum is wrong, `noise`
    once for each run of other bytes between two messages. A message behind either is found, since after a
    wrong checksum the search goes on right behind the sync bytes."""

    framing: Framing
    bad: int = 0
    noise: int = 0
    _held: bytes = b""
    _skipping: bool = False
    """The run of bytes that is being skipped has been counted."""

    def feed(self, data: bytes) -> list[tuple[bytes, bytes]]:
        """Return head and body of the messages that these bytes complete."""
        held, at, found = self._held + data, 0, list[tuple[bytes, bytes]]()
        framing = self.framing
        while True:
            start = self._find(held, at)
            head = held[start : start + framing.head]
            size = framing.body(head) if len(head) == framing.head else None
            end = start + framing.head + (size or 0)
            if size is None or len(held) < end + framing.checksum_size:
                break
            given = int.from_bytes(held[end : end + framing.checksum_size], framing.order)
            if given == framing.checksum(held[start + framing.covers : end]):
                found.append((head, held[start + framing.head : end]))
                self._skipping = False
                at = end + framing.checksum_size
            else:
                self.bad += 1
                self._skipping = True
                at = start + len(framing.sync)
        self._held = held[start:]
        return found

    def drop(self) -> None:
        """Discard a partial message: the line was interrupted, its rest will not come."""
        self._held, self._skipping = b"", False

    def _find(self, held: bytes, at: int) -> int:
        """Return where the next message may begin; whatever lies before is noise."""
        sync, start = self.framing.sync, at
        while True:
            start = held.find(sync[0], start)
            if start < 0:
                start = len(held)
                break
            head = held[start : start + self.framing.head]
            whole = len(head) == self.framing.head
            begins = head.startswith(sync) if len(head) >= len(sync) else sync.startswith(head)
            if begins and (not whole or self.framing.body(head) is not None):
                break
            start += 1
        if start > at and not self._skipping:
            self.noise += 1
            self._skipping = True
        return start
