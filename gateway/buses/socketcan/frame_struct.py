"""The kernel's `struct can_frame` and `struct canfd_frame` (linux/can.h): frames <-> bytes. Pure functions.

Rules. A CAN FD frame is told from a classic one by its size alone, 72 bytes against 16. What goes out as CAN
FD is padded with zeros to the next length that there is (ISO 11898-1: 0 to 8, 12, 16, 20, 24, 32, 48, 64).
"""

from __future__ import annotations

import struct

from gateway.buses.can_errors import CanError
from gateway.buses.lengths import padded
from protocols.frames import CanFrame

CLASSIC = struct.Struct("=IB3x8s")
"""can_id, len, pad, data."""
FD = struct.Struct("=IBB2x64s")
"""can_id, len, flags, reserved, data."""
HEAD = struct.Struct("=IBB")
EXTENDED, REMOTE, ERROR = 0x8000_0000, 0x4000_0000, 0x2000_0000
"""Flags in can_id."""
ID, BASE_ID = 0x1FFF_FFFF, 0x7FF
BRS, FDF = 0x01, 0x04
"""Flags of a CAN FD frame: switched bit rate; CAN FD at all (newer kernels set it)."""


def pack(frame: CanFrame) -> bytes:
    """What a raw CAN socket takes. Raises ValueError for what no frame of its kind can carry."""
    data, can_id = frame.data, frame.id
    if can_id > (ID if frame.extended else BASE_ID) or can_id < 0:
        raise ValueError(f"{frame} has an id that its format cannot carry")
    if len(data) > (64 if frame.fd else 8):
        raise ValueError(f"{frame} carries {len(data)} bytes")
    if frame.extended:
        can_id |= EXTENDED
    if frame.fd:
        data = padded(frame).data
        return FD.pack(can_id, len(data), FDF | (BRS if frame.brs else 0), data)
    if frame.remote:
        return CLASSIC.pack(can_id | REMOTE, 0, b"")
    return CLASSIC.pack(can_id, len(data), data)


def unpack(raw: bytes) -> CanFrame | CanError | None:
    """A frame, or what the controller says of itself; None if it is neither."""
    size = len(raw)
    if size not in (CLASSIC.size, FD.size):
        return None
    can_id, length, flags = HEAD.unpack_from(raw)
    fd = size == FD.size
    if length > (64 if fd else 8):
        return None
    if can_id & ERROR:
        return CanError(can_id & ID, raw[8:16])
    extended = can_id & EXTENDED != 0
    number = can_id & (ID if extended else BASE_ID)
    if fd:
        return CanFrame(number, raw[8 : 8 + length], extended, False, True, flags & BRS != 0)
    if can_id & REMOTE:
        return CanFrame(number, b"", extended, True)
    return CanFrame(number, raw[8 : 8 + length], extended)
