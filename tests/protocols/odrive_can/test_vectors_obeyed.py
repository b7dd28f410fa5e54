"""What ODrives obey, from vectors: frames, and the words of whoever obeys them.

What vouches: frames are cantools' with the DBCs 0.6.10 and 0.5.6 (node ids given out, short frames and
edges of numbers: bytes by hand, with `struct`); the words are derived by hand from
odriverobotics/ODrive@f9b5419 `can_simple.cpp`, `axis.cpp`, `controller.cpp`, and the README's tables of
both twins.
"""

from __future__ import annotations

import math
import struct
from collections.abc import Sequence
from typing import Any

import pytest

from protocols import messages as msg
from protocols.frames import CanFrame, Frame
from protocols.messages import Message
from protocols.odrive_can.decoder import OdriveDecoder
from protocols.odrive_can.options import Options, Settings
from protocols.plugin import Device
from tests.protocols.odrive_can.conversation import frame

SERIAL = 0x385F34733330
ROUND = math.tau
ARM = msg.Arm("left")
Line = tuple[str, dict[str, Any], list[Message]]


def decoder(line: str = "0.6", **settings: Any) -> OdriveDecoder:
    """Of left at node 3 and right at node 4."""
    options = Options(firmware="0.5" if line == "0.5" else "0.6")
    names = (("left", 3, SERIAL), ("right", 4, SERIAL + 1))
    return OdriveDecoder(
        [Device(name, node, options, Settings(serial, **settings)) for name, node, serial in names]
    )


def obeyed(listener: OdriveDecoder, line: str, said: Sequence[Line], node: int = 3) -> None:
    """What each frame means, one after the other."""
    for name, signals, words in said:
        received = listener.decode(0, frame(name, line, node, **signals))
        assert list(received) == words, name


def setting(name: str, value: float) -> msg.WriteParameter:
    """A parameter of left's."""
    return msg.WriteParameter("left", name, value)


COMMON: list[Line] = [
    (
        "Set_Limits",
        {"Velocity_Limit": 2, "Current_Limit": 3},
        [setting("Velocity_Limit", 2.0), setting("Current_Limit", 3.0)],
    ),
    (
        "Set_Vel_Gains",
        {"Vel_Gain": 2, "Vel_Integrator_Gain": 3},
        [setting("Vel_Gain", 2.0), setting("Vel_Integrator_Gain", 3.0)],
    ),
    (
        "Set_Traj_Accel_Limits",
        {"Traj_Accel_Limit": 2, "Traj_Decel_Limit": 3},
        [setting("Traj_Accel_Limit", 2.0), setting("Traj_Decel_Limit", 3.0)],
    ),
    ("Set_Pos_Gain", {"Pos_Gain": 4}, [setting("Pos_Gain", 4.0)]),
    ("Set_Traj_Vel_Limit", {"Traj_Vel_Limit": 5}, [setting("Traj_Vel_Limit", 5.0)]),
    ("Set_Traj_Inertia", {"Traj_Inertia": 6}, [setting("Traj_Inertia", 6.0)]),
    # Disarmed it remembers, and says nothing.
    ("Set_Input_Vel", {"Input_Vel": 1.5, "Input_Torque_FF": 0.5}, []),
    ("Set_Axis_State", {"Axis_Requested_State": 0}, []),
    ("Set_Axis_State", {"Axis_Requested_State": 8}, [ARM, msg.Velocity("left", 1.5 * ROUND, 0.5)]),
    ("Set_Axis_State", {"Axis_Requested_State": 0}, []),
    (
        "Set_Input_Vel",
        {"Input_Vel": -0.25, "Input_Torque_FF": 0.125},
        [msg.Velocity("left", -0.25 * ROUND, 0.125)],
    ),
    ("Set_Controller_Mode", {"Control_Mode": 1, "Input_Mode": 1}, [msg.Torque("left", 0.125)]),
    ("Set_Input_Torque", {"Input_Torque": -2}, [msg.Torque("left", -2.0)]),
    ("Set_Controller_Mode", {"Control_Mode": 3, "Input_Mode": 1}, [msg.Hold("left")]),
    (
        "Set_Input_Pos",
        {"Input_Pos": 2.5, "Vel_FF": 0.5, "Torque_FF": 0.25},
        [msg.Position("left", 2.5 * ROUND, 0.5 * ROUND, 0.25)],
    ),
    (
        "Set_Controller_Mode",
        {"Control_Mode": 3, "Input_Mode": 1},
        [msg.Position("left", 2.5 * ROUND, 0.5 * ROUND, 0.25)],
    ),
    ("Set_Controller_Mode", {"Control_Mode": 3, "Input_Mode": 0}, []),
    ("Set_Controller_Mode", {"Control_Mode": 0, "Input_Mode": 1}, []),
    ("Set_Controller_Mode", {"Control_Mode": 3, "Input_Mode": 1}, [msg.Hold("left")]),
    ("Set_Input_Pos", {"Input_Pos": 1}, [msg.Position("left", ROUND)]),
    ("Set_Axis_State", {"Axis_Requested_State": 1}, [msg.Idle("left")]),
    ("Set_Input_Pos", {"Input_Pos": 2}, []),
    ("Set_Axis_State", {"Axis_Requested_State": 8}, [ARM, msg.Hold("left")]),
    ("Set_Axis_State", {"Axis_Requested_State": 11}, [msg.Home("left")]),
    ("Set_Input_Pos", {"Input_Pos": 2}, []),
    ("Set_Axis_State", {"Axis_Requested_State": 8}, [ARM, msg.Hold("left")]),
]
"""A day of both lines; it ends holding."""


