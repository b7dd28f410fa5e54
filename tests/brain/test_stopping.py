"""The whole brain before obstacles that appear: it stops in time, for goals and for driving by hand.

`screen_case` is one of a campaign's numbered cases (`tests/prove/test_stopping.py`); a sample runs here.
"""

from __future__ import annotations

from dataclasses import replace
from math import pi, sqrt

import numpy as np
import pytest

from brain.belief import BrainState, Pose
from brain.brain import BrainSettings
from brain.planning.costmap import PlannerSettings
from protocols import messages as msg
from protocols.messages import SECOND, seconds
from tests.brain.helpers import BODY, ROOMS, Box, Noise, Office, Trip

ROBOT = replace(
    BODY,
    footprint=(
        (0.2, 0.1),
        (0.05, 0.12),
        (-0.05, 0.12),
        (-0.2, 0.1),
        (-0.2, -0.1),
        (-0.05, -0.12),
        (0.05, -0.12),
        (0.2, -0.1),
    ),
)
HALL = ROOMS[:4]


class Hall(Office):
    """A hall whose lidar loses beams."""

    dropout = 0.0
    """Share of the beams that give no reading"""

    def scan(self) -> msg.LaserScan:
        scan = super().scan()
        lost = self._rng.random(len(scan.ranges)) < self.dropout
        return replace(scan, ranges=tuple(np.where(lost, 0.0, scan.ranges).tolist()))


def hall(pose: Pose, seed: int = 1, noise: float = 0.01, dropout: float = 0.0) -> Trip:
    """At rest in the hall, with all sources reporting."""
    office = Hall(HALL, pose, Noise(range=noise), seed, ROBOT)
    office.dropout = dropout
    trip = Trip(office, BrainSettings(ROBOT))
    trip.run(0.5)
    return trip


def by_hand(trip: Trip, linear: float, angular: float, span: float) -> None:
    """Repeat the same twist for this time [s]."""
    for _ in range(round(span * 100)):
        trip.tick([msg.Drive(linear, angular)])


def least_distance(speed: float) -> float:
    """From how near on [m] nothing can be done: 100 ms until the next scan, 10 ms of a tick and 50 ms of the
    wheels' lag at this speed, then braking; and 4 cm by which noise may hide."""
    return speed * 0.16 + speed**2 / (2.0 * ROBOT.max_linear_acceleration) + 0.04


def screen(random: np.random.Generator, pose: Pose, distance: float) -> Box:
    """A screen across the way, this far before the robot's front, more or less to a side; or beside it."""
    width = random.uniform(0.5, 3.0)
    if random.random() < 0.7:
        x, y = pose.x + 0.2 + distance, pose.y + random.uniform(-1.0, 1.0) * (0.5 * width + 0.1)
        return x, y - 0.5 * width, x + 0.03, y + 0.5 * width
    side = pose.y + random.choice([-1.0, 1.0]) * (0.12 + distance)
    return pose.x - 0.5 * width, side, pose.x + 0.5 * width, side + 0.03


def screen_case(seed: int, number: int) -> str:
    """Drive at random, let a screen appear where braking is still possible; return what came of it."""
    random = np.random.Generator(np.random.PCG64((seed, number)))
    trip = hall(
        Pose(-1.0, random.uniform(0.0, 2.0), 0.0),
        int(random.integers(1 << 30)),
        random.uniform(0.003, 0.03),
        float(random.choice([0.0, 0.1, 0.4])),
    )
    office, speed = trip.office, random.uniform(0.2, 0.6)
    goal = number % 4 == 3
    if goal:
        trip.tick([msg.Goal(5.0, 0.0)])
        trip.run(10.0, lambda _: office.pose.x > 0.0 and office.speed > 0.4)
    else:
        by_hand(trip, speed, 0.0, 1.0 + random.random())
    near = least_distance(abs(office.speed))
    office.boxes.append(screen(random, office.pose, random.uniform(near, max(near, 1.5))))
    if goal:
        trip.run(6.0)
    else:
        by_hand(trip, speed, float(random.choice([0.0, 0.0, -0.3, 0.3, 0.8])), 4.0)
    assert office.touched == 0, f"touched at {office.pose}, {office.boxes[-1]}"
    return f"{'goal' if goal else 'by hand'}: {trip.brain.belief().state}"


@pytest.mark.sample(2)
@pytest.mark.parametrize("number", range(4))
def test_a_screen_that_appears_is_never_touched(number: int) -> None:
    screen_case(8, number)


