"""Targets of bare joints: one per motor, repeated at every step until replaced or dropped.

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

from brain.checks import objection
from brain.health import Health, HealthLevel, HealthSettings
from brain.settings import suggestion
from brain.status import StatusReporter
from protocols.messages import Command, Event, Feedback, Hold, Idle, MoveTool, Nanos, Position, Velocity


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


class JointTargets:
    """The joints of a body without a base, or those that a base carries beside its wheels. Plain data."""

    def __init__(
        self,
        motors: Sequence[str],
        timeouts: Mapping[str, Nanos],
        settings: HealthSettings,
        status: StatusReporter,
    ) -> None:
        self.motors = tuple(motors)
        self.health = Health(motors, (), timeouts, settings)
        self._targets: dict[str, Command] = {motor: Idle(motor) for motor in motors}
        self._motions: dict[str, _Motion] = {}
        self.feedback: dict[str, Feedback] = {}
        """The newest position and velocity of each joint."""
        self._status = status
        self.ended, self.why = 0, ""
        """Number of places for the tip that are done with, and why the last was given up."""

    def observe(self, events: Sequence[Event]) -> None:
        """Process the motors' events of this step."""
        self.health.observe(events)
        for event in events:
            if isinstance(event, Feedback) and event.motor in self._targets:
                known = self.feedback.get(event.motor, event)
                position = known.position if event.position is None else event.position
                velocity = known.velocity if event.velocity is None else event.velocity
                self.feedback[event.motor] = Feedback(event.motor, event.t, position, velocity)

    def request(self, now: Nanos, task: Command, stopped: str) -> None:
        """Accept a target, or note the reason why not."""
        reason = f"stopped: {stopped}" if stopped else self._objection(now, task)
        if reason:
            self._status.add_note("warning", f"{type(task).__name__} refused: {reason}")
        else:
            self._targets[task.motor] = task
            self._motions.pop(task.motor, None)

    def reach(self, now: Nanos, targets: Sequence[Command], span: Nanos) -> str:
        """Take targets, positions to be reached together within a time; return why not, or ""."""
        if wrong := next((why for target in targets if (why := self._objection(now, target))), ""):
            return wrong
        for target in targets:
            before = self._targets[target.motor]
            measured = self.feedback[target.motor].position if target.motor in self.feedback else None
            start = before.position if isinstance(before, Position) else measured
            self._targets[target.motor] = target
            self._motions.pop(target.motor, None)
            if isinstance(target, Position) and start is not None and span > 0:
                self._motions[target.motor] = _Motion(start, now, span)
        return ""

    def place(self, now: Nanos, task: MoveTool) -> str:  # noqa: ARG002 -- an arm's
        """Begin to bring the tip to a place; return why not, or ""."""
        return "these joints are no arm: none moves a tool"

    def stand(self, now: Nanos) -> None:
        """End every motion where it is. What a joint holds, or presses on, it goes on to hold."""
        for command in self.commands(now):
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
        health = self.health.source(now, task.motor)
        lost = health.level >= HealthLevel.HALT and not isinstance(task, Idle)
        return health.reason if lost else ""

    def drop_lost(self, now: Nanos, stopped: str) -> dict[str, str]:
        """Drop every target if stopped, else those of lost motors; return why, by lost motor."""
        if stopped:
            self._targets = {motor: Idle(motor) for motor in self.motors}
            self._motions.clear()
        reasons = {}
        for motor in self.motors:
            health = self.health.source(now, motor)
            if health.level < HealthLevel.HALT:
                continue
            reasons[motor] = health.reason
            if not isinstance(self._targets[motor], Idle):
                self._targets[motor] = Idle(motor)
                self._motions.pop(motor, None)
                self._status.add_note("error", f"the target of {motor} is dropped: {health.reason}")
        return reasons

    @property
    def busy(self) -> bool:
        """True if any motor has a target other than Idle."""
        return any(not isinstance(target, Idle) for target in self._targets.values())

    def commands(self, now: Nanos) -> tuple[Command, ...]:
        """Return one command per motor, in the order of the robot file."""
        if not self._motions:
            return tuple(self._targets.values())
        for motor, motion in list(self._motions.items()):
            if now >= motion.since + motion.duration:
                del self._motions[motor]
        return tuple(
            self._motions[target.motor].at(now, target)
            if isinstance(target, Position) and target.motor in self._motions
            else target
            for target in self._targets.values()
        )
