"""The ear: what would be obeyed; and that ear and twin agree on it."""

from __future__ import annotations

import struct

import pytest
from numpy.random import PCG64, Generator

from protocols import messages as msg
from protocols.frames import CanFrame, Frame
from protocols.messages import MILLISECOND, Command, Request
from protocols.odrive_can.codec import BROADCAST, encode, radians
from protocols.odrive_can.decoder import OdriveDecoder
from protocols.odrive_can.messages import (
    Address,
    ClearErrors,
    EnterDfuMode,
    Estop,
    Message,
    Reboot,
    RxSdo,
    SetAbsolutePosition,
    SetAxisState,
    SetControllerMode,
    SetInputPos,
    SetInputTorque,
    SetInputVel,
    SetLimits,
    SetPosGain,
    SetTrajAccelLimits,
    SetTrajInertia,
    SetTrajVelLimit,
    SetVelGains,
)
from protocols.odrive_can.options import Settings
from protocols.odrive_can.twin06 import Twin06
from tests.protocols.odrive_can.helpers import device

CLOSED, IDLE = SetAxisState(8), SetAxisState(1)


def received(decoder: OdriveDecoder, *messages: Message, node: int = 1) -> list[Command | Request]:
    return [word for message in messages for word in decoder.decode(0, encode(node, message))]


def test_setpoints_are_obeyed_only_in_closed_loop_and_in_their_mode() -> None:
    decoder = OdriveDecoder([device()])
    assert received(decoder, SetControllerMode(2, 1), SetInputVel(2.0, 0.5)) == []
    assert received(decoder, CLOSED) == [msg.Velocity("left", radians(2.0), 0.5)]
    assert received(decoder, SetInputVel(3.0, 0.25)) == [msg.Velocity("left", radians(3.0), 0.25)]
    assert received(decoder, SetControllerMode(1, 1)) == [msg.Torque("left", 0.25)]
    assert received(decoder, SetInputTorque(0.75)) == [msg.Torque("left", 0.75)]
    assert received(decoder, SetControllerMode(3, 1)) == [msg.Hold("left")]
    assert received(decoder, SetInputPos(1.5, 0.25, -0.5)) == [
        msg.Position("left", radians(1.5), radians(0.25), -0.5)
    ]
    assert received(decoder, IDLE) == [msg.Idle("left")]
    assert received(decoder, SetInputPos(1.0, 0.0, 0.0)) == []
    assert received(decoder, CLOSED) == [msg.Hold("left")]


def test_inactive_inputs_and_voltage_control_give_no_word() -> None:
    decoder = OdriveDecoder([device()])
    assert received(decoder, SetControllerMode(2, 0), CLOSED, SetInputVel(2.0, 0.0)) == []
    assert received(decoder, SetControllerMode(0, 1), SetInputTorque(1.0)) == []


@pytest.mark.parametrize(
    ("message", "words"),
    [
        (Estop(), [msg.Estop("left")]),
        (ClearErrors(0), [msg.ClearFault("left")]),
        (Reboot(0), [msg.Reboot("left")]),
        (EnterDfuMode(), [msg.Reboot("left")]),
        (SetAxisState(11), [msg.Home("left")]),
        (SetAxisState(4), [msg.Idle("left")]),
        (SetAxisState(0), []),
        (SetAbsolutePosition(0.0), [msg.Zero("left")]),
        (SetAbsolutePosition(2.0), [msg.WriteParameter("left", "Position", radians(2.0))]),
        (SetPosGain(20.0), [msg.WriteParameter("left", "Pos_Gain", 20.0)]),
        (SetTrajVelLimit(2.0), [msg.WriteParameter("left", "Traj_Vel_Limit", 2.0)]),
        (SetTrajInertia(2.0), [msg.WriteParameter("left", "Traj_Inertia", 2.0)]),
        (RxSdo(1, 291, 0, 7), [msg.WriteParameter("left", "endpoint 291", 7.0)]),
        (RxSdo(0, 291, 0, 7), []),
        (
            SetLimits(10.0, 20.0),
            [
                msg.WriteParameter("left", "Velocity_Limit", 10.0),
                msg.WriteParameter("left", "Current_Limit", 20.0),
            ],
        ),
        (
            SetVelGains(0.5, 0.25),
            [
                msg.WriteParameter("left", "Vel_Gain", 0.5),
                msg.WriteParameter("left", "Vel_Integrator_Gain", 0.25),
            ],
        ),
        (
            SetTrajAccelLimits(2.0, 3.0),
            [
                msg.WriteParameter("left", "Traj_Accel_Limit", 2.0),
                msg.WriteParameter("left", "Traj_Decel_Limit", 3.0),
            ],
        ),
    ],
    ids=lambda value: type(value).__name__ if not isinstance(value, list) else "",
)
def test_what_clears_restarts_or_configures(message: Message, words: list[Request]) -> None:
    assert received(OdriveDecoder([device()]), message) == words


