"""Tasks: the queue, manual driving and its timeout, replanning, exploring, patience."""

from __future__ import annotations

import tracemalloc
from dataclasses import replace
from math import hypot
from typing import NamedTuple

import numpy as np
import pytest

from brain.belief import Pose
from brain.bodies.plane import Twist
from brain.perception.body_scan import to_body
from brain.perception.map import Map, MapSettings
from brain.perception.mount import Mount
from brain.planning.behaviours import STATES, BehaviourState, Fact
from brain.planning.costmap import PlannerSettings
from brain.planning.navigator import Navigator
from brain.planning.planner import FrontierPath, Path
from brain.planning.polyline import Point, Polyline
from protocols.messages import MILLISECOND, SECOND, Drive, Goal, Nanos
from tests.brain.helpers import BODY
from tests.brain.perception.office import box, scan_at
from tests.brain.planning.maps import PlainMap, two_rooms


class Run:
    """A navigator on a map, tick by tick."""

    def __init__(
        self, grid: PlainMap, here: Point = (0.0, 0.0), settings: PlannerSettings | None = None
    ) -> None:
        self.navigator = Navigator(BODY, settings or PlannerSettings())
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

    def path(self) -> Path | FrontierPath | None:
        return self.navigator.path

    def busy(self) -> bool:
        return self.navigator.busy

    def texts(self) -> str:
        return " | ".join(text for _, text in self.navigator.notes)


def test_goals_are_reached_in_order() -> None:
    run = Run(PlainMap(two_rooms()))
    run.tick(Goal(1.0, 1.0), Goal(4.0, 1.0, 1.5))
    for goal in (Goal(1.0, 1.0), Goal(4.0, 1.0, 1.5)):
        run.run(0.3)
        assert run.navigator.goals.present == goal
        assert isinstance(run.navigator.path, Path)
        assert run.navigator.path.points[0] == run.here
        assert run.navigator.path.points[-1] == (goal.x, goal.y)
        run.here = (goal.x, goal.y)
        run.navigator.arrived(run.now)
    assert run.navigator.goals.reached == 2
    assert not run.busy()
    assert "goal 2 reached: (4.00, 1.00, yaw 1.50)" in run.texts()


def test_a_path_that_becomes_blocked_is_replaced_within_the_period() -> None:
    grid = PlainMap(two_rooms(height=60, door=(2, 12)))
    grid.occupied[48:58, 30] = False
    run = Run(grid, (0.0, -1.4))
    run.tick(Goal(4.0, -1.4))
    run.run(0.2)
    assert isinstance(run.navigator.path, Path)
    version = run.navigator.route().version
    grid.occupied[2:12, 30] = True
    grid.version += 1
    run.run(0.4)
    assert isinstance(run.navigator.path, Path)
    assert run.navigator.route().version > version
    assert max(y for _, y in run.navigator.path.points) > 2.5
    assert "the path is dropped: it is blocked near" in run.texts()


def test_a_wall_that_shifts_by_less_than_the_margin_costs_no_path() -> None:
    """Planned with the margin, checked without: a map that flickers does not make the robot stutter."""
    grid = PlainMap(two_rooms())
    run = Run(grid, settings=PlannerSettings(comfort=0.0, dislike=0.0, margin=0.15))
    run.tick(Goal(4.0, 0.0))
    run.run(0.3)
    version = run.navigator.route().version
    grid.occupied[[16, 25], 30] = True
    grid.version += 1
    run.run(1.0)
    assert run.navigator.route().version == version


def test_off_the_path_a_new_one_is_planned() -> None:
    run = Run(PlainMap(two_rooms()))
    run.tick(Goal(4.0, 0.0))
    run.run(0.3)
    run.here = (0.0, 1.2)
    run.run(0.4)
    assert run.navigator.path is not None
    assert run.navigator.path.points[0] == (0.0, 1.2)
    assert "m off it" in run.texts()


def test_a_goal_without_a_path_is_given_up_with_the_reason_and_the_next_follows() -> None:
    closed = two_rooms()
    closed[:, 30] = True
    run = Run(PlainMap(closed), settings=PlannerSettings(patience=8 * SECOND))
    run.tick(Goal(4.0, 0.0), Goal(1.0, 1.0), Goal(4.0, 1.0))
    run.run(1.0)
    assert run.navigator.route().version == 0
    assert "is closed" in run.navigator.no_path_reason
    run.run(7.5)
    assert run.navigator.goals.why.startswith("no path to goal 1 (4.00, 0.00) within 8 s: everything between")
    assert (run.navigator.goals.ended, run.navigator.goals.reached, run.navigator.goals.given_up) == (
        1,
        0,
        "",
    )
    assert "it is given up, 2 to go" in run.texts()
    assert isinstance(run.navigator.path, Path)
    run.here = (1.0, 1.0)
    run.navigator.arrived(run.now)
    run.run(8.5)
    assert not run.busy()
    assert (run.navigator.goals.ended, run.navigator.goals.reached) == (3, 1)
    assert run.navigator.goals.given_up.startswith("no path to goal 3 (4.00, 1.00)")
    assert run.texts().count("no path: ") == 2
    run.tick(Goal(1.0, 1.0))
    assert run.navigator.goals.given_up == ""


