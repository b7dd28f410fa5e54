"""Random, truncated, oversized, foreign traffic: the twin's torque stays finite. (Else: the contract.)"""

from __future__ import annotations

import math
import struct
from typing import Literal

import pytest
from numpy.random import PCG64, Generator

from protocols import messages as msg
from protocols.frames import CanFrame, Frame
from protocols.messages import MILLISECOND
from protocols.odrive_can import twin as make_twin
from protocols.odrive_can.options import Options
from tests.protocols.odrive_can.helpers import CLOSED, device, encode, to

TURNS = 4000
EXTREMES = (0.0, -0.0, 1e-40, 1.0, -1.0, 3.4e38, -3.4e38, math.nan, math.inf, -math.inf)


def random_frame(random: Generator) -> Frame:
    """Mostly ids of node 1, broadcasts and neighbours; now and then what does not belong on a CAN bus."""
    if random.random() < 0.02:
        return random.bytes(int(random.integers(0, 40)))
    node = int(random.choice([1, 1, 1, 1, 2, 63, int(random.integers(0, 64))]))
    length = 8 if random.random() < 0.7 else int(random.integers(0, 65))
    data = random.bytes(length)
    if length == 8 and random.random() < 0.5:
        data = struct.pack("<ff", *(EXTREMES[int(random.integers(0, len(EXTREMES)))] for _ in range(2)))
    flags = [random.random() < 0.05 for _ in range(3)]
    return CanFrame(node << 5 | int(random.integers(0, 32)), data, *flags)


@pytest.mark.parametrize("line", ["0.5", "0.6"])
def test_the_twin_survives_any_traffic_and_its_torque_stays_finite_and_limited(
    line: Literal["0.5", "0.6"],
) -> None:
    seed = 2
    random = Generator(PCG64(seed))
    twin = make_twin(device(options=Options(firmware=line)), seed)
    limit = twin.settings.current_hard_max * twin.settings.torque_constant
    for turn in range(TURNS):
        now = turn * MILLISECOND
        frame = random_frame(random)
        if isinstance(frame, CanFrame) and frame.id & 0x1F in (0x06, 0x16, 0x1F):
            continue  # it would be gone: renamed, restarting, or in its boot loader
        twin.receive(now, frame)
        if turn % 50 == 0:
            for message in (to("Set_Controller_Mode", 1 + turn // 50 % 3, 1 + turn // 150 % 6), CLOSED):
                twin.receive(now, encode(1, message))
        torques, frames = twin.step(now, [msg.Feedback("left", now, position=turn * 0.01, velocity=10.0)])
        assert math.isfinite(torques[0].torque), (seed, turn, frame)
        assert abs(torques[0].torque) <= limit, (seed, turn, frame)
        assert all(isinstance(reported, CanFrame) and len(reported.data) == 8 for reported in frames)
