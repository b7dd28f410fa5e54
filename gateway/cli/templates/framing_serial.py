"""How a message stands on the wire: its payload and its address ↔ a run of bytes. No state but the stream's.

Rules. Reading takes any bytes, cut anywhere, and never raises. What is not for us is foreign, what is for us
and no message is bad; each is counted once.

FILL IN beginning, length and checksum from the manual. The clauses "streams", "counts" and "checksums" tell.
The invented device speaks messages of 13 bytes, with a CRC-16 (XMODEM) of the rest at the end, little-endian:

    A5 01 | address u8 | payload | crc u16     to it
    A5 02 | address u8 | payload | crc u16     from it
"""

from __future__ import annotations

import binascii
import struct
from collections.abc import Collection
from typing import Literal

from protocols.frames import Frame
from protocols.plugin import RxCounters

from . import codec

BUS: Literal["can", "canfd", "serial"] = "serial"
COMMAND, STATUS = 1, 2
"""Messages from the host, and from the device."""
MAX_ADDRESS = 0xFF

_HEAD = struct.Struct("<BBB")
_CRC = struct.Struct("<H")
SYNC = 0xA5
SIZE = _HEAD.size + codec.SIZE + _CRC.size
"""Bytes in a message, of either kind."""


def ids(_kind: int, _address: int) -> frozenset[int]:
    """A serial line has no CAN ids."""
    return frozenset()


def message(kind: int, address: int, payload: bytes) -> Frame:
    """A payload on its way to or from an address."""
    body = _HEAD.pack(SYNC, kind, address) + payload
    return body + _CRC.pack(binascii.crc_hqx(body, 0))


class Reader:
    """Takes a stream apart into (address, payload), however it was cut. Holds one message at most.

    Counted is once what is not for us: each message to somebody else, each run of bytes that is no message;
    and as bad each message whose CRC is wrong. The search goes on right behind a false start."""

    def __init__(self, kind: int, addresses: Collection[int], counters: RxCounters | None = None) -> None:
        self._start = bytes((SYNC, kind))
        self._addresses = frozenset(addresses)
        self.counters = counters or RxCounters()
        self._held = b""
        self._skipping = False
        """Whether the run of bytes that is being skipped has been counted."""

    def read(self, frame: Frame) -> list[tuple[int, bytes]]:
        """What is complete with these bytes, for these addresses."""
        if not isinstance(frame, bytes):
            self.counters.ignored += 1
            return []
        held, at, found = self._held + frame, 0, list[tuple[int, bytes]]()
        while True:
            at = self._skip(held, at)
            whole = held[at : at + SIZE]
            if len(whole) < SIZE:
                break
            if binascii.crc_hqx(whole[: -_CRC.size], 0) != _CRC.unpack(whole[-_CRC.size :])[0]:
                self.counters.malformed += 1
                self._skipping = True
                at += 1
                continue
            self._skipping = False
            at += SIZE
            if whole[2] in self._addresses:
                found.append((whole[2], whole[_HEAD.size : -_CRC.size]))
            else:
                self.counters.ignored += 1
        self._held = held[at:]
        return found

    def drop(self) -> None:
        """Forget a message begun, since its rest will not come."""
        self._held, self._skipping = b"", False

    def _skip(self, held: bytes, at: int) -> int:
        """Where the next message may begin; what lies before is counted as one."""
        start = at
        while start < len(held) and not self._start.startswith(held[start : start + 2]):
            start += 1
        if start > at and not self._skipping:
            self.counters.ignored += 1
            self._skipping = True
        return start
