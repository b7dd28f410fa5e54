"""Tasks: the queue, driving by hand and its timeout, replanning, exploring, patience."""

from __future__ import annotations

import numpy as np
import pytest

from brain.planning.line import Line, Point
from brain.planning.mission import Mission
from brain.planning.planner import FrontierPath, Path
from brain.planning.survey import PlannerSettings
from protocols.messages import MILLISECOND, SECOND, Drive, Goal, Nanos
from tests.brain.planning.test_planner import RADIUS, Paper, two_rooms


class Day:
    """A mission at work on a map, tick by tick."""

    def __init__(
        self, grid: Paper, here: Point = (0.0, 0.0), settings: PlannerSettings | None = None
    ) -> None:
        self.mission = Mission(RADIUS, settings or PlannerSettings())
        self.grid, self.here, self.now = grid, here, SECOND

    def tick(self, *tasks: Goal | Drive) -> None:
        for task in tasks:
            self.mission.ask(self.now, task)
        self.mission.step(self.now, self.here, self.grid)
        self.now += 5 * MILLISECOND

    def run(self, span: float) -> None:
        for _ in range(round(span / 0.005)):
            self.tick()

    def busy(self) -> bool:
        return self.mission.busy

    def drive(self) -> Drive | None:
        return self.mission.drive

    def texts(self) -> str:
        return " | ".join(text for _, text in self.mission.remarks)


def test_goals_are_reached_in_the_order_in_which_they_were_asked() -> None:
    day = Day(Paper(two_rooms()))
    day.tick(Goal(1.0, 1.0), Goal(4.0, 1.0, 1.5))
    for goal in (Goal(1.0, 1.0), Goal(4.0, 1.0, 1.5)):
        day.run(0.3)
        assert day.mission.goal == goal
        assert isinstance(day.mission.path, Path)
        assert day.mission.path.points[0] == day.here
        assert day.mission.path.points[-1] == (goal.x, goal.y)
        day.here = (goal.x, goal.y)
        day.mission.arrived(day.now)
    assert day.mission.reached == 2
    assert not day.busy()
    assert "goal 2 reached: (4.00, 1.00, yaw 1.50)" in day.texts()


def test_a_path_that_becomes_blocked_is_replaced_within_the_period() -> None:
    grid = Paper(two_rooms(height=60, door=(2, 12)))
    grid.occupied[48:58, 30] = False
    day = Day(grid, (0.0, -1.4))
    day.tick(Goal(4.0, -1.4))
    day.run(0.2)
    assert isinstance(day.mission.path, Path)
    version = day.mission.path_version
    grid.occupied[2:12, 30] = True
    grid.version += 1
    day.run(0.4)
    assert isinstance(day.mission.path, Path)
    assert day.mission.path_version > version
    assert max(y for _, y in day.mission.path.points) > 2.5
    assert "the path is dropped: something stands on it near" in day.texts()


def test_a_wall_that_shifts_by_less_than_the_margin_costs_no_path() -> None:
    """Planned with the margin, judged without: a map that flickers does not make the robot stutter."""
    grid = Paper(two_rooms())
    day = Day(grid, settings=PlannerSettings(comfort=0.0, dislike=0.0, margin=0.15))
    day.tick(Goal(4.0, 0.0))
    day.run(0.3)
    version = day.mission.path_version
    grid.occupied[[16, 25], 30] = True
    grid.version += 1
    day.run(1.0)
    assert day.mission.path_version == version


def test_astray_from_the_path_there_is_a_new_one() -> None:
    day = Day(Paper(two_rooms()))
    day.tick(Goal(4.0, 0.0))
    day.run(0.3)
    day.here = (0.0, 1.2)
    day.run(0.4)
    assert day.mission.path is not None
    assert day.mission.path.points[0] == (0.0, 1.2)
    assert "m off it" in day.texts()


def test_no_path_in_time_gives_the_goals_up_and_says_why() -> None:
    closed = two_rooms()
    closed[:, 30] = True
    day = Day(Paper(closed))
    day.tick(Goal(4.0, 0.0), Goal(1.0, 1.0))
    day.run(1.0)
    assert day.busy()
    assert day.mission.path_version == 0
    assert "is closed" in day.mission.why_none
    day.run(7.5)
    assert not day.busy()
    assert day.mission.given_up.startswith("no path to goal 1 (4.00, 0.00) within 8 s: everything between")
    assert day.texts().endswith("2 goals dropped")
    assert day.texts().count("no path: ") == 1
    day.tick(Goal(1.0, 1.0))
    assert day.mission.given_up == ""
    day.run(0.3)
    assert isinstance(day.mission.path, Path)


def test_a_search_that_does_not_end_is_no_path_in_time() -> None:
    day = Day(Paper(two_rooms()), settings=PlannerSettings(expansions_per_step=1, patience=SECOND))
    day.tick(Goal(4.0, 0.0))
    day.run(1.1)
    assert "the search has not ended" in day.mission.given_up


