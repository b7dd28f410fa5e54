"""Bare joints: an operator's targets, each ended when its motor cannot be trusted.

Rules. A motor that is silent or in fault loses its target, and only that motor; a stop ends all. Nothing
moves again by itself afterwards. What is said to a person goes to the condition of the body that has them.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from brain.status import StatusReporter
from brain.control.joints import Targets
from brain.health import WELL, Health, HealthSettings, Level
from protocols.messages import Command, Event, Idle, Nanos


class JointTargets:
    """The joints of a bench, or those that a base carries beside its wheels. State is plain data."""

    def __init__(
        self,
        motors: Sequence[str],
        timeouts: Mapping[str, Nanos],
        settings: HealthSettings,
        condition: StatusReporter,
    ) -> None:
        self.motors = tuple(motors)
        self.health = Health(motors, (), timeouts, settings)
        self._targets = Targets(motors)
        self._condition = condition

    def observe(self, events: Sequence[Event]) -> None:
        """What the motors say, at every step."""
        self.health.observe(events)

    def ask(self, now: Nanos, task: Command, stopped: str) -> None:
        """Take up a target, or say why not."""
        if stopped:
            why = f"stopped: {stopped}"
        else:
            verdict = self.health.source(now, task.motor) if task.motor in self.motors else WELL
            lost = verdict.level >= Level.STAND and not isinstance(task, Idle)
            why = verdict.reason if lost else self._targets.ask(task)
        if why:
            self._condition.say("warning", f"{type(task).__name__} refused: {why}")

    def end(self, now: Nanos, stopped: str) -> tuple[str, ...]:
        """End every target if stopped, else those of motors that cannot be trusted: why, one by one."""
        if stopped:
            for motor in self._targets.wanted():
                self._targets.drop(motor)
        reasons = []
        for motor in self.motors:
            verdict = self.health.source(now, motor)
            if verdict.level < Level.STAND:
                continue
            reasons.append(verdict.reason)
            if self._targets.drop(motor):
                self._condition.say("error", f"the target of {motor} is dropped: {verdict.reason}")
        return tuple(reasons)

    @property
    def busy(self) -> bool:
        """Whether any of them is to do something."""
        return bool(self._targets.wanted())

    def commands(self) -> tuple[Command, ...]:
        """One command per motor, in the order in which they were named."""
        return self._targets.commands()