@pytest.mark.parametrize("line", ["0.5", "0.6"])
def test_vectors_of_a_day_of_either_line(line: str) -> None:
    listener = decoder(line)
    obeyed(listener, line, COMMON)
    again: list[Message] = [msg.Hold("left")] if line == "0.5" else [msg.Position("left", 3 * ROUND)]
    obeyed(
        listener,
        line,
        [
            ("Set_Input_Pos", {"Input_Pos": 3}, [msg.Position("left", 3 * ROUND)]),
            ("Set_Axis_State", {"Axis_Requested_State": 8}, [ARM, *again]),
        ],
    )


DISARMS: list[Line] = [("Set_Input_Vel", {"Input_Vel": 1}, [])]
ARMS: list[Line] = [("Set_Axis_State", {"Axis_Requested_State": 8}, [ARM, msg.Velocity("left", ROUND)])]


@pytest.mark.parametrize(
    ("name", "line", "word"),
    [
        ("Estop", "0.6", msg.Estop("left")),
        ("Reboot", "0.6", msg.Reboot("left")),
        ("Enter_DFU_Mode", "0.6", msg.Reboot("left")),
        ("Reboot", "0.5", msg.Reboot("left")),
    ],
)
def test_vectors_of_what_disarms(name: str, line: str, word: Message) -> None:
    listener = decoder(line)
    obeyed(listener, line, [*DISARMS, *ARMS, (name, {}, [word]), *DISARMS, *ARMS])


def test_vectors_of_0_6_alone() -> None:
    obeyed(
        decoder(),
        "0.6",
        [
            ("Set_Absolute_Position", {"Position": 0}, [msg.Zero("left")]),
            ("Set_Absolute_Position", {"Position": 1.25}, [setting("Position", 1.25 * ROUND)]),
            ("Clear_Errors", {}, [msg.ClearFault("left")]),
            ("RxSdo", {"Opcode": 1, "Endpoint_ID": 291, "Value": 7}, [setting("endpoint 291", 7.0)]),
            ("RxSdo", {"Opcode": 0, "Endpoint_ID": 291, "Value": 7}, []),
        ],
    )


def test_vectors_of_0_5_alone() -> None:
    obeyed(
        decoder("0.5"),
        "0.5",
        [
            ("Set_Linear_Count", {"Position": 0}, [msg.Zero("left")]),
            ("Set_Linear_Count", {"Position": -5}, [setting("Linear_Count", -5.0)]),
            ("Start_Anticogging", {}, [msg.Home("left")]),
            ("Clear_Errors", {}, [msg.ClearFault("left")]),
            ("Set_Axis_Node_ID", {"Axis_Node_ID": 9}, [msg.SetId("", SERIAL, 9)]),
            ("Clear_Errors", {}, []),
        ],
    )


