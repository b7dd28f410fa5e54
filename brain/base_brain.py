"""The brain of a base on wheels: perceive → plan → control, and whether it may move.

Rules. Perception processes every event at every step, planning does a bounded amount of work at each, control
runs with its own period. The allowed speed is a share of the body's limits: all of it while every source is
well, some while one is late, none while one is lost. None means braking within the acceleration limits, not
disarming; only a stop from above, or rest with nothing to do, disarms the motors (Idle).
Motors that are not wheels are joints that the base carries (a mast, a lift): they take an operator's targets
(`brain.joint_targets`) independently of the base.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from brain.belief import Belief, BrainState, BrainTask, Pose
from brain.bodies.differential import Differential, arc
from brain.checks import objection
from brain.control.profile import REST, Twist, approach
from brain.control.pursuit import Bounds, Pursuit
from brain.health import Health, HealthLevel, SourceHealth
from brain.joint_targets import JointTargets
from brain.perception.consistency import Trust
from brain.perception.mount import Mount
from brain.perception.perception import Perception
from brain.planning.navigator import Navigator
from brain.planning.planner import FrontierPath
from brain.planning.stop_zone import StopZone
from brain.settings import BrainSettings
from brain.status import Note, StatusReporter
from protocols import messages as msg
from protocols.messages import MILLISECOND, SECOND, Command, Event, Nanos, seconds

MAX_EXTRAPOLATION: Nanos = 100 * MILLISECOND
"""An estimate is extrapolated to now by its own twist, by at most this much."""
MAX_CONTROL_STEP: Nanos = 100 * MILLISECOND
"""A longer time between two commands counts as this: after a pause the speed must not jump."""
MAX_GOALS = 1000
"""Goals that wait."""
FARTHEST_GOAL = 10_000.0
"""m from the origin, along x and y."""
WAITING_NOTE_AFTER: Nanos = 3 * SECOND
"""After this time of waiting at the start, a note says for what."""


class BaseBrain:
    """Perception, planning and control of one base. State is plain data."""

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
        self.navigator = Navigator(body.radius, settings.planner)
        self._zone = StopZone(body, self.perception.mounts, settings.stop)
        self.pursuit = Pursuit()
        self._health = Health((body.left, body.right), tuple(sensors), timeouts, settings.health)
        self._status = StatusReporter()
        joints = [motor for motor in motors if motor not in (body.left, body.right)]
        self._joints = JointTargets(joints, timeouts, settings.health, self._status)
        self._twist = REST
        """Commanded twist."""
        self._followed = 0
        """Version of the path that pursuit follows."""
        self._control_at: Nanos | None = None
        """When control is due next,"""
        self._controlled: Nanos | None = None
        """and when it last ran."""
        self._rest_since: Nanos | None = None
        self._started: Nanos | None = None
        self._waiting_noted = False
        self._commands: Sequence[Command] = self._idle()

    def adopt(self, settings: BrainSettings) -> None:
        """Continue with other settings."""
        self._settings = settings
        self._body = settings.differential or self._body
        self._health.settings = self._joints.health.settings = settings.health
        self.navigator.settings, self.navigator.radius = settings.planner, self._body.radius
        self._zone.body, self._zone.settings = self._body, settings.stop

    def step(
        self, now: Nanos, events: Sequence[Event], tasks: Sequence[BrainTask], stopped: str
    ) -> Sequence[Command]:
        """Return one command per motor."""
        base_tasks: list[BrainTask] = []
        self._joints.observe(events)
        for task in tasks:
            if isinstance(task, msg.Goal | msg.Drive) or task.motor not in self._joints.motors:
                base_tasks.append(task)
            else:
                self._joints.request(now, task, stopped)
        self._joints.drop_lost(now, stopped)
        joints = {command.motor: command for command in self._joints.commands()}
        wheels = self._step_base(now, events, base_tasks, stopped)
        return [joints.get(command.motor, command) for command in wheels]

    def _step_base(
        self, now: Nanos, events: Sequence[Event], tasks: Sequence[BrainTask], stopped: str
    ) -> Sequence[Command]:
        """Return the wheels' commands; Idle for the other motors."""
        self.perception.observe(now, events)
        estimate = self.perception.estimate
        self._zone.observe(estimate.t if estimate else now, self.perception.raw, events)
        self._health.observe(events, self.perception.absent)
        self._health.helpful = self.perception.helpful
        verdict = self.perception.verdict
        health = self._health.assess(now, self.perception.rejected, self.perception.contradictions(), verdict)
        by_hand = self.navigator.drive is not None or any(isinstance(task, msg.Drive) for task in tasks)
        if by_hand and verdict.trust is Trust.LOST and health.reason == verdict.reason:
            health = SourceHealth(HealthLevel.SLOW, health.reason)  # a person sees where it is
        waiting = self._waiting(now)
        lost = stopped or ("" if waiting else health.reason if health.level is HealthLevel.LOST else "")
        self._accept(now, tasks, lost, waiting)
        if lost and not waiting and self.navigator.busy:
            self._status.add_note("warning", f"{self.navigator.drop()}: {lost}")
        if not waiting and not lost:
            self._plan(now, health)
            self._give_up_standing()
        self._update_state(stopped, lost, waiting, health)
        if stopped or waiting:
            return self._disarm()
        return self._control(now, 0.0 if lost else self._speed_share(health))

    def belief(self) -> Belief:
        """Return estimate, goal, path, map and state as a value."""
        path, perception = self.navigator.path, self.perception
        return Belief(
            self._status.state,
            self._status.reason,
            perception.estimate,
            self.navigator.goal,
            path.points if path else (),
            self.navigator.path_version,
            perception.map.view(),
            dict(perception.rejected),
            self.navigator.reached,
            perception.raw,
        )

    def take_notes(self) -> list[Note]:
        """Return the notes for the operator since the last call."""
        planned, self.navigator.notes = self.navigator.notes, []
        seen: list[Note] = [("warning", text) for text in self._zone.take_notes()]
        return planned + seen + self._status.take_notes()

    # -- may it move? -------------------------------------------------------------------------

    def _waiting(self, now: Nanos) -> str:
        """Return what is missing before the first motion; "" once everything has reported."""
        if self._status.state is not BrainState.INITIALISING:
            return ""
        self._started = now if self._started is None else self._started
        missing = self._health.missing() or ("" if self.perception.estimate else "an estimate of the pose")
        if missing and not self._waiting_noted and now - self._started > WAITING_NOTE_AFTER:
            self._waiting_noted = True
            self._status.add_note("warning", f"still waiting for {missing}")
        return missing and f"waiting for {missing}"

    def _accept(self, now: Nanos, tasks: Sequence[BrainTask], lost: str, waiting: str) -> None:
        for task in tasks:
            if not isinstance(task, msg.Goal | msg.Drive):
                reason = f"{task.motor} is a wheel of a base: use a goal, or drive"
            elif wrong := objection(task) or self._beyond_reach(task):
                reason = wrong
            elif waiting and isinstance(task, msg.Drive):
                reason = waiting
            else:
                reason = "" if waiting else lost
            if reason:
                self._status.add_note("warning", f"{type(task).__name__} refused: {reason}")
            elif isinstance(task, msg.Goal | msg.Drive):
                self.navigator.accept(now, task)

    def _beyond_reach(self, task: msg.Goal | msg.Drive) -> str:
        """Return why a goal can never be reached, whatever is found on the way; "" if it may be."""
        if isinstance(task, msg.Drive):
            return ""
        if len(self.navigator.goals) >= MAX_GOALS:
            return f"{MAX_GOALS} goals are waiting already"
        far = max(abs(task.x), abs(task.y))
        return "" if far <= FARTHEST_GOAL else f"({task.x:g}, {task.y:g}) is beyond {FARTHEST_GOAL:g} m"

    def _speed_share(self, health: SourceHealth) -> float:
        """Return the share of the largest speeds that is allowed."""
        if health.level is HealthLevel.OK:
            return 1.0
        return self._settings.health.slow if health.level is HealthLevel.SLOW else 0.0

    def _update_state(self, stopped: str, lost: str, waiting: str, health: SourceHealth) -> None:
        status, navigator = self._status, self.navigator
        pathless = bool(navigator.goals) and navigator.path is None and bool(navigator.no_path_reason)
        if waiting:
            status.reason = waiting if not stopped else f"{waiting}; stopped: {stopped}"
        elif stopped:
            status.enter(BrainState.STOPPED, stopped, "warning")
        elif lost:
            status.enter(BrainState.STOPPED, lost)
        elif navigator.given_up:
            status.enter(BrainState.STOPPED, navigator.given_up)
        elif health.level is HealthLevel.SLOW:
            status.enter(BrainState.DEGRADED, f"{health.reason}: slow")
        elif health.level is HealthLevel.HALT:
            status.enter(BrainState.DEGRADED, f"{health.reason}: standing")
        elif pathless:
            status.enter(BrainState.DEGRADED, f"no path: {navigator.no_path_reason}")
        elif navigator.busy and self._zone.standing:
            status.enter(BrainState.DEGRADED, self._zone.reason)
        elif navigator.busy:
            status.enter(BrainState.RUNNING, self._zone.reason)
        else:
            status.enter(BrainState.READY, "")

    # -- plan ---------------------------------------------------------------------------------

    def _plan(self, now: Nanos, health: SourceHealth) -> None:
        pose = self._pose(now)
        if health.level >= HealthLevel.HALT:
            self.navigator.pause()
        self.navigator.step(now, (pose.x, pose.y), self.perception.map)

    def _give_up_standing(self) -> None:
        """Drop goals to which no way is free: there is a path by the map, and an obstacle by the lidar."""
        if self.navigator.goals and self._zone.standing > seconds(self._settings.planner.patience):
            self._status.add_note("warning", f"{self.navigator.drop()}: {self._zone.reason}")

    def _pose(self, now: Nanos) -> Pose:
        """Return the newest estimate's pose, extrapolated to now by its own twist."""
        estimate = self.perception.estimate
        assert estimate is not None
        dt = seconds(min(max(now - estimate.t, 0), MAX_EXTRAPOLATION))
        return arc(estimate.pose, estimate.linear * dt, estimate.angular * dt)

    # -- control ------------------------------------------------------------------------------

    def _control(self, now: Nanos, share: float) -> Sequence[Command]:
        """Return new commands if control is due, or a scan shows an obstacle; else the previous ones."""
        due = self._control_at is None or now >= self._control_at
        if not due and not self._zone.is_too_fast((self._twist.linear, self._twist.angular)):
            return self._commands
        period = self._settings.pursuit.period
        if due:
            late = self._control_at is None or now - self._control_at >= period
            self._control_at = now + period if late or self._control_at is None else self._control_at + period
        since = period if self._controlled is None else min(now - self._controlled, MAX_CONTROL_STEP)
        self._controlled = now
        body = self._body
        wanted = body.limit(*self._wanted_twist(now, share))
        desired = approach(
            self._twist,
            Twist(*wanted),
            seconds(since),
            body.max_linear_acceleration,
            body.max_angular_acceleration,
        )
        previous = self._twist.linear, self._twist.angular
        allowed = self._zone.allowed(previous, (desired.linear, desired.angular), wanted, seconds(since))
        self._twist = Twist(*allowed)
        self._commands = self._wheel_commands(now)
        return self._commands

    def _wanted_twist(self, now: Nanos, share: float) -> tuple[float, float]:
        """Return the twist wanted (linear, angular), before the body's limits."""
        self._follow_new_path()
        drive = self.navigator.drive
        if drive is not None:
            linear, angular = self._body.limit(drive.linear, drive.angular)
            return share * linear, share * angular
        pose = self._pose(now)
        body, costmap = self._body, self.navigator.costmap
        bounds = Bounds(
            share * body.max_linear,
            share * body.max_angular,
            body.max_linear_acceleration,
            body.max_angular_acceleration,
        )
        clearance = costmap.clearance(pose.x, pose.y) if costmap else 0.0
        twist = self.pursuit.step(pose, self._twist, bounds, clearance, self._settings.pursuit)
        trusted = share > 0.0 and self.perception.verdict.trust < Trust.DOUBTFUL
        if self.pursuit.arrived and trusted:
            self.navigator.arrived(now)
        return twist.linear, twist.angular

    def _follow_new_path(self) -> None:
        navigator = self.navigator
        if navigator.path_version == self._followed:
            return
        self._followed = navigator.path_version
        if navigator.path is None or navigator.goal is None:
            self.pursuit.drop()
        else:
            yaw = None if isinstance(navigator.path, FrontierPath) else navigator.goal.yaw
            self.pursuit.follow(navigator.path.points, yaw)

    def _wheel_commands(self, now: Nanos) -> Sequence[Command]:
        if self._twist != REST or self.navigator.busy:
            self._rest_since = None
        elif self._rest_since is None:
            self._rest_since = now
        if self._rest_since is not None and now - self._rest_since >= self._settings.pursuit.idle_after:
            return self._idle()
        if self._rest_since is not None and all(isinstance(c, msg.Idle) for c in self._commands):
            return self._commands  # not armed since it was last disarmed: there is nothing to bring to rest
        left, right = self._body.inverse(self._twist.linear, self._twist.angular)
        wheels = {self._body.left: left, self._body.right: right}
        return tuple(
            msg.Velocity(motor, wheels[motor]) if motor in wheels else msg.Idle(motor)
            for motor in self._motors
        )

    def _disarm(self) -> Sequence[Command]:
        self._twist, self._controlled, self._control_at = REST, None, None
        self._rest_since = None
        self._follow_new_path()
        self._commands = self._idle()
        return self._commands

    def _idle(self) -> Sequence[Command]:
        return tuple(msg.Idle(motor) for motor in self._motors)
