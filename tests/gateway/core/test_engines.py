"""A recorded drive through the whole gateway, with either engine of the filter."""

from __future__ import annotations

import struct
from contextlib import closing
from dataclasses import replace
from itertools import takewhile

import numpy as np
import pytest

from gateway import config
from gateway.core.step import Gateway
from gateway.runtime.session import open_session
from protocols.frames import CanFrame, Packet
from protocols.messages import SECOND, Goal


def shape(packet: Packet) -> tuple[object, ...]:
    """All but the values of a frame."""
    assert isinstance(packet.frame, CanFrame)
    return packet.t, packet.bus, packet.frame.id, len(packet.frame.data)


def set_point(packet: Packet) -> float:
    """A velocity [turns/s], which comes first (ODrive, Set_Input_Vel); 0 in other frames."""
    assert isinstance(packet.frame, CanFrame)
    velocity: float = (
        struct.unpack_from("<f", packet.frame.data)[0] if packet.frame.id & 0x1F == 0x0D else 0.0
    )
    return velocity


def test_filterpy_as_the_engine_gives_the_same_drive() -> None:
    """Tick by tick: the same frames with set-points equal to 1e-6, estimate and covariance to 1e-9."""
    robot = config.load_robot("diffbot")
    with open_session(robot, simulated=True) as session:
        session.submit(Goal(1.2, 0.6))
        with closing(session.run()) as run:
            ticks = list(takewhile(lambda tick: tick.now < 6 * SECOND, run))
    perception = robot.brain.perception
    other = replace(perception, filter=replace(perception.filter, engine="filterpy"))
    ours = Gateway(robot)
    theirs = Gateway(replace(robot, brain=replace(robot.brain, perception=other)))
    for tick in ticks:
        outputs = [gateway.step(tick.now, tick.inputs) for gateway in (ours, theirs)]
        assert [shape(packet) for packet in outputs[0].packets] == [shape(p) for p in outputs[1].packets]
        a_points, b_points = ([set_point(p) for p in one.packets] for one in outputs)
        assert a_points == pytest.approx(b_points, abs=1e-6)
        a, b = ours.belief().estimate, theirs.belief().estimate
        if a is None or b is None:
            assert a is b
            continue
        assert (
            np.abs(np.subtract((a.pose.x, a.pose.y, a.pose.yaw), (b.pose.x, b.pose.y, b.pose.yaw))).max()
            < 1e-9
        )
        assert np.abs(a.covariance - b.covariance).max() < 1e-9
    assert ours.belief().reached == 1
