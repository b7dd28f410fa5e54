"""What `gateway bench` measures of this language, and where somebody else's codec knows the same messages.

Rules. Data and calls only: nothing here is used by the robot. Everybody starts from plain values, or from a
frame. Bare `struct` knows its message beforehand, checks nothing and makes no frame: it is the floor.
cantools does what its documentation shows first, `encode_message` and `decode_message` with the checks it
makes by default.

Source of names and identifiers: the DBC of package odrive-can 2.1.0.
"""

from __future__ import annotations

import struct
from collections.abc import Callable
from dataclasses import astuple, dataclass, field
from importlib.resources import files
from typing import Any

from protocols.frames import CanFrame
from protocols.odrive_can.codec import decode_from_device, encode
from protocols.odrive_can.messages import SetInputPos, SetInputVel

RIVAL = ("cantools", "cantools", "cantools on the vendor's DBC")
DBC = ("odrive_can", "dbc/odrive-cansimple-0.6.10.dbc")
"""Package and file in it."""
NODE = 3


def prepared(cantools: Any) -> Any:  # noqa: ANN401 -- cantools has no types
    """The vendor's messages, as cantools has them."""
    package, file = DBC
    return cantools.database.load_string((files(package) / file).read_text("utf-8"), "dbc")


@dataclass(frozen=True, slots=True)
class Sample:
    """One message in one direction."""

    what: str
    ours: Callable[[], object]
    struct: Callable[[], object]
    id: int
    """Of its frame."""
    data: bytes
    """Of its frame: what encoding must give, what is decoded."""
    values: dict[str, float] = field(default_factory=dict)
    """By the DBC's names, to be encoded; {}: it is decoded"""

    def theirs(self, known: Any) -> Callable[[], object]:  # noqa: ANN401 -- cantools has no types
        """What cantools does for it."""
        number, data, values = self.id, self.data, self.values
        if not values:
            return lambda: known.decode_message(number, data)
        return lambda: known.encode_message(number, dict(values))

    def alike(self, ours: Any, theirs: Any, struct: Any) -> bool:  # noqa: ANN401 -- a frame, or fields
        """Encoding gives the same bytes, decoding the same fields in order."""
        if self.values:
            return bool(theirs == struct == ours.data == self.data and ours.id == self.id)
        fields = list(astuple(ours))
        return fields == [getattr(value, "value", value) for value in theirs.values()] == list(struct)


_PAIR, _POSITION, _BEAT = struct.Struct("<ff"), struct.Struct("<fhh"), struct.Struct("<IBBBx")
_ESTIMATES = CanFrame(NODE << 5 | 0x09, _PAIR.pack(1.25, -0.5))
_HEARTBEAT = CanFrame(NODE << 5 | 0x01, _BEAT.pack(0, 8, 0, 1))

SAMPLES = (
    Sample(
        "encode Set_Input_Vel",
        lambda: encode(NODE, SetInputVel(2.5, 0.25)),
        lambda: _PAIR.pack(2.5, 0.25),
        NODE << 5 | 0x0D,
        _PAIR.pack(2.5, 0.25),
        {"Input_Vel": 2.5, "Input_Torque_FF": 0.25},
    ),
    Sample(
        "encode Set_Input_Pos",
        lambda: encode(NODE, SetInputPos(1.5, 0.5, 0.25)),
        lambda: _POSITION.pack(1.5, round(0.5 / 0.001), round(0.25 / 0.001)),
        NODE << 5 | 0x0C,
        _POSITION.pack(1.5, 500, 250),
        {"Input_Pos": 1.5, "Vel_FF": 0.5, "Torque_FF": 0.25},
    ),
    Sample(
        "decode Get_Encoder_Estimates",
        lambda: decode_from_device(_ESTIMATES),
        lambda: _PAIR.unpack(_ESTIMATES.data),
        _ESTIMATES.id,
        _ESTIMATES.data,
    ),
    Sample(
        "decode Heartbeat",
        lambda: decode_from_device(_HEARTBEAT),
        lambda: _BEAT.unpack(_HEARTBEAT.data),
        _HEARTBEAT.id,
        _HEARTBEAT.data,
    ),
)
