"""Another program in the place of our perception, or of our control: by its grids, by its twists."""

from __future__ import annotations

import math
from dataclasses import replace
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest

import gateway
from brain.belief import Belief
from gateway.config import load_robot, parse_robot
from gateway.core.robot import Robot
from gateway.recording import read_recording
from gateway.replay import replay_recording
from protocols import messages as msg
from protocols.messages import SECOND

GOAL = msg.Goal(1.2, 0.3)
GIVEN = {"perception": "[brain.perception]\n", "pursuit": "[brain.pursuit]\n"}


def robot(*given: str) -> Robot:
    """The robot of which these are given."""
    text = load_robot("diffbot").text
    for name in given:
        table = GIVEN[name]
        there = table in text
        text = text.replace(table, f"{table}given = true\n") if there else f"{text}\n{table}given = true\n"
    return parse_robot(text)


def twist(belief: Belief) -> msg.Drive | None:
    """What a simple controller sends: to the point 0.4 m ahead on the path; nothing without one."""
    if belief.estimate is None or not belief.path:
        return None
    pose, path = belief.estimate.pose, belief.path
    fine = [
        (a[0] + (b[0] - a[0]) * k / 20.0, a[1] + (b[1] - a[1]) * k / 20.0)
        for a, b in pairwise(path)
        for k in range(21)
    ]
    nearest = min(range(len(fine)), key=lambda i: math.dist(fine[i], (pose.x, pose.y)))
    ahead = next((p for p in fine[nearest:] if math.dist(p, (pose.x, pose.y)) > 0.4), fine[-1])
    if math.dist(fine[-1], (pose.x, pose.y)) <= 0.1:
        return msg.Drive(0.0, 0.0)
    angle = math.remainder(math.atan2(ahead[1] - pose.y, ahead[0] - pose.x) - pose.yaw, math.tau)
    return msg.Drive(0.3 * max(0.0, math.cos(angle)), max(-1.0, min(1.0, 2.0 * angle)))


def grid(free: bool = True) -> msg.Grid:
    """4 × 4 m about the origin of the odometry, with a wall across x = 0.6 m, or free."""
    cells = np.ones((80, 80), np.uint8)
    if not free:
        cells[:, 52] = 2
    return msg.Grid(-2.0, -2.0, 0.0, True, 0.05, 80, cells.tobytes())


def test_another_program_drives_along_our_path_to_the_goal(tmp_path: Path) -> None:
    recording = tmp_path / "led.mcap"
    with gateway.open_session(robot("pursuit"), simulated=True, seed=1, record=recording) as session:
        session.submit(GOAL)
        versions, driven, still = set[int](), 0, 0.0
        for tick in session.run(seconds=40.0):
            belief = session.belief
            versions.add(belief.path_version)
            if tick.now < 3 * SECOND and belief.estimate is not None:
                still = max(still, math.hypot(belief.estimate.pose.x, belief.estimate.pose.y))
            elif tick.number % 10 == 0 and (drive := twist(belief)) is not None:
                session.submit(drive)
                driven += 1
            if belief.reached:
                break
        pose = session.belief.estimate.pose  # type: ignore[union-attr]
    assert still < 0.02, "without who drives, the base stands"
    assert session.belief.reached == 1
    assert math.dist((pose.x, pose.y), (GOAL.x, GOAL.y)) <= 0.25
    assert driven > 20
    assert max(versions) >= 1
    comparison = replay_recording(read_recording(recording))
    assert comparison.ok, comparison.text()


def test_who_drives_falls_silent_and_the_goal_stays() -> None:
    with gateway.open_session(robot("pursuit"), simulated=True, seed=1) as session:
        session.submit(GOAL)
        for tick in session.run(seconds=5.0):
            if 2 * SECOND < tick.now < 3 * SECOND and tick.number % 10 == 0:
                session.submit(twist(session.belief) or msg.Drive(0.0, 0.0))
            belief = session.belief
    assert belief.estimate is not None
    assert abs(belief.estimate.linear) < 0.01
    assert belief.goal == GOAL
    assert belief.estimate.pose.x > 0.05


