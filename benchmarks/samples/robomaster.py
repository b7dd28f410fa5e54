"""Benchmark samples of robomaster, measured beside cantools on the same bytes.

Rules. Data and calls only: the robot uses nothing of this. Every contestant starts from plain values, or from
a frame. The vendor has code in C, and no package for Python.
"""

from __future__ import annotations

import struct
from typing import Any

from benchmarks.samples.cantools_messages import RIVAL as RIVAL
from benchmarks.samples.cantools_messages import Sample, database
from protocols.frames import CanFrame
from protocols.robomaster.table import SLOTS, TABLE

DBC = """
BO_ 512 first_four: 8 host
 SG_ first : 7|16@0- (1,0) [0|0] "" motor
 SG_ second : 23|16@0- (1,0) [0|0] "" motor
 SG_ third : 39|16@0- (1,0) [0|0] "" motor
 SG_ fourth : 55|16@0- (1,0) [0|0] "" motor
BO_ 513 feedback: 8 motor
 SG_ angle : 7|16@0+ (1,0) [0|0] "" host
 SG_ velocity : 23|16@0- (1,0) [0|0] "rpm" host
 SG_ current : 39|16@0- (1,0) [0|0] "" host
 SG_ temperature : 55|8@0+ (1,0) [0|0] "C" host
 SG_ error : 63|8@0+ (1,0) [0|0] "" host
"""
COUNTS = dict(zip(SLOTS, (8192, -8192, 1, -16384), strict=True))
_FOUR, _FIVE = struct.Struct(">hhhh"), struct.Struct(">HhhBB")
_FEEDBACK = CanFrame(0x201, bytes.fromhex("03e8ff9c00642b00"))


def prepared(cantools: Any) -> Any:  # noqa: ANN401 -- cantools has no types
    """Return the messages as a cantools database."""
    return database(cantools, DBC)


SAMPLES = (
    Sample(
        "encode the currents of four motors",
        lambda: TABLE.encode("0x200", **COUNTS),
        lambda: _FOUR.pack(8192, -8192, 1, -16384),
        0x200,
        bytes.fromhex("2000e0000001c000"),
        COUNTS,
    ),
    Sample(
        "decode a controller's feedback",
        lambda: TABLE.decode(_FEEDBACK, "from_device"),
        lambda: _FIVE.unpack(_FEEDBACK.data),
        _FEEDBACK.id,
        _FEEDBACK.data,
    ),
)
