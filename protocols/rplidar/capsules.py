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
from functools import lru_cache
from itertools import pairwise
from typing import NamedTuple

from protocols.rplidar.table import DENSE, EXPRESS, HQ, REPEATS, TURN_Q6, ULTRA, Node
from protocols.toolkit.serial import CRC32, xor8

RAYS: Mapping[int, int] = {EXPRESS: 32, DENSE: 40, ULTRA: 96, HQ: 96}
FARTHEST: Mapping[int, int] = {EXPRESS: 0x3FFF, DENSE: 0xFFFF}
"""mm"""
SCALES = ((3328, 16384, 4), (1792, 4096, 3), (1280, 2048, 2), (512, 512, 1), (0, 0, 0))
"""Of an ultra capsule: from which number on, what that is [mm], and by how many bits steps are longer"""
NO_RETURN = (0x1FF, -0x200)
"""Of a prediction"""
NEAREST_ULTRA = 150
"""mm: what is nearer is so far beside its place that it is no reading (its datasheets begin at 200 mm)."""
SYNC_HQ = 0xA5
_HQ_RAY = struct.Struct("<HIBB")


class Capsule(NamedTuple):
    """Rays one after the other; how far they are apart follows from where the next capsule begins."""

    first: bool
    """Of a stream"""
    start: float
    """Degrees, of the first ray"""
    distances: tuple[int, ...]
    """mm; 0: no return"""
    offsets: tuple[float, ...]
    """Degrees by which each ray is behind its place"""


def is_capsule(held: bytes, at: int) -> bool:
    """True if two bytes here may begin a capsule."""
    return held[at] >> 4 == 0xA and held[at + 1] >> 4 == 0x5


def is_sound(data: bytes) -> bool:
    """True if the checksum of a capsule is right."""
    return xor8(data[2:]) == data[0] & 0xF | data[1] << 4 & 0xF0


def is_sound_hq(data: bytes) -> bool:
    """True if the checksum of a packet of HQ is right."""
    return CRC32(data[:-4] + bytes(3)) == int.from_bytes(data[-4:], "little")


def head(data: bytes) -> tuple[bool, float]:
    """Return whether a capsule is the first of its stream, and where its first ray is [degrees]."""
    (word,) = struct.unpack_from("<H", data, 2)
    return bool(word & 0x8000), (word & 0x7FFF) / 64.0 % 360.0


def capsule(data: bytes, kind: int, after: bytes = b"") -> Capsule:
    """Decode a capsule of an answer of this type; `after` is the next, without which the last two rays of an
    ultra capsule are not known."""
    if kind == DENSE:
        return Capsule(*head(data), struct.unpack_from("<40H", data, 4), (0.0,) * 40)
    if kind == ULTRA:
        found = _ultra(data, after)
        far = tuple(each if each >= NEAREST_ULTRA else 0 for each in found)
        return Capsule(*head(data), far, tuple(behind(each) for each in found))
    rays = list[tuple[int, float]]()
    for one, other, low in struct.iter_unpack("<HHB", data[4:]):
        rays.append((one >> 2, ((one & 3) << 4 | low & 0xF) / 8.0))
        rays.append((other >> 2, ((other & 3) << 4 | low >> 4) / 8.0))
    return Capsule(*head(data), tuple(each for each, _ in rays), tuple(each for _, each in rays))


def encode_capsule(one: Capsule, kind: int, after: int = 0) -> bytes:
    """Return a capsule as it stands on the line. What is out of reach is no return. `after` is the first
    distance of the next [mm], for an ultra capsule, whose offsets are those of `behind`."""
    body = struct.pack("<H", round(one.start * 64.0) % TURN_Q6 | (0x8000 if one.first else 0))
    if kind == ULTRA:
        body += struct.pack("<32I", *_cabins(one.distances, after))
    elif kind == DENSE:
        body += struct.pack("<40H", *_reached(one.distances, kind))
    else:
        found = list(zip(_reached(one.distances, kind), one.offsets, strict=True))
        for at in range(0, len(found), 2):
            (a, later), (b, last) = found[at : at + 2]
            p, q = round(later * 8.0), round(last * 8.0)
            body += struct.pack("<HHB", a << 2 | p >> 4, b << 2 | q >> 4, p & 0xF | (q & 0xF) << 4)
    check = xor8(body)
    return bytes((0xA0 | check & 0xF, 0x50 | check >> 4)) + body


