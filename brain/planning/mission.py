"""What is to be done, and the path to it: a queue of goals, driving by hand, and replanning.

Rules. A goal is done only when its true place is reached. Where nothing known leads to it, the robot goes
`Toward` the best edge of the known, and asks again as the map grows; an edge that stays unknown when seen
from near is given up for another, so exploring ends. A path that becomes blocked is dropped at once: the
robot brakes until there is another. Without any path for `patience` the goals are given up, told why.
Driving by hand takes over: it drops the goals, and ends by itself if it is not repeated. After a stop
nothing is resumed: goals are asked anew. Looks at the map are due by `now`; a search goes on at each step.
"""

from __future__ import annotations

from itertools import pairwise
from math import hypot
from typing import Literal, TypeAlias

from brain.planning.astar import Searching
from brain.planning.costmap import BLOCKED, Costmap, Map, build, origin
from brain.planning.line import Line, Point
from brain.planning.planner import FrontierPath, NoPath, Path, Planning
from brain.planning.survey import PlannerSettings, survey
from protocols.messages import SECOND, Drive, Goal, Nanos, seconds

Level: TypeAlias = Literal["info", "warning", "error"]
Note: TypeAlias = tuple[Level, str]

NEAR = 0.2
"""m: an edge of the known this near is reached"""
STARE: Nanos = SECOND
"""How long an edge that is reached may stay unknown before it is given up."""
ASTRAY = 0.5
"""m off the path, from which on a new one is planned"""


