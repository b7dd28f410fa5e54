"""The packet of LDROBOT's lidars, in its own units: degrees clockwise from ahead, millimetres, milliseconds.

A packet has the turn's speed, the angles of its first and last ray, twelve rays, evenly spaced between these,
and the time of the last. All numbers are little-endian; the checksum is the last of 47 bytes:

    54 2C | speed, °/s, u16 | start, 0.01°, u16 | 12 × (distance, mm, u16 | intensity u8) | end, 0.01°, u16 |
    timestamp, ms, u16, 0 … 29999 | CRC-8 of all before it

Source: LD06 Development manual v1.0, LD19 Development manual v2.5 (LDROBOT).
"""

from __future__ import annotations

import struct
from collections.abc import Sequence
from typing import NamedTuple

from protocols.toolkit.serial import Framing, crc

NAME = "ld06"
RAYS = 12
"""Of a packet"""
TURN = 36_000
"""0.01°"""
ROUND = 30_000
"""ms after which the timestamp begins anew"""
FARTHEST = 0xFFFF
"""mm"""
PACKET_BYTES = 47
CRC8 = crc(8, 0x4D, reflected=False)
_LAYOUT, _RANGES = (struct.Struct("<2sHH" + RAYS * ray + "HH") for ray in ("HB", "Hx"))
_SYNC = b"\x54\x2c"
FRAMING = Framing(_SYNC, len(_SYNC), lambda _: _LAYOUT.size - len(_SYNC), CRC8, 1)


class Packet(NamedTuple):
    """What one packet says."""

    speed: int
    """°/s"""
    start: int
    """0.01°"""
    distances: Sequence[int]
    """mm; 0: no return"""
    intensities: bytes
    end: int
    """0.01°"""
    stamp: int
    """ms"""

    @property
    def step(self) -> float:
        """Degrees from one ray to the next."""
        return (self.end - self.start) % TURN / 100.0 / (RAYS - 1)


def encode(packet: Packet) -> bytes:
    """Return a packet as it stands on the line."""
    rays = [number for ray in zip(packet.distances, packet.intensities, strict=True) for number in ray]
    return FRAMING.frame(_LAYOUT.pack(_SYNC, packet.speed, packet.start, *rays, packet.end, packet.stamp))


def decode(message: bytes) -> Packet | None:
    """Decode a packet without its checksum; None if it has an angle or a time that there is not."""
    _, speed, start, *distances, end, stamp = _RANGES.unpack(message)
    if start >= TURN or end >= TURN or stamp > ROUND:  # whether 30000 itself comes is uncertain
        return None
    return Packet(speed, start, distances, message[8:-4:3], end, stamp)
