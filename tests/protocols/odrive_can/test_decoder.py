"""The command decoder: what no device obeys, and that decoder and twin agree. (What is obeyed, from
independent frames: `test_vectors_obeyed`.)"""

from __future__ import annotations

import struct

import pytest
from numpy.random import PCG64, Generator

from protocols.frames import CanFrame, Frame
from protocols.messages import MILLISECOND
from protocols.odrive_can.codec import BROADCAST, encode
from protocols.odrive_can.decoder import OdriveDecoder
from protocols.odrive_can.messages import (
    Estop,
    Message,
    SetControllerMode,
    SetInputPos,
    SetInputTorque,
    SetInputVel,
)
from protocols.odrive_can.twin06 import Twin06
from tests.protocols.odrive_can.helpers import CLOSED, IDLE, device


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
        encode(3, IDLE),
        encode(BROADCAST, IDLE),
        encode(BROADCAST, CLOSED),
        encode(BROADCAST, Estop()),
        b"serial",
    ],
    ids=str,
)
def test_what_no_device_obeys_gives_no_command(frame: Frame) -> None:
    decoder = OdriveDecoder([device("left", 1), device("right", 2)])
    for message in (SetControllerMode(2, 1), CLOSED):
        decoder.decode(0, encode(1, message))
    assert list(decoder.decode(0, frame)) == []


def test_decoder_and_twin_agree_on_random_traffic() -> None:
    """A decoder beside a healthy twin keeps the same state after every frame, whatever the frames are."""
    seed = 7
    random = Generator(PCG64(seed))
    messages: list[Message] = [CLOSED, CLOSED, IDLE, SetInputVel(1.0, 0.0), SetInputPos(0.1, 0.0, 0.0)]
    messages += [SetInputTorque(0.01), *(SetControllerMode(mode, 1) for mode in (1, 2, 3))]
    decoder, twin = OdriveDecoder([device()]), Twin06(device(), 0)
    for turn in range(3000):
        node = 1 if random.random() < 0.9 else int(random.integers(0, 64))
        frame = encode(node, messages[int(random.integers(0, len(messages)))])
        length = int(random.integers(0, 9)) if random.random() < 0.2 else len(frame.data)
        if random.random() < 0.1:
            frame = CanFrame(int(random.integers(0, 0x20)) | 0x20 & ~0x16, random.bytes(length))
        if frame.id & 0x1F in (0x02, 0x16, 0x18, 0x1F) or frame.id >> 5 == BROADCAST:
            continue
        decoder.decode(turn, frame)
        twin.receive(turn * MILLISECOND, frame)
        assert repr(decoder.axes[0]) == repr(twin.axis), f"seed {seed}, turn {turn}: {frame}"
