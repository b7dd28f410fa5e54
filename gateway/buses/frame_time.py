"""Lengths, durations and arbitration priority of CAN, CAN FD and serial frames. Pure functions.

Sources: ISO 11898-1:2015, frame formats and data length code; worst-case bit stuffing as in Davis, Burns,
Bril and Lukkien, "Controller Area Network (CAN) schedulability analysis: refuted, revisited and revised",
2007, eq. 1.
"""

from __future__ import annotations

from bisect import bisect_left
from dataclasses import replace

from protocols.frames import CanFrame, Frame
from protocols.messages import SECOND, Nanos

LENGTHS = (0, 1, 2, 3, 4, 5, 6, 7, 8, 12, 16, 20, 24, 32, 48, 64)
"""Data bytes by CAN FD's data length code; classic CAN has the first nine."""
SERIAL_BITS = 10
"""Bits per byte at 8N1: start, eight data, stop."""


def padded(frame: CanFrame) -> CanFrame:
    """Return the frame as transmitted: CAN FD data is zero-padded to the next length that has a code."""
    if not frame.fd or not 8 < len(frame.data) <= 64:
        return frame
    length = LENGTHS[bisect_left(LENGTHS, len(frame.data))]
    return frame if length == len(frame.data) else replace(frame, data=frame.data.ljust(length, b"\0"))


def frame_time(frame: Frame, bitrate: int, data_bitrate: int = 0) -> Nanos:
    """Return the duration from the first bit to the end of the interframe space, with worst-case stuffing.

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
    """Return the bits sent at the arbitration bit rate, and those at the data bit rate (0 in classic CAN)."""
    if not frame.fd:
        stuffed = (54 if frame.extended else 34) + 8 * len(frame.data)
        return stuffed + 13 + (stuffed - 1) // 4, 0
    # Arbitration phase: start to BRS with stuff bits; CRC delimiter, ACK, end of frame and interframe space.
    # Data phase: ESI, DLC and data with stuff bits; then stuff count and CRC, with a fixed stuff bit in front
    # and after every fourth bit.
    head = 36 if frame.extended else 17
    length = len(padded(frame).data)
    crc = 21 if length > 16 else 17
    data = 5 + 8 * length
    checked = 4 + crc
    return head + (head - 1) // 4 + 13, data + data // 4 + checked + 1 + checked // 4


def priority(frame: Frame) -> tuple[int, ...]:
    """Return the arbitration key; the smallest wins (a dominant bit is 0). Serial bytes do not contend."""
    if isinstance(frame, bytes):
        return ()
    if not frame.extended:
        return frame.id, int(frame.remote), 0, 0, 0
    # The base id goes first; there the substitute remote bit and the extension bit, both recessive, lose.
    return frame.id >> 18, 1, 1, frame.id & 0x3FFFF, int(frame.remote)
