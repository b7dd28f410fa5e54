"""SDO: one object of a device's dictionary read or written, expedited or in segments, or refused.

Rules. Every SDO frame has 8 bytes. A message is a frozen value; `encode` gives its 8 bytes, `decode_request`
(client → server) and `decode_answer` (server → client) take any bytes and give None for what is ill-formed.
Block transfer is not spoken: a request for it decodes to `Unsupported`, so that a server can refuse it.
What becomes of them is the `transfer`'s at the client's side, the `server`'s at the other.

Source: package canopen 2.4.1 (`sdo/constants.py`, `sdo/exceptions.py` for the numbers of the abort codes);
CiA 301 "SDO protocols".
"""

from __future__ import annotations

import struct
from dataclasses import dataclass
from typing import Any, TypeAlias

SIZE = 8
SEGMENT = 7
"""Bytes of data in a segment."""
EXPEDITED = 4
"""Bytes of data that go without segments."""


@dataclass(frozen=True, slots=True)
class Download:
    """Write an object of 1 to 4 bytes."""

    index: int
    sub: int
    data: bytes


@dataclass(frozen=True, slots=True)
class DownloadStart:
    """Write an object in segments; size in bytes, None if it is not told."""

    index: int
    sub: int
    size: int | None


@dataclass(frozen=True, slots=True)
class DownloadSegment:
    """The next piece, of up to 7 bytes."""

    toggle: bool
    data: bytes
    last: bool


@dataclass(frozen=True, slots=True)
class Upload:
    """Read an object."""

    index: int
    sub: int


@dataclass(frozen=True, slots=True)
class UploadSegment:
    """Ask for the next piece."""

    toggle: bool


@dataclass(frozen=True, slots=True)
class Unsupported:
    """A request that is not spoken here (block transfer), or is none."""

    command: int
    index: int
    sub: int


@dataclass(frozen=True, slots=True)
class Abort:
    """A transfer is broken off, by either side."""

    index: int
    sub: int
    code: int


@dataclass(frozen=True, slots=True)
class Downloaded:
    """The object is written, or its segments may come."""

    index: int
    sub: int


@dataclass(frozen=True, slots=True)
class SegmentDownloaded:
    """A piece was taken."""

    toggle: bool


@dataclass(frozen=True, slots=True)
class Uploaded:
    """The object's value, of 1 to 4 bytes."""

    index: int
    sub: int
    data: bytes


@dataclass(frozen=True, slots=True)
class UploadStart:
    """The object is longer than 4 bytes: ask for its pieces."""

    index: int
    sub: int
    size: int | None


@dataclass(frozen=True, slots=True)
class UploadedSegment:
    """A piece of up to 7 bytes."""

    toggle: bool
    data: bytes
    last: bool


Request: TypeAlias = Download | DownloadStart | DownloadSegment | Upload | UploadSegment | Unsupported | Abort
Answer: TypeAlias = Downloaded | SegmentDownloaded | Uploaded | UploadStart | UploadedSegment | Abort

ABORT = 0x80
_HEAD = struct.Struct("<BHB4s")
_LONG = struct.Struct("<BHBI")


def encode(message: Request | Answer) -> bytes:
    """The 8 bytes of a message. ValueError if its data do not fit into it."""
    kind = type(message)
    if kind is Download or kind is Uploaded or kind is Upload:
        return _expedited(message)
    return _other(message)


def _expedited(message: Any) -> bytes:  # noqa: ANN401 -- one of three, by its type: the bulk of all traffic
    if type(message) is Upload:
        return _LONG.pack(0x40, message.index, message.sub, 0)
    data, command = message.data, 0x23 if type(message) is Download else 0x43
    return _HEAD.pack(command | _unused(data) << 2, message.index, message.sub, data)


def _other(message: Request | Answer) -> bytes:
    match message:
        case Downloaded(index, sub):
            return _LONG.pack(0x60, index, sub, 0)
        case DownloadStart(index, sub, size):
            return _LONG.pack(0x20 | (size is not None), index, sub, size or 0)
        case UploadStart(index, sub, size):
            return _LONG.pack(0x40 | (size is not None), index, sub, size or 0)
        case DownloadSegment(toggle, data, last) | UploadedSegment(toggle, data, last):
            return _segment(toggle, data, last)
        case UploadSegment(toggle):
            return bytes((0x60 | toggle << 4, 0, 0, 0, 0, 0, 0, 0))
        case SegmentDownloaded(toggle):
            return bytes((0x20 | toggle << 4, 0, 0, 0, 0, 0, 0, 0))
        case Abort(index, sub, code):
            return _LONG.pack(ABORT, index, sub, code)
        case Unsupported(command, index, sub):
            return _LONG.pack(command, index, sub, 0)
        case Download() | Uploaded() | Upload():
            return _expedited(message)


def _unused(data: bytes) -> int:
    if not 1 <= len(data) <= EXPEDITED:
        raise ValueError(f"{len(data)} bytes do not go without segments")
    return EXPEDITED - len(data)


