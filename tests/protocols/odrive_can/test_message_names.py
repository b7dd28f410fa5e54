"""The vendor's names of a host's messages."""

from __future__ import annotations

import pytest

from protocols.frames import CanFrame, Frame
from protocols.odrive_can import plugin
from protocols.odrive_can.codec import BROADCAST, LINE05, LINE06, encode, frame_id
from protocols.odrive_can.message_names import messages_in
from protocols.reference_vectors import vectors_of

MARKED = ("Reboot", "Clear_Errors")
"""Names that stand for another payload in each line."""


@pytest.mark.parametrize(
    "vector",
    [vector for vector in vectors_of(plugin) if vector.direction == "to_device"],
    ids=lambda vector: str(vector.name),
)
def test_a_vector_has_the_name_that_its_source_gives(vector: object) -> None:
    (vector,) = [v for v in vectors_of(plugin) if v == vector]
    name = str(vector.meaning.get("cmd") or vector.meaning["msg"])
    if vector.meaning.get("request"):
        name = f"request for {name}"
    elif name in MARKED and not vector.entry["data"]:
        name += " (0.5.x)"
    assert name in messages_in(vector.frame)


@pytest.mark.parametrize(
    ("frame", "names"),
    [
        (CanFrame(frame_id(1, 0x19), b"\0" * 8), ("Set_Absolute_Position", "Set_Linear_Count")),
        (CanFrame(frame_id(1, 0x16), b"\0"), ("Reboot",)),
        (CanFrame(frame_id(1, 0x16)), ("Reboot (0.5.x)",)),
        (CanFrame(frame_id(1, 0x07), b"\1\0\0\0"), ("Set_Axis_State",)),
        (CanFrame(frame_id(1, 0x07), b"\1\0\0"), ()),
        (CanFrame(frame_id(1, 0x0C), b"\0" * 7), ()),
        (CanFrame(frame_id(BROADCAST, 0x06), b"\0" * 7), ("Address",)),
        (CanFrame(frame_id(1, 0x06), b"\0" * 8), ("Set_Axis_Node_ID",)),
        (CanFrame(frame_id(1, 0x03), remote=True), ("request for Get_Error", "request for Get_Motor_Error")),
        (CanFrame(frame_id(1, 0x07), remote=True), ()),
        (CanFrame(frame_id(1, 0x09), b"\0" * 8), ()),
        (CanFrame(frame_id(1, 0x07), b"\1\0\0\0", fd=True), ()),
        (CanFrame(0xFFFF << 5 | 0x0D, b"\0" * 8, extended=True), ("Set_Input_Vel",)),
        (b"\1\2\3", ()),
    ],
    ids=str,
)
def test_names(frame: Frame, names: tuple[str, ...]) -> None:
    assert messages_in(frame) == names


def test_every_message_to_a_device_that_we_encode_has_a_name() -> None:
    for row in (*LINE05, *LINE06):
        if row.direction == "to_device":
            values = [1 if code in "BHIiSQbc7" else 1.0 for code in row.codes]
            assert len(messages_in(encode(1, row.message(*values)))) >= 1, row
