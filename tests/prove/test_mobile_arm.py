"""The base with an arm, and the two arms, over their motors' languages, with the whole brain: what they carry
ends where it should."""

from __future__ import annotations

from contextlib import closing
from math import hypot

import pytest

from gateway.config import load_robot
from gateway.config.mission import load_mission
from gateway.runtime.session import open_session

pytestmark = pytest.mark.prove

NEAR = 0.06
"""m from where it is to be put down"""


@pytest.mark.parametrize(
    ("robot", "mission", "place", "limit"),
    [
        ("mobile_arm", "carry", (0.2, 1.89, 0.235), 90.0),
        ("two_arms", "hand_over", (0.376, -0.35, 0.035), 60.0),
    ],
)
def test_a_block_is_carried(
    robot: str, mission: str, place: tuple[float, float, float], limit: float
) -> None:
    made = load_robot(robot)
    with open_session(made, simulated=True, seed=0) as session:
        assert session.twins is not None
        world = session.twins.world
        session.submit(load_mission(mission, made))
        with closing(session.run(limit)) as ticks:
            for _ in ticks:
                view = session.belief.mission
                if view is not None and view.phase not in ("running", "paused"):
                    break
        view = session.belief.mission
        assert view is not None
        assert (view.phase, view.reason) == ("done", "")
        x, y, z = world.movable()["block"]
        assert z == pytest.approx(place[2], abs=0.01), "it lies on what it was put on"
        assert hypot(x - place[0], y - place[1]) < NEAR
        assert world.contacts() == 0