def test_a_mission_that_a_person_pauses_is_not_driven_on() -> None:
    with gateway.open_session(robot("pursuit"), simulated=True, seed=1) as session:
        session.submit(msg.Mission("there", (GOAL,)))
        refused, places = 0, dict[float, float]()
        for tick in session.run(seconds=9.0):
            if tick.now > 2 * SECOND and tick.number % 10 == 0:
                session.submit(msg.Drive(0.3, 0.0))
            if tick.now == 4 * SECOND:
                session.submit(msg.Pause())
            if tick.now == 7 * SECOND:
                session.submit(msg.Resume())
            if session.belief.estimate is not None:
                places[tick.now / SECOND] = session.belief.estimate.pose.x
            refused += "Drive refused: the mission is paused" in str(tick.outputs.notes)
        assert refused > 20
        assert places[4.0] > 0.1
        assert places[5.5] == pytest.approx(places[4.0], abs=0.25)  # it brakes,
        assert places[7.0] == pytest.approx(places[5.5], abs=0.005)  # and stands
        assert places[8.5] > places[7.0] + 0.1


def test_no_goal_is_reached_at_a_place_that_is_told_to_a_robot_that_sees_nothing() -> None:
    with gateway.open_session(robot("perception", "pursuit"), simulated=True, seed=1) as session:
        assert session.twins is not None
        session.submit(msg.Goal(1.0, 0.0))
        for tick in session.run(seconds=4.0):
            if tick.now == 2 * SECOND:
                session.twins.disconnect("lidar")
            elif tick.now == 3 * SECOND:
                assert "no scan" in session.belief.reason
                session.submit(msg.Locate(1.0, 0.0, 0.0))
            belief = session.belief
    assert belief.reached == 0
    assert belief.goal == msg.Goal(1.0, 0.0)


@pytest.mark.parametrize("walled", [False, True])
def test_what_another_program_perceives_is_planned_on(walled: bool, tmp_path: Path) -> None:
    recording = tmp_path / "given.mcap"
    with gateway.open_session(robot("perception"), simulated=True, seed=1, record=recording) as session:
        session.submit(GOAL)
        for tick in session.run(seconds=20.0):
            if tick.number % 100 == 99:
                session.submit(grid(free=not walled))
            if session.belief.reached:
                break
        belief = session.belief
    assert belief.map is not None
    assert {int(np.abs(tile).max()) for tile in belief.map.tiles.values()} == {1}
    assert belief.reached == (0 if walled else 1)
    if walled:
        assert belief.estimate is not None
        assert belief.estimate.pose.x < 0.45, "it stands before a wall that only the grid has"
    comparison = replay_recording(read_recording(recording))
    assert comparison.ok, comparison.text()


@pytest.mark.parametrize(
    ("given", "wrong", "said"),
    [
        ((), {}, "the robot perceives by itself, unless its file says otherwise: perception.given = true"),
        (("perception",), {"columns": 79}, "whole rows are expected"),
        (("perception",), {"columns": 0}, "whole rows are expected"),
        (("perception",), {"resolution": 0.01}, "to 10 m are expected"),
        (("perception",), {"resolution": 10.0}, "it covers 800 × 800 m: at most 51.2 × 51.2 m are taken"),
        (("perception",), {"x": 1e5}, "is beyond 10000 m"),
        (("perception",), {"yaw": math.nan}, "its yaw must be"),
    ],
)
def test_a_grid_that_cannot_be_taken_is_refused_in_words(
    given: tuple[str, ...], wrong: dict[str, float], said: str
) -> None:
    notes = list[str]()
    with gateway.open_session(robot(*given), simulated=True, seed=1) as session:
        for tick in session.run(seconds=1.5):
            notes += [note.text for note in tick.outputs.notes]
            if tick.number == 250:
                session.submit(replace(grid(), **wrong))  # type: ignore[arg-type]
    assert any(said in note for note in notes), notes