def _segment(toggle: bool, data: bytes, last: bool) -> bytes:
    if len(data) > SEGMENT:
        raise ValueError(f"{len(data)} bytes do not fit into a segment")
    return bytes((toggle << 4 | (SEGMENT - len(data)) << 1 | last,)) + data.ljust(SEGMENT, b"\0")


def decode_request(data: bytes) -> Request | None:
    """What a client says; None if it is ill-formed."""
    if len(data) != SIZE:
        return None
    command = data[0]
    match command >> 5:
        case 0:
            return DownloadSegment(*_piece(data))
        case 1:
            return _download(data)
        case 2:
            return Upload(*_head(data))
        case 3:
            return UploadSegment(bool(command & 0x10))
        case 4:
            return _abort(data)
    return Unsupported(command, *_head(data))


def decode_answer(data: bytes) -> Answer | None:
    """What a server says; None if it is ill-formed."""
    if len(data) != SIZE:
        return None
    command, index, sub, rest = _HEAD.unpack(data)
    kind = command >> 5
    if kind == 2 and command & 2:
        return Uploaded(index, sub, rest[: EXPEDITED - (command >> 2 & 3)] if command & 1 else rest)
    if kind == 3:
        return Downloaded(index, sub)
    if kind == 2:
        return UploadStart(index, sub, _size(data))
    if kind == 0:
        return UploadedSegment(*_piece(data))
    if kind == 1:
        return SegmentDownloaded(bool(command & 0x10))
    return _abort(data) if kind == 4 else None


def _head(data: bytes) -> tuple[int, int]:
    return data[1] | data[2] << 8, data[3]


def _abort(data: bytes) -> Abort:
    return Abort(*_head(data), int.from_bytes(data[4:], "little"))


def _piece(data: bytes) -> tuple[bool, bytes, bool]:
    return bool(data[0] & 0x10), data[1 : SIZE - (data[0] >> 1 & 7)], bool(data[0] & 1)


def _length(data: bytes) -> int:
    """Bytes of an expedited value: without the size bit it is all four."""
    return EXPEDITED - (data[0] >> 2 & 3) if data[0] & 1 else EXPEDITED


def _size(data: bytes) -> int | None:
    return int.from_bytes(data[4:], "little") if data[0] & 1 else None


def _download(data: bytes) -> Download | DownloadStart:
    if data[0] & 2:
        return Download(*_head(data), data[4 : 4 + _length(data)])
    return DownloadStart(*_head(data), _size(data))


# -- why a transfer was broken off --------------------------------------------------------------------

TOGGLE = 0x05030000
TIMEOUT = 0x05040000
UNKNOWN_COMMAND = 0x05040001
WRITE_ONLY = 0x06010001
READ_ONLY = 0x06010002
NO_OBJECT = 0x06020000
NOT_MAPPABLE = 0x06040041
PDO_TOO_LONG = 0x06040042
INCOMPATIBLE = 0x06040043
LENGTH_MISMATCH = 0x06070010
NO_SUBINDEX = 0x06090011
BAD_VALUE = 0x06090030
UNAVAILABLE = 0x060A0023
GENERAL = 0x08000000
DEVICE_STATE = 0x08000022
NO_DATA = 0x08000024

ABORTS: dict[int, str] = {
    TOGGLE: "the toggle bit did not alternate",
    TIMEOUT: "the transfer took too long",
    UNKNOWN_COMMAND: "the device does not know this SDO command",
    0x05040002: "wrong block size",
    0x05040003: "wrong sequence number",
    0x05040004: "wrong checksum",
    0x05040005: "the device is out of memory",
    0x06010000: "the object cannot be accessed in this way",
    WRITE_ONLY: "the object can only be written",
    READ_ONLY: "the object can only be read",
    NO_OBJECT: "the device has no such object",
    NOT_MAPPABLE: "the object cannot be mapped into a PDO",
    PDO_TOO_LONG: "the mapped objects are longer than a PDO",
    INCOMPATIBLE: "the parameter does not go together with others",
    0x06040047: "the device contradicts itself",
    0x06060000: "the device's hardware failed",
    LENGTH_MISMATCH: "the length does not match the object's type",
    0x06070012: "the value is too long for the object's type",
    0x06070013: "the value is too short for the object's type",
    NO_SUBINDEX: "the object has no such subindex",
    BAD_VALUE: "the value is outside the object's range",
    0x06090031: "the value is too high",
    0x06090032: "the value is too low",
    0x06090036: "the maximum is below the minimum",
    UNAVAILABLE: "the object has no value now",
    GENERAL: "general error",
    0x08000020: "the value cannot be taken over",
    0x08000021: "the device is under local control",
    DEVICE_STATE: "the device's present state does not allow it",
    0x08000023: "the device has no object dictionary",
    NO_DATA: "there are no data",
}


def abort_text(code: int) -> str:
    """What an abort code says, with its number."""
    return f"{ABORTS.get(code, 'an unknown reason')} (SDO abort {code:#010x})"
