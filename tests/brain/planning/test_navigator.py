"""Tasks: the queue, manual driving and its timeout, replanning, exploring, patience."""

from __future__ import annotations

import numpy as np
import pytest

from brain.planning.costmap import PlannerSettings
from brain.planning.navigator import Navigator
from brain.planning.planner import FrontierPath, Path
from brain.planning.polyline import Point, Polyline
from protocols.messages import MILLISECOND, SECOND, Drive, Goal, Nanos
from tests.brain.planning.maps import RADIUS, PlainMap, two_rooms


class Run:
    """A navigator on a map, tick by tick."""

    def __init__(
        self, grid: PlainMap, here: Point = (0.0, 0.0), settings: PlannerSettings | None = None
    ) -> None:
        self.navigator = Navigator(RADIUS, settings or PlannerSettings())
        self.grid, self.here, self.now = grid, here, SECOND

    def tick(self, *tasks: Goal | Drive) -> None:
        for task in tasks:
            self.navigator.accept(self.now, task)
        self.navigator.step(self.now, self.here, self.grid)
        self.now += 5 * MILLISECOND

    def run(self, span: float) -> None:
        for _ in range(round(span / 0.005)):
            self.tick()

    def drive(self) -> Drive | None:
        return self.navigator.drive

    def busy(self) -> bool:
        return self.navigator.busy

    def texts(self) -> str:
        return " | ".join(text for _, text in self.navigator.notes)


def test_goals_are_reached_in_order() -> None:
    run = Run(PlainMap(two_rooms()))
    run.tick(Goal(1.0, 1.0), Goal(4.0, 1.0, 1.5))
    for goal in (Goal(1.0, 1.0), Goal(4.0, 1.0, 1.5)):
        run.run(0.3)
        assert run.navigator.goal == goal
        assert isinstance(run.navigator.path, Path)
        assert run.navigator.path.points[0] == run.here
        assert run.navigator.path.points[-1] == (goal.x, goal.y)
        run.here = (goal.x, goal.y)
        run.navigator.arrived(run.now)
    assert run.navigator.reached == 2
    assert not run.busy()
    assert "goal 2 reached: (4.00, 1.00, yaw 1.50)" in run.texts()


def test_a_path_that_becomes_blocked_is_replaced_within_the_period() -> None:
    grid = PlainMap(two_rooms(height=60, door=(2, 12)))
    grid.occupied[48:58, 30] = False
    run = Run(grid, (0.0, -1.4))
    run.tick(Goal(4.0, -1.4))
    run.run(0.2)
    assert isinstance(run.navigator.path, Path)
    version = run.navigator.path_version
    grid.occupied[2:12, 30] = True
    grid.version += 1
    run.run(0.4)
    assert isinstance(run.navigator.path, Path)
    assert run.navigator.path_version > version
    assert max(y for _, y in run.navigator.path.points) > 2.5
    assert "the path is dropped: it is blocked near" in run.texts()


def test_a_wall_that_shifts_by_less_than_the_margin_costs_no_path() -> None:
    """Planned with the margin, checked without: a map that flickers does not make the robot stutter."""
    grid = PlainMap(two_rooms())
    run = Run(grid, settings=PlannerSettings(comfort=0.0, dislike=0.0, margin=0.15))
    run.tick(Goal(4.0, 0.0))
    run.run(0.3)
    version = run.navigator.path_version
    grid.occupied[[16, 25], 30] = True
    grid.version += 1
    run.run(1.0)
    assert run.navigator.path_version == version


def test_off_the_path_a_new_one_is_planned() -> None:
    run = Run(PlainMap(two_rooms()))
    run.tick(Goal(4.0, 0.0))
    run.run(0.3)
    run.here = (0.0, 1.2)
    run.run(0.4)
    assert run.navigator.path is not None
    assert run.navigator.path.points[0] == (0.0, 1.2)
    assert "m off it" in run.texts()


def test_no_path_in_time_gives_the_goals_up_with_the_reason() -> None:
    closed = two_rooms()
    closed[:, 30] = True
    run = Run(PlainMap(closed))
    run.tick(Goal(4.0, 0.0), Goal(1.0, 1.0))
    run.run(1.0)
    assert run.busy()
    assert run.navigator.path_version == 0
    assert "is closed" in run.navigator.no_path_reason
    run.run(7.5)
    assert not run.busy()
    assert run.navigator.given_up.startswith("no path to goal 1 (4.00, 0.00) within 8 s: everything between")
    assert run.texts().endswith("2 goals dropped")
    assert run.texts().count("no path: ") == 1
    run.tick(Goal(1.0, 1.0))
    assert run.navigator.given_up == ""
    run.run(0.3)
    assert isinstance(run.navigator.path, Path)


def test_a_search_that_does_not_end_is_no_path_in_time() -> None:
    run = Run(PlainMap(two_rooms()), settings=PlannerSettings(expansions_per_step=1, patience=SECOND))
    run.tick(Goal(4.0, 0.0))
    run.run(1.1)
    assert "the search has not ended" in run.navigator.given_up