class Mission:
    """The tasks and the path. State is plain data."""

    def __init__(self, radius: float, settings: PlannerSettings) -> None:
        self.radius, self.settings = radius, settings
        self.goals: list[Goal] = []
        self.reached = 0
        self.drive: Drive | None = None
        self.path: Path | FrontierPath | None = None
        self.path_version = 0
        self.why_none = ""
        """Why there is no path to the goal; "" while that is not known."""
        self.given_up = ""
        """Why the last goals were given up; "" after a new task."""
        self.costmap: Costmap | None = None
        """As it was at the last look at the map."""
        self.remarks: list[Note] = []
        self._drive_until: Nanos = 0
        self._planning: Planning | None = None
        self._look_at: Nanos = 0
        self._explore_at: Nanos = 0
        self._without_since: Nanos | None = None
        self._edge_since: Nanos | None = None
        self._dead: tuple[Point, ...] = ()

    @property
    def busy(self) -> bool:
        """Whether there is anything to be done."""
        return bool(self.goals) or self.drive is not None

    @property
    def goal(self) -> Goal | None:
        """The goal that is gone to."""
        return self.goals[0] if self.goals else None

    def ask(self, now: Nanos, task: Goal | Drive) -> None:
        """Take up a task. Goals queue; driving by hand takes over."""
        self.given_up = ""
        if isinstance(task, Goal):
            self.goals.append(task)
            if len(self.goals) == 1:
                self._begin(now)
            self._say("info", f"goal {self._number(len(self.goals))} asked: {place(task)}")
            return
        if self.goals:
            self._say("warning", f"driven by hand: {self.drop()}")
        if self.drive is None:
            self._say("info", "driven by hand")
        self.drive = task
        self._drive_until = now + self.settings.drive_timeout

    def drop(self) -> str:
        """Forget every task; what was dropped, in words."""
        count = len(self.goals)
        self.goals, self.drive = [], None
        self._forget_path()
        self._planning, self._without_since, self.why_none = None, None, ""
        return "nothing to drop" if not count else f"{count} goal{'s' if count > 1 else ''} dropped"

    def pause(self) -> None:
        """Time passes that must not count against a path (the robot may not move now)."""
        self._without_since = None

    def step(self, now: Nanos, here: Point, grid: Map) -> None:
        """Go on with the search, or look at the map if that is due: a bounded amount of work."""
        if self.drive is not None and now >= self._drive_until:
            self.drive = None
            self._say(
                "info", f"driving by hand ended: not repeated within {_ms(self.settings.drive_timeout)}"
            )
        if not self.goals:
            return
        if now >= self._look_at:
            self._look_at = now + self.settings.period
            self._look(now, here, grid)
        elif self._planning is not None:
            self._go_on(now, here)
        self._lose_patience(now)

    def arrived(self, now: Nanos) -> None:
        """The robot stands at the end of the path."""
        if isinstance(self.path, FrontierPath):
            self._edge_since = now if self._edge_since is None else self._edge_since
        elif self.path is not None:
            self.reached += 1
            done = self.goals.pop(0)
            self._say("info", f"goal {self.reached} reached: {place(done)}")
            self._begin(now)

    # -- within -------------------------------------------------------------------------------

    def _begin(self, now: Nanos) -> None:
        """The first goal of the queue is a new one."""
        self._forget_path()
        self._planning, self._dead, self.why_none = None, (), ""
        self._look_at = now
        self._without_since = now if self.goals else None

    def _forget_path(self) -> None:
        if self.path is not None:
            self.path = None
            self.path_version += 1
        self._edge_since = None

    def _look(self, now: Nanos, here: Point, grid: Map) -> None:
        """Is the path still good? Is it time for another?"""
        goal = (self.goals[0].x, self.goals[0].y)
        costmap = survey(grid, self.radius, self.settings, standing=here, given_up=self._dead)
        self.costmap = costmap
        if self.path is not None:
            off = self._obstructed(here, grid)
            if off:
                self._say("info", f"the path is dropped: {off}")
                self._forget_path()
                self._planning = None
            elif isinstance(self.path, Path) or now < self._explore_at:
                return
        if self._planning is not None:
            return
        self._explore_at = now + self.settings.explore
        occupied = _plain(grid, 0.0) if costmap.level_at(*here) == BLOCKED else None
        self._planning = Planning(costmap, occupied, here, goal, self.settings)

    def _obstructed(self, here: Point, grid: Map) -> str:
        """Why the rest of the path cannot be followed; "" if it can.

        Judged by the footprint alone, without the margin that it was planned with: so a wall that
        shifts by a cell as it is seen better does not cost a path."""
        assert self.path is not None
        line = Line(self.path.points)
        along, off = line.project(here)
        if off > ASTRAY:
            return f"the robot is {off:.2f} m off it"
        costmap = _plain(grid, self.radius)
        rest = [line.point(along), *(p for p, at in zip(line.points, line.at, strict=True) if at > along)]
        begin = along
        for a, b in pairwise(rest):
            begin += hypot(b[0] - a[0], b[1] - a[1])
            escaping = begin <= self.path.escapes + costmap.resolution
            if not escaping and costmap.is_blocked(a, b):
                return f"something stands on it near ({b[0]:.2f}, {b[1]:.2f})"
        return ""

    def _go_on(self, now: Nanos, here: Point) -> None:
        assert self._planning is not None
        answer = self._planning.advance(self.settings.expansions_per_step)
        if isinstance(answer, Searching):
            return
        self._planning = None
        if isinstance(answer, NoPath):
            if answer.reason != self.why_none:
                self._say("warning", f"no path: {answer.reason}")
            self.why_none = answer.reason
            self._forget_path()
        elif isinstance(answer, Path) or not self._stares(now, here, answer):
            self._take(answer)

    def _stares(self, now: Nanos, here: Point, answer: FrontierPath) -> bool:
        """Whether the answer is where the robot is already, or the way that it is on."""
        end = answer.points[-1]
        if hypot(end[0] - here[0], end[1] - here[1]) > NEAR:
            self._edge_since = None
            old = self.path
            return (
                isinstance(old, FrontierPath)
                and hypot(old.beyond[0] - answer.beyond[0], old.beyond[1] - answer.beyond[1]) < NEAR
            )
        if self._edge_since is None:
            self._edge_since = now
        elif now - self._edge_since > STARE:
            self._dead = (*self._dead, answer.beyond)
            self._edge_since = None
        return self.path is not None

    def _take(self, answer: Path | FrontierPath) -> None:
        end, length = answer.points[-1], Line(answer.points).length
        if isinstance(answer, Path):
            self._say("info", f"a path: {length:.2f} m to ({end[0]:.2f}, {end[1]:.2f})")
        elif not isinstance(self.path, FrontierPath):
            self._say("info", f"exploring: nothing known leads to goal {self._number(1)}")
        if answer.escapes > 0.0:
            self._say(
                "warning",
                f"too near to an obstacle: the path begins with {answer.escapes:.2f} m out of there",
            )
        self.path, self.why_none, self._without_since = answer, "", None
        self.path_version += 1

    def _lose_patience(self, now: Nanos) -> None:
        if self.path is not None:
            self._without_since = None
            return
        if self._without_since is None:
            self._without_since = now
        if now - self._without_since < self.settings.patience:
            return
        goal = self.goals[0]
        why = self.why_none or "the search has not ended"
        waited = seconds(self.settings.patience)
        self.given_up = f"no path to goal {self._number(1)} {place(goal)} within {waited:g} s: {why}"
        self._say("warning", self.drop())

    def _number(self, position: int) -> int:
        return self.reached + position

    def _say(self, level: Level, text: str) -> None:
        self.remarks.append((level, text))


def _plain(grid: Map, radius: float) -> Costmap:
    """Only what is blocked for this radius."""
    return build(
        grid.blocked(radius),
        grid.unknown,
        resolution=grid.resolution,
        origin=origin(grid),
        unknown_is_free=True,
    )


def place(goal: Goal) -> str:
    """A goal in words."""
    yaw = "" if goal.yaw is None else f", yaw {goal.yaw:.2f}"
    return f"({goal.x:.2f}, {goal.y:.2f}{yaw})"


def _ms(span: Nanos) -> str:
    return f"{span // 1_000_000} ms"
