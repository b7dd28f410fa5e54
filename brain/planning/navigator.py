"""The navigator: a queue of goals, the path to the first of them, replanning, and manual driving.

Rules. A goal is reached only at its true position. Where no known path leads to it, the robot follows a
`FrontierPath` to the best frontier of known ground and replans as the map grows, or rolls towards a goal
beyond its extent; a frontier that stays unknown when seen from near is excluded, so exploring ends. A path
that becomes blocked is dropped at once: the robot brakes until there is another. Without any path for
`patience` the goals are given up, with a note why. Manual driving takes over: it drops the goals, and ends by
itself if it is not repeated. After a stop nothing is resumed: goals must be sent again. The work of a step
does not depend on the map's size.
"""

from __future__ import annotations

from math import hypot, inf

from brain.planning.astar import Searching
from brain.planning.costmap import NEAR, TILE_WORK, Costmap, Map, PlannerSettings
from brain.planning.planner import FrontierPath, NoPath, Path, PathQuery, PlanResult
from brain.planning.polyline import Point, Polyline
from brain.planning.snapshot import Snapshot, is_blocked
from brain.status import Note, NoteLevel
from protocols.messages import MILLISECOND, SECOND, Drive, Goal, Nanos, seconds

FRONTIER_TOLERANCE = 0.2
"""m: a frontier this near is reached, and two frontiers this close are the same"""
FRONTIER_TIMEOUT: Nanos = SECOND
"""Time that a reached frontier may stay unknown before it is excluded."""
MAX_PATH_ERROR = 0.5
"""m off the path, from which on a new one is planned"""
TILES_PER_STEP = 2
"""Changed tiles of the costmap that a step draws."""
CHECKED_PER_STEP = 4
"""Straight parts of the path, of 2 m at most, that a step checks: in each period first those ahead of the
robot,"""
CHECKED_FIRST = 5.0
"""m of them, then the rest in turn."""


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
        """None before the first step."""
        self.notes: list[Note] = []
        self._drive_until: Nanos = 0
        self._query: PathQuery | None = None
        self._line = Polyline(((0.0, 0.0),))
        """The path;"""
        self._along = self._checked = self._rest = 0.0
        """m along it: the robot at the last check, up to where it was checked since, where to go on then."""
        self._blocked = ""
        """Why the last path to this goal was dropped."""
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
        """Update the costmap, check the path, continue the search: a bounded amount of work."""
        if self.drive is not None and now >= self._drive_until:
            self.drive = None
            timeout = self.settings.drive_timeout // MILLISECOND
            self._note("info", f"manual driving ended: not repeated within {timeout} ms")
        wanted = (self.radius, self.settings)
        if self.costmap is None or (self.costmap.radius, self.costmap.settings) != wanted:
            self.costmap, self._query = Costmap(grid.resolution, self.radius, self.settings), None
        work = self.settings.expansions_per_step
        work -= TILE_WORK * self.costmap.update(grid, here, TILES_PER_STEP)
        if not self.goals:
            return
        if self.path is not None:
            self._check_path(now, here, self.costmap)
        if now >= self._check_at:
            self._check_at = now + self.settings.period
            if self._query is None and (
                self.path is None or (isinstance(self.path, FrontierPath) and now >= self._explore_at)
            ):
                self._explore_at = now + self.settings.explore
                goal = (self.goals[0].x, self.goals[0].y)
                ground = Snapshot(self.costmap, grid, here, goal, self._excluded)
                self._query = PathQuery(ground, here, goal, self.settings)
        if self._query is not None:
            self._continue_search(now, here, self._query.advance(max(work, 1), self.costmap, grid))
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
        self._query, self._excluded, self.no_path_reason, self._blocked = None, (), "", ""
        self._check_at = now
        self._pathless_since = now if self.goals else None

    def _drop_path(self) -> None:
        if self.path is not None:
            self.path = None
            self.path_version += 1
        self._frontier_since = None

    def _check_path(self, now: Nanos, here: Point, costmap: Costmap) -> None:
        """Drop a path that is obstructed: it is checked part by part, all over again each period.

        Checked with the footprint alone, without the margin used for planning: so a wall that shifts by a
        cell as it is seen better does not cost a path."""
        assert self.path is not None
        reason, line = "", self._line
        if now >= self._check_at:
            self._along, off = line.project(here)
            if off > MAX_PATH_ERROR:
                reason = f"the robot is {off:.2f} m off it"
            self._rest = self._checked if self._along < self._checked < line.length else inf
            self._checked = max(self._along, self.path.escape)
        for _ in range(CHECKED_PER_STEP):
            if reason or self._checked >= line.length:
                break
            if self._along + CHECKED_FIRST <= self._checked < self._rest < inf:
                self._checked, self._rest = self._rest, inf
            end = line.straight(self._checked, 2.0)
            a, b = line.point(self._checked), line.point(end)
            if is_blocked(costmap, a, b, NEAR):
                reason = f"it is blocked near ({b[0]:.2f}, {b[1]:.2f})"
            self._checked = end
        if reason:
            self._note("info", f"the path is dropped: {reason}")
            self._drop_path()
            self._query, self._check_at, self._blocked = None, now, reason

    def _continue_search(self, now: Nanos, here: Point, result: PlanResult) -> None:
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
        self._line, self._checked, self._along, self._rest = Polyline(result.points), result.escape, 0.0, inf
        end, length = result.points[-1], self._line.length
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
        if self._blocked:
            reason += f"; there was a path until {self._blocked}"
        self.given_up = f"no path to {goal} within {seconds(self.settings.patience):g} s: {reason}"
        self._note("warning", self.drop())

    def _note(self, level: NoteLevel, text: str) -> None:
        self.notes.append((level, text))


def _text(goal: Goal) -> str:
    yaw = "" if goal.yaw is None else f", yaw {goal.yaw:.2f}"
    return f"({goal.x:.2f}, {goal.y:.2f}{yaw})"
