"""Every base on wheels through the office, by its robot file alone; its legs against the shortest paths.

./go prove -k tours                    PROVE_ROBOTS="mecanum omni" chooses some
"""

from __future__ import annotations

import os
from contextlib import closing

import pytest

from brain.bodies.body import Base
from gateway.cli.tour import Tour
from gateway.config import load_robot
from gateway.runtime.session import open_session
from protocols.messages import SECOND
from tests.shortest import shortest

pytestmark = pytest.mark.prove

ROBOTS = ["diffbot", "ackermann", "mecanum", "omni", "skid_steer", "swerve", "tracked"]
LONGEST = 300 * SECOND
"""Of a tour"""


@pytest.mark.parametrize("name", os.environ.get("PROVE_ROBOTS", " ".join(ROBOTS)).split())
def test_the_tour_of_the_office(name: str) -> None:
    robot = load_robot(name)
    body = robot.brain.body
    assert isinstance(body, Base)
    with open_session(robot, simulated=True) as session:
        assert session.twins is not None
        tour = Tour(session, session.tour())
        session.submit(*tour.goals)
        with closing(session.run()) as ticks:
            for tick in ticks:
                tour.on_tick(tick)
                if len(tour.arrivals) == len(tour.goals) or tick.now > LONGEST:
                    break
    print(f"\n{name}", *tour.figures(), sep="\n")
    assert tour.near == len(tour.goals)
    assert (tour.contacts, tour.touched_people) == (0, 0)
    corners = [tuple(outline) for outline in tour.outlines]
    at = (0.0, 0.0)
    for leg, arrival in zip(tour.legs, tour.arrivals, strict=True):
        best = shortest(corners, at, (arrival.goal.x, arrival.goal.y), body.inner_radius)
        print(f"goal {arrival.goal.x:.1f}, {arrival.goal.y:.1f}: {leg.driven:.2f} m, at best {best:.2f} m")
        if body.turning_radius == 0.0:
            assert leg.driven <= 1.05 * best + 0.1
        at = (arrival.goal.x, arrival.goal.y)
