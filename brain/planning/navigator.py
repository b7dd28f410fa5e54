"""The navigator: a queue of goals, the path to the first of them, what is done without one, manual driving.

Rules. A goal is reached only at its true position. Where no known path leads to it, the robot follows a
`FrontierPath` to the best frontier of known ground (`exploring`) and replans as the map grows, or rolls
towards a goal beyond it. A path that becomes blocked is dropped at once (`path_watch`): the robot brakes
until there is another; but someone in motion there is waited for. What is done without a way is up to
`brain.planning.behaviours`. Without any progress for `patience` the goal is given up, with a note why, and
the next one follows. Manual driving takes over: it drops the goals, and ends by itself if it is not repeated.
After a stop no goal is resumed: they must be sent again. The work of a step does not depend on the map's
size.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

from brain.belief import Pose
from brain.bodies.body import Base
from brain.bodies.plane import Twist
from brain.planning.astar import Searching
from brain.planning.behaviours import Behaviour, BehaviourSettings, BehaviourState, Fact
from brain.planning.blocks import labelling
from brain.planning.costmap import Map, PlannerSettings
from brain.planning.exploring import Exploring
from brain.planning.goals import Goals, text_of
from brain.planning.path_watch import PathWatch, crosses
from brain.planning.planner import FrontierPath, NoPath, Path, PathQuery, PlanResult
from brain.planning.polyline import Point
from brain.planning.progress import GoalProgress
from brain.planning.snapshot import Snapshot
from brain.planning.stop_zone import Mover
from brain.planning.terrain import Terrain
from brain.status import Note, NoteLevel
from protocols.messages import MILLISECOND, SECOND, Drive, Goal, Nanos, seconds

NOMINAL: Nanos = 5 * MILLISECOND
"""Span of a step that does `expansions_per_step` of work"""
LONG: Nanos = 4 * NOMINAL
"""Span from which on a step does no more, however long it is"""
MAX_MISSES = 3
"""Paths whose end a base may miss until it gives the goal up"""


@dataclass(frozen=True, slots=True)
class Route:
    """What is to be driven, and what has become of it."""

    goal: Goal | None
    """The present goal"""
    path: Path | FrontierPath | None
    version: int
    """Of the path"""
    slow: Callable[[float, float], float] | None
    """Returns the largest speed [m/s] at a place, by the zones"""
    drive: Twist | None
    """Manual driving"""
    motion: Twist | None
    """What is done in place of following the path"""
    state: BehaviourState
    reason: str
    """Why the navigator is in it"""
    pathless: str
    """Why there is no path to the goal"""
    given_up: str
    """Why the last goals were given up"""
    reached: int
    ended: int
    """Number of goals that were reached or given up"""
    why: str
    """Why the last of these was given up"""

    @property
    def busy(self) -> bool:
        """Whether there is a goal, or manual driving."""
        return self.goal is not None or self.drive is not None


class Navigator:
    """Goals, path and manual driving. State is plain data."""

    def __init__(
        self, body: Base, settings: PlannerSettings, behaviour: BehaviourSettings | None = None
    ) -> None:
        self.body, self.settings = body, settings
        labelling()  # imported now, since that takes longer than a step
        self.behaviour_settings = behaviour or BehaviourSettings()
        self.behaviour = Behaviour()
        self.motion: Twist | None = None
        """What the base is to do in place of following the path: a behaviour, or a step of a mission."""
        self.goals = Goals()
        self.drive: Drive | None = None
        self._drive_until: Nanos = 0
        self.no_path_reason = ""
        """Why there is no path to the goal; "" while that is not known."""
        self.notes: list[Note] = []
        self.terrain: Terrain | None = None
        """None before the first step."""
        self._watch = PathWatch()
        self._exploring = Exploring()
        self._progress = GoalProgress()
        self._misses = 0
        """How often the end of a path to this goal was missed."""
        self._query: PathQuery | None = None
        self._answered = False
        """Whether a search for a way to this goal has ended"""
        self._stepped_at: Nanos | None = None
        """When the last step was"""
        self._check_at: Nanos = 0
        self._explore_at: Nanos = 0
        self._passing = False
        """Whether the path leads to the goal before, which the robot passes."""

    @property
    def path(self) -> Path | FrontierPath | None:
        """The path that is followed."""
        return self._watch.path

    @property
    def busy(self) -> bool:
        """True if there is a goal, or manual driving."""
        return bool(self.goals.waiting) or self.drive is not None

    def accept(self, now: Nanos, task: Goal | Drive) -> None:
        """Accept a task. Goals queue; manual driving takes over."""
        self.goals.forget()
        self.motion = None
        if isinstance(task, Goal):
            accepted = self.goals.add(task)
            if len(self.goals.waiting) == 1:
                self._begin_goal(now)
            self.note("info", accepted)
            return
        if self.goals.waiting:
            self.note("warning", f"manual driving: {self.drop(now)}")
        if self.drive is None:
            self.note("info", "manual driving")
        self.drive = task
        self._drive_until = now + self.settings.drive_timeout

    def steer(self, now: Nanos, task: Drive) -> None:
        """Let another program drive along the path: goals and path are kept."""
        self.drive, self._drive_until = task, now + self.settings.drive_timeout

    def go(self, now: Nanos, goal: Goal, *, passing: bool = False) -> None:
        """Take a goal of a mission, in place of all.

        In passing, the path to the last is kept until there is one to this."""
        self.goals.forget()
        self.goals.take(goal)
        if passing and self.path is not None:
            self._passing, self._check_at, self._query = True, now, None
            self._exploring.forget()
        else:
            self._begin_goal(now)

    def route(self) -> Route:
        """Return what is to be driven now."""
        terrain, drive, behaviour, goals = self.terrain, self.drive, self.behaviour, self.goals
        return Route(
            goals.present,
            self.path,
            self._watch.version,
            terrain.costmap.zones.limit if terrain else None,
            None if drive is None else Twist(drive.linear, drive.angular, drive.lateral),
            self.motion,
            behaviour.state,
            behaviour.reason,
            self.no_path_reason if goals.waiting and self.path is None else "",
            goals.given_up,
            goals.reached,
            goals.ended,
            goals.why,
        )

    def adopt(self, body: Base, settings: PlannerSettings, behaviour: BehaviourSettings) -> None:
        """Continue with other settings."""
        self.body, self.settings, self.behaviour_settings = body, settings, behaviour

    def forget(self) -> None:
        """Take goals that were given up as known: something else is to be done."""
        self.goals.forget()

    def take_notes(self) -> list[Note]:
        """Return the notes for the operator since the last call."""
        notes, self.notes = self.notes, []
        return notes

    def drop(self, now: Nanos) -> str:
        """Drop every task, and end what is done about it; return in words what was dropped."""
        self.behaviour.update(now, {Fact.NO_GOAL}, "")
        self.drive, self.motion = None, None
        self._drop_path()
        self._query, self.no_path_reason = None, ""
        return self.goals.drop()

    def pause(self) -> None:
        """Do not count this time against `patience` (the robot may not move now)."""
        self._progress.pause()

    def step(
        self,
        now: Nanos,
        here: Point,
        grid: Map,
        yaw: float = 0.0,
        standing: float = 0.0,
        obstacle: str = "",
        moving: Sequence[Mover] = (),
        wanted: Twist | None = None,
    ) -> None:
        """Update the costmap, check the path, continue the search: a bounded amount of work.

        `standing`: for how long [s] the base stands before an obstacle, `obstacle` that in words; `moving`:
        what moves about it; `wanted`: the motion of a mission's step, in place of the path."""
        self._advance(now, here, grid, yaw, standing, obstacle, moving)
        self.motion = wanted if wanted is not None else self.motion

    def _advance(
        self,
        now: Nanos,
        here: Point,
        grid: Map,
        yaw: float,
        standing: float,
        obstacle: str,
        moving: Sequence[Mover],
    ) -> None:
        if self.drive is not None and now >= self._drive_until:
            self.drive = None
            timeout = self.settings.drive_timeout // MILLISECOND
            self.note("info", f"manual driving ended: not repeated within {timeout} ms")
        terrain = self.terrain
        if terrain is None or not terrain.is_for(self.body, self.settings):
            terrain = self.terrain = Terrain(self.body, self.settings, grid.resolution)
            self._query = None
        work = self._work(now) - terrain.update(grid, here)
        goal = self.goals.present
        if goal is None:
            self._behave(now, here, yaw, standing, obstacle, moving)
            return
        if self.path is not None:
            self._check_path(now, here, terrain, moving)
        if now >= self._check_at:
            self._check_at = now + self.settings.period
            explores = isinstance(self.path, FrontierPath) and now >= self._explore_at
            if self._query is None and (self.path is None or self._passing or explores):
                self._explore_at = now + self.settings.explore
                place = (goal.x, goal.y)
                self._query = PathQuery(
                    Snapshot(terrain.costmap, here, place, self._exploring.excluded),
                    here,
                    place,
                    self.settings,
                    terrain.footprint,
                    yaw=yaw,
                    goal_yaw=goal.yaw,
                    near=goal.near,
                )
        if self._query is not None:
            self._continue_search(now, here, self._query.advance(max(work, 1), terrain.costmap, grid))
        self._behave(now, here, yaw, standing, obstacle, moving)

    def arrived(self, now: Nanos) -> None:
        """Process that the robot stands at the end of the path."""
        if self._passing:
            return
        if isinstance(self.path, FrontierPath):
            self._exploring.arrive(now)
        elif self.path is not None:
            self.note("info", self.goals.reach())
            self._begin_goal(now)

    def missed(self, now: Nanos, reason: str) -> None:
        """Plan again, since the base cannot reach the end of this path on it; give up after some times."""
        if self.path is None:
            return
        self._misses += 1
        if self._misses > MAX_MISSES and self.goals.waiting:
            self._give_up(now, f"{self.goals.name} is missed again and again: {reason}")
            return
        self.replan(now, f"the path is dropped: {reason}")

    def replan(self, now: Nanos, why: str = "") -> None:
        """Drop the path, with a note why, and search for another at once."""
        if why and self.path is not None:
            self.note("info", why)
        self._drop_path()
        self._query, self._check_at = None, now

    def clearance(self, pose: Pose, most: float) -> float:
        """Return the distance [m] from the footprint to the nearest obstacle of the map; more than `most`
        may be `most`."""
        return 0.0 if self.terrain is None else self.terrain.clearance(pose, most)

    # -- private ------------------------------------------------------------------------------

    def _begin_goal(self, now: Nanos) -> None:
        """Start with the first goal of the queue."""
        self._drop_path()
        self._watch.forget()
        self._exploring.begin()
        self._progress.begin(now)
        self._misses, self._query, self.no_path_reason, self._check_at = 0, None, "", now
        self._answered = False

    def _work(self, now: Nanos) -> int:
        """Return the work of this step: in proportion to the time since the last, up to a long one's."""
        span = NOMINAL if self._stepped_at is None else now - self._stepped_at
        self._stepped_at = now
        return self.settings.expansions_per_step * min(span, LONG) // NOMINAL

    def _drop_path(self) -> None:
        self._watch.drop()
        self._exploring.leave()
        self._passing = False

    def _check_path(self, now: Nanos, here: Point, terrain: Terrain, moving: Sequence[Mover]) -> None:
        """Drop a path that is obstructed."""
        wait = now + 2 * self.settings.period if self._may_wait(now) else 0
        reason = self._watch.begin_check(here) if now >= self._check_at else ""
        reason = reason or self._watch.check(terrain.costmap, terrain.footprint, moving, wait)
        if reason:
            self.replan(now, f"the path is dropped: {reason}")

    def _may_wait(self, now: Nanos) -> bool:
        """Return whether someone who crosses is waited for: not for ever."""
        yielding = self.behaviour.state is BehaviourState.YIELDING
        return not yielding or now - self.behaviour.since < self.behaviour_settings.crossing

    def _continue_search(self, now: Nanos, here: Point, result: PlanResult) -> None:
        if isinstance(result, Searching):
            return
        self._query, self._answered = None, True
        if isinstance(result, NoPath):
            words = result.reason.partition("(")[0]
            if not self.no_path_reason.startswith(words):
                self.note("warning", f"no path: {result.reason}")
            self.no_path_reason = result.reason
            self._drop_path()
        elif isinstance(result, Path):
            self._use(result)
        elif self.path is None and self._exploring.looks_again():
            return
        elif not self._exploring.keeps(now, here, result, self.path, self.body.radius):
            self._use(result)

    def _use(self, result: Path | FrontierPath) -> None:
        before = self.path
        self._watch.use(result)
        end, length = result.points[-1], self._watch.line.length
        if isinstance(result, Path):
            self.note("info", f"path: {length:.2f} m to ({end[0]:z.2f}, {end[1]:z.2f})")
        elif not isinstance(before, FrontierPath):
            self.note("info", f"exploring: no known path to {self.goals.name}")
        if result.escape > 0.0:
            self.note(
                "warning",
                f"too near to an obstacle: the path begins with {result.escape:.2f} m away from it",
            )
        self.no_path_reason, self._passing = "", False

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
            reason = self._watch.crossing
        elif Fact.STUCK in facts or Fact.STUCK_HERE in facts:
            reason = obstacle
        if not behaviour.update(now, facts | ({Fact.MOVED} if over else set()), reason):
            return
        if behaviour.state in (BehaviourState.LOOKING, BehaviourState.BACKING, BehaviourState.YIELDING):
            self.note("info", f"{behaviour.state}: {behaviour.reason}")
        if behaviour.state is BehaviourState.GIVEN_UP:
            self._give_up(now, reason)
        elif before is BehaviourState.BACKING and self.path is not None:
            self.replan(now)

    def _facts(
        self, now: Nanos, here: Point, yaw: float, standing: float, moving: Sequence[Mover]
    ) -> set[Fact]:
        if not self.goals.waiting:
            return {Fact.NO_GOAL}
        if not self._answered:
            self._progress.pause()
        follows = self.path is not None and not standing and self.motion is None
        self._progress.watch(now, here, follows=follows)
        facts, path, settings = {Fact.GOAL}, self.path, self.behaviour_settings
        if isinstance(path, FrontierPath):
            facts.add(Fact.FRONTIER)
        elif path is not None:
            facts.add(Fact.PATH)
        else:
            facts.add(Fact.NO_WAY if self.no_path_reason else Fact.NO_PATH)
        facts.add(Fact.CROSSING if now < self._watch.crossing_until else Fact.CLEAR)
        searches = self._query is not None and path is None
        held = (standing > 0.0 or path is None) and not searches
        if held and self._progress.none_for(now) >= self.settings.patience:
            facts.add(Fact.IMPATIENT)
        if standing * SECOND > settings.stuck_after and not crosses(here, moving):
            room = self.behaviour.tried < settings.tries and self._room_behind(here, yaw)
            facts.add(Fact.STUCK if room else Fact.STUCK_HERE)
        turns = settings.look > 0.0 and not self.body.turning_radius
        if turns and now - self.behaviour.since > settings.look_after:
            facts.add(Fact.TIME_TO_LOOK)
        return facts

    def _room_behind(self, here: Point, yaw: float) -> bool:
        """Return whether the robot fits behind where it is, on known ground."""
        back, terrain = self.behaviour_settings.back, self.terrain
        return bool(back) and terrain is not None and terrain.has_room_behind(here, yaw, back)

    def _no_progress(self, obstacle: str) -> str:
        """Return in words why the goal is given up."""
        goal, span = f"{self.goals.name} {text_of(self.goals.waiting[0])}", seconds(self.settings.patience)
        if self.path is not None:
            return f"no way on to {goal} for {span:g} s: {obstacle or self.behaviour.reason}"
        reason = self.no_path_reason
        if self._watch.blocked:
            reason += f"; a path known before is obstructed, perhaps only for a time: {self._watch.blocked}"
        return f"no path to {goal} within {span:g} s: {reason}"

    def _give_up(self, now: Nanos, reason: str) -> None:
        """Give up the present goal, and go on with the next."""
        self.motion = None
        self.note("warning", self.goals.give_up(reason))
        self._begin_goal(now)

    def note(self, level: NoteLevel, text: str) -> None:
        """Add a note for the operator."""
        self.notes.append((level, text))