def test_by_hand_it_stops_before_a_wall_with_one_note_and_can_leave() -> None:
    trip = hall(Pose(4.0, 1.0, 0.0), seed=5, noise=0.02)
    by_hand(trip, 0.5, 0.0, 5.0)
    assert trip.office.touched == 0
    assert 0.04 < 6.0 - trip.office.pose.x - 0.2 < 0.12
    belief = trip.brain.belief()
    assert belief.state is BrainState.DEGRADED
    assert belief.reason.startswith("obstacle 0.0")
    assert belief.reason.endswith("m ahead: standing")
    assert sum("obstacle" in text for _, text in trip.notes) == 1
    by_hand(trip, -0.3, 0.0, 2.0)
    assert trip.office.pose.x < 5.4
    assert trip.brain.belief().reason == ""
    trip.run(1.0)
    assert trip.brain.belief().state is BrainState.READY


def test_the_command_falls_in_the_very_step_in_which_the_scan_shows_the_obstacle() -> None:
    trip = hall(Pose(-1.0, 1.0, 0.0))
    assert trip.brain.set("pursuit.period_ms", 70.0) == ""
    by_hand(trip, 0.6, 0.0, 1.53)
    office, before = trip.office, trip.commands
    assert office.speed > 0.59
    office.boxes.append((office.pose.x + 0.5, 0.5, office.pose.x + 0.53, 1.5))
    appeared = office.now
    while trip.commands == before:
        trip.tick([msg.Drive(0.6, 0.0)])
    assert office.now % (SECOND // 10) == 0
    while office.speed > 0.58:
        trip.tick([msg.Drive(0.6, 0.0)])
    slower, jerk = 0.02, 0.7 * ROBOT.max_linear_jerk  # by how much it is then, and the ramp to that
    ramp = sqrt(2.0 * slower / jerk) - slower / ROBOT.max_linear_acceleration
    assert seconds(office.now - appeared) <= 0.15 + ramp


def test_a_stronger_deceleration_is_used_before_what_is_too_near_for_the_ordinary_one() -> None:
    stopped = []
    for deceleration in (None, 4.0):
        trip = hall(Pose(-1.0, 1.0, 0.0))
        strong = replace(ROBOT, stop_deceleration=deceleration)
        trip = Trip(trip.office, BrainSettings(strong))
        trip.run(0.5)
        by_hand(trip, 0.6, 0.0, 1.5)
        trip.office.boxes.append((trip.office.pose.x + 0.38, 0.5, trip.office.pose.x + 0.41, 1.5))
        by_hand(trip, 0.6, 0.0, 2.0)
        stopped.append(trip.office.touched == 0)
    assert stopped == [False, True]


def test_a_thin_pole_is_seen_and_not_touched() -> None:
    for offset in (-0.1, 0.0):
        trip = hall(Pose(-1.0, 1.0, 0.0))
        by_hand(trip, 0.6, 0.0, 1.5)
        x, y = trip.office.pose.x + 1.0, 1.0 + offset
        trip.office.boxes.append((x, y - 0.025, x + 0.05, y + 0.025))
        by_hand(trip, 0.6, 0.0, 2.5)
        assert trip.office.touched == 0
        assert "standing" in trip.brain.belief().reason


def test_normal_driving_is_not_slowed() -> None:
    """A goal in the next room, and one 0.31 m before a wall: never standing."""
    office = Office(pose=Pose(1.0, 2.0, 0.0), body=ROBOT)
    trip = Trip(office, BrainSettings(ROBOT))
    assert trip.go(msg.Goal(2.2, 0.0)).reached == 1
    assert abs(office.pose.x - 3.2) < 0.1
    assert trip.go(msg.Goal(1.41, 1.0, -pi / 2.0)).reached == 2
    assert trip.office.touched == 0
    assert "degraded" not in trip.states


def test_goals_are_dropped_if_there_is_a_path_and_no_room_to_follow_it() -> None:
    """In a slot 6 cm wider than the robot, with the goal behind it: the corners would touch."""
    slot = ((2.2, 1.15, 2.7, 1.3), (2.2, 0.7, 2.7, 0.85))
    office = Office((*HALL, *slot), Pose(2.3, 1.0, 0.0), body=ROBOT)
    patient = PlannerSettings(patience=SECOND)
    trip = Trip(office, BrainSettings(ROBOT, planner=patient))
    trip.tick([msg.Goal(-1.5, 0.0)])
    trip.run(4.0, lambda b: b.goal is None)
    assert "for 1 s: obstacle 0.0" in trip.notes[-2][1]
    assert trip.brain.belief().path == ()
    assert office.touched == 0
