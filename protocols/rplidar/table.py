"""Requests, answers and data of Slamtec's lidars, in their own units: degrees clockwise from ahead, mm, µs.

To the device: `A5 | command`, or `A5 | command | size | payload | XOR of all before it`. From it: a
descriptor `A5 5A | length of the data, 30 bits, and 2 bits: 1 = repeated | type`, then the data, once or
until STOP; what is repeated has no descriptor of its own. All numbers are little-endian. Only capsules have a
checksum.

Source: Slamtec/rplidar_sdk@99478e5; Interface Protocol and Application Notes (Slamtec).
"""

from __future__ import annotations

import struct
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from typing import NamedTuple

from protocols.plugin import FaultInfo
from protocols.toolkit.motor_driver import Rx
from protocols.toolkit.serial import xor8

NAME = "rplidar"
STOP, RESET, SCAN, FORCE_SCAN, EXPRESS_SCAN = 0x25, 0x40, 0x20, 0x21, 0x82
GET_INFO, GET_HEALTH, GET_RATE, GET_CONF = 0x50, 0x52, 0x59, 0x84
SET_PWM, GET_BOARD = 0xF0, 0xFF
NAMES: Mapping[int, str] = {
    STOP: "STOP",
    RESET: "RESET",
    SCAN: "SCAN",
    FORCE_SCAN: "FORCE_SCAN",
    EXPRESS_SCAN: "EXPRESS_SCAN",
    GET_INFO: "GET_INFO",
    GET_HEALTH: "GET_HEALTH",
    GET_RATE: "GET_SAMPLERATE",
    GET_CONF: "GET_LIDAR_CONF",
    SET_PWM: "SET_MOTOR_PWM",
    GET_BOARD: "GET_ACC_BOARD_FLAG",
}
READS = frozenset({GET_INFO, GET_HEALTH, GET_RATE, GET_CONF, GET_BOARD})
PAYLOADS: Mapping[int, Collection[int]] = {
    EXPRESS_SCAN: (5,),
    GET_CONF: (4, 6),
    SET_PWM: (2,),
    GET_BOARD: (4,),
}
"""Bytes of the payload, by command"""
PWM_MOST = 1023

INFO, HEALTH, RATE, CONF, BOARD = 0x04, 0x06, 0x15, 0x20, 0xFF
NODES, EXPRESS, DENSE = 0x81, 0x82, 0x85
SCANS = frozenset({NODES, EXPRESS, DENSE})
"""What is read here,"""
REPEATS: Mapping[int, int] = {NODES: 5, EXPRESS: 84, 0x83: 781, 0x84: 132, DENSE: 84}
"""and all that is repeated: its bytes, by type of the answer"""
ANSWERS: Mapping[int, range] = {
    INFO: range(20, 21),
    HEALTH: range(3, 4),
    RATE: range(4, 5),
    CONF: range(4, 65),
    BOARD: range(4, 5),
}
"""Bytes of what comes once, by type"""
ANSWER_NAMES = {INFO: "info", HEALTH: "health", RATE: "rate", CONF: "conf", BOARD: "board"}
ERROR = PROTECTION = 2
"""Of the health: protection stop"""
FAULTS: Mapping[int, FaultInfo] = {
    PROTECTION: FaultInfo(
        "protection stop",
        "its motor is blocked, its laser or its supply failed",
        "free what turns, see that it gets 5 V with enough current, and switch it off and on",
        latching=False,
    )
}
HEAD = 7
"""Bytes of a descriptor"""
REPEATED = 1 << 30
NODE_BYTES, CAPSULE_BYTES = 5, 84
FARTHEST_NODE, FARTHEST_EXPRESS, FARTHEST_DENSE = 0xFFFF, 0x3FFF, 0xFFFF
"""mm / 4, mm, mm"""
TURN_Q6, FIRST_Q6 = 360 * 64, 20 * 64
_NODE, _HEADER = struct.Struct("<BHH"), struct.Struct("<I")


# -- to the device ---------------------------------------------------------------------------------------


@dataclass(frozen=True, slots=True)
class Requests:
    """How requests stand on the line: a message is one without its checksum."""

    def frame(self, message: bytes) -> bytes:
        """Return a request as it stands on the line."""
        whole = b"\xa5" + message
        return whole + bytes((xor8(whole),)) if message[0] & 0x80 else whole

    def read(self, held: bytes, at: int) -> tuple[bytes | Rx | None, int]:
        """Return what begins here, and where the search goes on, as every `FrameFormat`."""
        if held[at] != 0xA5:
            found = held.find(b"\xa5", at)
            return Rx.IGNORED, found if found >= 0 else len(held)
        if len(held) < at + 2:
            return None, at
        command = held[at + 1]
        if command not in NAMES:
            return Rx.IGNORED, at + 1
        if not command & 0x80:
            return held[at + 1 : at + 2], at + 2
        if len(held) < at + 3:
            return None, at
        size = held[at + 2]
        if size not in PAYLOADS[command]:
            return Rx.IGNORED, at + 1
        end = at + 3 + size
        if len(held) <= end:
            return None, at
        if xor8(held[at : end + 1]):
            return Rx.MALFORMED, at + 1
        return held[at + 1 : end], end + 1


