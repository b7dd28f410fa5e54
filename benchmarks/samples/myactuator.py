"""Benchmark samples of myactuator, measured beside cantools on the same bytes.

Rules. Data and calls only: the robot uses nothing of this. Every contestant starts from plain values, or from
a frame. The usual library, myactuator_rmd, is C++ and opens a CAN interface itself: it gives no bytes.
"""

from __future__ import annotations

import struct
from typing import Any

from benchmarks.samples.cantools_messages import RIVAL as RIVAL
from benchmarks.samples.cantools_messages import Sample, database
from protocols.frames import CanFrame
from protocols.myactuator.table import ANY

_P, _V, _T = 25 / 65535, 90 / 4095, 48 / 4095
_KP, _KD = 500 / 4095, 5 / 4095
DBC = f"""
BO_ 321 command: 8 host
 SG_ command M : 0|8@1+ (1,0) [0|0] "" motor
 SG_ speed m162 : 32|32@1- (0.01,0) [0|0] "deg/s" motor
BO_ 577 answer: 8 motor
 SG_ command M : 0|8@1+ (1,0) [0|0] "" host
 SG_ temperature m156 : 8|8@1- (1,0) [0|0] "C" host
 SG_ current m156 : 16|16@1- (0.01,0) [0|0] "A" host
 SG_ velocity m156 : 32|16@1- (1,0) [0|0] "deg/s" host
 SG_ angle m156 : 48|16@1- (1,0) [0|0] "deg" host
BO_ 1025 motion: 8 host
 SG_ position : 7|16@0+ ({_P},-12.5) [0|0] "rad" motor
 SG_ velocity : 23|12@0+ ({_V},-45) [0|0] "rad/s" motor
 SG_ stiffness : 27|12@0+ ({_KP},0) [0|0] "" motor
 SG_ damping : 47|12@0+ ({_KD},0) [0|0] "" motor
 SG_ torque : 51|12@0+ ({_T},-24) [0|0] "Nm" motor
BO_ 1281 motion_reply: 6 motor
 SG_ motor : 7|8@0+ (1,0) [0|0] "" host
 SG_ position : 15|16@0+ ({_P},-12.5) [0|0] "rad" host
 SG_ velocity : 31|12@0+ ({_V},-45) [0|0] "rad/s" host
 SG_ torque : 35|12@0+ ({_T},-24) [0|0] "Nm" host
"""
NUMBERS = {"position": 10.0, "velocity": 1.0, "stiffness": 100.0, "damping": 1.0, "torque": 10.0}
_SPEED, _MOTION = struct.Struct("<B3xi"), struct.Struct(">HHBHB")
_FOUR, _REPLY = struct.Struct("<xbhhh"), struct.Struct(">BHHB")
_STATUS = CanFrame(0x241, bytes.fromhex("9c326400f4012d00"))
_MOVED = CanFrame(0x501, bytes.fromhex("01e66682eb55"))


def prepared(cantools: Any) -> Any:  # noqa: ANN401 -- cantools has no types
    """Return the messages as a cantools database."""
    return database(cantools, DBC)


def _status() -> tuple[float, ...]:
    temperature, current, velocity, angle = _FOUR.unpack(_STATUS.data)
    return temperature, current * 0.01, velocity, angle


def _moved() -> tuple[float, ...]:
    motor, position, both, low = _REPLY.unpack(_MOVED.data)
    return motor, position * _P - 12.5, (both >> 4) * _V - 45, ((both & 15) << 8 | low) * _T - 24


def _motion() -> bytes:
    p, v, kp = round((10.0 + 12.5) / _P), round((1.0 + 45.0) / _V), round(100.0 / _KP)
    kd, t = round(1.0 / _KD), round((10.0 + 24.0) / _T)
    return _MOTION.pack(p, v << 4 | kp >> 8, kp & 255, kd << 4 | t >> 8, t & 255)


SAMPLES = (
    Sample(
        "encode speed",
        lambda: ANY.encode("speed", 1, value=100.0),
        lambda: _SPEED.pack(0xA2, round(100.0 / 0.01)),
        0x141,
        bytes.fromhex("a200000010270000"),
        {"command": 0xA2, "speed": 100.0},
    ),
    Sample("encode motion", lambda: ANY.encode("motion", 1, **NUMBERS), _motion, 0x401, _motion(), NUMBERS),
    Sample("decode status 2", lambda: ANY.decode(_STATUS, "from_device"), _status, _STATUS.id, _STATUS.data),
    Sample("decode motion reply", lambda: ANY.decode(_MOVED, "from_device"), _moved, _MOVED.id, _MOVED.data),
)
