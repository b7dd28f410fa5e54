"""What a scan is sent in, beside single nodes: capsules (express, ultra, dense) and packets of HQ.

A capsule begins with two nibbles, A and 5, each with half of its checksum (XOR of all behind them), then
where its first ray is; the others are evenly spaced up to where the next capsule begins:

    express: 16 × (two distances of 14 bits, mm, two offsets of 6 bits, 1/8 degree)
    dense:   40 × distance u16, mm
    ultra:   32 × u32: distance on a scale of 12 bits | two predictions of 10 bits, signed, of the rays
             behind it: from this distance, and from that of the next u32, in the steps of their scale
    HQ:      A5 | time stamp u64 | 96 × (angle, 90/16384 degree, u16 | distance, mm / 4, u32 | quality |
             flags) | CRC-32 of all before it, filled up with three 0

In an ultra scan the ray leaves off the lens's axis: how far it is from the place in the capsule hangs on the
distance (`behind`).

Source: Slamtec/rplidar_sdk@99478e5 (`sdk/include/sl_lidar_cmd.h`, `sdk/src/dataunpacker/unpacker`).
"""

from __future__ import annotations

import math
import struct
from collections.abc import Mapping, Sequence
from functools import cache, lru_cache
from itertools import chain, pairwise
from typing import NamedTuple

from protocols.rplidar.table import RAYS, TURN_Q6, Node
from protocols.toolkit.serial import CRC32, xor8

FARTHEST: Mapping[str, int] = {"express": 0x3FFF, "dense": 0xFFFF}
"""mm"""
SCALES = ((3328, 16384, 4), (1792, 4096, 3), (1280, 2048, 2), (512, 512, 1), (0, 0, 0))
"""Of an ultra capsule: from which number on, what that is [mm], and by how many bits steps are longer"""
NO_RETURN = (0x1FF, -0x200)
"""Of a prediction"""
_PREDICTIONS = [-0x10000 if each in NO_RETURN else each for each in (*range(0x200), *range(-0x200, 0))]
"""By their bits: of what does not return one that is never beyond 0"""
NEAREST_ULTRA = 150
"""mm: what is nearer is so far beside its place that it is no reading (its datasheets begin at 200 mm)."""
SYNC_HQ = 0xA5
_HQ_RAY = struct.Struct("<HIBB")
_EXPRESS, _DENSE = struct.Struct("<" + 16 * "2Hx"), struct.Struct("<40H")
_OFFSETS = [[(high << 4 | low & 0xF) / 8.0 for low in range(0x100)] for high in range(4)]
"""Degrees, by the two bits beside a distance, and the four others, beside which others may be"""


class Capsule(NamedTuple):
    """Rays one after the other; how far they are apart follows from where the next capsule begins."""

    first: bool
    """Of a stream"""
    start: float
    """Degrees, of the first ray"""
    distances: Sequence[int]
    """mm; 0: no return"""
    offsets: Sequence[float]
    """Degrees by which each ray is behind its place; (): none is"""


def begins(held: bytes, at: int, scan: str) -> bool:
    """True if what begins here may be a message of a scan, as far as it has come."""
    if scan == "hq":
        return held[at] == SYNC_HQ
    return held[at] >> 4 == 0xA and (len(held) == at + 1 or held[at + 1] >> 4 == 0x5)


def is_sound(data: bytes, scan: str) -> bool:
    """True if the checksum of a message of a scan is right."""
    if scan == "hq":
        return CRC32(data[:-4] + bytes(3)) == int.from_bytes(data[-4:], "little")
    return xor8(data[2:]) == data[0] & 0xF | data[1] << 4 & 0xF0


def head(data: bytes) -> tuple[bool, float]:
    """Return whether a capsule is the first of its stream, and where its first ray is [degrees]."""
    word = data[2] | data[3] << 8
    return word >= 0x8000, (word & 0x7FFF) / 64.0 % 360.0


def rays(data: bytes, scan: str, after: bytes = b"") -> tuple[Sequence[int], Sequence[float]]:
    """Return the distances [mm] of a capsule, and by how many degrees each ray is behind its place; (): none
    is. `after` is the next capsule, without which the last two rays of an ultra one are not known."""
    if scan == "dense":
        return _DENSE.unpack_from(data, 4), ()
    if scan == "ultra":
        found = _ultra(data, after)
        return found, [*map(behind, found)]
    words, lows = _EXPRESS.unpack_from(data, 4), data[8::5]
    sixes = chain.from_iterable(zip(lows, [low >> 4 for low in lows], strict=True))
    offsets = [_OFFSETS[word & 3][low] for word, low in zip(words, sixes, strict=True)]
    return [word >> 2 for word in words], offsets


