"""The brain of bare joints on a bench: no sensors, no map; an operator's targets, motor by motor.

Rules. A motor that is silent or in fault loses its target, and only that motor; a stop ends all. Nothing
moves again by itself afterwards. Every motor has one command at every step.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from brain.belief import Belief, BrainState
from brain.condition import Condition
from brain.control.joints import Targets
from brain.health import WELL, Health, Level
from brain.planning.mission import Remark
from brain.settings import BrainSettings
from protocols.words import Command, Drive, Event, Goal, Idle, Nanos


class Bench:
    """Passes an operator's targets to the joints that can be trusted."""

    def __init__(self, settings: BrainSettings, motors: Sequence[str], timeouts: Mapping[str, Nanos]) -> None:
        self._motors = tuple(motors)
        self._targets = Targets(motors)
        self._health = Health(motors, (), timeouts, settings.health)
        self._condition = Condition()

    def adopt(self, settings: BrainSettings) -> None:
        """Go on with other settings."""
        self._health.settings = settings.health

    def step(
        self, now: Nanos, events: Sequence[Event], tasks: Sequence[Goal | Drive | Command], stopped: str
    ) -> Sequence[Command]:
        """One target per motor."""
        self._health.hear(events)
        missing = self._health.missing()
        for task in tasks:
            self._ask(now, task, stopped)
        if stopped:
            for motor in self._targets.wanted():
                self._targets.drop(motor)
        lost = self._drop_lost(now)
        self._settle(stopped, missing, lost)
        return self._targets.commands()

    def belief(self) -> Belief:
        """Only a state."""
        return Belief(self._condition.state, self._condition.reason, None, None, (), 0, None, {}, 0)

    def take_remarks(self) -> list[Remark]:
        """What there is to say since this was last asked."""
        return self._condition.take_remarks()

    def _ask(self, now: Nanos, task: Goal | Drive | Command, stopped: str) -> None:
        if isinstance(task, Goal | Drive):
            why = "these are bare joints: there is no base to drive"
        elif stopped:
            why = f"stopped: {stopped}"
        else:
            verdict = self._health.source(now, task.motor) if task.motor in self._motors else WELL
            lost = verdict.level >= Level.STAND and not isinstance(task, Idle)
            why = verdict.reason if lost else self._targets.ask(task)
        if why:
            self._condition.say("warning", f"{type(task).__name__} refused: {why}")

    def _drop_lost(self, now: Nanos) -> str:
        """End the targets of motors that cannot be trusted; which, in words."""
        reasons = []
        for motor in self._motors:
            verdict = self._health.source(now, motor)
            if verdict.level < Level.STAND:
                continue
            reasons.append(verdict.reason)
            if self._targets.has(motor):
                self._targets.drop(motor)
                self._condition.say("error", f"the target of {motor} is dropped: {verdict.reason}")
        return "; ".join(reasons)

    def _settle(self, stopped: str, missing: str, lost: str) -> None:
        if stopped:
            self._condition.obey(stopped)
        elif missing and self._condition.state is BrainState.INITIALISING:
            self._condition.become(BrainState.INITIALISING, f"waiting for {missing}")
        elif lost:
            all_lost = len(lost.split("; ")) == len(self._motors)
            self._condition.become(BrainState.STOPPED if all_lost else BrainState.DEGRADED, lost)
        elif self._targets.wanted():
            self._condition.become(BrainState.RUNNING, "")
        else:
            self._condition.become(BrainState.READY, "")
