"""Requests, answers and nodes of Slamtec's lidars, in their own units: degrees clockwise from ahead, mm, µs.

To the device: `A5 | command`, or `A5 | command | size | payload | XOR of all before it`. From it: a
descriptor `A5 5A | length of the data, 30 bits, and 2 bits: 1 = repeated | type`, then the data, once or
until STOP; what is repeated has no descriptor of its own. All numbers are little-endian. Only capsules
(`capsules`) have a checksum. Commands and types are in `device.toml`; here they have their names.

Source: Slamtec/rplidar_sdk@99478e5; Interface Protocol and Application Notes (Slamtec).
"""

from __future__ import annotations

import struct
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Literal, NamedTuple, TypeAlias

from protocols.plugin import FaultInfo
from protocols.toolkit.device_file import device_file
from protocols.toolkit.faults import faults
from protocols.toolkit.motor_driver import Rx
from protocols.toolkit.serial import xor8

NAME = "rplidar"
FILE: Mapping[str, Any] = device_file(__package__ or "")
CODES: Mapping[str, int] = {name: code for name, (code, *_) in FILE["requests"].items()}
NAMES: Mapping[int, str] = {code: name for name, code in CODES.items()}
PAYLOADS: Mapping[int, list[int]] = {code: sizes for code, *sizes in FILE["requests"].values()}
"""What may be the bytes of a payload, by command"""
READS = "GET_"
"""How requests begin that only ask"""
PWM_MOST = 1023

Scan: TypeAlias = Literal["standard", "express", "ultra", "dense", "hq"]
ANSWERS: Mapping[int, tuple[str, range]] = {
    kind: (name, range(fewest, most + 1)) for name, (kind, fewest, most) in FILE["answers"].items()
}
"""What comes once: its name, and the bytes that it may have, by type"""
TYPES: Mapping[str, int] = {name: kind for name, (kind, *_) in {**FILE["answers"], **FILE["scans"]}.items()}
SCANS: Mapping[int, str] = {kind: name for name, (kind, *_) in FILE["scans"].items()}
"""What is repeated"""
CONF: Mapping[str, int] = FILE["conf"]
"""What GET_LIDAR_CONF asks for"""
SCAN_NAMES: Mapping[str, str] = FILE["names"]
SIZES: Mapping[str, int] = {name: size for name, (_, size, _) in FILE["scans"].items()}
RAYS: Mapping[str, int] = {name: rays for name, (*_, rays) in FILE["scans"].items() if rays}
"""Of one message of what is repeated, and read here"""
ERROR = PROTECTION = 2
"""Of the health: protection stop"""
FAULTS: Mapping[int, FaultInfo] = faults(FILE["faults"]["health"])
HEAD = 7
"""Bytes of a descriptor"""
REPEATED = 1 << 30
NODE_BYTES = SIZES["standard"]
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
        command, size = (*held[at + 1 : at + 3], None, None)[:2]
        if command is not None and command not in NAMES:
            return Rx.IGNORED, at + 1
        if command is not None and not command & 0x80:
            return held[at + 1 : at + 2], at + 2
        if command is None or size is None:
            return None, at
        end = at + 3 + size
        if size not in PAYLOADS[command]:
            return Rx.IGNORED, at + 1
        if len(held) <= end:
            return None, at
        return (Rx.MALFORMED, at + 1) if xor8(held[at : end + 1]) else (held[at + 1 : end], end + 1)


REQUESTS = Requests()


def request(name: str, payload: bytes = b"") -> bytes:
    """Return a request as it stands on the line."""
    code = CODES[name]
    return REQUESTS.frame(bytes((code, len(payload))) + payload if code & 0x80 else bytes((code,)))


def pwm(duty: int) -> bytes:
    """Return what sets the motor's duty, 0 to `PWM_MOST`."""
    return request("SET_MOTOR_PWM", duty.to_bytes(2, "little"))


def express_scan(mode: int) -> bytes:
    """Return what starts a scan in capsules; `mode` is the device's number of it, 0 the first of all."""
    return request("EXPRESS_SCAN", bytes((mode, 0, 0, 0, 0)))


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
        return HEAD if word == REPEATED | SIZES.get(SCANS.get(kind, ""), 0) else 0
    return HEAD + word if kind in ANSWERS and word in ANSWERS[kind][1] else 0


def answer(name: str, data: bytes) -> bytes:
    """Return an answer that comes once."""
    return b"\xa5\x5a" + _HEADER.pack(len(data)) + bytes((TYPES[name],)) + data


def descriptor(scan: str) -> bytes:
    """Return what precedes a stream."""
    return b"\xa5\x5a" + _HEADER.pack(SIZES[scan] | REPEATED) + bytes((TYPES[scan],))


class Node(NamedTuple):
    """One ray of a standard scan, or of one of HQ."""

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
    return Node(flags & 1 == 1, flags >> 2, (angle >> 1) / 64.0, distance / 4.0)


def encode_node(one: Node) -> bytes:
    """Return a node as it stands on the line."""
    flags = one.quality << 2 | (1 if one.first else 2)
    angle = round(one.angle * 64.0) % TURN_Q6 << 1 | 1
    return _NODE.pack(flags, angle, min(round(one.distance * 4.0), FARTHEST_NODE))