def test_vectors_of_a_board_with_two_axes() -> None:
    options = Options(firmware="0.5")
    pairs = (("left", 3, 4), ("right", 4, 3), ("far", 9, -1))
    listener = OdriveDecoder(
        [Device(name, node, options, Settings(node, other_axis=other)) for name, node, other in pairs]
    )
    assert listener.decode(0, frame("Clear_Errors", "0.5")) == [
        msg.ClearFault("left"),
        msg.ClearFault("right"),
    ]
    assert listener.decode(0, frame("Reboot", "0.5", 4)) == [msg.Reboot("left"), msg.Reboot("right")]
    assert listener.decode(0, frame("Reboot", "0.5", 9)) == [msg.Reboot("far")]
    assert listener.decode(0, frame("Set_Axis_State", "0.5", 4, Axis_Requested_State=1)) == [
        msg.Idle("right")
    ]
    assert listener.decode(0, frame("Set_Axis_Node_ID", "0.5", 4, Axis_Node_ID=7)) == [msg.SetId("", 4, 7)]
    assert listener.decode(0, frame("Clear_Errors", "0.5", 4)) == []
    assert listener.decode(0, frame("Clear_Errors", "0.5", 7)) == [
        msg.ClearFault("left"),
        msg.ClearFault("right"),
    ]
    assert listener.decode(0, frame("Clear_Errors", "0.5", 0x3F)) == []


def test_vectors_of_a_board_as_it_comes() -> None:
    """Node ids 0 and 1."""
    options = Options(firmware="0.5")
    pairs = (("left", 0, 1), ("right", 1, 0))
    listener = OdriveDecoder(
        [Device(name, node, options, Settings(node + 1, other_axis=other)) for name, node, other in pairs]
    )
    for node in (0, 1):
        both = [msg.ClearFault("left"), msg.ClearFault("right")]
        assert listener.decode(0, frame("Clear_Errors", "0.5", node)) == both


def test_vectors_of_extended_identifiers() -> None:
    options = Options(firmware="0.5", is_extended=True)
    pairs = (("left", 3, 0x30004), ("right", 0x30004, 3))
    listener = OdriveDecoder(
        [Device(name, node, options, Settings(node, other_axis=other)) for name, node, other in pairs]
    )
    both = [msg.ClearFault("left"), msg.ClearFault("right")]
    assert listener.decode(0, frame("Clear_Errors", "0.5")) == []
    assert listener.decode(0, frame("Clear_Errors", "0.5", extended=True)) == both
    assert listener.decode(0, frame("Clear_Errors", "0.5", 0x30004, extended=True)) == both
    renames = frame("Set_Axis_Node_ID", "0.5", 3, True, Axis_Node_ID=0x50005)
    assert listener.decode(0, renames) == [msg.SetId("", 3, 0x50005)]
    assert listener.decode(0, frame("Clear_Errors", "0.5", 0x50005, extended=True)) == both
    assert listener.decode(0, frame("Clear_Errors", "0.5", 3, extended=True)) == []


def test_vectors_of_both_lines_on_one_bus() -> None:
    """Each hears what is for its node, in its own language."""
    new, old = Options(firmware="0.6"), Options(firmware="0.5")
    listener = OdriveDecoder(
        [
            Device("new", 3, new, Settings(3)),
            Device("old", 4, old, Settings(4)),
            Device("newer", 5, new, Settings(5)),
        ]
    )
    for name, node, line in (("new", 3, "0.6"), ("old", 4, "0.5"), ("newer", 5, "0.6")):
        assert listener.decode(0, frame("Clear_Errors", line, node)) == [msg.ClearFault(name)]
    assert listener.decode(0, frame("Set_Linear_Count", "0.5", 4)) == [msg.Zero("old")]
    assert listener.decode(0, frame("Set_Absolute_Position", "0.6", 3)) == [msg.Zero("new")]


