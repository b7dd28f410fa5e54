"""How long a wire takes on its bus: bits of a CAN or CAN FD frame, bytes of a serial line. Pure functions.

Sources: ISO 11898-1:2015, frame formats; worst-case bit stuffing as in Davis, Burns, Bril and Lukkien,
"Controller Area Network (CAN) schedulability analysis: refuted, revisited and revised", 2007, eq. 1.
"""

from __future__ import annotations

from gateway.buses.lengths import padded
from protocols.frames import CanFrame, Frame
from protocols.messages import SECOND, Nanos

SERIAL_BITS = 10
"""Of one byte at 8N1: start, eight of data, stop."""


def frame_time(frame: Frame, bitrate: int, data_bitrate: int = 0) -> Nanos:
    """From its first bit to the end of the gap behind it, stuffed as badly as can be.

    `bitrate` is that of the arbitration phase, or the baud rate; `data_bitrate` that of a switched CAN FD
    frame's data phase, 0 if the bus has none. Raises ValueError for a rate that is not positive."""
    if bitrate <= 0 or data_bitrate < 0:
        raise ValueError(f"a bus of {bitrate} and {data_bitrate} bit/s carries nothing")
    if isinstance(frame, bytes):
        return len(frame) * SERIAL_BITS * SECOND // bitrate
    slow, fast = frame_bits(frame)
    switched = data_bitrate if frame.brs and data_bitrate else bitrate
    return slow * SECOND // bitrate + fast * SECOND // switched


def frame_bits(frame: CanFrame) -> tuple[int, int]:
    """Bits at the bit rate of the arbitration, and bits at that of the data phase (0 in classic CAN)."""
    if not frame.fd:
        stuffed = (54 if frame.extended else 34) + 8 * len(frame.data)
        return stuffed + 13 + (stuffed - 1) // 4, 0
    # Arbitration: start to BRS with stuff bits; CRC delimiter, ACK, end and gap. Data: ESI, DLC and data with
    # stuff bits; then stuff count and CRC, with a fixed stuff bit in front and after every fourth bit.
    head = 36 if frame.extended else 17
    length = len(padded(frame).data)
    crc = 21 if length > 16 else 17
    data = 5 + 8 * length
    checked = 4 + crc
    return head + (head - 1) // 4 + 13, data + data // 4 + checked + 1 + checked // 4


def priority(frame: Frame) -> tuple[int, ...]:
    """Who wins the arbitration: the smaller (a dominant bit is 0). Serial bytes do not contend."""
    if isinstance(frame, bytes):
        return ()
    if not frame.extended:
        return frame.id, int(frame.remote), 0, 0, 0
    # The base id goes first; there a substitute remote bit and the extension bit, both recessive, lose.
    return frame.id >> 18, 1, 1, frame.id & 0x3FFFF, int(frame.remote)