class Person(NamedTuple):
    """Somebody in motion."""

    x: float
    y: float
    vx: float
    vy: float


def test_who_crosses_is_waited_for_and_who_stands_is_driven_around() -> None:
    for speed, states in ((0.8, ["following", "yielding"]), (0.0, ["following"])):
        grid = PlainMap(np.zeros((40, 60), bool))
        run = Run(grid, (0.0, 0.0))
        run.tick(Goal(4.0, 0.0))
        run.run(0.4)
        grid.occupied[17:24, 30] = True
        grid.version += 1
        seen = []
        for _ in range(150):
            moving = (Person(2.0, 0.0, 0.0, speed),)
            run.navigator.step(run.now, run.here, grid, moving=moving)
            run.now += 5 * MILLISECOND
            seen.append(run.navigator.behaviour.state.value)
        assert list(dict.fromkeys(seen))[: len(states)] == states
        assert (run.navigator.motion == Twist()) == (speed > 0.0)  # stands, and keeps its path
        assert run.path() is not None
        grid.occupied[17:24, 30] = speed == 0.0
        grid.version += 1
        run.run(0.6)
        assert run.navigator.behaviour.state is BehaviourState.FOLLOWING
        assert run.navigator.motion is None


def test_a_base_that_is_stuck_backs_off_twice_then_looks_around_then_gives_up() -> None:
    """There is a path by the map, and an obstacle that only the stop zone sees."""
    run = Run(PlainMap(np.zeros((40, 60), bool)), settings=PlannerSettings(patience=25 * SECOND))
    run.tick(Goal(4.0, 0.0))
    seen, standing, yaw = [], 0.0, 0.0
    for _ in range(5400):
        motion = run.navigator.motion
        moves = motion is not None and motion != Twist()
        standing = 0.0 if moves else standing + 0.005
        if motion is not None:
            run.here = run.here[0] + motion.linear * 0.005, run.here[1]
            yaw += motion.angular * 0.005
        elif run.here[0] < 0.0:
            run.here = run.here[0] + 0.002, run.here[1]
            standing = 0.0
        run.navigator.step(run.now, run.here, run.grid, yaw, standing, "a chair ahead")
        run.now += 5 * MILLISECOND
        seen.append(run.navigator.behaviour.state.value)
    states = [state for state, before in zip(seen, ["", *seen], strict=False) if state != before]
    stuck = ["following", "backing off", "planning"]
    assert states[:8] == ["planning", *stuck, *stuck, "following"]
    assert states[8:10] == ["looking", "planning"]
    assert run.navigator.goals.given_up == "no way on to goal 1 (4.00, 0.00) for 25 s: a chair ahead"


def test_every_state_is_left_and_every_fact_is_used() -> None:
    following = {after for rows in STATES.values() for _, after in rows}
    assert set(STATES) == set(BehaviourState) == following | {BehaviourState.IDLE}
    assert all(any(fact in (Fact.NO_GOAL, Fact.GOAL) for fact, _ in rows) for rows in STATES.values())
    assert {fact for rows in STATES.values() for fact, _ in rows} == set(Fact)


