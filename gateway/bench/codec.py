"""One message to bytes and back: our codec, cantools on the vendor's DBC, and bare `struct`.

Rules. Everybody goes from plain values to the data of the frame, or from the data to values by name (bare `struct`:
to a tuple), in the way that its documentation shows first. What each does beyond that is its own affair: ours
makes the frame with its identifier, and lets no number through that is not finite; cantools checks ranges and names
the values of enumerations.
"""

from __future__ import annotations

import struct
from collections.abc import Mapping
from dataclasses import dataclass

from gateway.bench.measure import Call, Effort, Rival, in_turn, rival
from gateway.bench.rows import Row, Target, against
from protocols.odrive_can.codec import decode_from_device, encode
from protocols.odrive_can.messages import GetEncoderEstimates, Heartbeat, SetInputPos, SetInputVel
from protocols.wire import CanFrame

GROUP = "one message of odrive_can (the DBC of package odrive-can, on which cantools works)"
DBC = "odrive-cansimple-0.6.10"
STRUCT = "bare struct"
NODE = 3
TWICE = Target(ratio=2.0)


@dataclass(frozen=True, slots=True)
class _Case:
    """One message in one direction."""

    what: str
    ours: Call
    struct: Call
    name: str
    """In the DBC, without the axis."""
    values: Mapping[str, float] | None
    """To be encoded under the DBC's names; None: to be decoded"""
    data: bytes = b""


def codec(effort: Effort) -> list[Row]:
    """Encode and decode, of two messages each."""
    cantools, database = _database()
    return [_row(case, cantools, database, effort.of(400, 20)) for case in _cases()]


def _row(case: _Case, cantools: Rival, database: Rival, rounds: int) -> Row:
    contestants: dict[str, Call] = {"ours": case.ours}
    if database.module is not None:
        message = database.module.get_message_by_name(f"Axis{NODE}_{case.name}")
        values, data = case.values, case.data
        if values is None:
            contestants[cantools.name] = lambda: message.decode(data)
        else:
            contestants[cantools.name] = lambda: message.encode(dict(values))
    contestants[STRUCT] = case.struct
    found = in_turn(contestants, rounds)
    beside = against(found, cantools.name, missing=(database,)) + against(found, STRUCT)
    return Row(GROUP, case.what, found["ours"], beside, TWICE)


def _cases() -> list[_Case]:
    estimates, beat, pair = struct.Struct("<ff"), struct.Struct("<IBBBx"), struct.Struct("<ff")
    position = struct.Struct("<fhh")
    told, alive = estimates.pack(1.25, -0.5), beat.pack(0, 8, 0, 1)
    told_frame = CanFrame(NODE << 5 | 0x09, told)
    alive_frame = CanFrame(NODE << 5 | 0x01, alive)
    return [
        _Case(
            "encode Set_Input_Vel",
            lambda: encode(NODE, SetInputVel(2.5, 0.25)),
            lambda: pair.pack(2.5, 0.25),
            "Set_Input_Vel",
            {"Input_Vel": 2.5, "Input_Torque_FF": 0.25},
        ),
        _Case(
            "encode Set_Input_Pos",
            lambda: encode(NODE, SetInputPos(1.5, 0.5, 0.25)),
            lambda: position.pack(1.5, round(0.5 / 0.001), round(0.25 / 0.001)),
            "Set_Input_Pos",
            {"Input_Pos": 1.5, "Vel_FF": 0.5, "Torque_FF": 0.25},
        ),
        _Case(
            "decode Get_Encoder_Estimates",
            lambda: decode_from_device(told_frame),
            lambda: estimates.unpack(told),
            "Get_Encoder_Estimates",
            None,
            told,
        ),
        _Case(
            "decode Heartbeat",
            lambda: decode_from_device(alive_frame),
            lambda: beat.unpack(alive),
            "Heartbeat",
            None,
            alive,
        ),
    ]


def expected() -> list[tuple[_Case, object]]:
    """Each case with what our side makes of it, for a test that all sides do the same work."""
    return [(case, case.ours()) for case in _cases()]


def _database() -> tuple[Rival, Rival]:
    """cantools, and the vendor's messages in it (or why they are not there)."""
    cantools = rival("cantools", "cantools")
    package = rival("odrive_can.utils", "odrive-can")
    if cantools.why_not or package.why_not:
        return cantools, Rival("cantools", None, cantools.why_not or package.why_not)
    return cantools, Rival(cantools.name, package.module.get_dbc(DBC))
