"""The brain of a base: perceive → plan → control, and whether it may move.

Rules. Perception processes every event at every step, planning does a bounded amount of work at each, control
runs with its own period. The allowed speed is a share of the body's limits: all of it while every source is
well, some while one is late, none while one is lost. None means braking within the acceleration limits, not
disarming; only a stop from above, or rest with nothing to do, disarms the motors (Idle).
Motors that are not wheels are joints that the base carries (a mast, a lift): they take an operator's targets
(`brain.joint_targets`) independently of the base. A mission (`brain.planning.missions`) drives both: its
goals are those of the navigator, its measured motions take the place of a path. A stop, a lost source, or a
hand at the controls pauses it, and only an operator resumes it.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from math import hypot

from brain.belief import Belief, BrainState, BrainTask, Pose, SystemState
from brain.bodies.body import Base
from brain.bodies.plane import Twist, arc
from brain.checks import objection
from brain.control.motion import Motion, Wish
from brain.health import Health, HealthLevel, SourceHealth
from brain.joint_targets import JointTargets
from brain.perception.consistency import Trust
from brain.perception.mount import Mount
from brain.perception.perception import Perception
from brain.planning.behaviours import State
from brain.planning.mission_steps import Seen
from brain.planning.missions import Missions, MissionTask, Phase
from brain.planning.navigator import Navigator
from brain.planning.planner import FrontierPath
from brain.planning.stop_zone import StopZone
from brain.settings import BrainSettings
from brain.status import Note, StatusReporter
from protocols import messages as msg
from protocols.messages import MILLISECOND, SECOND, Command, Event, Nanos, seconds

MAX_EXTRAPOLATION: Nanos = 100 * MILLISECOND
"""An estimate is extrapolated to now by its own twist, by at most this much."""
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
        body: Base,
        motors: Sequence[str],
        sensors: Mapping[str, Mount],
        timeouts: Mapping[str, Nanos],
    ) -> None:
        self._settings, self._body = settings, body
        self.perception = Perception(body, dict(sensors), settings.perception, settings.stop.self_seen)
        self.navigator = Navigator(body, settings.planner, settings.behaviour)
        self.missions = Missions()
        self._zone = StopZone(body, self.perception.mounts, settings.stop)
        self.motion = Motion(settings.pursuit, body, motors)
        self._health = Health(body.joints, tuple(sensors), timeouts, settings.health)
        self._status = StatusReporter()
        joints = [motor for motor in motors if motor not in body.joints]
        self._joints = JointTargets(joints, timeouts, settings.health, self._status)
        self._followed = 0
        """Version of the path that is followed."""
        self._started: Nanos | None = None
        self._waiting_noted = False

    def adopt(self, settings: BrainSettings) -> None:
        """Continue with other settings."""
        self._settings = settings
        assert isinstance(settings.body, Base), "a change of a setting keeps the body"
        self._body = settings.body
        self._health.settings = self._joints.health.settings = settings.health
        navigator = self.navigator
        navigator.settings, navigator.body = settings.planner, self._body
        navigator.behaviour_settings = settings.behaviour
        self._zone.body, self._zone.settings = self._body, settings.stop
        self.motion.body, self.motion.settings = self._body, settings.pursuit

    def step(
        self, now: Nanos, events: Sequence[Event], tasks: Sequence[BrainTask], stopped: str
    ) -> Sequence[Command]:
        """Return one command per motor."""
        base_tasks: list[BrainTask] = []
        self._joints.observe(events)
        for task in tasks:
            motor = getattr(task, "motor", None)
            if motor not in self._joints.motors or not isinstance(task, Command):
                base_tasks.append(task)
                continue
            if self.missions.moves(task.motor):
                self._halt(now, f"an operator moves {motor}")
            self._joints.request(now, task, stopped)
        for lost, reason in self._joints.drop_lost(now, stopped).items():
            if self.missions.moves(lost):
                self._halt(now, reason)
        wheels = self._step_base(now, events, base_tasks, stopped)
        joints = {command.motor: command for command in self._joints.commands(now)}
        return [joints.get(command.motor, command) for command in wheels]

    def _step_base(
        self, now: Nanos, events: Sequence[Event], tasks: Sequence[BrainTask], stopped: str
    ) -> Sequence[Command]:
        """Return the wheels' commands; Idle for the other motors."""
        self.perception.observe(now, events)
        self.motion.observe(events)
        estimate = self.perception.estimate
        raw = self.perception.raw
        moving = self.perception.moving(raw, doubts=True)
        self._zone.observe(estimate.t if estimate else now, raw, events, moving)
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
        if lost:
            self._halt(now, lost)
            busy, dropped = self.navigator.busy, self.navigator.drop(now)
            if busy:
                self._status.add_note("warning", f"{dropped}: {lost}")
        if not waiting and not lost:
            twist = self._mission(now, health)
            self._plan(now, health)
            self.navigator.motion = twist if twist is not None else self.navigator.motion
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
            self.missions.view(),
            self._systems(),
        )

    def take_notes(self) -> list[Note]:
        """Return the notes for the operator since the last call."""
        planned, self.navigator.notes = self.navigator.notes, []
        seen: list[Note] = [("warning", text) for text in self._zone.take_notes()]
        steps, self.missions.notes = self.missions.notes, []
        return steps + planned + seen + self._status.take_notes()

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
            match task:
                case msg.Goal() | msg.Drive():
                    reason = self._drive_to(now, task, lost, waiting)
                case msg.Mission() | msg.Pause() | msg.Resume() | msg.Drop():
                    reason = self._on_mission(now, task, lost)
                case _:
                    reason = f"{task.motor} moves the base: give the base a goal, or drive it"
            if reason:
                self._status.add_note("warning", f"{type(task).__name__} refused: {reason}")

    def _drive_to(self, now: Nanos, task: msg.Goal | msg.Drive, lost: str, waiting: str) -> str:
        """Take a goal, or drive by hand; return why not, or ""."""
        by_hand, missions = isinstance(task, msg.Drive), self.missions
        reason = objection(task) or self._beyond_reach(task) or (waiting if by_hand else "") or lost
        if not reason and not by_hand and missions.phase is Phase.RUNNING:
            reason = "a mission is running: pause it, or drop it"
        if reason:
            return reason
        missions.forget()
        self._halt(now, "manual driving")
        self.navigator.accept(now, task)
        return ""

    def _on_mission(self, now: Nanos, task: MissionTask, may_not_move: str) -> str:
        """Begin, pause, resume or drop a mission; return why not, or ""."""
        missions, before = self.missions, self.missions.phase
        goes = isinstance(task, msg.Mission | msg.Resume)
        if goes and self.navigator.busy and before is not Phase.RUNNING:
            return "there are goals: drop them first"
        reason = missions.request(task, self._body, self._joints.motors, may_not_move)
        if isinstance(task, msg.Drop) and self.navigator.goals:
            reason = ""
            self._status.add_note("info", f"{self.navigator.drop(now)}: an operator sent drop")
        if goes and not reason:
            self.navigator.given_up = ""
        self._settle(now, before)
        return reason

    def _halt(self, now: Nanos, reason: str) -> None:
        """Pause the mission, if it is running."""
        before = self.missions.phase
        self.missions.halt(reason)
        self._settle(now, before)

    def _settle(self, now: Nanos, before: Phase) -> None:
        """End what a mission has begun that does not run any more."""
        if before is Phase.RUNNING and self.missions.phase not in (Phase.RUNNING, Phase.DONE):
            self._joints.stand(now)
            self.navigator.drop(now)

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
        planning, mission = navigator.behaviour, self.missions
        if waiting:
            status.reason = waiting if not stopped else f"{waiting}; stopped: {stopped}"
        elif stopped:
            status.enter(BrainState.STOPPED, stopped, "warning")
        elif lost:
            status.enter(BrainState.STOPPED, lost)
        elif navigator.given_up and not mission.active:
            status.enter(BrainState.STOPPED, navigator.given_up)
        elif mission.phase is Phase.FAILED:
            status.enter(BrainState.STOPPED, f"mission {mission.name}: {mission.reason}")
        elif health.level is HealthLevel.SLOW:
            status.enter(BrainState.DEGRADED, f"{health.reason}: slow")
        elif health.level is HealthLevel.HALT:
            status.enter(BrainState.DEGRADED, f"{health.reason}: standing")
        elif pathless:
            status.enter(BrainState.DEGRADED, f"no path: {navigator.no_path_reason}")
        elif navigator.busy and self._zone.standing:
            status.enter(BrainState.DEGRADED, self._zone.reason)
        elif planning.state in (State.LOOKING, State.BACKING):
            status.enter(BrainState.DEGRADED, f"{planning.state}: {planning.reason}")
        elif navigator.busy or mission.phase is Phase.RUNNING:
            why = planning.reason if planning.state is State.YIELDING else self._zone.reason
            status.enter(BrainState.RUNNING, why)
        elif mission.phase is Phase.PAUSED:
            status.enter(BrainState.READY, f"mission {mission.name} is paused: {mission.reason}")
        else:
            status.enter(BrainState.READY, "")

    def _systems(self) -> tuple[SystemState, ...]:
        """Return what perception, planning and control do, and why."""
        verdict, behaviour = self.perception.verdict, self.navigator.behaviour
        trust = verdict.trust.name.lower().replace("_", " ")
        perception = "waiting" if self.perception.estimate is None else trust
        return (
            SystemState("perception", perception, verdict.reason),
            SystemState("planning", behaviour.state.value, behaviour.reason),
            SystemState("control", self._controlling(), self._zone.reason),
        )

    def _controlling(self) -> str:
        """Return in a word what control does."""
        if all(isinstance(command, msg.Idle) for command in self.motion.commands):
            return "disarmed"
        if self.navigator.drive is not None:
            return "by hand"
        if self._zone.standing:
            return "standing"
        if self.navigator.motion is not None:
            return "measured motion" if any(self.navigator.motion) else "holding"
        return "following" if self.navigator.path is not None else "holding"

    # -- plan ---------------------------------------------------------------------------------

    def _plan(self, now: Nanos, health: SourceHealth) -> None:
        pose = self._pose(now)
        if health.level >= HealthLevel.HALT:
            self.navigator.pause()
        zone = self._zone
        obstacle = (zone.standing, zone.reason) if zone.standing else (0.0, "")
        moving = self.perception.moving(pose)
        self.navigator.step(now, (pose.x, pose.y), self.perception.map, pose.yaw, *obstacle, moving)

    def _mission(self, now: Nanos, health: SourceHealth) -> Twist | None:
        """Let the mission do its step; return the twist that it wants, None for the navigator's."""
        missions, navigator, before = self.missions, self.navigator, self.missions.phase
        if before is not Phase.RUNNING:
            return None
        estimate, zone = self.perception.estimate, self._zone
        assert estimate is not None
        seen = Seen(
            now,
            self._body,
            self._pose(now),
            hypot(estimate.linear, estimate.lateral),
            estimate.angular,
            health.level < HealthLevel.HALT,
            zone.reason if zone.standing else "",
            navigator.ended,
            navigator.why,
            self._joints.feedback,
            self.perception.marker,
        )
        want = missions.advance(seen)
        if want.goal is not None:
            navigator.go(now, want.goal, passing=want.passing)
        elif not want.keep and navigator.goals:
            navigator.drop(now)
        if want.targets and (why := self._joints.reach(now, want.targets, round(want.seconds * SECOND))):
            missions.halt(why)
        self._settle(now, before)
        if navigator.goals or missions.phase is not Phase.RUNNING:
            return None
        return want.twist or Twist()

    def _pose(self, now: Nanos) -> Pose:
        """Return the newest estimate's pose, extrapolated to now by its own twist."""
        estimate = self.perception.estimate
        assert estimate is not None
        dt = seconds(min(max(now - estimate.t, 0), MAX_EXTRAPOLATION))
        return arc(estimate.pose, estimate.linear * dt, estimate.angular * dt, estimate.lateral * dt)

    # -- control ------------------------------------------------------------------------------

    def _control(self, now: Nanos, share: float) -> Sequence[Command]:
        """Return new commands if control is due, or a scan shows an obstacle; else the previous ones."""
        if not self.motion.is_due(now, self._zone):
            return self.motion.commands
        self._follow_new_path()
        pose, navigator = self._pose(now), self.navigator
        drive = navigator.drive
        hand = Twist(drive.linear, drive.angular, drive.lateral) if drive is not None else navigator.motion
        wish = Wish(
            pose,
            share,
            navigator.busy or self.missions.phase is Phase.RUNNING,
            hand,
            navigator.clearance(pose, self._settings.pursuit.obstacle_distance),
        )
        commands = self.motion.step(now, wish, self._zone)
        trusted = share > 0.0 and self.perception.verdict.trust < Trust.DOUBTFUL
        if self.motion.arrived and trusted and hand is None:
            navigator.arrived(now)
        elif self.motion.pursuit.missed and hand is None:
            navigator.missed(now, self.motion.pursuit.missed)
        return commands

    def _follow_new_path(self) -> None:
        navigator = self.navigator
        if navigator.path_version == self._followed:
            return
        self._followed = navigator.path_version
        if navigator.path is None or navigator.goal is None:
            self.motion.drop()
        else:
            yaw = None if isinstance(navigator.path, FrontierPath) else navigator.goal.yaw
            costmap = navigator.costmap
            self.motion.follow(navigator.path, yaw, costmap.zones.limit if costmap else None)

    def _disarm(self) -> Sequence[Command]:
        self._follow_new_path()
        return self.motion.disarm()