REQUESTS = Requests()


def request(command: int, payload: bytes = b"") -> bytes:
    """Return a request as it stands on the line."""
    return REQUESTS.frame(bytes((command, len(payload))) + payload if command & 0x80 else bytes((command,)))


def pwm(duty: int) -> bytes:
    """Return what sets the motor's duty, 0 to `PWM_MOST`."""
    return request(SET_PWM, duty.to_bytes(2, "little"))


def express_scan(mode: int) -> bytes:
    """Return what starts a scan in capsules; `mode` is the device's number of it, 0 the first of all."""
    return request(EXPRESS_SCAN, bytes((mode, 0, 0, 0, 0)))


# -- from the device -------------------------------------------------------------------------------------


def answer_size(head: bytes) -> int | None:
    """Return the bytes of an answer, with its data if they come once, by its first bytes; 0: it is none;
    None: more must come."""
    if not b"\xa5\x5a".startswith(head[:2]):
        return 0
    if len(head) < HEAD:
        return None
    (word,), kind = _HEADER.unpack_from(head, 2), head[6]
    if word & REPEATED:
        return HEAD if word == REPEATED | REPEATS.get(kind, 0) else 0
    return HEAD + word if word in ANSWERS.get(kind, ()) else 0


def answer(kind: int, data: bytes) -> bytes:
    """Return an answer that comes once."""
    return b"\xa5\x5a" + _HEADER.pack(len(data)) + bytes((kind,)) + data


def descriptor(kind: int) -> bytes:
    """Return what precedes a stream."""
    return b"\xa5\x5a" + _HEADER.pack(REPEATS[kind] | REPEATED) + bytes((kind,))


class Node(NamedTuple):
    """One ray of a standard scan."""

    first: bool
    """Of a turn"""
    quality: int
    angle: float
    """Degrees"""
    distance: float
    """mm; 0: no return"""


def is_node(held: bytes, at: int) -> bool:
    """True if five bytes here may be a node: by their start flag, its inverse, the check bit, and the angle,
    which is about 0 of the first of a turn."""
    flags, angle = held[at] & 3, held[at + 2] << 7 | held[at + 1] >> 1
    if flags not in (1, 2) or not held[at + 1] & 1 or angle >= TURN_Q6:
        return False
    return flags == 2 or not FIRST_Q6 < angle < TURN_Q6 - FIRST_Q6


def node(data: bytes) -> Node:
    """Decode a node."""
    flags, angle, distance = _NODE.unpack(data)
    return Node(bool(flags & 1), flags >> 2, (angle >> 1) / 64.0, distance / 4.0)


def encode_node(one: Node) -> bytes:
    """Return a node as it stands on the line."""
    flags = one.quality << 2 | (1 if one.first else 2)
    angle = round(one.angle * 64.0) % TURN_Q6 << 1 | 1
    return _NODE.pack(flags, angle, min(round(one.distance * 4.0), FARTHEST_NODE))


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


def capsule(data: bytes, kind: int) -> Capsule:
    """Decode a capsule of an answer of this type, express or dense."""
    (head,) = struct.unpack_from("<H", data, 2)
    first, start = bool(head & 0x8000), (head & 0x7FFF) / 64.0 % 360.0
    if kind == DENSE:
        distances = struct.unpack_from("<40H", data, 4)
        return Capsule(first, start, distances, (0.0,) * 40)
    rays = list[tuple[int, float]]()
    for one, other, low in struct.iter_unpack("<HHB", data[4:]):
        rays.append((one >> 2, ((one & 3) << 4 | low & 0xF) / 8.0))
        rays.append((other >> 2, ((other & 3) << 4 | low >> 4) / 8.0))
    return Capsule(first, start, tuple(each for each, _ in rays), tuple(each for _, each in rays))


def encode_capsule(one: Capsule, kind: int) -> bytes:
    """Return a capsule as it stands on the line. What is out of reach is no return."""
    head = round(one.start * 64.0) % TURN_Q6 | (0x8000 if one.first else 0)
    body = struct.pack("<H", head)
    if kind == DENSE:
        body += struct.pack("<40H", *_reached(one.distances, FARTHEST_DENSE))
    else:
        found = list(zip(_reached(one.distances, FARTHEST_EXPRESS), one.offsets, strict=True))
        for at in range(0, len(found), 2):
            (a, behind), (b, later) = found[at : at + 2]
            p, q = round(behind * 8.0), round(later * 8.0)
            body += struct.pack("<HHB", a << 2 | p >> 4, b << 2 | q >> 4, p & 0xF | (q & 0xF) << 4)
    check = xor8(body)
    return bytes((0xA0 | check & 0xF, 0x50 | check >> 4)) + body


def _reached(distances: Sequence[int], farthest: int) -> list[int]:
    return [each if each <= farthest else 0 for each in distances]
