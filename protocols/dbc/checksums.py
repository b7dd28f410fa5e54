"""Checksums of CAN messages, as files that describe them leave them to be known.

Rules. Each is of the whole data, with the bits of the checksum itself at 0, and is cut to the width of its
signal. Those over bytes leave out the byte that the checksum is in.

Source: SAE J1850 and AUTOSAR CRC Library (CRC-8 and CRC-8H2F, whose parameters are those of the CRC RevEng
catalogue); commaai/opendbc@64d13ef for Honda's, Toyota's and the comma body's.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from functools import cache, partial, reduce
from operator import xor
from typing import TypeAlias

Checksum: TypeAlias = Callable[[int, bool, bytes, int], int]
"""From the id, whether it has 29 bits, the data and the place of the byte with the checksum."""


@cache
def _table(polynomial: int) -> tuple[int, ...]:
    found = []
    for byte in range(256):
        for _ in range(8):
            byte = (byte << 1) ^ polynomial if byte & 0x80 else byte << 1
        found.append(byte & 0xFF)
    return tuple(found)


def _crc(polynomial: int, end: int, data: Iterable[int]) -> int:
    """Return a CRC of 8 bits that begins with FFh."""
    table = _table(polynomial)
    return reduce(lambda crc, byte: table[crc ^ byte], data, 0xFF) ^ end


def _others(data: bytes, at: int) -> bytes:
    return data[:at] + data[at + 1 :]


def _crc8(polynomial: int, number: int, extended: bool, data: bytes, at: int) -> int:
    return _crc(polynomial, 0xFF, _others(data, at))


def _comma(number: int, extended: bool, data: bytes, at: int) -> int:
    return _crc(0xD5, 0, reversed(_others(data, at)))


def _sum(number: int, extended: bool, data: bytes, at: int) -> int:
    return sum(data)


def _xor(number: int, extended: bool, data: bytes, at: int) -> int:
    return reduce(xor, data, 0)


def _toyota(number: int, extended: bool, data: bytes, at: int) -> int:
    return sum(number.to_bytes(4, "big")) + len(data) + sum(data)


def _honda(number: int, extended: bool, data: bytes, at: int) -> int:
    nibbles = sum(int(digit, 16) for digit in f"{number:x}{data.hex()}")
    return 8 - nibbles + (3 if extended else 0)


CHECKSUMS: Mapping[str, Checksum] = {
    "sum": _sum,
    "xor": _xor,
    "crc8_j1850": partial(_crc8, 0x1D),
    "crc8_autosar": partial(_crc8, 0x2F),
    "toyota": _toyota,
    "honda": _honda,
    "comma": _comma,
}
"""By the name in a robot file. "sum" and "xor": of all bytes. "crc8_j1850": polynomial 1Dh,
"crc8_autosar": 2Fh, both from FFh, inverted. "toyota": sum of the id's bytes, the length and the data.
"honda": 8 less the sum of all nibbles, 3 more with an id of 29 bits. "comma": polynomial D5h from FFh, the
last byte first."""
