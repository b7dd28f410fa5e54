"""Framing: a payload and its address ↔ a run of bytes. No state but the stream's.

Rules. Reading takes any bytes, cut anywhere, and never raises. What is not ours is ignored, a message with a
wrong checksum is malformed; each is counted once.

FILL IN start, length and checksum from the manual. The clauses "streams", "counts" and "checksums" check
them. The messages of the invented device have 13 bytes, with a CRC-16 (XMODEM) of the rest at the end,
little-endian:

    A5 01 | address u8 | payload | crc u16     to the device
    A5 02 | address u8 | payload | crc u16     from the device

"""

from __future__ import annotations

import binascii
import struct
from collections.abc import Collection
from typing import Literal

from protocols.frames import Frame, IdMask
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


def ids(_kind: int, _address: int) -> tuple[IdMask, ...]:
    """Return no CAN ids: a serial line has none."""
    return ()


def make_frame(kind: int, address: int, payload: bytes) -> Frame:
    """Return the message with a payload to or from an address."""
    body = _HEAD.pack(SYNC, kind, address) + payload
    return body + _CRC.pack(binascii.crc_hqx(body, 0))


class Reader:
    """Extracts (address, payload) from a stream, however it was cut. Holds one message at most.

    Counted once as ignored: each message for another address, each run of bytes that is no message; as
    malformed: each message whose CRC is wrong. The search goes on right behind a false start."""

    def __init__(self, kind: int, addresses: Collection[int], counters: RxCounters | None = None) -> None:
        self._start = bytes((SYNC, kind))
        self._addresses = frozenset(addresses)
        self.counters = counters or RxCounters()
        self._held = b""
        self._skipping = False
        """The run of bytes that is being skipped has been counted."""

    def read(self, frame: Frame) -> list[tuple[int, bytes]]:
        """Return the payloads that these bytes complete, for these addresses."""
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
        """Discard a partial message, since its rest will not come."""
        self._held, self._skipping = b"", False

    def _skip(self, held: bytes, at: int) -> int:
        """Return where the next message may begin; count what lies before, once."""
        start = at
        while start < len(held) and not self._start.startswith(held[start : start + 2]):
            start += 1
        if start > at and not self._skipping:
            self.counters.ignored += 1
            self._skipping = True
        return start
