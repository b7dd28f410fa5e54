"""Missions and behaviours of a base in the kinematic office, with the whole brain."""

from __future__ import annotations

import copy
from collections.abc import Sequence
from itertools import pairwise
from math import degrees, hypot, pi

import pytest

from brain.belief import BrainState, Pose
from brain.brain import Brain, BrainSettings
from protocols import messages as msg
from protocols.messages import MILLISECOND, SECOND, Command, Goal, Mission
from tests.brain.helpers import BODY, MOUNTS, TICK, TIMEOUTS, Office, Trip

DOOR = (2.0, 1.4, 2.1, 2.6)
NEXT_ROOM = Goal(4.5, -1.0)
OPEN = Pose(-1.0, 3.0, 0.0)
"""A place with 3 m of free ground ahead, and the origin of what the robot believes"""


def begun(*steps: msg.Step, office: Office | None = None, settings: BrainSettings | None = None) -> Trip:
    """A trip that has just begun a mission."""
    trip = Trip(office or Office(pose=OPEN), settings)
    trip.run(0.5)
    trip.tick([Mission("m", steps)])
    return trip


def texts(trip: Trip) -> str:
    return " | ".join(text for _, text in trip.notes)


def phase(trip: Trip) -> str:
    mission = trip.brain.belief().mission
    return mission.phase if mission else ""


@pytest.mark.parametrize("closed", [7.0, pytest.param(20.0, marks=pytest.mark.prove)])
def test_a_closed_door_is_waited_for_with_looks_and_then_taken(closed: float) -> None:
    trip = Trip(Office())
    trip.tick([NEXT_ROOM])
    trip.run(40.0, lambda b: trip.office.pose.x > 1.2 and bool(b.path) and b.path[-1][0] > 2.5)
    trip.office.boxes.append(DOOR)
    trip.run(closed)
    belief = trip.brain.belief()
    assert belief.goal == NEXT_ROOM
    assert belief.state is BrainState.DEGRADED
    assert [system.state in ("waiting", "looking") for system in belief.systems] == [False, True, False]
    trip.office.boxes.remove(DOOR)
    trip.run(15.0, lambda b: trip.office.pose.x > 2.3)
    assert trip.office.pose.x > 2.3
    assert trip.office.touched == 0
    assert "looking: everything between" in texts(trip)


def test_measured_motions_end_where_they_should_by_the_true_pose() -> None:
    trip = begun(msg.Move(0.4, distance=2.0), msg.Turn(-pi / 2), msg.Move(0.3, seconds=3.0))
    trip.run(25.0, lambda b: phase(trip) != "running")
    assert phase(trip) == "done"
    pose = trip.office.pose
    assert abs(pose.x - OPEN.x - 2.0) < 0.04
    assert abs(OPEN.y - pose.y - 0.9) < 0.08
    assert abs(degrees(pose.yaw) + 90.0) < 3.0
    assert trip.brain.belief().state is BrainState.READY


def test_a_stop_pauses_a_mission_and_only_an_operator_resumes_it() -> None:
    trip = begun(msg.Move(0.4, distance=2.0), Goal(2.0, 0.3))
    trip.run(2.0)
    for _ in range(50):
        trip.tick([msg.Resume()], stopped="stopped by hand")
    assert all(isinstance(command, msg.Idle) for command in trip.commands)
    assert "Resume refused: stopped by hand" in texts(trip)
    at = trip.office.pose
    trip.run(3.0)
    assert hypot(trip.office.pose.x - at.x, trip.office.pose.y - at.y) < 1e-6
    assert phase(trip) == "paused"
    assert trip.brain.belief().reason == "mission m is paused: stopped by hand"
    two = copy.deepcopy(trip)
    for each in (trip, two):
        each.tick([msg.Resume()])
        each.run(10.0, lambda b: bool(b.mission and b.mission.step == "2"))
    assert abs(trip.office.pose.x - OPEN.x - 2.0) < 0.05
    assert trip.office.pose == two.office.pose
    trip.run(10.0, lambda b: bool(b.mission and b.mission.phase == "done"))
    assert phase(trip) == "done"


def test_a_lost_source_and_a_hand_pause_it_and_others_must_wait() -> None:
    trip = begun(msg.Wait(60.0))
    trip.tick([NEXT_ROOM, Mission("other", (msg.Wait(1.0),))])
    assert "Goal refused: a mission is running: pause it, or drop it" in texts(trip)
    assert "Mission refused: mission 'm' is running, not done: drop it first" in texts(trip)
    trip.tick([msg.Drive(0.1, 0.0)])
    assert trip.brain.belief().mission is not None
    assert "paused at step 1 of 1: manual driving" in texts(trip)
    trip.run(1.0)
    trip.tick([msg.Resume(), msg.Locate(0.0, 0.0, 0.0)])  # where its map has begun
    assert "paused at step 1 of 1: the robot was told where it is" in texts(trip)
    trip.tick([msg.Resume()])
    trip.office.silent = {"lidar"}
    trip.run(15.0, lambda b: phase(trip) == "paused")
    assert phase(trip) == "paused"
    assert "paused at step 1 of 1: lidar: no scan" in texts(trip)
    trip.office.silent = set()
    trip.run(1.0)
    assert phase(trip) == "paused"
    trip.tick([msg.Drop()])
    assert phase(trip) == "dropped"
    assert trip.go(Goal(0.5, 0.0), span=10.0).reached == 1


def test_joints_that_a_base_carries_move_together_while_it_stands() -> None:
    office = Office()
    timeouts = {**TIMEOUTS, "mast": 100 * MILLISECOND}
    brain = Brain(BrainSettings(BODY), ("left", "mast", "right"), MOUNTS, timeouts)
    mast, log = 0.0, []
    mission = Mission("m", (msg.Reach((msg.Position("mast", 0.5),), 1.0), msg.Wait(0.1)))
    commands: Sequence[Command] = ()
    for tick in range(300):
        events = [*office.step([c for c in commands if c.motor != "mast"])]
        wanted = commands[1] if commands else msg.Idle("mast")
        speed = (wanted.position - mast) / 0.02 if isinstance(wanted, msg.Position) else 0.0
        mast += speed * 0.01
        events.append(msg.Feedback("mast", office.now, mast, speed))
        commands = brain.step(office.now, events, [mission] if tick == 50 else [], "")
        log.append(mast)
    belief = brain.belief()
    assert belief.mission is not None
    assert belief.mission.phase == "done"
    rates = [(b - a) / (TICK / SECOND) for a, b in pairwise(log)]
    assert abs(mast - 0.5) < 1e-3
    assert max(rates) < 1.05 * 1.875 * 0.5  # of the motion of least jerk: 15/8 of the mean


def test_a_lost_joint_that_a_step_moves_pauses_the_mission_whatever_its_name() -> None:
    office, mast = Office(), "mast: upper part"
    timeouts = {**TIMEOUTS, mast: 100 * MILLISECOND}
    brain = Brain(BrainSettings(BODY), ("left", mast, "right"), MOUNTS, timeouts)
    mission = Mission("m", (msg.Reach((msg.Position(mast, 0.5),), 9.0),))
    commands: Sequence[Command] = ()
    for tick in range(150):
        events = [*office.step([command for command in commands if command.motor != mast])]
        events += [msg.Feedback(mast, office.now, 0.0, 0.0)] if tick < 100 else []
        commands = brain.step(office.now, events, [mission] if tick == 50 else [], "")
    view = brain.belief().mission
    assert view is not None
    assert (view.phase, view.reason) == ("paused", f"{mast}: no feedback for more than 90 ms")
