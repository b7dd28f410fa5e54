"""SDO messages of a client: upload (read) and download (write) of one object, expedited or segmented.

Rules. Every SDO frame has 8 bytes. A message is a frozen value; `encode` returns the 8 bytes of a request,
`decode_response` takes any bytes and returns None for malformed ones. Block transfer is not used. `client`
has the client's side of the protocol, `server` the server's, which is in bytes.

Source: package canopen 2.4.1 (`sdo/constants.py`, `sdo/exceptions.py` for the numbers of the abort codes);
CiA 301 "SDO protocols".
"""

from __future__ import annotations

import struct
from dataclasses import dataclass
from typing import TypeAlias

SIZE = 8
SEGMENT = 7
"""Bytes of data in a segment."""
EXPEDITED = 4
"""Bytes of data that fit into the first message."""


@dataclass(frozen=True, slots=True)
class Named:
    """A message that names its object."""

    index: int
    sub: int


@dataclass(frozen=True, slots=True)
class Download(Named):
    """Request: write an object of 1 to 4 bytes."""

    data: bytes


@dataclass(frozen=True, slots=True)
class DownloadStart(Named):
    """Request: begin to write an object in segments; size in bytes."""

    size: int


@dataclass(frozen=True, slots=True)
class DownloadSegment:
    """Request: write the next segment, of up to 7 bytes."""

    toggle: bool
    data: bytes
    last: bool


@dataclass(frozen=True, slots=True)
class Upload(Named):
    """Request: read an object."""


@dataclass(frozen=True, slots=True)
class UploadSegment:
    """Request: read the next segment."""

    toggle: bool


@dataclass(frozen=True, slots=True)
class Abort(Named):
    """Response: the transfer is aborted."""

    code: int


@dataclass(frozen=True, slots=True)
class Downloaded(Named):
    """Response: the object is written, or its segments may be sent."""


@dataclass(frozen=True, slots=True)
class SegmentDownloaded:
    """Response: a segment was accepted."""

    toggle: bool


@dataclass(frozen=True, slots=True)
class Uploaded(Named):
    """Response: the object's value, of 1 to 4 bytes."""

    data: bytes


@dataclass(frozen=True, slots=True)
class UploadStart(Named):
    """Response: the object is longer than 4 bytes, and is read in segments."""

    size: int | None


@dataclass(frozen=True, slots=True)
class UploadedSegment:
    """Response: a segment of up to 7 bytes."""

    toggle: bool
    data: bytes
    last: bool


Request: TypeAlias = Download | DownloadStart | DownloadSegment | Upload | UploadSegment
Response: TypeAlias = Downloaded | SegmentDownloaded | Uploaded | UploadStart | UploadedSegment | Abort

ABORT = 0x80
HEAD = struct.Struct("<BHB4s")
"""Command, index, subindex, and data or a size."""
_LONG = struct.Struct("<BHBI")


def encode(message: Request) -> bytes:
    """Encode a request. ValueError if its data do not fit."""
    if isinstance(message, Upload):  # the bulk of all traffic, without the cost of a match
        return _LONG.pack(0x40, message.index, message.sub, 0)
    if isinstance(message, Download):
        size = len(message.data)
        if not 1 <= size <= EXPEDITED:
            raise ValueError(f"{size} bytes are no expedited transfer")
        return HEAD.pack(0x23 | (EXPEDITED - size) << 2, message.index, message.sub, message.data)
    match message:
        case DownloadStart(index, sub, size):
            return _LONG.pack(0x21, index, sub, size)
        case DownloadSegment(toggle, data, last):
            if len(data) > SEGMENT:
                raise ValueError(f"{len(data)} bytes do not fit into a segment")
            command = toggle << 4 | (SEGMENT - len(data)) << 1 | last
            return bytes((command,)) + data.ljust(SEGMENT, b"\0")
        case UploadSegment(toggle):
            return bytes((0x60 | toggle << 4, 0, 0, 0, 0, 0, 0, 0))


def decode_response(data: bytes) -> Response | None:
    """Decode a response; None if it is malformed. Expedited data without a size are four bytes."""
    if len(data) != SIZE:
        return None
    command, index, sub, rest = HEAD.unpack(data)
    match command >> 5:
        case 2 if command & 2:
            return Uploaded(index, sub, rest[: EXPEDITED - (command >> 2 & 3)] if command & 1 else rest)
        case 3:
            return Downloaded(index, sub)
        case 2:
            return UploadStart(index, sub, int.from_bytes(rest, "little") if command & 1 else None)
        case 0:
            segment = data[1 : SIZE - (command >> 1 & 7)]
            return UploadedSegment(bool(command & 0x10), segment, bool(command & 1))
        case 1:
            return SegmentDownloaded(bool(command & 0x10))
        case 4:
            return Abort(index, sub, int.from_bytes(rest, "little"))
    return None


# -- abort codes --------------------------------------------------------------------------------------

TOGGLE = 0x05030000
TIMEOUT = 0x05040000
UNKNOWN_COMMAND = 0x05040001
READ_ONLY = 0x06010002
NO_OBJECT = 0x06020000
NOT_MAPPABLE = 0x06040041
PDO_TOO_LONG = 0x06040042
INCOMPATIBLE = 0x06040043
LENGTH_MISMATCH = 0x06070010
NO_SUBINDEX = 0x06090011
BAD_VALUE = 0x06090030
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
    0x06010001: "the object can only be written",
    READ_ONLY: "the object can only be read",
    NO_OBJECT: "the device has no such object",
    NOT_MAPPABLE: "the object cannot be mapped into a PDO",
    PDO_TOO_LONG: "the mapped objects are longer than a PDO",
    INCOMPATIBLE: "the parameter is incompatible with others",
    0x06040047: "internal incompatibility of the device",
    0x06060000: "the device's hardware failed",
    LENGTH_MISMATCH: "the length does not match the object's type",
    0x06070012: "the value is too long for the object's type",
    0x06070013: "the value is too short for the object's type",
    NO_SUBINDEX: "the object has no such subindex",
    BAD_VALUE: "the value is outside the object's range",
    0x06090031: "the value is too high",
    0x06090032: "the value is too low",
    0x06090036: "the maximum is below the minimum",
    0x060A0023: "the object has no value now",
    GENERAL: "general error",
    0x08000020: "the value cannot be transferred or stored",
    0x08000021: "the device is under local control",
    DEVICE_STATE: "the device's present state does not allow it",
    0x08000023: "the device has no object dictionary",
    NO_DATA: "there are no data",
}


def abort_text(code: int) -> str:
    """Return the meaning of an abort code, with its number."""
    return f"{ABORTS.get(code, 'an unknown reason')} (SDO abort {code:#010x})"
