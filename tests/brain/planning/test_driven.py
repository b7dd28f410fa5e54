"""Plans that are driven, in a kinematic office: a door of 0.45 m, a slow zone."""

from __future__ import annotations

from dataclasses import replace

from brain.planning.costmap import PlannerSettings
from brain.planning.zones import Zone
from brain.settings import BrainSettings
from protocols import messages as msg
from tests.brain.helpers import BODY, ROOMS, Office, Trip
from tests.brain.planning.maps import DIFFBOT

OUTLINED = replace(BODY, footprint=DIFFBOT.corners)
NARROW = (*ROOMS[:4], (2.0, -2.0, 2.1, 0.9), (2.0, 1.35, 2.1, 4.0), *ROOMS[6:])
"""The office with a door of 0.45 m."""


def through_the_door(seed: int, *goals: msg.Goal) -> Trip:
    """Drive through it; a collision, or a goal that is not reached, fails."""
    trip = Trip(Office(NARROW, seed=seed, body=OUTLINED), BrainSettings(OUTLINED))
    trip.go(*goals)
    reached = [text for _, text in trip.notes if "reached" in text]
    assert len(reached) == len(goals), f"seed {seed}: {trip.notes}"
    assert trip.office.touched == 0, f"seed {seed}"
    return trip


def test_a_robot_0_24_m_wide_drives_through_a_door_of_0_45_m() -> None:
    assert through_the_door(1, msg.Goal(3.0, 1.6)).office.pose.x > 2.9


def test_in_a_slow_zone_it_drives_slowly() -> None:
    ramp = Zone(((0.3, -3.0), (0.9, -3.0), (0.9, 5.0), (0.3, 5.0)), "slow", 0.2)
    settings = BrainSettings(OUTLINED, planner=PlannerSettings(zones={"ramp": ramp}))
    trip, inside, outside = Trip(Office(body=OUTLINED), settings), [0.0], [0.0]
    trip.tick([msg.Goal(1.6, 1.5)])
    for _ in range(1200):
        trip.tick()
        (inside if 0.32 < trip.office.pose.x < 0.88 else outside).append(trip.office.speed)
    assert trip.office.pose.x > 1.0
    assert max(inside) < 0.23
    assert max(outside) > 0.4
