"""The navigator: a queue of goals, the path to the first of them, replanning, and manual driving.

Rules. A goal is reached only at its true position. Where no known path leads to it, the robot follows a
`FrontierPath` to the best frontier of known ground and replans as the map grows; a frontier that stays
unknown when seen from near is excluded, so exploring ends. A path that becomes blocked is dropped at once:
the robot brakes until there is another. Without any path for `patience` the goals are given up, with a note
why. Manual driving takes over: it drops the goals, and ends by itself if it is not repeated. After a stop
nothing is resumed: goals must be sent again. The map is checked periodically; a search goes on at each step.
"""

from __future__ import annotations

from itertools import islice, pairwise
from math import hypot

from brain.planning.astar import Searching
from brain.planning.costmap import (
    BLOCKED,
    MAX_LINES,
    Costmap,
    Map,
    PlannerSettings,
    footprint_costmap,
    planning_costmap,
)
from brain.planning.planner import FrontierPath, NoPath, Path, PathQuery
from brain.planning.polyline import Point, Polyline
from brain.status import Note, NoteLevel
from protocols.messages import MILLISECOND, SECOND, Drive, Goal, Nanos, seconds

FRONTIER_TOLERANCE = 0.2
"""m: a frontier this near is reached, and two frontiers this close are the same"""
FRONTIER_TIMEOUT: Nanos = SECOND
"""Time that a reached frontier may stay unknown before it is excluded."""
MAX_PATH_ERROR = 0.5
"""m off the path, from which on a new one is planned"""


