"""The way of a car through a hall with pillars: our Hybrid A*, and OMPL's RRTConnect on Reeds-Shepp curves.

Rules. Both have the same map, turning radius, start and goal, and a pose is free for both if it is for our
footprint. OMPL asks a function in Python for each pose: most answers are read from a table, as ours are. It
looks for any way, and shortens that afterwards if it is told to; ours, for one that is nearly the cheapest,
with metres backward twice as dear. So the length of a way, as a multiple of ours, stands beside its time.
"""

from __future__ import annotations

from importlib import import_module
from math import hypot
from typing import Any

import numpy as np

from benchmarks.measure import Call, Effort, NotMeasured, in_turn, rival
from benchmarks.paths import EVERYTHING, SEED, Mask, ground_of
from benchmarks.rows import Row, against
from brain.belief import Pose
from brain.planning.astar import CellPath, CellSearch
from brain.planning.costmap import NEAR, UNKNOWN
from brain.planning.footprint import Footprint, Shape
from brain.planning.hybrid_astar import HybridSearch
from brain.planning.snapshot import Snapshot
from brain.planning.ways import Prices, Way, Ways

GROUP = "a car's way, 75 m among pillars (1500 × 300 cells)"
WHAT = "Hybrid A*"
CELL, LONG, WIDE = 0.05, 80.0, 15.0
CAR = Shape(0.15, hypot(0.45, 0.15), ((0.45, -0.15), (0.45, 0.15), (-0.15, 0.15), (-0.15, -0.15)), 0.5)
"""A car of 0.6 × 0.3 m that turns with a radius of 0.5 m, on cells of this size, in a hall [m]"""
START, GOAL = (2.0, 2.0, 0.0), (77.0, 13.0, 0.0)
ENOUGH, SHORTENING = 30.0, 5.0
"""s that OMPL may search and shorten, at most"""


def cars(effort: Effort) -> list[Row]:
    """One hall."""
    blocked = pillars()
    ground, round_ = ground_of(blocked, CELL, CAR), ground_of(blocked, CELL, Shape.circle(CAR.outer))
    lengths: dict[str, list[float]] = {}
    contestants: dict[str, Call] = {"ours": lambda: lengths.setdefault("ours", []).append(ours(ground))}
    ompl = rival("ompl", "ompl")
    first, shortened = "RRTConnect, its first way", "the same and simplifySolution"
    if not ompl.why_not:
        theirs = InOmpl(ground)
        contestants[first] = lambda: lengths.setdefault(first, []).append(theirs.way(shortened=False))
        contestants[shortened] = lambda: lengths.setdefault(shortened, []).append(theirs.way(shortened=True))
    plain = "our A*, a circle about the car that turns on the spot"
    contestants[plain] = lambda: lengths.setdefault(plain, []).append(of_circle(round_))
    found = in_turn(contestants, effort.of(7, 1))
    named = {
        f"{'' if name == plain else ompl.name + ': '}{name}; {_median(each) / _median(lengths['ours']):.2f} "
        "of the length": found[name]
        for name, each in lengths.items()
        if name != "ours"
    }
    return [Row(GROUP, WHAT, found["ours"], against(named, *named, missing=(ompl,)))]


def _median(values: list[float]) -> float:
    return float(np.median(values))


def pillars() -> Mask:
    """A hall of 80 × 15 m with a pillar of 0.5 m every few metres. The same every time."""
    random = np.random.Generator(np.random.PCG64(SEED))
    size = round(LONG / CELL)
    blocked = np.zeros((size, size), dtype=np.bool_)
    blocked[round(WIDE / CELL) :, :] = blocked[0, :] = blocked[:, [0, -1]] = True
    for _ in range(60):
        row, column = random.integers(20, 280), random.integers(80, 1500)
        blocked[row : row + 10, column : column + 10] = True
    return blocked


def ours(ground: Snapshot) -> float:
    """The length of our way [m]."""
    search = HybridSearch(Ways(ground, Footprint(CAR, CELL), Prices()), Pose(*START), GOAL)
    way = search.advance(EVERYTHING)
    if not isinstance(way, Way):
        raise NotMeasured(f"no way for a car: {way}")
    return float(np.hypot(*np.diff(way.poses[:, :2], axis=0).T).sum())


def of_circle(ground: Snapshot) -> float:
    """The length of the way for a circle [m]: no car can follow it."""
    start, end = ground.index(*START[:2]), ground.index(*GOAL[:2])
    assert start is not None
    assert end is not None
    way = CellSearch(ground, start, end).advance(EVERYTHING)
    if not isinstance(way, CellPath):
        raise NotMeasured(f"no way for a circle: {way}")
    return way.cost


class Free:
    """Whether the car may be at a pose, for one pose at a time."""

    def __init__(self, ground: Snapshot) -> None:
        rows, columns = np.indices((round(WIDE / CELL), round(LONG / CELL)))
        levels = ground.levels(rows.reshape(-1), columns.reshape(-1)) % UNKNOWN
        self._levels: Any = levels.reshape(rows.shape).tolist()
        self._ground, self._footprint = ground, Footprint(CAR, CELL)

    def at(self, x: float, y: float, yaw: float) -> bool:
        """As `Footprint.collides` has it; the table first, which knows most."""
        if not (0.0 <= x < LONG and 0.0 <= y < WIDE):
            return False
        level = self._levels[int(y / CELL)][int(x / CELL)]
        if level < NEAR or level >= self._ground.wide:
            return bool(level >= NEAR)
        pose = (np.array([value]) for value in (x, y, yaw))
        return not bool(self._footprint.collides(self._ground, *pose)[0])


class InOmpl:
    """The same hall in OMPL (2.0.1)."""

    def __init__(self, ground: Snapshot) -> None:
        self._base, self._geometric = import_module("ompl.base"), import_module("ompl.geometric")
        util = import_module("ompl.util")
        util.setLogLevel(util.LogLevel.LOG_NONE)
        self._free = Free(ground)

    def way(self, *, shortened: bool) -> float:
        """The length of a way [m]; another one at each call."""
        base = self._base
        space = base.ReedsSheppStateSpace(1.1 * CAR.turning_radius)  # as ours: `ways.AUTHORITY`
        bounds = base.RealVectorBounds(2)
        for axis, most in enumerate((LONG, WIDE)):
            bounds.setLow(axis, 0.0)
            bounds.setHigh(axis, most)
        space.setBounds(bounds)
        setup = self._geometric.SimpleSetup(space)
        information = setup.getSpaceInformation()
        setup.setStateValidityChecker(lambda state: self._free.at(state.getX(), state.getY(), state.getYaw()))
        information.setStateValidityCheckingResolution(1.5 * CELL / space.getMaximumExtent())
        setup.setStartAndGoalStates(_state(space, START), _state(space, GOAL))
        setup.setPlanner(self._geometric.RRTConnect(information))
        setup.solve(ENOUGH)
        if not setup.haveExactSolutionPath():
            raise NotMeasured(f"OMPL has found no way in {ENOUGH:g} s")
        if shortened:
            setup.simplifySolution(SHORTENING)
        return float(setup.getSolutionPath().length())


def _state(space: Any, pose: tuple[float, float, float]) -> Any:  # noqa: ANN401 -- OMPL's
    state = space.allocState()
    state.setX(pose[0])
    state.setY(pose[1])
    state.setYaw(pose[2])
    return state
