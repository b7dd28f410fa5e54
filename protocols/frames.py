"""Frames: what is transferred on a bus, and the states of a bus. Values only."""

from __future__ import annotations

from collections.abc import Container, Iterable
from enum import StrEnum
from typing import TypeAlias

from protocols.messages import Nanos, value


@value
class CanFrame:
    """A CAN frame; `fd` marks CAN FD (up to 64 data bytes), `brs` its bit-rate switch."""

    id: int
    data: bytes = b""
    extended: bool = False
    remote: bool = False
    """A remote frame (RTR) requests data and carries none; its `data` is empty."""
    fd: bool = False
    brs: bool = False
    requested: int = 0
    """Bytes of data that a remote frame asks for; 0 of any other."""

    def __str__(self) -> str:
        """Return candump's notation: `123#DEADBEEF`, `123#R`, `123#R8`, `12345678##1DEADBEEF`."""
        head = f"{self.id:08X}" if self.extended else f"{self.id:03X}"
        if self.remote:
            return f"{head}#R{self.requested or ''}"
        return f"{head}{f'##{int(self.brs)}' if self.fd else '#'}{self.data.hex().upper()}"


EXTENDED_BIT = 1 << 31
"""The bit of an id's number that gives its format, as in the kernel's filters (1: 29 bits)."""
ID_BITS = EXTENDED_BIT | 0x1FFF_FFFF
"""The mask of one id alone."""
IdMask: TypeAlias = tuple[int, int]
"""CAN ids as (id, mask), both with `EXTENDED_BIT`: all whose masked bits equal those of the first number."""


def id_number(frame: CanFrame) -> int:
    """Return the id of a frame with the bit of its format."""
    return frame.id | EXTENDED_BIT if frame.extended else frame.id


def exact(number: int, extended: bool = False) -> IdMask:
    """Return one id alone."""
    return (number | EXTENDED_BIT if extended else number), ID_BITS


def id_matches(ids: IdMask, frame: CanFrame | int) -> bool:
    """True if a frame, or a number with the bit of its format, is among these ids."""
    number = frame if isinstance(frame, int) else id_number(frame)
    return (number ^ ids[0]) & ids[1] == 0


def any_matches(choices: Iterable[IdMask], frame: CanFrame | int) -> bool:
    """True if a frame, or a number with the bit of its format, is among any of these ids."""
    number = frame if isinstance(frame, int) else id_number(frame)
    return any((number ^ ids) & mask == 0 for ids, mask in choices)


class IdSet:
    """Many ids, to be looked up quickly: by mask."""

    def __init__(self, choices: Iterable[IdMask]) -> None:
        self._by_mask: dict[int, set[int]] = {}
        for number, mask in choices:
            self._by_mask.setdefault(mask, set()).add(number & mask)

    def __contains__(self, number: int) -> bool:
        """True if a number, with the bit of its format, is among them."""
        for mask, values in self._by_mask.items():  # noqa: SIM110 -- a generator takes twice as long
            if number & mask in values:
                return True
        return False


def overlap(one: IdMask, other: IdMask) -> bool:
    """True if there is an id that both contain."""
    return (one[0] ^ other[0]) & one[1] & other[1] == 0


Frame: TypeAlias = CanFrame | bytes
"""One CAN frame, or any run of serial bytes (a piece of a stream, cut anywhere)."""


OF_BYTES = "serial", "i2c", "camera"
"""Kinds of bus that carry bytes: a serial line; I²C, whose frames are transfers (`protocols.toolkit.i2c`);
and a camera, whose frames are what it saw."""

FD_LENGTHS = frozenset({*range(9), 12, 16, 20, 24, 32, 48, 64})
"""Data bytes that a frame of CAN FD can have."""


def malformed(frame: Frame, kind: str) -> str:
    """Return why a frame cannot be sent on a bus of this kind (`BusSettings.kind`); "" if it can."""
    if not isinstance(frame, CanFrame):
        return "" if kind in OF_BYTES else "bytes on a CAN bus"
    if kind in OF_BYTES:
        return "a CAN frame on a serial line"
    if not 0 <= frame.id <= (0x1FFF_FFFF if frame.extended else 0x7FF):
        return f"an id of more than {29 if frame.extended else 11} bits"
    if frame.fd:
        if kind != "canfd":
            return "a frame of CAN FD on a classic bus"
        return "a remote frame of CAN FD" if frame.remote else _wrong_length(frame.data, FD_LENGTHS)
    if frame.brs or (frame.remote and frame.data):
        return "a bit-rate switch in a classic frame" if frame.brs else "a remote frame with data"
    if not 0 <= frame.requested <= 8 * frame.remote:
        return f"{frame.requested} bytes of data asked for"
    return _wrong_length(frame.data, range(9))


def _wrong_length(data: bytes, lengths: Container[int]) -> str:
    return "" if len(data) in lengths else f"{len(data)} bytes of data"


@value
class Packet:
    """A frame on a bus, and its time: of reception (stamped by the bus) or of sending."""

    t: Nanos
    bus: str
    frame: Frame


class BusState(StrEnum):
    """The state of a bus. Reported on change only."""

    UP = "up"
    PASSIVE = "passive"
    """Error-passive: it still works, badly."""
    OFF = "off"
    """Bus-off: nothing is transmitted."""
    FULL = "full"
    """The transmit queue is full; the newest command wins, older ones were dropped."""
    GONE = "gone"
    """The interface or port has disappeared."""
    BACK = "back"
    """It has come back after GONE or OFF."""
