"""Lengths, durations and arbitration priority of CAN, CAN FD and serial frames: exact, bit by bit.

Source: ISO 11898-1:2015: frame formats, data length code, cyclic redundancy check (polynomial 0x4599 in
classic CAN), bit stuffing. A CAN FD frame's CRC has its stuff bits at fixed places, so its value is not
needed.
"""

from __future__ import annotations

from bisect import bisect_left
from dataclasses import replace
from functools import lru_cache

from protocols.frames import CanFrame, Frame
from protocols.messages import SECOND, Nanos

LENGTHS = (0, 1, 2, 3, 4, 5, 6, 7, 8, 12, 16, 20, 24, 32, 48, 64)
"""Data bytes by CAN FD's data length code; classic CAN has the first nine."""
SERIAL_BITS = 10
"""Bits per byte at 8N1: start, eight data, stop."""
INTERFRAME_BITS = 3
"""The bits of the interframe space, during which no frame begins."""
_TRAILER_BITS = 1 + 1 + 7 + INTERFRAME_BITS
"""Acknowledgement, its delimiter, end of frame, interframe space: none is stuffed, nor is the CRC delimiter
before them."""


def padded(frame: CanFrame) -> CanFrame:
    """Return the frame as transmitted: CAN FD data is zero-padded to the next length that has a code."""
    if not frame.fd or not 8 < len(frame.data) <= 64:
        return frame
    length = LENGTHS[bisect_left(LENGTHS, len(frame.data))]
    return frame if length == len(frame.data) else replace(frame, data=frame.data.ljust(length, b"\0"))


def frame_time(frame: Frame, bitrate: int, data_bitrate: int = 0) -> Nanos:
    """Return the duration from the first bit to the end of the interframe space.

    `bitrate` is that of the arbitration phase, or the baud rate; `data_bitrate` that of the data phase of a
    CAN FD frame with bit-rate switch, 0 if the bus has none. Raises ValueError for a rate that is not
    positive."""
    if bitrate <= 0 or data_bitrate < 0:
        raise ValueError(f"a bus of {bitrate} and {data_bitrate} bit/s carries nothing")
    if isinstance(frame, bytes):
        return len(frame) * SERIAL_BITS * SECOND // bitrate
    slow, fast = frame_bits(frame)
    switched = data_bitrate if frame.brs and data_bitrate else bitrate
    return slow * SECOND // bitrate + fast * SECOND // switched


def frame_bits(frame: CanFrame) -> tuple[int, int]:
    """Return the bits sent at the arbitration bit rate, and those at the data bit rate (0 in classic CAN).

    The rate changes at the sample point of BRS, and back at that of the CRC delimiter: a part of each is
    slow, the rest fast. Together they take one bit at each rate, wherever the sample points are: BRS counts
    as slow, the CRC delimiter as fast."""
    if not frame.fd:
        return _classic_bits(frame), 0
    data = padded(frame).data
    code = bisect_left(LENGTHS, len(data))
    bits, width = _id_bits(frame.id, frame.extended)
    # RRS; IDE of a standard frame; FDF, res, BRS | ESI (dominant: error active), length code, data
    rest = 4 if frame.extended else 5
    slow, run = _stuff(bits << rest | 0b100 | frame.brs, width + rest, _START)
    fast, run = _stuff(code, 5, run)
    of_data, run = _stuffed(data, run)
    slow, fast = slow + width + rest, fast + 5 + of_data
    # Stuff count with parity, and CRC: a fixed stuff bit before them, in place of one due behind the data,
    # and after every fourth bit.
    checked = 4 + (21 if len(data) > 16 else 17)
    return slow + _TRAILER_BITS, fast - (run & _JUST_STUFFED) + 1 + checked + checked // 4 + 1


