"""The packet of a BNO080, BNO085 or BNO086 in its mode UART-RVC, in its own units: 0.01°, mg.

    AA AA | index, u8 | yaw | pitch | roll | acceleration x | y | z, i16 each | 3 reserved | sum

The sum is that of all behind AA AA.

19 bytes, little-endian, 100 times a second with 115,200 baud.

Source: adafruit-circuitpython-bno08x-rvc 1.0.24; BNO08X datasheet, from memory.
"""

from __future__ import annotations

import struct
from dataclasses import dataclass
from typing import NamedTuple

from protocols.messages import MILLISECOND, Nanos
from protocols.toolkit.motor_driver import Rx
from protocols.toolkit.serial import Framing, sum8

NAME = "bno08x"
BAUDRATE = 115_200
PERIOD: Nanos = 10 * MILLISECOND
SYNC = b"\xaa\xaa"
PACKET_BYTES = 19
ROUND = 256
"""Packets after which the index begins anew"""
MG = 9.80665e-3
"""m/s²"""
ENDS = (-32768, 32767)
"""Counts of what may as well be beyond"""
_LAYOUT = struct.Struct("<2sB6h3s")


_FRAMING = Framing(SYNC, len(SYNC), lambda _: _LAYOUT.size - len(SYNC), sum8, 1, covers=len(SYNC))


@dataclass(frozen=True, slots=True)
class Packets:
    """How packets stand on the line. The bytes of a sync may be those of the next: behind some that are left
    over, it is the last two of a row of AA that begin one."""

    def frame(self, message: bytes) -> bytes:
        """Return a packet as it stands on the line."""
        return _FRAMING.frame(message)

    def read(self, held: bytes, at: int) -> tuple[bytes | Rx | None, int]:
        """Return what begins here, and where the search goes on, as every `FrameFormat`."""
        found, end = _FRAMING.read(held, at)
        if found is Rx.MALFORMED and held[at + len(SYNC)] == SYNC[0]:
            return Rx.IGNORED, end
        return found, end


FRAMING = Packets()


class Packet(NamedTuple):
    """What one packet says."""

    number: int
    yaw: int
    pitch: int
    roll: int
    """0.01°"""
    x: int
    y: int
    z: int
    """mg, gravity included"""


def encode(packet: Packet) -> bytes:
    """Return a packet as it stands on the line."""
    return FRAMING.frame(_LAYOUT.pack(SYNC, *packet, bytes(3)))


def decode(message: bytes) -> Packet | None:
    """Decode a packet without its checksum; None if it has an angle that there is not."""
    _, *numbers, _ = _LAYOUT.unpack(message)
    packet = Packet(*numbers)
    most = 18_000, 9_000, 18_000
    angles = packet.yaw, packet.pitch, packet.roll
    return packet if all(abs(each) <= end for each, end in zip(angles, most, strict=True)) else None
