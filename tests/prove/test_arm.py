"""The arm's grasp, whole: the block is lifted, and is on the tray at the end; several seeds."""

from __future__ import annotations

from contextlib import closing

import pytest

from gateway.config import load_robot
from gateway.config.mission import load_mission
from gateway.runtime.session import open_session
from protocols.messages import SECOND

pytestmark = pytest.mark.prove


@pytest.mark.parametrize(
    ("name", "seed"), [("arm", 0), ("arm", 1), ("arm", 2), ("arm_dynamixel", 0), ("arm_feetech", 0)]
)
def test_the_block_is_lifted_and_put_on_the_tray(name: str, seed: int) -> None:
    robot = load_robot(name)
    highest, contacts = 0.0, 0
    with open_session(robot, simulated=True, seed=seed) as session:
        assert session.twins is not None
        world = session.twins.world
        session.submit(load_mission("grasp", robot))
        with closing(session.run()) as ticks:
            for tick in ticks:
                highest = max(highest, world.movable()["block"][2])
                contacts = world.contacts()
                view = session.belief.mission
                if (view is not None and view.phase not in ("running", "paused")) or tick.now > 40 * SECOND:
                    break
        assert view is not None
        assert (view.phase, view.reason) == ("done", "")
        x, y, z = world.movable()["block"]
    assert highest > 0.18
    assert (x, y) == pytest.approx((0.0, 0.4), abs=0.02)
    assert z == pytest.approx(0.055, abs=0.005)
    assert contacts == 0
