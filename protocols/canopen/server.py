"""The SDO server of a device: the 8 bytes of a request in, the 8 bytes of its response out.

Rules. Plain data. One transfer at a time: a new request of either kind replaces an unfinished one. A segment
without a beginning, a toggle bit that does not alternate, block transfer and an unknown command are refused;
a client's abort ends the transfer without a response. A segmented download takes effect with its last
segment. Of expedited data without a size the object takes as many bytes as it has.

Source: CiA 301 "SDO protocols"; package canopen 2.4.1 `sdo/server.py` for the abort codes. (It answers a
segment without a beginning with a general error, and so does this.)
"""

from __future__ import annotations

from dataclasses import dataclass

from protocols.canopen import sdo
from protocols.canopen.dictionary import Dictionary
from protocols.canopen.objects import Key

LONGEST = 256
"""Bytes that are accepted in segments; there is no longer object."""


@dataclass(slots=True)
class SdoServer:
    """The SDO server of one device."""

    key: Key = (0, 0)
    """Of the last transfer that was begun."""
    outgoing: bytes | None = None
    """What remains of a segmented upload."""
    incoming: bytes | None = None
    """What has been received of a segmented download."""
    size: int | None = None
    """Bytes of the download, as its request states."""
    toggle: int = 0
    """0x10 for every second segment."""

    def handle(self, dictionary: Dictionary, data: bytes) -> tuple[bytes | None, Key | None]:
        """Serve a request; return its response, and the object that it wrote."""
        if len(data) != sdo.SIZE:
            return None, None
        command, index, sub, rest = sdo.HEAD.unpack(data)
        kind = command >> 5
        if kind in (0, 3):
            code, response = self._segment(dictionary, command, data[1:])
        elif kind == 4:
            self.outgoing = self.incoming = None
            return None, None
        else:
            self.key, self.toggle, self.outgoing, self.incoming = (index, sub), 0, None, None
            code, response = self._begin(dictionary, command, rest)
        if code:
            self.outgoing = self.incoming = None
            return sdo.HEAD.pack(sdo.ABORT, *self.key, code.to_bytes(4, "little")), None
        ends_download = (kind == 1 and command & 2) or (kind == 0 and command & 1)
        return response, self.key if ends_download else None

    def _begin(self, dictionary: Dictionary, command: int, rest: bytes) -> tuple[int, bytes]:
        """Begin a transfer; return (abort code, response)."""
        done = sdo.HEAD.pack(0x60, *self.key, bytes(4))
        if command >> 5 == 2:
            code, value = dictionary.read(self.key)
            if len(value) <= sdo.EXPEDITED:
                head = 0x43 | (sdo.EXPEDITED - len(value)) << 2
                return code or (0 if value else sdo.NO_DATA), sdo.HEAD.pack(head, *self.key, value)
            self.outgoing = value
            return 0, sdo.HEAD.pack(0x41, *self.key, len(value).to_bytes(4, "little"))
        if command >> 5 != 1:
            return sdo.UNKNOWN_COMMAND, b""
        if not command & 2:
            self.incoming, self.size = b"", int.from_bytes(rest, "little") if command & 1 else None
            return 0, done
        sized = bool(command & 1)
        value = rest[: sdo.EXPEDITED - (command >> 2 & 3)] if sized else rest
        return dictionary.write(self.key, value, sized=sized), done

    def _segment(self, dictionary: Dictionary, command: int, data: bytes) -> tuple[int, bytes]:
        """Go on with a transfer; return (abort code, response)."""
        uploads, toggle = command >> 5 == 3, command & 0x10
        if (self.outgoing if uploads else self.incoming) is None:
            return sdo.GENERAL, b""
        if toggle != self.toggle:
            return sdo.TOGGLE, b""
        self.toggle ^= 0x10
        if self.outgoing is not None:
            part, rest = self.outgoing[: sdo.SEGMENT], self.outgoing[sdo.SEGMENT :]
            self.outgoing = rest or None
            head = toggle | (sdo.SEGMENT - len(part)) << 1 | (not rest)
            return 0, bytes((head,)) + part.ljust(sdo.SEGMENT, b"\0")
        value = (self.incoming or b"") + data[: sdo.SEGMENT - (command >> 1 & 7)]
        self.incoming = value
        if len(value) > LONGEST:
            return sdo.LENGTH_MISMATCH, b""
        response = bytes((0x20 | toggle,)) + bytes(7)
        if not command & 1:
            return 0, response
        self.incoming = None
        if self.size is not None and self.size != len(value):
            return sdo.LENGTH_MISMATCH, b""
        return dictionary.write(self.key, value), response
