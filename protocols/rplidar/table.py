"""Requests, answers and data of Slamtec's lidars, in their own units: degrees clockwise from ahead, mm, µs.

To the device: `A5 | command`, or `A5 | command | size | payload | XOR of all before it`. From it: a
descriptor `A5 5A | length of the data, 30 bits, and 2 bits: 1 = repeated | type`, then the data, once or
until STOP; what is repeated has no descriptor of its own. All numbers are little-endian. Only capsules
(`capsules`) have a checksum.

Source: Slamtec/rplidar_sdk@99478e5; Interface Protocol and Application Notes (Slamtec).
"""

from __future__ import annotations

import struct
from collections.abc import Collection, Mapping
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
NODES, EXPRESS, HQ, ULTRA, DENSE = 0x81, 0x82, 0x83, 0x84, 0x85
REPEATS: Mapping[int, int] = {NODES: 5, EXPRESS: 84, HQ: 781, ULTRA: 132, DENSE: 84, 0x86: 172}
"""What is repeated: its bytes, by type of the answer"""
SCANS = REPEATS.keys() - {0x86}
"""What of it is read here"""
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
NODE_BYTES = REPEATS[NODES]
FARTHEST_NODE = 0xFFFF
"""mm / 4"""
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
