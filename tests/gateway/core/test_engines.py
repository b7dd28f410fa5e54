"""A recorded drive through the whole gateway, with either engine of the filter."""

from __future__ import annotations

from contextlib import closing
from dataclasses import replace
from itertools import takewhile

import numpy as np

from gateway import config
from gateway.core.step import Gateway
from gateway.runtime.session import open_session
from protocols.messages import SECOND, Goal


def test_filterpy_as_the_engine_gives_the_same_drive() -> None:
    """Tick by tick: the same commands, and the same estimate and covariance to 1e-9."""
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
        assert outputs[0].packets == outputs[1].packets
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
