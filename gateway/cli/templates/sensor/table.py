"""The packets of the device.

FILL IN, this file first, from the manual: how a packet begins and ends, its fields and units. The clauses
"bytes", "counts", "streams" and "checksums" check them. The invented device is an inertial sensor:

    A5 5A | number, u8 | angular rates x, y, z | accelerations x, y, z, i16 each | CRC-16

17 bytes, little-endian, 100 times a second.
"""

from __future__ import annotations

import struct
from typing import NamedTuple

from protocols.messages import MILLISECOND, Nanos
from protocols.toolkit.serial import CRC16_XMODEM, Framing

NAME = "blank"
PERIOD: Nanos = 10 * MILLISECOND
RATE_UNIT, PUSH_UNIT = 1e-3, 5e-3
"""rad/s, m/s²"""
ENDS = (-32768, 32767)
"""Counts of what may as well be beyond"""
PACKET_BYTES = 17
_LAYOUT, _SYNC = struct.Struct("<2sB6h"), b"\xa5\x5a"
FRAMING = Framing(_SYNC, len(_SYNC), lambda _: _LAYOUT.size - len(_SYNC), CRC16_XMODEM, 2)


class Packet(NamedTuple):
    """What one packet says, in counts."""

    number: int
    rates: tuple[int, int, int]
    pushes: tuple[int, int, int]


def encode(packet: Packet) -> bytes:
    """Return a packet as it stands on the line."""
    return FRAMING.frame(_LAYOUT.pack(_SYNC, packet.number, *packet.rates, *packet.pushes))


def decode(message: bytes) -> Packet:
    """Decode a packet without its checksum."""
    _, number, a, b, c, x, y, z = _LAYOUT.unpack(message)
    return Packet(number, (a, b, c), (x, y, z))
