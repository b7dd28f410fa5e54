"""A base as a limb: what moves the robot in the plane; perception, planning and control of it.

Rules. Perception processes every event at every step, planning does a bounded amount of work at each, control
runs with its own period. The allowed speed is a share of the body's limits: all of it while every source is
well, some while one is late, none while one is lost. None means braking within the acceleration limits, not
disarming; only a stop from above, or rest with nothing to do, disarms the motors (Idle).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from math import hypot, pi

from brain.belief import Belief, BrainTask, MissionView, Pose, SystemState
from brain.bodies.body import Base
from brain.bodies.plane import Twist, frame_of, wrap
from brain.checks import objection
from brain.control.motion import MotionControl, MotionInputs
from brain.health import Health, HealthLevel, SourceHealth
from brain.limb import Allowance, Course, Percept, Plan
from brain.perception.consistency import Trust
from brain.perception.filter_inputs import Nis
from brain.perception.given_map import GivenMap
from brain.perception.mount import Mount
from brain.perception.percept import Sight
from brain.perception.perception import Perception
from brain.planning.behaviours import BehaviourState
from brain.planning.navigator import Navigator, Route
from brain.planning.planner import FrontierPath
from brain.planning.stop_zone import StopZone
from brain.settings import BrainSettings
from brain.skills.skill import Intent, Observed, Tally
from brain.status import Note
from protocols import messages as msg
from protocols.messages import Command, Event, Nanos

MAX_GOALS = 1000
"""Goals that wait."""
FARTHEST = 10_000.0
"""m from the origin, along x and y: of goals, and of where the robot may be."""
NEAR_ENOUGH = 0.25
"""m from the end of its path at which a base rests that another program drives: it has arrived,"""
RESTS = 0.02
"""m/s, and rad/s: so slow."""
LEAST_SIGMA, MOST_SIGMA = (0.001, 0.001), (5.0, pi)
"""m, rad: how sure, and how unsure, who tells it where it is may be."""


class BaseLimb:
    """Perception, planning and control of one base. State is plain data."""

    def __init__(
        self,
        body: Base,
        sensors: Mapping[str, Mount],
        timeouts: Mapping[str, Nanos],
        settings: BrainSettings,
    ) -> None:
        self.motors = body.joints
        seen, saved = settings.stop.self_seen, settings.saved
        self.perception = Perception(body, dict(sensors), settings.perception, seen, saved)
        self.motion = MotionControl(settings.pursuit, body, body.joints)
        self.navigator = Navigator(body, settings.planner, settings.behaviour)
        self._body, self._settings = body, settings
        self._zone = StopZone(body, self.perception.mounts, settings.stop)
        self._health = Health(body.joints, tuple(sensors), timeouts, settings.health)
        self._sight = self.perception.sight(0)
        self._given = GivenMap(self.perception.map.resolution) if settings.perception.given else None
        """What another program has perceived"""
        self._wanted: Twist | None = None
        """The motion that a mission's step wants"""
        self._followed = 0
        """Version of the path that is followed."""

    def adopt(self, settings: BrainSettings) -> None:
        """Continue with other settings."""
        body = settings.base
        assert body is not None, "a change of a setting keeps the body"
        self._body, self._settings = body, settings
        self._health.adopt(settings.health)
        self.navigator.adopt(body, settings.planner, settings.behaviour)
        self._zone.adopt(body, settings.stop)
        self.motion.adopt(body, settings.pursuit)

    # -- percept and allowance ----------------------------------------------------------------------

    def perceive(self, now: Nanos, events: Sequence[Event], given: Percept | None = None) -> Percept:
        """Process the events since the last step; `given`: what is perceived, in place of its own."""
        self.perception.observe(now, events)
        self.motion.observe(events)
        sight = given.sight if given is not None else None
        sight = self._sight = sight or self.perception.sight(now)
        estimate = sight.estimate
        self._zone.observe(estimate.t if estimate else now, sight.raw, events, sight.suspects)
        self._health.observe(events, sight.absent, sight.helpful)
        return Percept(now, sight=sight)

    def allow(self, percept: Percept, *, by_hand: bool) -> Allowance:
        """Return what its sources and their agreement allow."""
        sight = percept.sight
        assert sight is not None, "a base has perceived"
        verdict = sight.verdict
        health = self._health.assess(percept.now, sight.rejected, sight.contradictions, verdict)
        by_hand = by_hand or (self.navigator.drive is not None and not self.is_led)
        if by_hand and verdict.trust is Trust.LOST and health.reason == verdict.reason:
            health = SourceHealth(HealthLevel.SLOW, health.reason)  # a person sees where it is
        shares = {HealthLevel.OK: 1.0, HealthLevel.SLOW: self._settings.health.slow}
        missing = self._health.missing() or ("" if sight.estimate else "an estimate of the pose")
        return Allowance(health.level, health.reason, shares.get(health.level, 0.0), missing)

    # -- what is asked for --------------------------------------------------------------------------

    def objection(self, now: Nanos, task: BrainTask, allowance: Allowance) -> str:  # noqa: ARG002
        """Return why a goal, or driving by hand, cannot be taken, or ""."""
        if not isinstance(task, msg.Goal | msg.Drive):
            motor = getattr(task, "motor", "")
            return f"{motor} moves the base: give the base a goal, or drive it"
        waiting = allowance.waiting if isinstance(task, msg.Drive) else ""
        return objection(task) or self._beyond_reach(task) or waiting or allowance.refusal

    def accept(self, now: Nanos, task: BrainTask) -> None:
        """Take a goal, or drive by hand."""
        assert isinstance(task, msg.Goal | msg.Drive), "a base takes these"
        if isinstance(task, msg.Drive) and self.is_led:
            self.navigator.steer(now, task)
        else:
            self.navigator.accept(now, task)

    @property
    def may_be_led(self) -> bool:
        """Whether another program drives along paths to goals."""
        return self._settings.pursuit.given

    @property
    def is_led(self) -> bool:
        """Whether it does so now: there is a goal."""
        return self.may_be_led and bool(self.navigator.goals.waiting)

    def take_map(self, task: msg.Grid) -> str:
        """Plan on the grid of another program from now on; return why not, or ""."""
        if self._given is None:
            return "the robot perceives by itself, unless its file says otherwise: perception.given = true"
        if why := objection(task):
            return why
        if max(abs(task.x), abs(task.y)) > FARTHEST:
            return f"({task.x:g}, {task.y:g}) is beyond {FARTHEST:g} m"
        pose, odom = self._sight.pose, self._sight.odom
        if pose is None or odom is None:
            return "there is no estimate yet: send it again when the robot is ready"
        return self._given.take(task, frame_of(pose, odom) if task.odom else Pose(0.0, 0.0, 0.0))

    def _beyond_reach(self, task: msg.Goal | msg.Drive) -> str:
        """Return why a goal can never be reached, whatever is found on the way; "" if it may be."""
        if isinstance(task, msg.Drive):
            return ""
        if len(self.navigator.goals.waiting) >= MAX_GOALS:
            return f"{MAX_GOALS} goals are waiting already"
        far = max(abs(task.x), abs(task.y))
        return "" if far <= FARTHEST else f"({task.x:g}, {task.y:g}) is beyond {FARTHEST:g} m"

    def locate(self, now: Nanos, task: msg.Locate) -> str:
        """Believe that the base is where it is said to be; return why not, or "". A path that it was
        following began elsewhere: another is searched."""
        sigmas = zip(("m", "rad"), (task.sigma, task.sigma_yaw), LEAST_SIGMA, MOST_SIGMA, strict=True)
        if why := objection(task):
            return why
        if max(abs(task.x), abs(task.y)) > FARTHEST:
            return f"({task.x:g}, {task.y:g}) is beyond {FARTHEST:g} m"
        for unit, sigma, least, most in sigmas:
            if not least <= sigma <= most:
                return (
                    f"a standard deviation of {sigma:g} {unit}: {least:g} to {most:.3g} {unit} are expected"
                )
        if not self.perception.locate(Pose(task.x, task.y, wrap(task.yaw)), task.sigma, task.sigma_yaw):
            return "there is no estimate yet: ask again when the robot is ready"
        self._sight = self.perception.sight(now)
        self.navigator.replan(now, "the path is dropped: the robot was told where it is")
        return ""

    def drop(self, now: Nanos, allowance: Allowance) -> None:
        """Drop every task of a base that may not do it any more."""
        if allowance.refusal:
            busy, dropped = self.navigator.busy, self.navigator.drop(now)
            if busy:
                self.navigator.note("warning", f"{dropped}: {allowance.refusal}")

    @property
    def busy(self) -> bool:
        """Whether there is a goal, or manual driving."""
        return self.navigator.busy

    def drop_goals(self, now: Nanos) -> str:
        """Drop the goals; return in words what was dropped, "" if there were none."""
        return self.navigator.drop(now) if self.navigator.goals.waiting else ""

    def forget(self) -> None:
        """Take goals that were given up as known: something else is to be done."""
        self.navigator.forget()

    def begin(self, now: Nanos, intent: Intent) -> str:
        """Go to the goal of a mission's step, or move as it wants."""
        self._wanted = intent.twist or Twist()
        if intent.goal is not None:
            self.navigator.go(now, intent.goal, passing=intent.passing)
        elif not intent.keep and self.navigator.goals.waiting:
            self.navigator.drop(now)
        return ""

    def see(self, seen: Observed, percept: Percept, allowance: Allowance) -> Observed:
        """Add where the base is, how fast, and what hinders it."""
        sight, route, obstacle = percept.sight, self.navigator.route(), self._zone.hindrance()
        assert sight is not None, "a base has perceived"
        assert sight.estimate is not None, "a mission waits for it"
        estimate = sight.estimate
        return replace(
            seen,
            body=self._body,
            pose=sight.pose,
            linear=hypot(estimate.linear, estimate.lateral),
            angular=estimate.angular,
            free=allowance.level < HealthLevel.HALT,
            obstructed=obstacle.reason if obstacle.standing else "",
            goals=Tally(route.ended, route.why),
            marker=sight.marker,
        )

    def stand(self, now: Nanos) -> None:
        """End what a mission has begun."""
        self.navigator.drop(now)

    # -- plan ---------------------------------------------------------------------------------------

    def plan(self, percept: Percept, allowance: Allowance, *, running: bool) -> Plan:
        """Plan, and return the motion wanted, if control is due."""
        now, sight = percept.now, percept.sight
        assert sight is not None, "a base has perceived"
        if sight.pose is not None and not allowance.waiting and not allowance.refusal:
            if allowance.level >= HealthLevel.HALT:
                self.navigator.pause()
            zone, pose = self._zone.hindrance(), sight.pose
            obstacle = (zone.standing, zone.reason) if zone.standing else (0.0, "")
            wanted = self._wanted if running and not self.navigator.goals.waiting else None
            grid = self._given or sight.map
            self.navigator.step(now, (pose.x, pose.y), grid, pose.yaw, *obstacle, sight.moving, wanted)
        route = self.navigator.route()
        stands, why = self._hindered(allowance, route)
        return Plan(
            route.busy,
            why,
            stands,
            route.given_up,
            self._motion_inputs(now, sight, allowance, route, running=running),
            Course(route.version) if self._settings.pursuit.given else _course(route),
        )

    def _hindered(self, allowance: Allowance, route: Route) -> tuple[str, str]:
        """Return why the base does not do as it should, and what it does about an obstacle."""
        zone = self._zone.hindrance()
        if allowance.level is HealthLevel.SLOW:
            return f"{allowance.reason}: slow", ""
        if allowance.level is HealthLevel.HALT:
            return f"{allowance.reason}: standing", ""
        if route.pathless:
            return f"no path: {route.pathless}", ""
        if route.busy and zone.standing:
            return zone.reason, ""
        if route.state in (BehaviourState.LOOKING, BehaviourState.BACKING):
            return f"{route.state}: {route.reason}", ""
        return "", route.reason if route.state is BehaviourState.YIELDING else zone.reason

    def _motion_inputs(
        self, now: Nanos, sight: Sight, allowance: Allowance, route: Route, *, running: bool
    ) -> MotionInputs | None:
        """Return what control needs to know, if it is due or a scan shows an obstacle."""
        pose, odom = sight.pose, sight.odom
        if allowance.stopped or allowance.waiting or pose is None or odom is None:
            return None
        if not self.motion.is_due(now, self._zone):
            return None
        hand = route.drive if route.drive is not None else route.motion
        if self.is_led:  # what planning does without a way comes first
            hand = route.motion or route.drive or Twist()
        share = 0.0 if allowance.refusal else allowance.share
        clearance = self.navigator.clearance(pose, self._settings.pursuit.obstacle_distance)
        return MotionInputs(pose, odom, share, route.busy or running, hand, clearance)

    # -- commands -----------------------------------------------------------------------------------

    def commands(self, percept: Percept, allowance: Allowance, plan: Plan) -> Sequence[Command]:
        """Return new commands if control is due, else the previous ones; Idle if it is to be disarmed."""
        inputs, sight = plan.inputs, percept.sight
        assert sight is not None, "a base has perceived"
        if allowance.stopped or allowance.waiting:
            self._follow(plan.course)
            return self.motion.disarm()
        if inputs is None:
            return self.motion.commands
        self._follow(plan.course)
        commands = self.motion.step(percept.now, inputs, self._zone)
        trusted = inputs.share > 0.0 and sight.verdict.trust < Trust.DOUBTFUL
        if self.is_led:
            if trusted:
                self._look_for_arrival(percept.now, sight)
        elif inputs.drive is None:
            if self.motion.arrived and trusted:
                self.navigator.arrived(percept.now)
            elif missed := self.motion.missed:
                self.navigator.missed(percept.now, missed)
        return commands

    def _look_for_arrival(self, now: Nanos, sight: Sight) -> None:
        """Note that another program has driven to the end of the path."""
        path, estimate, pose = self.navigator.path, sight.estimate, sight.pose
        if path is None or estimate is None or pose is None:
            return
        rests = max(hypot(estimate.linear, estimate.lateral), abs(estimate.angular)) < RESTS
        x, y = path.points[-1]
        if rests and hypot(pose.x - x, pose.y - y) <= NEAR_ENOUGH:
            self.navigator.arrived(now)

    def _follow(self, course: Course) -> None:
        if course.version == self._followed:
            return
        self._followed = course.version
        if course.path is None:
            self.motion.drop()
        else:
            self.motion.follow(course.path, course.yaw, course.slow)

    # -- for observers ------------------------------------------------------------------------------

    @property
    def nis(self) -> Mapping[str, Nis]:
        """Normalised innovations squared, by sensor."""
        return self.perception.nis

    def believe(self, belief: Belief, mission: MissionView | None) -> Belief:  # noqa: ARG002
        """Add estimate, goal, path and map."""
        sight, route = self._sight, self.navigator.route()
        return replace(
            belief,
            estimate=sight.estimate,
            goal=route.goal,
            path=route.path.points if route.path else (),
            path_version=route.version,
            map=(self._given or sight.map).view(),
            rejected=dict(sight.rejected),
            reached=route.reached,
            raw=sight.raw,
            systems=self._systems(route),
            explained=tuple(self.perception.explanations()),
        )

    def _systems(self, route: Route) -> tuple[SystemState, ...]:
        """Return what perception, planning and control do, and why."""
        verdict, estimate = self.perception.verdict, self._sight.estimate
        perception = "waiting" if estimate is None else verdict.trust.name.lower().replace("_", " ")
        return (
            SystemState("perception", perception, verdict.reason),
            SystemState("planning", route.state.value, route.reason),
            SystemState("control", self._controlling(route), self._zone.hindrance().reason),
        )

    def _controlling(self, route: Route) -> str:
        """Return in a word what control does."""
        if all(isinstance(command, msg.Idle) for command in self.motion.commands):
            return "disarmed"
        if route.drive is not None:
            return "by hand"
        if self._zone.hindrance().standing:
            return "standing"
        if route.motion is not None:
            return "measured motion" if any(route.motion) else "holding"
        return "following" if route.path is not None else "holding"

    def take_notes(self) -> list[Note]:
        """Return the notes for the operator since the last call."""
        texts = self.perception.take_notes() + self._zone.take_notes()
        seen: list[Note] = [("warning", text) for text in texts]
        return self.navigator.take_notes() + seen


def _course(route: Route) -> Course:
    """Return the path to be followed."""
    if route.path is None or route.goal is None:
        return Course(route.version)
    yaw = None if isinstance(route.path, FrontierPath) else route.goal.yaw
    return Course(route.version, route.path, yaw, route.slow)