class Navigator:
    """Goals, path and manual driving. State is plain data."""

    def __init__(self, radius: float, settings: PlannerSettings) -> None:
        self.radius, self.settings = radius, settings
        self.goals: list[Goal] = []
        self.reached = 0
        self.drive: Drive | None = None
        self.path: Path | FrontierPath | None = None
        self.path_version = 0
        self.no_path_reason = ""
        """Why there is no path to the goal; "" while that is not known."""
        self.given_up = ""
        """Why the last goals were given up; "" after a new task."""
        self.costmap: Costmap | None = None
        """As of the last check of the map."""
        self.notes: list[Note] = []
        self._drive_until: Nanos = 0
        self._query: PathQuery | None = None
        self._check_at: Nanos = 0
        self._explore_at: Nanos = 0
        self._pathless_since: Nanos | None = None
        self._frontier_since: Nanos | None = None
        """Since when the robot stands at the frontier that it went to."""
        self._excluded: tuple[Point, ...] = ()
        """Frontiers that stayed unknown."""

    @property
    def busy(self) -> bool:
        """True if there is a goal, or manual driving."""
        return bool(self.goals) or self.drive is not None

    @property
    def goal(self) -> Goal | None:
        """The present goal."""
        return self.goals[0] if self.goals else None

    def accept(self, now: Nanos, task: Goal | Drive) -> None:
        """Accept a task. Goals queue; manual driving takes over."""
        self.given_up = ""
        if isinstance(task, Goal):
            self.goals.append(task)
            if len(self.goals) == 1:
                self._begin_goal(now)
            self._note("info", f"goal {self.reached + len(self.goals)} accepted: {_text(task)}")
            return
        if self.goals:
            self._note("warning", f"manual driving: {self.drop()}")
        if self.drive is None:
            self._note("info", "manual driving")
        self.drive = task
        self._drive_until = now + self.settings.drive_timeout

    def drop(self) -> str:
        """Drop every task; return in words what was dropped."""
        count = len(self.goals)
        self.goals, self.drive = [], None
        self._drop_path()
        self._query, self._pathless_since, self.no_path_reason = None, None, ""
        return "nothing to drop" if not count else f"{count} goal{'s' if count > 1 else ''} dropped"

    def pause(self) -> None:
        """Do not count this time against `patience` (the robot may not move now)."""
        self._pathless_since = None

    def step(self, now: Nanos, here: Point, grid: Map) -> None:
        """Continue the search, or check the map if that is due: a bounded amount of work."""
        if self.drive is not None and now >= self._drive_until:
            self.drive = None
            timeout = self.settings.drive_timeout // MILLISECOND
            self._note("info", f"manual driving ended: not repeated within {timeout} ms")
        if not self.goals:
            return
        if now >= self._check_at:
            self._check_at = now + self.settings.period
            self._check_map(now, here, grid)
        elif self._query is not None:
            self._continue_search(now, here)
        self._check_patience(now)

    def arrived(self, now: Nanos) -> None:
        """Process that the robot stands at the end of the path."""
        if isinstance(self.path, FrontierPath):
            self._frontier_since = now if self._frontier_since is None else self._frontier_since
        elif self.path is not None:
            self.reached += 1
            goal = self.goals.pop(0)
            self._note("info", f"goal {self.reached} reached: {_text(goal)}")
            self._begin_goal(now)

    # -- private ------------------------------------------------------------------------------

    def _begin_goal(self, now: Nanos) -> None:
        """Start with the first goal of the queue."""
        self._drop_path()
        self._query, self._excluded, self.no_path_reason = None, (), ""
        self._check_at = now
        self._pathless_since = now if self.goals else None

    def _drop_path(self) -> None:
        if self.path is not None:
            self.path = None
            self.path_version += 1
        self._frontier_since = None

    def _check_map(self, now: Nanos, here: Point, grid: Map) -> None:
        """Drop a path that is obstructed, and start a search if one is due."""
        goal = (self.goals[0].x, self.goals[0].y)
        costmap = planning_costmap(
            grid, self.radius, self.settings, standing=here, unreachable=self._excluded
        )
        self.costmap = costmap
        if self.path is not None:
            obstruction = self._obstruction(here, grid)
            if obstruction:
                self._note("info", f"the path is dropped: {obstruction}")
                self._drop_path()
                self._query = None
            elif isinstance(self.path, Path) or now < self._explore_at:
                return
        if self._query is not None:
            return
        self._explore_at = now + self.settings.explore
        occupied = footprint_costmap(grid, 0.0) if costmap.level_at(*here) == BLOCKED else None
        self._query = PathQuery(costmap, occupied, here, goal, self.settings)

    def _obstruction(self, here: Point, grid: Map) -> str:
        """Return why the rest of the path cannot be followed; "" if it can.

        Checked with the footprint alone, without the margin used for planning: so a wall that shifts by a
        cell as it is seen better does not cost a path. Of a path with very many corners, the next ones."""
        assert self.path is not None
        line = Polyline(self.path.points)
        along, off = line.project(here)
        if off > MAX_PATH_ERROR:
            return f"the robot is {off:.2f} m off it"
        costmap = footprint_costmap(grid, self.radius)
        rest = [line.point(along), *(p for p, at in zip(line.points, line.at, strict=True) if at > along)]
        begin = along
        for a, b in islice(pairwise(rest), MAX_LINES):
            begin += hypot(b[0] - a[0], b[1] - a[1])
            escaping = begin <= self.path.escape + costmap.resolution
            if not escaping and costmap.is_blocked(a, b):
                return f"it is blocked near ({b[0]:.2f}, {b[1]:.2f})"
        return ""

    def _continue_search(self, now: Nanos, here: Point) -> None:
        assert self._query is not None
        result = self._query.advance(self.settings.expansions_per_step)
        if isinstance(result, Searching):
            return
        self._query = None
        if isinstance(result, NoPath):
            if result.reason != self.no_path_reason:
                self._note("warning", f"no path: {result.reason}")
            self.no_path_reason = result.reason
            self._drop_path()
        elif isinstance(result, Path) or not self._keeps_frontier(now, here, result):
            self._use(result)

    def _keeps_frontier(self, now: Nanos, here: Point, result: FrontierPath) -> bool:
        """True if the result leads to where the robot already is, or equals the path it is following."""
        end = result.points[-1]
        if hypot(end[0] - here[0], end[1] - here[1]) > FRONTIER_TOLERANCE:
            self._frontier_since = None
            old = self.path
            return (
                isinstance(old, FrontierPath)
                and hypot(old.beyond[0] - result.beyond[0], old.beyond[1] - result.beyond[1])
                < FRONTIER_TOLERANCE
            )
        if self._frontier_since is None:
            self._frontier_since = now
        elif now - self._frontier_since > FRONTIER_TIMEOUT:
            self._excluded = (*self._excluded, result.beyond)
            self._frontier_since = None
        return self.path is not None

    def _use(self, result: Path | FrontierPath) -> None:
        end, length = result.points[-1], Polyline(result.points).length
        if isinstance(result, Path):
            self._note("info", f"path: {length:.2f} m to ({end[0]:.2f}, {end[1]:.2f})")
        elif not isinstance(self.path, FrontierPath):
            self._note("info", f"exploring: no known path to goal {self.reached + 1}")
        if result.escape > 0.0:
            self._note(
                "warning",
                f"too near to an obstacle: the path begins with {result.escape:.2f} m away from it",
            )
        self.path, self.no_path_reason, self._pathless_since = result, "", None
        self.path_version += 1

    def _check_patience(self, now: Nanos) -> None:
        if self.path is not None:
            self._pathless_since = None
            return
        if self._pathless_since is None:
            self._pathless_since = now
        if now - self._pathless_since < self.settings.patience:
            return
        goal = f"goal {self.reached + 1} {_text(self.goals[0])}"
        reason = self.no_path_reason or "the search has not ended"
        self.given_up = f"no path to {goal} within {seconds(self.settings.patience):g} s: {reason}"
        self._note("warning", self.drop())

    def _note(self, level: NoteLevel, text: str) -> None:
        self.notes.append((level, text))


def _text(goal: Goal) -> str:
    yaw = "" if goal.yaw is None else f", yaw {goal.yaw:.2f}"
    return f"({goal.x:.2f}, {goal.y:.2f}{yaw})"