def test_a_search_is_given_up_for_its_work_and_never_for_its_time() -> None:
    settings = PlannerSettings(expansions_per_step=20, patience=SECOND // 10)
    slow, costly = (
        Run(PlainMap(two_rooms()), settings=replace(settings, expansions_per_search=most))
        for most in (1_000_000, 4000)
    )
    for run in (slow, costly):
        run.tick(Goal(4.0, 0.0))
        run.run(10.0)
    assert isinstance(slow.navigator.path, Path)
    assert "has not ended after 4000 expansions" in costly.navigator.goals.given_up


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


def test_a_path_out_of_a_place_too_near_to_an_obstacle_is_not_dropped_for_its_beginning() -> None:
    run = Run(PlainMap(two_rooms()), (1.88, -1.0))
    run.tick(Goal(0.0, 0.0))
    run.run(1.0)
    assert isinstance(run.navigator.path, Path)
    assert run.navigator.route().version == 1
    assert "the path begins with" in run.texts()


def test_a_goal_given_up_after_its_path_was_blocked_says_so() -> None:
    run = Run(PlainMap(two_rooms()), settings=PlannerSettings(patience=8 * SECOND))
    run.tick(Goal(4.0, 0.0))
    run.run(0.3)
    run.grid.occupied[:, 30] = True
    run.grid.version += 1
    run.run(9.0)
    assert not run.busy()
    assert (
        "is closed; a path known before is obstructed, perhaps only for a time: it is"
        in run.navigator.goals.given_up
    )


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
        if run.navigator.goals.reached:
            break
    assert explored
    assert run.navigator.goals.reached == 1


def test_what_becomes_known_before_the_base_moves_is_not_explored() -> None:
    grid = PlainMap(two_rooms(), np.ones((40, 60), bool))
    grid.unknown[5:15, 15:35] = False
    run = Run(grid)
    run.tick(Goal(2.0, 0.0))
    run.run(0.1)
    grid.unknown[:] = False
    grid.version += 1
    run.run(0.2)
    assert isinstance(run.path(), Path)
    assert "exploring" not in run.texts()


def test_a_frontier_that_stays_unknown_is_excluded_and_exploring_ends() -> None:
    """A pane of glass, a blind spot: exploring must not wait there for ever."""
    unknown = np.zeros((40, 60), bool)
    unknown[:, 31:] = True
    run = Run(PlainMap(two_rooms(), unknown), settings=PlannerSettings(patience=8 * SECOND))
    run.tick(Goal(4.0, 0.0))
    for _ in range(10_000):
        run.tick()
        if isinstance(run.navigator.path, FrontierPath):
            run.here = run.navigator.path.points[-1]
            run.navigator.arrived(run.now)
        if not run.busy():
            break
    assert run.navigator.goals.reached == 0
    assert "is closed" in run.navigator.goals.given_up


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
    version = run.navigator.route().version
    run.run(0.3)
    assert run.navigator.route().version == version + 1
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
    while run.path() is not None and run.now < start + 10 * SECOND:
        run.navigator.step(run.now, run.here, run.grid)
        run.now += span
    assert run.now - start <= periods * PlannerSettings().period + 2 * span


def test_in_a_map_of_places_far_apart_a_path_is_found_at_once() -> None:
    """Planning takes the part about the robot: not all that lies between two places 3 km apart."""
    rolling, walls = Map(MapSettings(farthest=6.0)), np.array(box(-3, -3, 3, 3))
    for far in (0.0, 2000.0):
        pose = Pose(far, far, 0.1)
        for _ in range(3):
            scan = scan_at(walls + far, pose, Mount(), 0, np.zeros(360))
            rolling.add(pose, to_body(scan, Mount(), 6.0), np.zeros((3, 3)))
    navigator, now = Navigator(BODY, PlannerSettings()), SECOND
    navigator.accept(now, Goal(2001.5, 2001.0))
    tracemalloc.start()
    for _ in range(200):
        now += 20 * MILLISECOND
        navigator.step(now, (2000.0, 2000.0), rolling)
    assert tracemalloc.get_traced_memory()[1] < 300e6
    tracemalloc.stop()
    assert navigator.path is not None
    assert navigator.path.points[-1] == pytest.approx((2001.5, 2001.0))


HALLS = {
    "corridor": ([*box(-1, -1.1, 26, -1), *box(-1, 1, 26, 1.1), *box(25.5, -1, 25.6, 1)], 24.5),
    "hall": ([*box(-1, -9, 61, -8.9), *box(-1, 8.9, 61, 9), *box(28, -6, 32, 9)], 58.0),
}


@pytest.mark.parametrize("name", HALLS)
def test_a_goal_far_beyond_a_map_of_few_tiles_is_reached(name: str) -> None:
    """With the map itself, and a robot that knows its pose and sees 6 m."""
    walls, far = HALLS[name]
    rolling = Map(MapSettings(farthest=6.0, tiles=64))
    navigator, now, here = Navigator(BODY, PlannerSettings()), SECOND, (0.0, 0.0)
    navigator.accept(now, Goal(far, 0.0))
    while navigator.goals.waiting:
        pose = Pose(*here, 0.0)
        scan = scan_at(np.array(walls), pose, Mount(), now, np.zeros(360))
        rolling.add(pose, to_body(scan, Mount(), 6.0), np.zeros((3, 3)))
        for _ in range(10):
            now += 20 * MILLISECOND
            navigator.step(now, here, rolling)
        if navigator.path is not None:
            line = navigator._watch.line
            along = line.project(here)[0] + 0.8
            here = line.point(min(along, line.length))
            if along >= line.length:
                navigator.arrived(now)
        assert now < 200 * SECOND, navigator.notes
    assert navigator.goals.reached == 1
    assert hypot(here[0] - far, here[1]) < 1e-9
    assert navigator.terrain is not None
    assert (rolling.tile(0, 0) is None) == (rolling.forgotten > 0) == (name == "hall")
    assert len(navigator.terrain.costmap.tiles) <= 2 * 64  # of the map, and beside it