def test_a_door_that_opens_in_time_is_taken() -> None:
    closed = two_rooms()
    closed[:, 30] = True
    grid = Paper(closed)
    day = Day(grid)
    day.tick(Goal(4.0, 0.0))
    day.run(3.0)
    grid.occupied[16:26, 30] = False
    grid.version += 1
    day.run(0.6)
    assert isinstance(day.mission.path, Path)
    assert day.mission.why_none == ""


def test_driving_by_hand_ends_when_the_operator_falls_silent() -> None:
    day = Day(Paper(two_rooms()))
    day.tick(Drive(0.2, 0.1))
    day.run(0.4)
    assert day.drive() == Drive(0.2, 0.1)
    day.tick(Drive(0.3, 0.0))
    day.run(0.45)
    assert day.drive() == Drive(0.3, 0.0)
    day.run(0.06)
    assert day.drive() is None
    assert "driving by hand ended: not repeated within 500 ms" in day.texts()


def test_driving_by_hand_takes_over_and_goals_do_not_come_back() -> None:
    day = Day(Paper(two_rooms()))
    day.tick(Goal(4.0, 0.0))
    day.run(0.3)
    day.tick(Drive(0.1, 0.0))
    assert day.mission.path is None
    day.run(2.0)
    assert not day.busy()
    assert "driven by hand: 1 goal dropped" in day.texts()


def test_exploring_reaches_a_goal_behind_what_is_not_known_yet() -> None:
    """What lies within 1.5 m becomes known; the robot is moved along its paths."""
    occupied = two_rooms()
    occupied[0:14, 20] = True
    unknown = np.ones_like(occupied)
    grid = Paper(occupied, unknown)
    day = Day(grid, (0.0, -1.0))
    rows, columns = np.indices(occupied.shape)
    day.tick(Goal(4.0, -1.0))
    explored = False
    for _ in range(4000):
        x, y = -0.95 + 0.1 * columns, -1.95 + 0.1 * rows
        if bool((unknown & (np.hypot(x - day.here[0], y - day.here[1]) < 1.5)).any()):
            unknown &= np.hypot(x - day.here[0], y - day.here[1]) >= 1.5
            grid.version += 1
        day.tick()
        path = day.mission.path
        explored |= isinstance(path, FrontierPath)
        if path is None:
            continue
        line = Line(path.points)
        along, _ = line.project(day.here)
        day.here = line.point(min(along + 0.01, line.length))
        if along >= line.length - 0.01:
            day.mission.arrived(day.now)
        if day.mission.reached:
            break
    assert explored
    assert day.mission.reached == 1


def test_an_edge_that_stays_unknown_is_given_up_and_exploring_ends() -> None:
    """A pane of glass, a blind spot: it must not be stared at for ever."""
    unknown = np.zeros((40, 60), bool)
    unknown[:, 31:] = True
    day = Day(Paper(two_rooms(), unknown))
    day.tick(Goal(4.0, 0.0))
    for _ in range(10_000):
        day.tick()
        if isinstance(day.mission.path, FrontierPath):
            day.here = day.mission.path.points[-1]
            day.mission.arrived(day.now)
        if not day.busy():
            break
    assert day.mission.reached == 0
    assert "is closed" in day.mission.given_up


def test_the_path_is_watched_while_another_is_being_planned() -> None:
    unknown = np.zeros((40, 60), bool)
    unknown[:, 31:] = True
    grid = Paper(two_rooms(), unknown)
    day = Day(grid, (0.0, -1.4))
    day.tick(Goal(4.0, -1.0))
    day.run(0.5)
    assert isinstance(day.mission.path, FrontierPath)
    day.mission.settings = PlannerSettings(expansions_per_step=1)
    day.run(0.6)
    grid.occupied[10:30, 25] = True
    grid.version += 1
    version = day.mission.path_version
    day.run(0.3)
    assert day.mission.path_version == version + 1
    assert "the path is dropped: something stands on it" in day.texts()


@pytest.mark.parametrize("span", [5 * MILLISECOND, 20 * MILLISECOND, 70 * MILLISECOND])
def test_looks_are_due_by_time_not_by_count(span: Nanos) -> None:
    day = Day(Paper(two_rooms()))
    looks = []
    blocked = day.grid.blocked
    day.grid.blocked = lambda radius: (looks.append(day.now), blocked(radius))[1]  # type: ignore[method-assign, func-returns-value]
    day.mission.ask(day.now, Goal(4.0, 0.0))
    while day.now < 11 * SECOND:
        day.mission.step(day.now, day.here, day.grid)
        day.now += span
    moments = sorted(set(looks))
    assert len(moments) == pytest.approx(40, abs=5)
