"""Targets of bare joints: one per motor, repeated at every step until replaced or dropped.

Rules. A position, velocity or torque target stays until another target, a stop, or the loss of its motor
ends it: an operator types `velocity left 2` once. A motor that is silent or in fault loses its target, and
only that motor does; a stop drops all. Nothing moves again by itself afterwards.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from brain.checks import objection
from brain.health import Health, HealthLevel, HealthSettings
from brain.settings import suggestion
from brain.status import StatusReporter
from protocols.messages import Command, Event, Idle, Nanos


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
        self._status = status

    def observe(self, events: Sequence[Event]) -> None:
        """Process the motors' events of this step."""
        self.health.observe(events)

    def request(self, now: Nanos, task: Command, stopped: str) -> None:
        """Accept a target, or note the reason why not."""
        reason = f"stopped: {stopped}" if stopped else self._objection(now, task)
        if reason:
            self._status.add_note("warning", f"{type(task).__name__} refused: {reason}")
        else:
            self._targets[task.motor] = task

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

    def drop_lost(self, now: Nanos, stopped: str) -> tuple[str, ...]:
        """Drop every target if stopped, else those of lost motors; return why each motor is lost."""
        if stopped:
            self._targets = {motor: Idle(motor) for motor in self.motors}
        reasons = []
        for motor in self.motors:
            health = self.health.source(now, motor)
            if health.level < HealthLevel.HALT:
                continue
            reasons.append(health.reason)
            if not isinstance(self._targets[motor], Idle):
                self._targets[motor] = Idle(motor)
                self._status.add_note("error", f"the target of {motor} is dropped: {health.reason}")
        return tuple(reasons)

    @property
    def busy(self) -> bool:
        """True if any motor has a target other than Idle."""
        return any(not isinstance(target, Idle) for target in self._targets.values())

    def commands(self) -> tuple[Command, ...]:
        """Return one command per motor, in the order of the robot file."""
        return tuple(self._targets.values())
