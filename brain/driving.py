"""The brain of a base on wheels: perceive → plan → control, and when it may move.

Rules. Perception hears every event at every step, planning does a bounded amount of work at each, control
is due by `now`. What may be driven is a share of the body's limits: all of it while all is well, some while
something is late, none while something is missing. None means braking within the acceleration limits, not
letting go; only a stop from above, or standing still with nothing to do, lets the motors go (Idle).
Motors that are no wheels are joints that the base carries (a mast, a lift): an operator's targets are theirs
(`brain.joint_targets`), whatever the base does.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from math import isfinite

from brain.belief import Belief, BrainState, Pose
from brain.bodies.differential import Differential
from brain.condition import StatusReporter
from brain.control.profile import REST, Twist, approach
from brain.control.pursuit import Bounds, Pursuit
from brain.health import Health, Level, Verdict
from brain.joint_targets import JointTargets
from brain.perception.mount import Mount
from brain.perception.perception import Perception
from brain.planning.mission import Mission, Note
from brain.planning.planner import FrontierPath
from brain.settings import BrainSettings
from protocols import messages as msg
from protocols.messages import MILLISECOND, SECOND, Command, Event, Nanos, seconds

FORESIGHT: Nanos = 100 * MILLISECOND
"""An estimate is carried on to now by its own speeds, but no farther than this."""
LONGEST: Nanos = 100 * MILLISECOND
"""A command later than this after the last counts as this late: a pause is no leave to leap."""


class BaseBrain:
    """The three systems of one base. State is plain data."""

    def __init__(
        self,
        settings: BrainSettings,
        body: Differential,
        motors: Sequence[str],
        sensors: Mapping[str, Mount],
        timeouts: Mapping[str, Nanos],
    ) -> None:
        self._settings, self._body, self._motors = settings, body, tuple(motors)
        self.perception = Perception(body, dict(sensors), settings.perception)
        self.mission = Mission(body.radius, settings.planner)
        self.pursuit = Pursuit()
        self._health = Health((body.left, body.right), tuple(sensors), timeouts, settings.health)
        self._condition = StatusReporter()
        carried = [motor for motor in motors if motor not in (body.left, body.right)]
        self._carried = JointTargets(carried, timeouts, settings.health, self._condition)
        self._twist = REST
        self._followed = 0
        """Version of the path that pursuit has taken up."""
        self._control_at: Nanos | None = None
        self._controlled: Nanos | None = None
        self._rest_since: Nanos | None = None
        self._began: Nanos | None = None
        self._told_waiting = False
        self._said: Sequence[Command] = self._idle()

    def adopt(self, settings: BrainSettings) -> None:
        """Go on with other settings."""
        self._settings = settings
        self._body = settings.differential or self._body
        self._health.settings = self._carried.health.settings = settings.health
        self.mission.settings, self.mission.radius = settings.planner, self._body.radius

    def step(
        self,
        now: Nanos,
        events: Sequence[Event],
        tasks: Sequence[msg.Goal | msg.Drive | Command],
        stopped: str,
    ) -> Sequence[Command]:
        """One command per motor."""
        carried = self._carry(now, events, tasks, stopped)
        wheels = self._roll(now, events, [t for t in tasks if not self._is_for_carried(t)], stopped)
        return [carried.get(word.motor, word) for word in wheels]

    def _is_for_carried(self, task: msg.Goal | msg.Drive | Command) -> bool:
        return not isinstance(task, msg.Goal | msg.Drive) and task.motor in self._carried.motors

    def _carry(
        self,
        now: Nanos,
        events: Sequence[Event],
        tasks: Sequence[msg.Goal | msg.Drive | Command],
        stopped: str,
    ) -> dict[str, Command]:
        """One command for each joint that the base carries."""
        self._carried.observe(events)
        for task in tasks:
            if not isinstance(task, msg.Goal | msg.Drive) and task.motor in self._carried.motors:
                self._carried.ask(now, task, stopped)
        self._carried.end(now, stopped)
        return {word.motor: word for word in self._carried.commands()}

    def _roll(
        self,
        now: Nanos,
        events: Sequence[Event],
        tasks: Sequence[msg.Goal | msg.Drive | Command],
        stopped: str,
    ) -> Sequence[Command]:
        """The wheels' commands; Idle for the others."""
        self.perception.observe(now, events)
        self._health.observe(events)
        verdict = self._health.judge(now, self.perception.rejected)
        waiting = self._waiting(now)
        lost = stopped or ("" if waiting else verdict.reason if verdict.level is Level.GONE else "")
        self._ask(now, tasks, lost, waiting)
        if lost and not waiting and self.mission.busy:
            self._condition.say("warning", f"{self.mission.drop()}: {lost}")
        if not waiting and not lost:
            self._plan(now, verdict)
        self._settle(stopped, lost, waiting, verdict)
        if stopped or waiting:
            return self._let_go()
        return self._control(now, 0.0 if lost else self._share(verdict))

    def belief(self) -> Belief:
        """All that is believed and wanted, after a step."""
        path, perception = self.mission.path, self.perception
        return Belief(
            self._condition.state,
            self._condition.reason,
            perception.estimate,
            self.mission.goal,
            path.points if path else (),
            self.mission.path_version,
            perception.map.view(),
            dict(perception.rejected),
            self.mission.reached,
            perception.raw,
        )

    def take_notes(self) -> list[Note]:
        """What there is to say since this was last asked."""
        planned, self.mission.remarks = self.mission.remarks, []
        return planned + self._condition.take_notes()

    # -- may it move? -------------------------------------------------------------------------

    def _waiting(self, now: Nanos) -> str:
        """What must be heard before the first motion; "" once it was."""
        if self._condition.state is not BrainState.INITIALISING:
            return ""
        self._began = now if self._began is None else self._began
        missing = self._health.missing() or ("" if self.perception.estimate else "an estimate of the pose")
        if missing and not self._told_waiting and now - self._began > PATIENT:
            self._told_waiting = True
            self._condition.say("warning", f"still waiting for {missing}")
        return missing and f"waiting for {missing}"

    def _ask(
        self, now: Nanos, tasks: Sequence[msg.Goal | msg.Drive | Command], lost: str, waiting: str
    ) -> None:
        for task in tasks:
            if not isinstance(task, msg.Goal | msg.Drive):
                why = f"{task.motor} is a wheel of a base: ask for a goal, or drive"
            elif not all(map(isfinite, _numbers(task))):
                why = f"{task} is not finite"
            elif waiting and isinstance(task, msg.Drive):
                why = waiting
            else:
                why = "" if waiting else lost
            if why:
                self._condition.say("warning", f"{type(task).__name__} refused: {why}")
            elif isinstance(task, msg.Goal | msg.Drive):
                self.mission.ask(now, task)

    def _share(self, verdict: Verdict) -> float:
        """How much of the largest speeds may be driven."""
        if verdict.level is Level.WELL:
            return 1.0
        return self._settings.health.slow if verdict.level is Level.SLOW else 0.0

    def _settle(self, stopped: str, lost: str, waiting: str, verdict: Verdict) -> None:
        mission = self.mission
        without = bool(mission.goals) and mission.path is None and bool(mission.why_none)
        if waiting:
            self._condition.reason = waiting if not stopped else f"{waiting}; stopped: {stopped}"
        elif stopped:
            self._condition.obey(stopped)
        elif lost:
            self._condition.become(BrainState.STOPPED, lost)
        elif mission.given_up:
            self._condition.become(BrainState.STOPPED, mission.given_up)
        elif verdict.level is Level.SLOW:
            self._condition.become(BrainState.DEGRADED, f"{verdict.reason}: slow")
        elif verdict.level is Level.STAND:
            self._condition.become(BrainState.DEGRADED, f"{verdict.reason}: standing")
        elif without:
            self._condition.become(BrainState.DEGRADED, f"no path: {mission.why_none}")
        elif mission.busy:
            self._condition.become(BrainState.RUNNING, "")
        else:
            self._condition.become(BrainState.READY, "")

    # -- plan ---------------------------------------------------------------------------------

    def _plan(self, now: Nanos, verdict: Verdict) -> None:
        pose = self._pose(now)
        if verdict.level >= Level.STAND:
            self.mission.pause()
        self.mission.step(now, (pose.x, pose.y), self.perception.map)

    def _pose(self, now: Nanos) -> Pose:
        """Where it is now: the newest estimate, carried on by its own speeds."""
        estimate = self.perception.estimate
        assert estimate is not None
        dt = seconds(min(max(now - estimate.t, 0), FORESIGHT))
        return self._body.arc(estimate.pose, estimate.linear * dt, estimate.angular * dt)

    # -- control ------------------------------------------------------------------------------

    def _control(self, now: Nanos, share: float) -> Sequence[Command]:
        """The commands that are due, or those of before."""
        if self._control_at is not None and now < self._control_at:
            return self._said
        period = self._settings.pursuit.period
        late = self._control_at is None or now - self._control_at >= period
        self._control_at = now + period if late or self._control_at is None else self._control_at + period
        since = period if self._controlled is None else min(now - self._controlled, LONGEST)
        self._controlled = now
        body = self._body
        wanted = body.limit(*self._wanted(now, share))
        self._twist = approach(
            self._twist,
            Twist(*wanted),
            seconds(since),
            body.max_linear_acceleration,
            body.max_angular_acceleration,
        )
        self._said = self._words(now)
        return self._said

    def _wanted(self, now: Nanos, share: float) -> tuple[float, float]:
        """The twist wanted, before the body's limits (linear, angular)."""
        self._take_up_path()
        drive = self.mission.drive
        if drive is not None:
            linear, angular = self._body.limit(drive.linear, drive.angular)
            return share * linear, share * angular
        pose = self._pose(now)
        body, costmap = self._body, self.mission.costmap
        bounds = Bounds(
            share * body.max_linear,
            share * body.max_angular,
            body.max_linear_acceleration,
            body.max_angular_acceleration,
        )
        clearance = costmap.clearance(pose.x, pose.y) if costmap else 0.0
        twist = self.pursuit.step(pose, self._twist, bounds, clearance, self._settings.pursuit)
        if self.pursuit.arrived:
            self.mission.arrived(now)
        return twist.linear, twist.angular

    def _take_up_path(self) -> None:
        mission = self.mission
        if mission.path_version == self._followed:
            return
        self._followed = mission.path_version
        if mission.path is None or mission.goal is None:
            self.pursuit.drop()
        else:
            yaw = None if isinstance(mission.path, FrontierPath) else mission.goal.yaw
            self.pursuit.follow(mission.path.points, yaw)

    def _words(self, now: Nanos) -> Sequence[Command]:
        if self._twist != REST or self.mission.busy:
            self._rest_since = None
        elif self._rest_since is None:
            self._rest_since = now
        if self._rest_since is not None and now - self._rest_since >= self._settings.pursuit.idle_after:
            return self._idle()
        if self._rest_since is not None and all(isinstance(word, msg.Idle) for word in self._said):
            return self._said  # never armed since it was last let go: there is nothing to bring to rest
        left, right = self._body.inverse(self._twist.linear, self._twist.angular)
        wheels = {self._body.left: left, self._body.right: right}
        return tuple(
            msg.Velocity(motor, wheels[motor]) if motor in wheels else msg.Idle(motor)
            for motor in self._motors
        )

    def _let_go(self) -> Sequence[Command]:
        self._twist, self._controlled, self._control_at = REST, None, None
        self._rest_since = None
        self._take_up_path()
        self._said = self._idle()
        return self._said

    def _idle(self) -> Sequence[Command]:
        return tuple(msg.Idle(motor) for motor in self._motors)


def _numbers(task: msg.Goal | msg.Drive) -> tuple[float, ...]:
    return (task.x, task.y, task.yaw or 0.0) if isinstance(task, msg.Goal) else (task.linear, task.angular)


PATIENT: Nanos = 3 * SECOND
"""After this long it is said what is still waited for."""