def _reached(distances: Sequence[int], kind: int) -> list[int]:
    return [each if each <= FARTHEST[kind] else 0 for each in distances]


# -- ultra -----------------------------------------------------------------------------------------------


@lru_cache(4096)
def behind(distance: int) -> float:
    """Return by how many degrees a ray of an ultra scan is behind its place, by its distance [mm]."""
    if distance < 50:
        return 7.5
    near = 98361 // (4 * distance)
    return 8.0 - math.degrees(((near << 6) + near**3 // 98304) / 65536.0)


def _unscaled(code: int) -> tuple[int, int]:
    """Return a distance [mm], and by how many bits the steps are longer there."""
    base, target, bits = next(each for each in SCALES if code >= each[0])
    return target + (code - base << bits), bits


def _scaled(distance: int) -> int:
    base, target, bits = next(each for each in SCALES if distance >= each[1])
    return min(base + (distance - target >> bits), 0xFFF)


def _bases(major: int, then: int) -> tuple[tuple[int, int], tuple[int, int]]:
    """Return from what the rays behind a distance are predicted, and in what steps."""
    here, there = _unscaled(major), _unscaled(then)
    return (here if here[0] or not there[0] else there), there


def _ultra(data: bytes, after: bytes) -> list[int]:
    """Return the distances of an ultra capsule [mm]."""
    words = [*struct.unpack_from("<32I", data, 4), *struct.unpack_from("<I", after or bytes(8), 4)]
    found = list[int]()
    for word, then in pairwise(words):
        found.append(_unscaled(word & 0xFFF)[0])
        bases = _bases(word & 0xFFF, then & 0xFFF)
        for (base, bits), shift in zip(bases, (12, 22), strict=True):
            code = (word >> shift & 0x3FF ^ 0x200) - 0x200
            found.append(0 if code in NO_RETURN else max(0, base + (code << bits)))
    return found if after else [*found[:-2], found[-2] if words[-2] & 0xFFF else 0, 0]


def _cabins(distances: Sequence[int], after: int) -> list[int]:
    """Return the words of an ultra capsule."""
    majors = [_scaled(each) for each in (*distances[::3], after)]
    words = list[int]()
    for at, (major, then) in enumerate(pairwise(majors)):
        word, bases = major, _bases(major, then)
        for (base, bits), shift, ray in zip(bases, (12, 22), (1, 2), strict=True):
            distance = distances[3 * at + ray]
            code = distance - base >> bits
            good = distance and NO_RETURN[1] < code < NO_RETURN[0]
            word |= ((code if good else NO_RETURN[0]) & 0x3FF) << shift
        words.append(word)
    return words


# -- HQ --------------------------------------------------------------------------------------------------


def packet(data: bytes) -> list[Node]:
    """Decode a packet of HQ."""
    rays = _HQ_RAY.iter_unpack(data[9:-4])
    return [
        Node(bool(flag & 1), bright, angle * 90.0 / 16384.0, mm / 4.0) for angle, mm, bright, flag in rays
    ]


def encode_packet(stamp: int, rays: Sequence[Node]) -> bytes:
    """Return a packet of HQ as it stands on the line, with its time stamp [µs]."""
    data = bytes((SYNC_HQ,)) + struct.pack("<Q", stamp)
    for one in rays:
        angle = round(one.angle * 16384.0 / 90.0) & 0xFFFF
        data += _HQ_RAY.pack(angle, round(one.distance * 4.0), one.quality, 1 if one.first else 2)
    data += CRC32(data + bytes(3)).to_bytes(4, "little")
    assert len(data) == REPEATS[HQ]
    return data
