"""CAN and CAN FD frames laid out bit by bit, as ISO 11898-1:2015 describes them.

Shares nothing with `gateway.buses.frame_time`, which it judges: all bits are written, with the CRC and, in
CAN FD, with the stuff-bit counter and the fixed stuff bits, and each takes its time.
"""

from __future__ import annotations

from dataclasses import dataclass
from fractions import Fraction

from protocols.frames import CanFrame

CRC_15 = (15, 14, 10, 8, 7, 4, 3, 0)
CRC_17 = (17, 16, 14, 13, 11, 6, 4, 3, 1, 0)
CRC_21 = (21, 20, 13, 11, 7, 4, 3, 0)
"""Powers of x in the generator polynomials."""
STUFF_COUNT = ("0000", "0011", "0110", "0101", "1100", "1111", "1010", "1001")
"""Stuff-bit counter, modulo 8: Gray code, and a bit for even parity."""
TAIL = "0" + "1" + 7 * "1" + 3 * "1"
"""Acknowledgement and its delimiter, end of frame, interframe space."""
SAMPLE_POINTS = (Fraction(4, 5), Fraction(7, 10))
"""Of a bit in the arbitration phase, and in the data phase."""


@dataclass(frozen=True)
class Layout:
    """The bits of a frame in the order sent, from its start bit to the end of the interframe space."""

    bits: str
    stuffed: int
    """How many of them are stuff bits, but the fixed ones."""
    brs: int | None = None
    """Place of a recessive BRS,"""
    delimiter: int = 0
    """and of the CRC delimiter."""

    def duration(
        self, nominal: Fraction, data: Fraction, sample_points: tuple[Fraction, Fraction] = SAMPLE_POINTS
    ) -> Fraction:
        """How long it takes, by the duration of a bit in either phase.

        The phase changes at the sample point of BRS, and of the CRC delimiter."""
        if self.brs is None:
            return len(self.bits) * nominal
        slow, fast = sample_points
        brs = slow * nominal + (1 - fast) * data
        delimiter = fast * data + (1 - slow) * nominal
        before, between = self.brs, self.delimiter - self.brs - 1
        after = len(self.bits) - self.delimiter - 1
        return before * nominal + brs + between * data + delimiter + after * nominal


def layout(frame: CanFrame) -> Layout:
    """Lay out a frame whose data has a length that can be sent."""
    return fd_layout(frame) if frame.fd else classic_layout(frame)


def classic_layout(frame: CanFrame) -> Layout:
    """A frame of classic CAN: stuffed from the start bit to the end of the CRC."""
    plain = "0" + identifier(frame) + str(int(frame.remote)) + "00" + content(frame)
    plain += remainder(plain, CRC_15, 0)
    bits = stuffed(plain + "1")  # the CRC delimiter is none of them, but one may be due before it
    return Layout(bits + TAIL, len(bits) - len(plain) - 1)


def fd_layout(frame: CanFrame) -> Layout:
    """A frame of CAN FD: stuffed to the end of the data, then a fixed stuff bit before each four bits."""
    head = "0" + identifier(frame) + ("0" if frame.extended else "00") + "10" + str(int(frame.brs))
    plain = head + "0" + content(frame)  # RRS, IDE of 11 bits, FDF, res, BRS | ESI
    bits = stuffed(plain)
    added = len(bits) - len(plain)
    count = STUFF_COUNT[added % 8]
    checked = count + remainder(bits + count, CRC_21 if len(frame.data) > 16 else CRC_17, 1)
    for at in range(0, len(checked), 4):
        bits += "10"[int(bits[-1])] + checked[at : at + 4]
    return Layout(bits + "1" + TAIL, added, len(stuffed(head)) - 1 if frame.brs else None, len(bits))


def identifier(frame: CanFrame) -> str:
    """Eleven bits; or these, SRR, IDE and 18 more."""
    return f"{frame.id >> 18:011b}11{frame.id & 0x3FFFF:018b}" if frame.extended else f"{frame.id:011b}"


def content(frame: CanFrame) -> str:
    """Data length code and data."""
    code = (0, 1, 2, 3, 4, 5, 6, 7, 8, 12, 16, 20, 24, 32, 48, 64).index(frame.requested or len(frame.data))
    return f"{code:04b}" + "".join(f"{byte:08b}" for byte in frame.data)


def stuffed(bits: str) -> str:
    """The bits, with one of the other value between five equal ones and what follows them."""
    sent = ""
    for bit in bits:
        if sent[-5:] in ("00000", "11111"):
            sent += "10"[int(sent[-1])]
        sent += bit
    return sent


def remainder(bits: str, powers: tuple[int, ...], first: int) -> str:
    """The remainder of a division, as on paper; `first`: the highest bit of the register to begin with."""
    width = powers[0]
    rest = [*map(int, bits), *[0] * width]
    rest[0] ^= first
    for at in range(len(bits)):
        if rest[at]:
            for power in powers:
                rest[at + width - power] ^= 1
    return "".join(map(str, rest[-width:]))
