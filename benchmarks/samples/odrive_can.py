"""Benchmark samples of odrive_can, measured beside cantools on the vendor's DBC.

Rules. Data and calls only: the robot uses nothing of this. Every contestant starts from plain values, or from
a frame.

Source of names and identifiers: the DBC of package odrive-can 2.1.0.
"""

from __future__ import annotations

import struct
from importlib.resources import files
from typing import Any

from benchmarks.samples.cantools_messages import Sample
from protocols.frames import CanFrame
from protocols.odrive_can.table import table_of

RIVAL = ("cantools", "cantools", "cantools on the vendor's DBC")
DBC = ("odrive_can", "dbc/odrive-cansimple-0.6.10.dbc")
"""Package and file in it."""
NODE = 3
MESSAGES = table_of("0.6")


def prepared(cantools: Any) -> Any:  # noqa: ANN401 -- cantools has no types
    """Return the vendor's DBC as a cantools database."""
    package, file = DBC
    return cantools.database.load_string((files(package) / file).read_text("utf-8"), "dbc")


_PAIR, _POSITION, _HEARTBEAT = struct.Struct("<ff"), struct.Struct("<fhh"), struct.Struct("<IBBBx")
_ESTIMATES_FRAME = CanFrame(NODE << 5 | 0x09, _PAIR.pack(1.25, -0.5))
_HEARTBEAT_FRAME = CanFrame(NODE << 5 | 0x01, _HEARTBEAT.pack(0, 8, 0, 1))

SAMPLES = (
    Sample(
        "encode Set_Input_Vel",
        lambda: MESSAGES.encode("Set_Input_Vel", NODE, Input_Vel=2.5, Input_Torque_FF=0.25),
        lambda: _PAIR.pack(2.5, 0.25),
        NODE << 5 | 0x0D,
        _PAIR.pack(2.5, 0.25),
        {"Input_Vel": 2.5, "Input_Torque_FF": 0.25},
    ),
    Sample(
        "encode Set_Input_Pos",
        lambda: MESSAGES.encode("Set_Input_Pos", NODE, Input_Pos=1.5, Vel_FF=0.5, Torque_FF=0.25),
        lambda: _POSITION.pack(1.5, round(0.5 / 0.001), round(0.25 / 0.001)),
        NODE << 5 | 0x0C,
        _POSITION.pack(1.5, 500, 250),
        {"Input_Pos": 1.5, "Vel_FF": 0.5, "Torque_FF": 0.25},
    ),
    Sample(
        "decode Get_Encoder_Estimates",
        lambda: MESSAGES.decode(_ESTIMATES_FRAME, "from_device"),
        lambda: _PAIR.unpack(_ESTIMATES_FRAME.data),
        _ESTIMATES_FRAME.id,
        _ESTIMATES_FRAME.data,
    ),
    Sample(
        "decode Heartbeat",
        lambda: MESSAGES.decode(_HEARTBEAT_FRAME, "from_device"),
        lambda: _HEARTBEAT.unpack(_HEARTBEAT_FRAME.data),
        _HEARTBEAT_FRAME.id,
        _HEARTBEAT_FRAME.data,
    ),
)
