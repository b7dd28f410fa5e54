"""The brain of bare joints: no sensors, no map; an operator's targets, motor by motor.

Rules. `brain.joint_targets` decides what happens to a target. Every motor has one command at every step.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from brain.belief import Belief, BrainState, BrainTask
from brain.joint_targets import JointTargets
from brain.settings import BrainSettings
from brain.status import Note, StatusReporter
from protocols.messages import Command, Drive, Event, Goal, Nanos


class JointBrain:
    """Passes an operator's targets to the joints whose feedback can be trusted."""

    def __init__(self, settings: BrainSettings, motors: Sequence[str], timeouts: Mapping[str, Nanos]) -> None:
        self._status = StatusReporter()
        self._joints = JointTargets(motors, timeouts, settings.health, self._status)

    def adopt(self, settings: BrainSettings) -> None:
        """Continue with other settings."""
        self._joints.health.settings = settings.health

    def step(
        self, now: Nanos, events: Sequence[Event], tasks: Sequence[BrainTask], stopped: str
    ) -> Sequence[Command]:
        """Return one command per motor."""
        joints = self._joints
        joints.observe(events)
        missing = joints.health.missing()
        for task in tasks:
            if isinstance(task, Goal | Drive):
                reason = "these are bare joints: there is no base to drive"
                self._status.add_note("warning", f"{type(task).__name__} refused: {reason}")
            else:
                joints.request(now, task, stopped)
        self._update_state(stopped, missing, joints.drop_lost(now, stopped))
        return joints.commands()

    def belief(self) -> Belief:
        """Return the state and its reason; a bare joint has no estimate, map or path."""
        return Belief(self._status.state, self._status.reason, None, None, (), 0, None, {}, 0)

    def take_notes(self) -> list[Note]:
        """Return the notes for the operator since the last call."""
        return self._status.take_notes()

    def _update_state(self, stopped: str, missing: str, lost: Sequence[str]) -> None:
        if stopped:
            self._status.enter(BrainState.STOPPED, stopped, "warning")
        elif missing and self._status.state is BrainState.INITIALISING:
            self._status.enter(BrainState.INITIALISING, f"waiting for {missing}")
        elif lost:
            all_lost = len(lost) == len(self._joints.motors)
            self._status.enter(BrainState.STOPPED if all_lost else BrainState.DEGRADED, "; ".join(lost))
        elif self._joints.busy:
            self._status.enter(BrainState.RUNNING, "")
        else:
            self._status.enter(BrainState.READY, "")