def _classic_bits(frame: CanFrame) -> int:
    """Return the bits of a classic CAN frame."""
    data = frame.data
    code = frame.requested if frame.remote else bisect_left(LENGTHS, len(data))
    count, run, checksum = _head(frame.id, frame.extended, frame.remote, code)
    for byte in data:
        added, run = _STUFFED[run << 8 | byte]
        count += added
        checksum = (checksum << 8 ^ _CHECKSUMS[checksum >> 7 ^ byte]) & 0x7FFF
    of_checksum, run = _stuff(checksum >> 8, 7, run)
    last, _ = _STUFFED[run << 8 | checksum & 0xFF]
    return count + 8 * len(data) + 15 + of_checksum + last + 1 + _TRAILER_BITS


def _id_bits(number: int, extended: bool) -> tuple[int, int]:
    """Return the bits of an id as a number, and how many they are with the start bit."""
    if not extended:
        return number, 12
    # base id; substitute remote and extension bit, both recessive; extension
    return number >> 18 << 20 | 0b11 << 18 | number & 0x3FFFF, 32


@lru_cache(maxsize=1 << 10)
def _head(number: int, extended: bool, remote: bool, code: int) -> tuple[int, int, int]:
    """Return the length of a classic frame up to its length code in bits with their stuff bits, the run after
    them, and the checksum so far."""
    bits, width = _id_bits(number, extended)
    # RTR; IDE and r0, or r1 and r0; length code
    bits, width = (bits << 1 | remote) << 6 | code, width + 7
    checksum = 0  # CRC-15, from the start bit on: zeros in front do not change it
    for byte in bits.to_bytes(5, "big"):
        checksum = (checksum << 8 ^ _CHECKSUMS[checksum >> 7 ^ byte]) & 0x7FFF
    added, run = _stuff(bits, width, _START)
    return width + added, run, checksum


def _stuffed(data: bytes, run: int) -> tuple[int, int]:
    """Return the length of these bytes in bits with their stuff bits, and the run after them."""
    count = 8 * len(data)
    for byte in data:
        added, run = _STUFFED[run << 8 | byte]
        count += added
    return count, run


_JUST_STUFFED = 1
_START = 0
"""A run: the number of equal bits sent last, their value, and whether the last was a stuff bit."""


@lru_cache(maxsize=1 << 14)
def _stuff(bits: int, width: int, run: int) -> tuple[int, int]:
    """Return how many stuff bits are put among and behind these bits, and the run after them."""
    length, last, stuffed = run >> 2, run >> 1 & 1, run & _JUST_STUFFED
    added = 0
    for at in reversed(range(width)):
        bit = bits >> at & 1
        length, last, stuffed = length + 1 if length and bit == last else 1, bit, 0
        if length == 5:
            added += 1
            length, last, stuffed = 1, 1 - bit, _JUST_STUFFED
    return added, length << 2 | last << 1 | stuffed


class _Stuffed(dict[int, tuple[int, int]]):
    """What `_stuff` says of a byte, by the run before it and the byte: filled as they come."""

    def __missing__(self, key: int) -> tuple[int, int]:
        return self.setdefault(key, _stuff(key & 0xFF, 8, key >> 8))


_STUFFED = _Stuffed()


def _byte_checksum(byte: int) -> int:
    """Return classic CAN's CRC-15 of a byte."""
    checksum = byte << 7
    for _ in range(8):
        checksum = checksum << 1 ^ (0x4599 if checksum & 0x4000 else 0)
    return checksum & 0x7FFF


_CHECKSUMS = tuple(map(_byte_checksum, range(256)))


def priority(frame: Frame) -> tuple[int, ...]:
    """Return the arbitration key; the smallest wins (a dominant bit is 0). Serial bytes do not contend."""
    if isinstance(frame, bytes):
        return ()
    if not frame.extended:
        return frame.id, int(frame.remote), 0, 0, 0
    # The base id goes first; there the substitute remote bit and the extension bit, both recessive, lose.
    return frame.id >> 18, 1, 1, frame.id & 0x3FFFF, int(frame.remote)
