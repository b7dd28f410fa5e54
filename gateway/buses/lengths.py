"""How long the data of a CAN frame can be (ISO 11898-1:2015, data length code). Pure."""

from __future__ import annotations

from bisect import bisect_left
from dataclasses import replace

from protocols.frames import CanFrame

LENGTHS = (0, 1, 2, 3, 4, 5, 6, 7, 8, 12, 16, 20, 24, 32, 48, 64)
"""Bytes of data by CAN FD's length code; classic CAN has the first nine."""


def padded(frame: CanFrame) -> CanFrame:
    """A frame as it stands on the wire: CAN FD data that no length code fits are filled up with zeros."""
    if not frame.fd or not 8 < len(frame.data) <= 64:
        return frame
    length = LENGTHS[bisect_left(LENGTHS, len(frame.data))]
    return frame if length == len(frame.data) else replace(frame, data=frame.data.ljust(length, b"\0"))
