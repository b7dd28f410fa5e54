"""The brain of bare joints: no sensors, no map; an operator's targets, motor by motor.

Rules. `brain.joint_targets` decides what happens to a target, `brain.planning.missions` to a mission. Every
motor has one command at every step. A stop, or a lost joint, pauses the mission.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from brain.belief import Belief, BrainState, BrainTask, SystemState
from brain.bodies.body import Linkage
from brain.joint_targets import JointTargets
from brain.linked_targets import LinkedTargets
from brain.planning.mission_steps import STAND, Seen
from brain.planning.missions import Missions, Phase
from brain.settings import BrainSettings
from brain.status import Note, StatusReporter
from protocols.messages import SECOND, Command, Drive, Drop, Event, Goal, Idle, Mission, Nanos, Pause, Resume


class JointBrain:
    """Passes an operator's targets to the joints whose feedback can be trusted."""

    def __init__(self, settings: BrainSettings, motors: Sequence[str], timeouts: Mapping[str, Nanos]) -> None:
        self._status = StatusReporter()
        body, given = settings.body, (motors, timeouts, settings.health, self._status)
        self._joints = LinkedTargets(body, *given) if isinstance(body, Linkage) else JointTargets(*given)
        self._missions = Missions()
        self._systems: tuple[SystemState, ...] = ()

    def adopt(self, settings: BrainSettings) -> None:
        """Continue with other settings."""
        self._joints.health.settings = settings.health

    def step(
        self, now: Nanos, events: Sequence[Event], tasks: Sequence[BrainTask], stopped: str
    ) -> Sequence[Command]:
        """Return one command per motor."""
        joints, missions = self._joints, self._missions
        joints.observe(events)
        missing = joints.health.missing()
        before = missions.phase
        for task in tasks:
            reason = ""
            if isinstance(task, Goal | Drive):
                reason = "these are bare joints: there is no base to drive"
            elif isinstance(task, Mission | Pause | Resume | Drop):
                reason = missions.request(task, None, joints.motors, stopped)
            else:
                if missions.moves(task.motor):
                    missions.halt(f"an operator moves {task.motor}")
                missions.forget()
                joints.request(now, task, stopped)
            if reason:
                self._status.add_note("warning", f"{type(task).__name__} refused: {reason}")
        lost = joints.drop_lost(now, stopped)
        waiting = bool(missing) and self._status.state is BrainState.INITIALISING
        if reason := stopped or ("" if waiting else "; ".join(lost.values())):
            missions.halt(reason)
        seen = Seen(now, joints=joints.feedback, ended=joints.ended, why=joints.why)
        want = STAND if waiting else missions.advance(seen)
        if want.place is not None and (reason := joints.place(now, want.place)):
            missions.halt(reason)
        if want.targets and (reason := joints.reach(now, want.targets, round(want.seconds * SECOND))):
            missions.halt(reason)
        if before is Phase.RUNNING and missions.phase in (Phase.PAUSED, Phase.DROPPED, Phase.FAILED):
            joints.stand(now)
        self._update_state(stopped, missing, lost)
        commands = joints.commands(now)
        self._systems = self._describe(missing, lost, commands)
        return commands

    def belief(self) -> Belief:
        """Return the state and its reason; a bare joint has no estimate, map or path."""
        state, reason, mission = self._status.state, self._status.reason, self._missions.view()
        return Belief(state, reason, None, None, (), 0, None, {}, 0, mission=mission, systems=self._systems)

    def take_notes(self) -> list[Note]:
        """Return the notes for the operator since the last call."""
        steps, self._missions.notes = self._missions.notes, []
        return steps + self._status.take_notes()

    def _describe(
        self, missing: str, lost: Mapping[str, str], commands: Sequence[Command]
    ) -> tuple[SystemState, ...]:
        """Return what perception, planning and control do, and why."""
        perception = ("degraded", "; ".join(lost.values())) if lost else ("measured", "")
        if missing:
            perception = "waiting", f"for {missing}"
        mission = self._missions.view()
        moving = any(getattr(command, "velocity", 0.0) for command in commands)
        disarmed = all(isinstance(command, Idle) for command in commands)
        return (
            SystemState("perception", *perception),
            SystemState("planning", mission.phase if mission else "idle", mission.reason if mission else ""),
            SystemState("control", "disarmed" if disarmed else "moving" if moving else "holding", ""),
        )

    def _update_state(self, stopped: str, missing: str, lost: Mapping[str, str]) -> None:
        if stopped:
            self._status.enter(BrainState.STOPPED, stopped, "warning")
        elif missing and self._status.state is BrainState.INITIALISING:
            self._status.enter(BrainState.INITIALISING, f"waiting for {missing}")
        elif lost:
            all_lost = len(lost) == len(self._joints.motors)
            state = BrainState.STOPPED if all_lost else BrainState.DEGRADED
            self._status.enter(state, "; ".join(lost.values()))
        elif self._missions.phase is Phase.FAILED:
            self._status.enter(BrainState.STOPPED, self._missions.reason)
        elif self._joints.busy or self._missions.phase is Phase.RUNNING:
            self._status.enter(BrainState.RUNNING, "")
        else:
            self._status.enter(BrainState.READY, "")
