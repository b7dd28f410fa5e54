"""The navigator: a queue of goals, the path to the first of them, what is done without one, manual driving.

Rules. A goal is reached only at its true position. Where no known path leads to it, the robot follows a
`FrontierPath` to the best frontier of known ground and replans as the map grows, or rolls towards a goal
beyond its extent; a frontier that stays unknown when seen from near is excluded, so exploring ends. A path
that becomes blocked is dropped at once: the robot brakes until there is another; but someone in motion there
is waited for. What is done without a way is up to `brain.planning.behaviours`. Without any progress for
`patience` the goal is given up, with a note why, and the next one follows. Manual driving takes over: it
drops the goals, and ends by itself if it is not repeated. After a stop no goal is resumed: they must be sent
again. The work of a step does not depend on the map's size.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from math import cos, dist, hypot, inf, sin
from typing import Protocol

from brain.belief import Pose
from brain.bodies.body import Base
from brain.bodies.plane import Twist
from brain.planning.astar import Searching
from brain.planning.behaviours import Behaviour, BehaviourSettings, Fact, State
from brain.planning.costmap import NEAR, TILE_WORK, UNKNOWN, Costmap, Map, PlannerSettings
from brain.planning.footprint import Footprint, Shape
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


PROGRESS = 0.3
"""m that the robot must get away from where it was, within `patience`"""
FLOWING: Nanos = 2 * SECOND
"""Following a path for this long without an obstacle is progress, too."""
CROSSING_SPEED, CROSSING_NEAR = 0.15, 1.0
"""m/s of someone who is waited for, and m from the place where the path is obstructed"""

MAX_MISSES = 3
"""Paths whose end a base may miss until it gives the goal up"""


class Mover(Protocol):
    """Something in motion, in the frame of the map: m, m/s."""

    @property
    def x(self) -> float: ...  # noqa: D102
    @property
    def y(self) -> float: ...  # noqa: D102
    @property
    def vx(self) -> float: ...  # noqa: D102
    @property
    def vy(self) -> float: ...  # noqa: D102


class Navigator:
    """Goals, path and manual driving. State is plain data."""

    def __init__(
        self, body: Base, settings: PlannerSettings, behaviour: BehaviourSettings | None = None
    ) -> None:
        self.body, self.settings = body, settings
        self.behaviour_settings = behaviour or BehaviourSettings()
        self.behaviour = Behaviour()
        self.motion: Twist | None = None
        """What the base is to do in place of following the path: a behaviour, or a step of a mission."""
        self.ended = 0
        """Number of goals that were reached or given up,"""
        self.why = ""
        """and why the last of them was given up; "" if it was reached."""
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
        self._misses = 0
        """How often the end of a path to this goal was missed."""
        self._drive_until: Nanos = 0
        self._query: PathQuery | None = None
        self._made_for: tuple[Base, PlannerSettings] | None = None
        """What the costmap was made for,"""
        self._footprint: Footprint
        """and the footprint."""
        self._line = Polyline(((0.0, 0.0),))
        """The path;"""
        self._along = self._checked = self._rest = 0.0
        """m along it: the robot at the last check, up to where it was checked since, where to go on then."""
        self._blocked = ""
        """Where the last path to this goal was obstructed."""
        self._check_at: Nanos = 0
        self._explore_at: Nanos = 0
        self._frontier_since: Nanos | None = None
        """Since when the robot stands at the frontier that it went to."""
        self._looked_twice = False
        """Whether a search has ended at a frontier before the base moved: the next may know more"""
        self._excluded: tuple[Point, ...] = ()
        """Frontiers that stayed unknown."""
        self._passing = False
        """Whether the path leads to the goal before, which the robot passes."""
        self._crossing = ""
        """Where someone in motion obstructs the path,"""
        self._crossing_until: Nanos = 0
        """and until when that holds."""
        self._was: Point = (0.0, 0.0)
        """Where the robot was when it last got further,"""
        self._progress_at: Nanos = 0
        """and when that was."""
        self._flowing_since: Nanos | None = None

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
        self.given_up, self.motion = "", None
        if isinstance(task, Goal):
            self.goals.append(task)
            if len(self.goals) == 1:
                self._begin_goal(now)
            self._note("info", f"goal {self.ended + len(self.goals)} accepted: {_text(task)}")
            return
        if self.goals:
            self._note("warning", f"manual driving: {self.drop(now)}")
        if self.drive is None:
            self._note("info", "manual driving")
        self.drive = task
        self._drive_until = now + self.settings.drive_timeout

    def go(self, now: Nanos, goal: Goal, *, passing: bool = False) -> None:
        """Take a goal of a mission, in place of all.

        In passing, the path to the last is kept until there is one to this."""
        self.given_up, self.goals = "", [goal]
        if passing and self.path is not None:
            self._passing, self._check_at, self._query, self._excluded = True, now, None, ()
        else:
            self._begin_goal(now)

    def drop(self, now: Nanos) -> str:
        """Drop every task, and end what is done about it; return in words what was dropped."""
        count = len(self.goals)
        self.behaviour.update(now, {Fact.NO_GOAL}, "")
        self.goals, self.drive, self.motion = [], None, None
        self._drop_path()
        self._query, self.no_path_reason = None, ""
        return "nothing to drop" if not count else f"{count} goal{'s' if count > 1 else ''} dropped"

    def pause(self) -> None:
        """Do not count this time against `patience` (the robot may not move now)."""
        self._was = (inf, inf)

    def step(
        self,
        now: Nanos,
        here: Point,
        grid: Map,
        yaw: float = 0.0,
        standing: float = 0.0,
        obstacle: str = "",
        moving: Sequence[Mover] = (),
    ) -> None:
        """Update the costmap, check the path, continue the search: a bounded amount of work.

        `standing`: for how long [s] the base stands before an obstacle, `obstacle` that in words; `moving`:
        what moves about it."""
        if self.drive is not None and now >= self._drive_until:
            self.drive = None
            timeout = self.settings.drive_timeout // MILLISECOND
            self._note("info", f"manual driving ended: not repeated within {timeout} ms")
        if self.costmap is None or self._made_for != (self.body, self.settings):
            shape = Shape.of(self.body)
            self._made_for, self._query = (self.body, self.settings), None
            self._footprint = Footprint(shape, grid.resolution)
            self.costmap = Costmap(
                grid.resolution, shape.inner, self.settings, shape.outer, self.body.max_linear
            )
        work = self.settings.expansions_per_step
        work -= TILE_WORK * self.costmap.update(grid, here, TILES_PER_STEP)
        if not self.goals:
            self._behave(now, here, yaw, standing, obstacle, moving)
            return
        if self.path is not None:
            self._check_path(now, here, self.costmap, moving)
        if now >= self._check_at:
            self._check_at = now + self.settings.period
            if self._query is None and (
                self.path is None
                or self._passing
                or (isinstance(self.path, FrontierPath) and now >= self._explore_at)
            ):
                self._explore_at = now + self.settings.explore
                goal = (self.goals[0].x, self.goals[0].y)
                ground = Snapshot(self.costmap, grid, here, goal, self._excluded)
                self._query = PathQuery(
                    ground,
                    here,
                    goal,
                    self.settings,
                    self._footprint,
                    yaw=yaw,
                    goal_yaw=self.goals[0].yaw,
                    near=self.goals[0].near,
                )
        if self._query is not None:
            self._continue_search(now, here, self._query.advance(max(work, 1), self.costmap, grid))
        self._behave(now, here, yaw, standing, obstacle, moving)

    def arrived(self, now: Nanos) -> None:
        """Process that the robot stands at the end of the path."""
        if self._passing:
            return
        if isinstance(self.path, FrontierPath):
            self._frontier_since = now if self._frontier_since is None else self._frontier_since
        elif self.path is not None:
            self.reached, self.ended, self.why = self.reached + 1, self.ended + 1, ""
            goal = self.goals.pop(0)
            self._note("info", f"goal {self.ended} reached: {_text(goal)}")
            self._begin_goal(now)

    def missed(self, now: Nanos, reason: str) -> None:
        """Plan again, since the base cannot reach the end of this path on it; give up after some times."""
        if self.path is None:
            return
        self._misses += 1
        if self._misses > MAX_MISSES and self.goals:
            self._give_up(now, f"goal {self.ended + 1} is missed again and again: {reason}")
            return
        self._note("info", f"the path is dropped: {reason}")
        self._drop_path()
        self._query, self._check_at = None, now

    def clearance(self, pose: Pose, most: float) -> float:
        """Return the distance [m] from the footprint to the nearest obstacle of the map; more than `most`
        may be `most`."""
        return 0.0 if self.costmap is None else self._footprint.clearance(self.costmap, pose, most)

    # -- private ------------------------------------------------------------------------------

    def _begin_goal(self, now: Nanos) -> None:
        """Start with the first goal of the queue."""
        self._misses, self._looked_twice = 0, False
        self._drop_path()
        self._query, self._excluded, self.no_path_reason, self._blocked = None, (), "", ""
        self._check_at = now
        self._was, self._progress_at = (inf, inf), now

    def _drop_path(self) -> None:
        if self.path is not None:
            self.path = None
            self.path_version += 1
        self._frontier_since, self._passing, self._crossing_until = None, False, 0

    def _check_path(self, now: Nanos, here: Point, costmap: Costmap, moving: Sequence[Mover]) -> None:
        """Drop a path that is obstructed: it is checked part by part, all over again each period.

        Checked with the footprint alone, without the margin used for planning: so a wall that shifts by a
        cell as it is seen better does not cost a path."""
        assert self.path is not None
        reason, line = "", self._line
        if now >= self._check_at:
            self._along, off = line.project(here, self._along, self._along + CHECKED_FIRST)
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
            if is_blocked(costmap, a, b, NEAR) or not self._footprint.fits_either_way(costmap, a, b):
                near = f"({b[0]:.2f}, {b[1]:.2f})"
                if _crosses(b, moving) and self._may_wait(now):
                    self._crossing = f"someone crosses the path near {near}"
                    self._crossing_until = now + 2 * self.settings.period
                    self._checked = line.length
                    break
                reason = self._blocked = f"it is blocked near {near}"
            self._checked = end
        if reason:
            self._note("info", f"the path is dropped: {reason}")
            self._drop_path()
            self._query, self._check_at = None, now

    def _may_wait(self, now: Nanos) -> bool:
        """Return whether someone who crosses is waited for: not for ever."""
        yielding = self.behaviour.state is State.YIELDING
        return not yielding or now - self.behaviour.since < self.behaviour_settings.crossing

    def _continue_search(self, now: Nanos, here: Point, result: PlanResult) -> None:
        if isinstance(result, Searching):
            return
        self._query = None
        if isinstance(result, NoPath):
            words = result.reason.partition("(")[0]
            if not self.no_path_reason.startswith(words):
                self._note("warning", f"no path: {result.reason}")
            self.no_path_reason = result.reason
            self._drop_path()
        elif isinstance(result, FrontierPath) and self.path is None and not self._looked_twice:
            self._looked_twice = True
        elif isinstance(result, Path) or not self._keeps_frontier(now, here, result):
            self._use(result)

    def _keeps_frontier(self, now: Nanos, here: Point, result: FrontierPath) -> bool:
        """True if the result leads to where the robot already is, or equals the path it is following.

        Unknown ground under the robot counts as free, so about a frontier that is excluded there is always
        another within the robot's radius: it must not creep from one to the next."""
        end, old = result.points[-1], self.path
        same = isinstance(old, FrontierPath) and dist(old.beyond, result.beyond) < FRONTIER_TOLERANCE
        near = FRONTIER_TOLERANCE + (self.body.radius if self._excluded else 0.0)
        there = dist(end, here) <= near or (same and self._frontier_since is not None)
        if not there:
            self._frontier_since = None
            return same
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
            self._note("info", f"exploring: no known path to goal {self.ended + 1}")
        if result.escape > 0.0:
            self._note(
                "warning",
                f"too near to an obstacle: the path begins with {result.escape:.2f} m away from it",
            )
        self.path, self.no_path_reason = result, ""
        self._passing = False
        self.path_version += 1

    # -- behaviours ---------------------------------------------------------------------------

    def _behave(
        self,
        now: Nanos,
        here: Point,
        yaw: float,
        standing: float,
        obstacle: str,
        moving: Sequence[Mover],
    ) -> None:
        """Choose what is done now, and give a goal up if that has brought nothing."""
        behaviour, before = self.behaviour, self.behaviour.state
        self.motion, over = behaviour.motion(now, here, yaw, self.body, self.behaviour_settings)
        facts = self._facts(now, here, yaw, standing, moving)
        reason = ""
        if Fact.IMPATIENT in facts:
            reason = self._no_progress(obstacle if standing else "")
        elif Fact.NO_WAY in facts:
            reason = self.no_path_reason
        elif Fact.CROSSING in facts:
            reason = self._crossing
        elif Fact.STUCK in facts or Fact.STUCK_HERE in facts:
            reason = obstacle
        if not behaviour.update(now, facts | ({Fact.MOVED} if over else set()), reason):
            return
        if behaviour.state in (State.LOOKING, State.BACKING, State.YIELDING):
            self._note("info", f"{behaviour.state}: {behaviour.reason}")
        if behaviour.state is State.GIVEN_UP:
            self._give_up(now, reason)
        elif before is State.BACKING and self.path is not None:
            self._drop_path()
            self._query, self._check_at = None, now

    def _facts(
        self, now: Nanos, here: Point, yaw: float, standing: float, moving: Sequence[Mover]
    ) -> set[Fact]:
        if not self.goals:
            return {Fact.NO_GOAL}
        self._watch_progress(now, here, standing)
        facts, path, settings = {Fact.GOAL}, self.path, self.behaviour_settings
        if isinstance(path, FrontierPath):
            facts.add(Fact.FRONTIER)
        elif path is not None:
            facts.add(Fact.PATH)
        else:
            facts.add(Fact.NO_WAY if self.no_path_reason else Fact.NO_PATH)
        facts.add(Fact.CROSSING if now < self._crossing_until else Fact.CLEAR)
        held = standing > 0.0 or path is None
        if held and now - self._progress_at >= self.settings.patience:
            facts.add(Fact.IMPATIENT)
        if standing * SECOND > settings.stuck_after and not _crosses(here, moving):
            room = self.behaviour.tried < settings.tries and self._room_behind(here, yaw)
            facts.add(Fact.STUCK if room else Fact.STUCK_HERE)
        turns = settings.look > 0.0 and not self.body.turning_radius
        if turns and now - self.behaviour.since > settings.look_after:
            facts.add(Fact.TIME_TO_LOOK)
        return facts

    def _watch_progress(self, now: Nanos, here: Point, standing: float) -> None:
        """Note when the robot last got further: away, or along a path that was free for some time."""
        if self.path is not None and not standing and self.motion is None:
            self._flowing_since = now if self._flowing_since is None else self._flowing_since
        else:
            self._flowing_since = None
        flows = self._flowing_since is not None and now - self._flowing_since > FLOWING
        if flows or not hypot(here[0] - self._was[0], here[1] - self._was[1]) < PROGRESS:
            self._was, self._progress_at = here, now

    def _room_behind(self, here: Point, yaw: float) -> bool:
        """Return whether the robot fits behind where it is, on known ground."""
        back, costmap = self.behaviour_settings.back, self.costmap
        if not back or costmap is None:
            return False
        behind = here[0] - back * cos(yaw), here[1] - back * sin(yaw)
        known = costmap.level_at(*behind) < UNKNOWN
        return known and not is_blocked(costmap, here, behind, NEAR)

    def _no_progress(self, obstacle: str) -> str:
        """Return in words why the goal is given up."""
        goal, span = f"goal {self.ended + 1} {_text(self.goals[0])}", seconds(self.settings.patience)
        if self.path is not None:
            return f"no way on to {goal} for {span:g} s: {obstacle or self.behaviour.reason}"
        reason = self.no_path_reason or "the search has not ended"
        if self._blocked:
            reason += f"; a path known before is obstructed, perhaps only for a time: {self._blocked}"
        return f"no path to {goal} within {span:g} s: {reason}"

    def _give_up(self, now: Nanos, reason: str) -> None:
        """Give up the present goal, and go on with the next."""
        self.goals.pop(0)
        self.ended, self.why, self.motion = self.ended + 1, reason, None
        left = len(self.goals)
        self._note("warning", f"{reason}; it is given up" + (f", {left} to go" if left else ""))
        self.given_up = "" if left else reason
        self._begin_goal(now)

    def _note(self, level: NoteLevel, text: str) -> None:
        self.notes.append((level, text))


def _crosses(place: Point, moving: Iterable[Mover]) -> bool:
    """Return whether something moves near a place."""
    return any(
        hypot(one.vx, one.vy) > CROSSING_SPEED and hypot(one.x - place[0], one.y - place[1]) < CROSSING_NEAR
        for one in moving
    )


def _text(goal: Goal) -> str:
    yaw = "" if goal.yaw is None else f", yaw {goal.yaw:.2f}"
    return f"({goal.x:.2f}, {goal.y:.2f}{yaw})"