def encode_capsule(one: Capsule, scan: str, after: int = 0) -> bytes:
    """Return a capsule as it stands on the line. What is out of reach is no return. `after` is the first
    distance of the next [mm], for an ultra capsule, whose offsets are those of `behind`."""
    body = struct.pack("<H", round(one.start * 64.0) % TURN_Q6 | (0x8000 if one.first else 0))
    found = [each if each <= FARTHEST.get(scan, each) else 0 for each in one.distances]
    if scan == "ultra":
        body += struct.pack("<32I", *_cabins(found, after))
    elif scan == "dense":
        body += struct.pack("<40H", *found)
    else:
        eighths = [round(each * 8.0) for each in one.offsets] or [0] * len(found)
        for a, b, p, q in zip(found[::2], found[1::2], eighths[::2], eighths[1::2], strict=True):
            body += struct.pack("<HHB", a << 2 | p >> 4, b << 2 | q >> 4, p & 0xF | (q & 0xF) << 4)
    check = xor8(body)
    return bytes((0xA0 | check & 0xF, 0x50 | check >> 4)) + body


# -- ultra -----------------------------------------------------------------------------------------------


@lru_cache(1 << 15)
def behind(distance: int) -> float:
    """Return by how many degrees a ray of an ultra scan is behind its place, by its distance [mm]."""
    if distance < 50:
        return 7.5
    near = 98361 // (4 * distance)
    return 8.0 - math.degrees(((near << 6) + near**3 // 98304) / 65536.0)


@cache
def _scale() -> Sequence[tuple[int, int]]:
    """Return, by number, a distance [mm], and by how many bits the steps are longer there."""
    rows = (next(each for each in SCALES if code >= each[0]) for code in range(0x1000))
    return [(target + (code - base << bits), bits) for code, (base, target, bits) in enumerate(rows)]


def _scaled(distance: int) -> int:
    base, target, bits = next(each for each in SCALES if distance >= each[1])
    return min(base + (distance - target >> bits), 0xFFF)


def _ultra(data: bytes, after: bytes) -> list[int]:
    """Return the distances of an ultra capsule [mm]; what is too near is no reading."""
    words = [*struct.unpack_from("<32I", data, 4), *struct.unpack_from("<I", after or bytes(8), 4)]
    found: list[int] = []
    scale, steps, least = _scale(), _PREDICTIONS, NEAREST_ULTRA
    here, finer = scale[words[0] & 0xFFF]
    for word, then in pairwise(words):
        there, bits = scale[then & 0xFFF]
        one, other = steps[word >> 12 & 0x3FF], steps[word >> 22]
        near = there + (one << bits) if there and not here else here + (one << finer)
        far = there + (other << bits)
        found += here if here >= least else 0, near if near >= least else 0, far if far >= least else 0
        here, finer = there, bits
    return found if after else [*found[:-2], found[-2] if words[-2] & 0xFFF else 0, 0]


def _cabins(distances: Sequence[int], after: int) -> list[int]:
    """Return the words of an ultra capsule."""
    words: list[int] = []
    majors, scale = [_scaled(each) for each in (*distances[::3], after)], _scale()
    for at, (major, then) in enumerate(pairwise(majors)):
        here, there = scale[major], scale[then]
        word, bases = major, (here if here[0] or not there[0] else there, there)
        for (base, bits), shift, distance in zip(bases, (12, 22), distances[3 * at + 1 :], strict=False):
            code = distance - base >> bits
            good = distance and NO_RETURN[1] < code < NO_RETURN[0]
            word |= ((code if good else NO_RETURN[0]) & 0x3FF) << shift
        words.append(word)
    return words


# -- HQ --------------------------------------------------------------------------------------------------


def packet(data: bytes) -> tuple[list[float], list[float]]:
    """Return the angles [degrees] and distances [mm] of a packet of HQ."""
    numbers = struct.unpack_from("<" + RAYS["hq"] * "HI2x", data, 9)
    return [each * 90.0 / 16384.0 for each in numbers[::2]], [each / 4.0 for each in numbers[1::2]]


def encode_packet(stamp: int, rays: Sequence[Node]) -> bytes:
    """Return a packet of HQ as it stands on the line, with its time stamp [µs]."""
    data = bytes((SYNC_HQ,)) + struct.pack("<Q", stamp)
    for one in rays:
        angle = round(one.angle * 16384.0 / 90.0) & 0xFFFF
        data += _HQ_RAY.pack(angle, round(one.distance * 4.0), one.quality, 1 if one.first else 2)
    assert len(rays) == RAYS["hq"]
    return data + CRC32(data + bytes(3)).to_bytes(4, "little")
