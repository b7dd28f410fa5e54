"""Bare joints as a limb: targets, one per motor, repeated at every step until replaced or dropped.

Rules. A position, velocity or torque target stays until another target, a stop, or the loss of its motor
ends it: an operator types `velocity left 2` once. A motor that is silent or in fault loses its target, and
only that motor does; a stop drops all. Nothing moves again by itself afterwards.
Positions that are to be reached in a given time are moved to together, without a step in the acceleration:
the motion of least jerk (Flash and Hogan 1985, eq. 3) from where each joint is.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import NamedTuple

from brain.belief import Belief, BrainTask, MissionView, SystemState
from brain.checks import objection
from brain.health import Health, HealthLevel
from brain.limb import Allowance, Percept, Plan
from brain.settings import BrainSettings, suggestion
from brain.skills.skill import Intent, Observed
from brain.status import Note, StatusReporter
from protocols.messages import (
    SECOND,
    Command,
    Event,
    Feedback,
    Hold,
    Idle,
    Nanos,
    Position,
    Velocity,
)


class _Motion(NamedTuple):
    """Of one joint, to its target."""

    start: float
    """rad"""
    since: Nanos
    duration: Nanos

    def at(self, now: Nanos, target: Position) -> Position:
        """Return the set-point: 10 s³ - 15 s⁴ + 6 s⁵ of the way, s the share of the time."""
        share = (now - self.since) / self.duration
        if share >= 1.0:
            return target
        way, span = target.position - self.start, self.duration / 1e9
        part = share**3 * (10.0 + share * (6.0 * share - 15.0))
        speed = 30.0 * share**2 * (1.0 - share) ** 2 * way / span
        return replace(target, position=self.start + part * way, velocity=speed)


class BareJoints:
    """Joints that move independently: those of a bench, or what a base carries beside its wheels. Plain
    data."""

    def __init__(
        self,
        motors: Sequence[str],
        timeouts: Mapping[str, Nanos],
        settings: BrainSettings,
        status: StatusReporter,
    ) -> None:
        self.motors = tuple(motors)
        self._health = Health(motors, (), timeouts, settings.health)
        self._targets: dict[str, Command] = {motor: Idle(motor) for motor in motors}
        self._motions: dict[str, _Motion] = {}
        self._feedback: dict[str, Feedback] = {}
        """The newest position and velocity of each joint."""
        self._status = status
        self._systems: tuple[SystemState, ...] = ()

    def adopt(self, settings: BrainSettings) -> None:
        """Continue with other settings."""
        self._health.adopt(settings.health)

    # -- percept and allowance ----------------------------------------------------------------------

    def perceive(self, now: Nanos, events: Sequence[Event], given: Percept | None = None) -> Percept:
        """Process the motors' events of this step; `given`: what is perceived, in place of its own."""
        self._health.observe(events)
        for event in events:
            if isinstance(event, Feedback) and event.motor in self._targets:
                known = self._feedback.get(event.motor, event)
                position = known.position if event.position is None else event.position
                velocity = known.velocity if event.velocity is None else event.velocity
                self._feedback[event.motor] = Feedback(event.motor, event.t, position, velocity)
        if given is not None:
            self._feedback.update(given.joints)
        return Percept(now, self._feedback)

    def allow(self, percept: Percept, *, by_hand: bool) -> Allowance:  # noqa: ARG002 -- a base's
        """Judge each joint by itself; all are lost if each is."""
        sources = {motor: self._health.source(percept.now, motor) for motor in self.motors}
        lost = {motor: one.reason for motor, one in sources.items() if one.level >= HealthLevel.HALT}
        all_lost = len(lost) == len(self.motors)
        level = HealthLevel.LOST if all_lost else HealthLevel.HALT if lost else HealthLevel.OK
        return Allowance(level, "; ".join(lost.values()), missing=self._health.missing(), lost=lost)

    # -- what is asked for --------------------------------------------------------------------------

    def objection(self, now: Nanos, task: BrainTask, allowance: Allowance) -> str:
        """Return why a target cannot be taken, or ""."""
        assert isinstance(task, Command), "a joint takes targets"
        return f"stopped: {allowance.stopped}" if allowance.stopped else self._objection(now, task)

    def accept(self, now: Nanos, task: BrainTask) -> None:  # noqa: ARG002 -- a base's
        """Take a target."""
        assert isinstance(task, Command), "a joint takes targets"
        self._targets[task.motor] = task
        self._motions.pop(task.motor, None)

    def begin(self, now: Nanos, intent: Intent) -> str:
        """Take the targets of a mission's step that are its own; return why not, or ""."""
        own = [target for target in intent.targets if target.motor in self._targets]
        return self.reach(now, own, round(intent.seconds * SECOND)) if own else ""

    def see(self, seen: Observed, percept: Percept, allowance: Allowance) -> Observed:  # noqa: ARG002
        """Add where the joints are."""
        return replace(seen, joints={**(seen.joints or {}), **percept.joints})

    def reach(self, now: Nanos, targets: Sequence[Command], span: Nanos) -> str:
        """Take targets, positions to be reached together within a time; return why not, or ""."""
        if wrong := next((why for target in targets if (why := self._objection(now, target))), ""):
            return wrong
        for target in targets:
            before = self._targets[target.motor]
            measured = self._feedback[target.motor].position if target.motor in self._feedback else None
            start = before.position if isinstance(before, Position) else measured
            self._targets[target.motor] = target
            self._motions.pop(target.motor, None)
            if isinstance(target, Position) and start is not None and span > 0:
                self._motions[target.motor] = _Motion(start, now, span)
        return ""

    def stand(self, now: Nanos) -> None:
        """End every motion where it is. What a joint holds, or presses on, it goes on to hold."""
        for command in self._set_points(now):
            if isinstance(command, Velocity):
                self._targets[command.motor] = Hold(command.motor)
            elif isinstance(command, Position) and command.motor in self._motions:
                self._targets[command.motor] = replace(command, velocity=0.0)
        self._motions.clear()

    def _objection(self, now: Nanos, task: Command) -> str:
        if task.motor not in self._targets:
            hint = suggestion(task.motor, self._targets)
            known = ", ".join(self._targets) + (f"; {hint}" if hint else "")
            return f"there is no motor {task.motor!r}; there are {known}"
        if wrong := objection(task):
            return wrong
        health = self._health.source(now, task.motor)
        lost = health.level >= HealthLevel.HALT and not isinstance(task, Idle)
        return health.reason if lost else ""

    def drop(self, now: Nanos, allowance: Allowance) -> None:  # noqa: ARG002 -- a base's
        """Drop every target if stopped, else those of lost motors."""
        if allowance.stopped:
            self._targets = {motor: Idle(motor) for motor in self.motors}
            self._motions.clear()
        for motor, reason in allowance.lost.items():
            if not isinstance(self._targets[motor], Idle):
                self._targets[motor] = Idle(motor)
                self._motions.pop(motor, None)
                self._status.add_note("error", f"the target of {motor} is dropped: {reason}")

    # -- plan and commands --------------------------------------------------------------------------

    def plan(self, percept: Percept, allowance: Allowance, *, running: bool) -> Plan:  # noqa: ARG002
        """Return the set-points of now; busy while any motor has a target other than Idle."""
        busy = any(not isinstance(target, Idle) for target in self._targets.values())
        set_points = {command.motor: command for command in self._set_points(percept.now)}
        return Plan(busy, degraded=allowance.reason, targets=set_points)

    def _set_points(self, now: Nanos) -> tuple[Command, ...]:
        for motor, motion in list(self._motions.items()):
            if now >= motion.since + motion.duration:
                del self._motions[motor]
        return tuple(
            self._motions[target.motor].at(now, target)
            if isinstance(target, Position) and target.motor in self._motions
            else target
            for target in self._targets.values()
        )

    def commands(self, percept: Percept, allowance: Allowance, plan: Plan) -> Sequence[Command]:  # noqa: ARG002
        """Return one command per motor, in the order of the robot file."""
        return self._described(allowance, tuple(plan.targets.values()))

    def _described(self, allowance: Allowance, commands: Sequence[Command]) -> Sequence[Command]:
        """Note what perception and control do, and why; return the commands."""
        perception = ("degraded", allowance.reason) if allowance.lost else ("measured", "")
        if allowance.missing:
            perception = "waiting", f"for {allowance.missing}"
        moving = any(getattr(command, "velocity", 0.0) for command in commands)
        disarmed = all(isinstance(command, Idle) for command in commands)
        control = "disarmed" if disarmed else "moving" if moving else "holding"
        self._systems = SystemState("perception", *perception), SystemState("control", control, "")
        return commands

    def believe(self, belief: Belief, mission: MissionView | None) -> Belief:
        """Add what is done; a joint has no estimate, map or path."""
        if not self._systems or belief.systems:
            return belief
        perception, control = self._systems
        doing = (mission.phase, mission.reason) if mission else ("idle", "")
        return replace(belief, systems=(perception, SystemState("planning", *doing), control))

    def take_notes(self) -> list[Note]:
        """Return none: they are the brain's."""
        return []