def given(serial: int, node: int, to: int = 0x3F) -> CanFrame:
    """A node id given out, as vector assign_node_id_5 has it."""
    return CanFrame(to << 5 | 6, bytes([node]) + serial.to_bytes(6, "little"))


def test_vectors_of_node_ids_that_are_given_out() -> None:
    listener = decoder()
    assert listener.decode(0, given(SERIAL, 5, to=3)) == []
    assert listener.decode(0, given(SERIAL, 0x40)) == []
    assert listener.decode(0, given(SERIAL + 9, 6)) == []
    assert listener.decode(0, given(SERIAL, 5)) == [msg.SetId("", SERIAL, 5)]
    assert listener.decode(0, frame("Clear_Errors", node=3)) == []
    assert listener.decode(0, frame("Clear_Errors", node=5)) == [msg.ClearFault("left")]
    # Who holds an id that another is given vacates it.
    assert listener.decode(0, given(SERIAL, 4)) == [msg.SetId("", SERIAL, 4), msg.SetId("", SERIAL + 1, 0x3F)]
    assert listener.decode(0, frame("Set_Pos_Gain", node=4, Pos_Gain=1)) == [setting("Pos_Gain", 1.0)]
    assert listener.decode(0, given(SERIAL, 0x3F)) == [msg.SetId("", SERIAL, 0x3F)]
    assert listener.decode(0, given(SERIAL + 9, 0x3F)) == []
    assert listener.decode(0, frame("Clear_Errors", node=0x3F)) == [
        msg.ClearFault("left"),
        msg.ClearFault("right"),
    ]
    assert listener.decode(0, frame("Reboot", node=0x3F)) == [msg.Reboot("left"), msg.Reboot("right")]
    assert listener.decode(0, frame("Estop", node=9)) == []


@pytest.mark.parametrize(
    ("frame", "line"),
    [
        (CanFrame(0x67, b"\1\0\0\0", remote=False), "0.6"),
        (CanFrame(0x67, b"\1"), "0.6"),
        (CanFrame(0x67, b"\1\0\0\0"), "0.5"),
    ],
)
def test_vectors_of_short_frames_are_read_as_if_zeros_followed(frame: CanFrame, line: str) -> None:
    """As vendor hosts send Set_Axis_State, with 4 bytes."""
    assert decoder(line).decode(0, frame) == [msg.Idle("left")]


@pytest.mark.parametrize(
    ("frame", "line", "words"),
    [
        (CanFrame(0x67, b"\1\0\0\0\0\0\0\0", fd=True), "0.6", []),
        (CanFrame(0x67, b"\1\0\0\0\0\0\0\0\0"), "0.6", []),
        (CanFrame(0x67, remote=True), "0.6", []),
        (CanFrame(0x76, remote=True), "0.6", []),
        (CanFrame(0x76, remote=True), "0.5", [msg.Reboot("left")]),
        (CanFrame(0x66, remote=True), "0.5", [msg.SetId("", SERIAL, 0)]),
        (CanFrame(0x7D, b"\1\0"), "0.5", []),
        (CanFrame(0x74), "0.6", []),
        (CanFrame(0x69, remote=True), "0.6", []),
        (CanFrame(0x7E6, remote=True), "0.6", []),
        (CanFrame(0x69), "0.6", []),
        (CanFrame(0x67, b"\1\0\0\0", extended=True), "0.6", []),
        (CanFrame(0x6D, struct.pack("<ff", math.nan, 0.0)), "0.6", []),
        (CanFrame(0x61, bytes(8)), "0.6", []),
        (CanFrame(0xA7, b"\1\0\0\0"), "0.6", []),  # to node 5
        (CanFrame(0x7E7, b"\1\0\0\0"), "0.6", []),  # a broadcast, as the next
        (CanFrame(0x7E2), "0.6", []),
        (b"serial", "0.6", []),
    ],
)
def test_vectors_of_frames_of_other_kinds(frame: Frame, line: str, words: list[Message]) -> None:
    listener = decoder(line)
    obeyed(listener, line, [*DISARMS, *ARMS])
    assert list(listener.decode(0, frame)) == words
