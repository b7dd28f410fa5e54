"""The brain of bare joints on a bench: no sensors, no map; an operator's targets, motor by motor.

Rules. What becomes of a target stands in `brain.joint_targets`. Every motor has one command at every step.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from brain.belief import Belief, BrainState
from brain.condition import StatusReporter
from brain.joint_targets import JointTargets
from brain.planning.mission import Note
from brain.settings import BrainSettings
from protocols.messages import Command, Drive, Event, Goal, Nanos


class JointBrain:
    """Passes an operator's targets to the joints that can be trusted."""

    def __init__(self, settings: BrainSettings, motors: Sequence[str], timeouts: Mapping[str, Nanos]) -> None:
        self._condition = StatusReporter()
        self._joints = JointTargets(motors, timeouts, settings.health, self._condition)

    def adopt(self, settings: BrainSettings) -> None:
        """Go on with other settings."""
        self._joints.health.settings = settings.health

    def step(
        self, now: Nanos, events: Sequence[Event], tasks: Sequence[Goal | Drive | Command], stopped: str
    ) -> Sequence[Command]:
        """One target per motor."""
        joints = self._joints
        joints.observe(events)
        missing = joints.health.missing()
        for task in tasks:
            if isinstance(task, Goal | Drive):
                why = "these are bare joints: there is no base to drive"
                self._condition.say("warning", f"{type(task).__name__} refused: {why}")
            else:
                joints.ask(now, task, stopped)
        self._settle(stopped, missing, joints.end(now, stopped))
        return joints.commands()

    def belief(self) -> Belief:
        """Only a state."""
        return Belief(self._condition.state, self._condition.reason, None, None, (), 0, None, {}, 0)

    def take_notes(self) -> list[Note]:
        """What there is to say since this was last asked."""
        return self._condition.take_notes()

    def _settle(self, stopped: str, missing: str, lost: Sequence[str]) -> None:
        if stopped:
            self._condition.obey(stopped)
        elif missing and self._condition.state is BrainState.INITIALISING:
            self._condition.become(BrainState.INITIALISING, f"waiting for {missing}")
        elif lost:
            all_lost = len(lost) == len(self._joints.motors)
            self._condition.become(BrainState.STOPPED if all_lost else BrainState.DEGRADED, "; ".join(lost))
        elif self._joints.busy:
            self._condition.become(BrainState.RUNNING, "")
        else:
            self._condition.become(BrainState.READY, "")