def test_a_door_that_opens_in_time_is_taken() -> None:
    closed = two_rooms()
    closed[:, 30] = True
    grid = PlainMap(closed)
    run = Run(grid)
    run.tick(Goal(4.0, 0.0))
    run.run(3.0)
    grid.occupied[16:26, 30] = False
    grid.version += 1
    run.run(0.6)
    assert isinstance(run.navigator.path, Path)
    assert run.navigator.no_path_reason == ""


def test_manual_driving_ends_without_repetition() -> None:
    run = Run(PlainMap(two_rooms()))
    run.tick(Drive(0.2, 0.1))
    run.run(0.4)
    assert run.drive() == Drive(0.2, 0.1)
    run.tick(Drive(0.3, 0.0))
    run.run(0.45)
    assert run.drive() == Drive(0.3, 0.0)
    run.run(0.06)
    assert run.drive() is None
    assert "manual driving ended: not repeated within 500 ms" in run.texts()


def test_manual_driving_drops_the_goals() -> None:
    run = Run(PlainMap(two_rooms()))
    run.tick(Goal(4.0, 0.0))
    run.run(0.3)
    run.tick(Drive(0.1, 0.0))
    assert run.navigator.path is None
    run.run(2.0)
    assert not run.busy()
    assert "manual driving: 1 goal dropped" in run.texts()


def test_exploring_reaches_a_goal_behind_what_is_not_known_yet() -> None:
    """What lies within 1.5 m becomes known; the robot is moved along its paths."""
    occupied = two_rooms()
    occupied[0:14, 20] = True
    unknown = np.ones_like(occupied)
    grid = PlainMap(occupied, unknown)
    run = Run(grid, (0.0, -1.0))
    rows, columns = np.indices(occupied.shape)
    run.tick(Goal(4.0, -1.0))
    explored = False
    for _ in range(4000):
        x, y = -0.95 + 0.1 * columns, -1.95 + 0.1 * rows
        if bool((unknown & (np.hypot(x - run.here[0], y - run.here[1]) < 1.5)).any()):
            unknown &= np.hypot(x - run.here[0], y - run.here[1]) >= 1.5
            grid.version += 1
        run.tick()
        path = run.navigator.path
        explored |= isinstance(path, FrontierPath)
        if path is None:
            continue
        line = Polyline(path.points)
        along, _ = line.project(run.here)
        run.here = line.point(min(along + 0.01, line.length))
        if along >= line.length - 0.01:
            run.navigator.arrived(run.now)
        if run.navigator.reached:
            break
    assert explored
    assert run.navigator.reached == 1


def test_a_frontier_that_stays_unknown_is_excluded_and_exploring_ends() -> None:
    """A pane of glass, a blind spot: exploring must not wait there for ever."""
    unknown = np.zeros((40, 60), bool)
    unknown[:, 31:] = True
    run = Run(PlainMap(two_rooms(), unknown))
    run.tick(Goal(4.0, 0.0))
    for _ in range(10_000):
        run.tick()
        if isinstance(run.navigator.path, FrontierPath):
            run.here = run.navigator.path.points[-1]
            run.navigator.arrived(run.now)
        if not run.busy():
            break
    assert run.navigator.reached == 0
    assert "is closed" in run.navigator.given_up


def test_the_path_is_checked_while_another_is_planned() -> None:
    unknown = np.zeros((40, 60), bool)
    unknown[:, 31:] = True
    grid = PlainMap(two_rooms(), unknown)
    run = Run(grid, (0.0, -1.4))
    run.tick(Goal(4.0, -1.0))
    run.run(0.5)
    assert isinstance(run.navigator.path, FrontierPath)
    run.navigator.settings = PlannerSettings(expansions_per_step=1)
    run.run(0.6)
    grid.occupied[10:30, 25] = True
    grid.version += 1
    version = run.navigator.path_version
    run.run(0.3)
    assert run.navigator.path_version == version + 1
    assert "the path is dropped: it is blocked near" in run.texts()


@pytest.mark.parametrize("span", [5 * MILLISECOND, 20 * MILLISECOND, 70 * MILLISECOND])
@pytest.mark.parametrize(("at", "periods"), [(30, 1), (560, 3)])
def test_an_obstacle_on_the_path_is_found_in_time(span: Nanos, at: int, periods: int) -> None:
    """However long a step is: near the robot within a period, 55 m ahead within a few."""
    run = Run(PlainMap(np.pad(np.zeros((20, 600), bool), 1, constant_values=True)), (0.0, -1.0))
    run.tick(Goal(58.0, -1.0))
    run.run(2.0)
    assert isinstance(run.navigator.path, Path)
    run.grid.occupied[:, at] = True
    run.grid.version += 1
    start = run.now
    while run.navigator.path is not None:
        run.navigator.step(run.now, run.here, run.grid)
        run.now += span
    assert run.now - start <= periods * PlannerSettings().period + 2 * span
