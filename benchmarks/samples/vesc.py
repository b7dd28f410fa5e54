"""Benchmark samples of vesc, measured beside cantools on the same bytes.

Rules. Data and calls only: the robot uses nothing of this. Every contestant starts from plain values, or from
a frame. No package that installs speaks these messages: pyvesc knows the serial protocol alone, and pybldc
writes firmware.
"""

from __future__ import annotations

import struct
from typing import Any

from benchmarks.samples.cantools_messages import RIVAL as RIVAL
from benchmarks.samples.cantools_messages import Sample, database
from protocols.frames import EXTENDED_BIT, CanFrame, id_number
from protocols.vesc.table import TABLE

DBC = """
BO_ 2147484439 SET_RPM: 4 host
 SG_ value : 7|32@0- (1,0) [0|0] "" motor
BO_ 2147483927 SET_CURRENT: 4 host
 SG_ value : 7|32@0- (0.001,0) [0|0] "A" motor
BO_ 2147485975 STATUS_1: 8 motor
 SG_ velocity : 7|32@0- (1,0) [0|0] "" host
 SG_ current : 39|16@0- (0.1,0) [0|0] "A" host
 SG_ duty : 55|16@0- (0.001,0) [0|0] "" host
BO_ 2147490583 STATUS_5: 8 motor
 SG_ position : 7|32@0- (1,0) [0|0] "" host
 SG_ voltage : 39|16@0- (0.1,0) [0|0] "V" host
"""
"""Bit 31 of an id: 29 bits."""
_ONE, _THREE, _TWO = struct.Struct(">i"), struct.Struct(">ihh"), struct.Struct(">ihxx")
_STATUS_1 = CanFrame(0x917, bytes.fromhex("fffff254007bfe38"), extended=True)
_STATUS_5 = CanFrame(0x1B17, bytes.fromhex("ffffef6e00f50000"), extended=True)


def prepared(cantools: Any) -> Any:  # noqa: ANN401 -- cantools has no types
    """Return the messages as a cantools database."""
    return database(cantools, DBC)


def _status_1() -> tuple[float, ...]:
    velocity, current, duty = _THREE.unpack(_STATUS_1.data)
    return velocity, current * 0.1, duty * 0.001


def _status_5() -> tuple[float, ...]:
    position, voltage = _TWO.unpack(_STATUS_5.data)
    return position, voltage * 0.1


SAMPLES = (
    Sample(
        "encode SET_RPM",
        lambda: TABLE.encode("SET_RPM", 23, value=-12_000),
        lambda: _ONE.pack(-12_000),
        EXTENDED_BIT | 0x317,
        bytes.fromhex("ffffd120"),
        {"value": -12_000},
    ),
    Sample(
        "encode SET_CURRENT",
        lambda: TABLE.encode("SET_CURRENT", 23, value=51.0),
        lambda: _ONE.pack(round(51.0 / 0.001)),
        EXTENDED_BIT | 0x117,
        bytes.fromhex("0000c738"),
        {"value": 51.0},
    ),
    Sample(
        "decode STATUS_1",
        lambda: TABLE.decode(_STATUS_1, "from_device"),
        _status_1,
        id_number(_STATUS_1),
        _STATUS_1.data,
    ),
    Sample(
        "decode STATUS_5",
        lambda: TABLE.decode(_STATUS_5, "from_device"),
        _status_5,
        id_number(_STATUS_5),
        _STATUS_5.data,
    ),
)