def test_broadcasts_reach_all_and_other_nodes_none() -> None:
    decoder = OdriveDecoder([device("left", 1), device("right", 2)])
    assert received(decoder, Reboot(0), node=BROADCAST) == [msg.Reboot("left"), msg.Reboot("right")]
    assert received(decoder, ClearErrors(0), node=BROADCAST) == [
        msg.ClearFault("left"),
        msg.ClearFault("right"),
    ]
    assert received(decoder, CLOSED, IDLE, Estop(), node=BROADCAST) == []
    assert received(decoder, IDLE, node=3) == []
    assert received(decoder, IDLE, node=2) == [msg.Idle("right")]


def test_a_node_id_given_out_is_followed() -> None:
    decoder = OdriveDecoder([device(settings=Settings(serial_number=77)), device("right", 2)])
    assert received(decoder, Address(9, 77), node=BROADCAST) == [msg.SetId("", 77, 9)]
    assert received(decoder, IDLE, node=9) == [msg.Idle("left")]
    assert received(decoder, IDLE, node=1) == []


@pytest.mark.parametrize(
    "frame",
    [
        CanFrame(0x27, remote=True),
        CanFrame(0x29, remote=True),
        CanFrame(0x7E6, remote=True),
        CanFrame(0x29),
        CanFrame(0x27, bytes.fromhex("08000000"), extended=True),
        CanFrame(0x2D, struct.pack("<ff", float("nan"), 0.0)),
        CanFrame(0x21, bytes(8)),
        b"serial",
    ],
)
def test_what_no_device_obeys_gives_no_word(frame: Frame) -> None:
    decoder = OdriveDecoder([device()])
    received(decoder, SetControllerMode(2, 1), CLOSED)
    assert list(decoder.decode(0, frame)) == []


def test_ear_and_twin_agree_on_random_traffic() -> None:
    """An ear beside a healthy twin remembers the same after every frame, whatever the frames are."""
    seed = 7
    random = Generator(PCG64(seed))
    makers: list[Message] = [CLOSED, CLOSED, IDLE, SetInputVel(1.0, 0.0), SetInputPos(0.1, 0.0, 0.0)]
    makers += [
        SetInputTorque(0.01),
        SetControllerMode(1, 1),
        SetControllerMode(2, 1),
        SetControllerMode(3, 1),
    ]
    decoder, twin = OdriveDecoder([device()]), Twin06(device(), 0)
    for turn in range(3000):
        node = 1 if random.random() < 0.9 else int(random.integers(0, 64))
        frame = encode(node, makers[int(random.integers(0, len(makers)))])
        length = int(random.integers(0, 9)) if random.random() < 0.2 else len(frame.data)
        if random.random() < 0.1:
            frame = CanFrame(int(random.integers(0, 0x20)) | 0x20 & ~0x16, random.bytes(length))
        if frame.id & 0x1F in (0x02, 0x16, 0x18, 0x1F) or frame.id >> 5 == BROADCAST:
            continue
        decoder.decode(turn, frame)
        twin.receive(turn * MILLISECOND, frame)
        assert repr(decoder.axes[0]) == repr(twin.axis), f"seed {seed}, turn {turn}: {frame}"
