"""Messages on a byte stream: between sync bytes and a checksum, however the stream was cut.

Rules. A `Framing` is a constant; a `Stream` holds at most one message's bytes. Any bytes are accepted, and
nothing raises.
"""

from __future__ import annotations

import zlib
from collections.abc import Callable
from dataclasses import dataclass
from functools import cache, reduce
from operator import xor
from typing import Literal, TypeAlias

from protocols.toolkit.motor_driver import Rx

Checksum: TypeAlias = Callable[[bytes], int]


def crc(width: int, polynomial: int, start: int = 0, *, reflected: bool = True, end: int = 0) -> Checksum:
    """Return a cyclic redundancy check. `polynomial` without its highest bit, as printed (not reflected);
    `end` is combined with the result by XOR. (Williams, A Painless Guide to CRC Error Detection, 1993.)"""
    table = _remainders(width, polynomial, reflected)
    ones, top = (1 << width) - 1, width - 8

    def check(data: bytes) -> int:
        value = start
        for byte in data:
            if reflected:
                value = value >> 8 ^ table[(value ^ byte) & 0xFF]
            else:
                value = (value << 8 & ones) ^ table[value >> top ^ byte]
        return value ^ end

    return check


@cache
def _remainders(width: int, polynomial: int, reflected: bool) -> tuple[int, ...]:
    """Return the remainder of each byte."""
    high, remainders = 1 << width - 1, []
    for byte in range(256):
        value = int(f"{byte:08b}"[::-1], 2) if reflected else byte
        value <<= width - 8
        for _ in range(8):
            value = value << 1 ^ (polynomial | high << 1 if value & high else 0)
        remainders.append(int(f"{value:0{width}b}"[::-1], 2) if reflected else value)
    return tuple(remainders)


CRC8_MAXIM = crc(8, 0x31)
CRC16_MODBUS = crc(16, 0x8005, 0xFFFF)
CRC16_XMODEM = crc(16, 0x1021, reflected=False)
"""What most vendors call CCITT, from 0."""
CRC32: Checksum = zlib.crc32


def inverted_sum8(data: bytes) -> int:
    """Complement of the sum, in 8 bits."""
    return ~sum(data) & 0xFF


def xor8(data: bytes) -> int:
    """XOR of all bytes."""
    return reduce(xor, data, 0)


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

    def frame(self, message: bytes) -> bytes:
        """Return a message, head and body, with its checksum."""
        return message + self.checksum(message[self.covers :]).to_bytes(self.checksum_size, self.order)

    def end(self, held: bytes, at: int) -> int | None:
        """Return where body and message end without the checksum, the end of the head at least; None: no
        message begins here."""
        head = held[at : at + self.head]
        if not head.startswith(self.sync[: len(head)]):
            return None
        size = self.body(head) if len(head) == self.head else 0
        return None if size is None else at + self.head + size


@dataclass(slots=True)
class Stream:
    """Splits a byte stream into messages. Holds at most one message's bytes.

    What is not a message is skipped: MALFORMED stands once for each message whose checksum is wrong, IGNORED
    once for each run of other bytes between two messages. A message behind either is found, since after a
    wrong checksum the search goes on right behind the sync bytes."""

    framing: Framing
    _held: bytes = b""
    _skipping: bool = False
    """The run of bytes that is being skipped has been reported."""

    def feed(self, data: bytes) -> list[bytes | Rx]:
        """Return the messages that these bytes complete: head and body."""
        framing, held, at, found = self.framing, self._held + data, 0, list[bytes | Rx]()
        while at < len(held):
            end = framing.end(held, at)
            if end is None:
                found += () if self._skipping else (Rx.IGNORED,)
                self._skipping = True
                at = held.find(framing.sync[0], at + 1)
                at = at if at >= 0 else len(held)
            elif len(held) < end + framing.checksum_size:
                break
            elif framing.checksum(held[at + framing.covers : end]) == int.from_bytes(
                held[end : end + framing.checksum_size], framing.order
            ):
                found.append(held[at:end])
                self._skipping = False
                at = end + framing.checksum_size
            else:
                found.append(Rx.MALFORMED)
                self._skipping = True
                at += len(framing.sync)
        self._held = held[at:]
        return found

    def messages(self, data: bytes) -> list[bytes]:
        """Return only the messages that these bytes complete."""
        return [each for each in self.feed(data) if isinstance(each, bytes)]

    def drop(self) -> None:
        """Discard a partial message: the line was interrupted, its rest will not come."""
        self._held, self._skipping = b"", False
