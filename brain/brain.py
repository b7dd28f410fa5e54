"""The brain: `step(now, events, tasks, stopped)` returns one command per motor.

Rules. A robot has limbs: one base at most, linkages, bare joints, as many as there are (`brain.limb`). A
step is four values of each limb: percept → allowance → plan → commands. Here is what is one for all: whether
the robot is ready, who takes which task, the mission, the state and its reason. It knows no vendor and no
bus. Time is an argument, work is bounded, state is plain data: a deep copy continues exactly as the original,
and equal inputs give equal commands.
A mission drives all limbs. A stop, a limb that is lost, or a hand at the controls pauses it, and only an
operator resumes it. Bare joints that a base carries beside its wheels are looked at only while in use.

    timeouts = {"left": 100 * MILLISECOND, "right": 100 * MILLISECOND, "lidar": 500 * MILLISECOND}
    brain = Brain(settings, ["left", "right"], {"lidar": Mount(x=0.12)}, timeouts)
    commands = brain.step(now, events, [Goal(4.0, 2.0)], "")
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

from brain.bare_joints import BareJoints
from brain.base_limb import BaseLimb
from brain.belief import Belief, BrainState, BrainTask
from brain.bodies.limbs import limbs
from brain.health import HealthLevel, HealthSettings
from brain.limb import Allowance, Limb, Percept, Plan, StepValues
from brain.linked_joints import LinkedJoints
from brain.other_brain import OtherBrain
from brain.perception.filter_inputs import Nis
from brain.perception.mount import Mount
from brain.planning.missions import MissionPhase, Missions, MissionTask
from brain.settings import BrainSettings, changed, keys, suggestion
from brain.skills import found
from brain.skills.skill import Observed
from brain.status import Note, StatusReporter
from protocols import messages as msg
from protocols.messages import SECOND, Command, Event, Nanos

__all__ = ["Brain", "BrainSettings", "HealthSettings"]

NO_BASE = "these are bare joints: there is no base to drive"
NOTHING = StepValues()
WAITING_NOTE_AFTER: Nanos = 3 * SECOND
"""After this time of waiting at the start, a note says for what."""


class Brain:
    """One brain for one robot.

    `timeouts` are by motor and by sensor: the age from which on the newest measurement is too old. The brain
    reacts at shares of it (`health`).

    Raises ValueError if the body has a joint that is no motor, or if motors, sensors and timeouts do not
    match one to one, with timeouts above 0."""

    def __init__(
        self,
        settings: BrainSettings,
        motors: Sequence[str],
        sensors: Mapping[str, Mount],
        timeouts: Mapping[str, Nanos],
    ) -> None:
        _check((*motors, *sensors), timeouts)
        if unknown := [name for name in settings.body.joints if name not in motors]:
            raise ValueError(
                f"brain.{settings.body.kind} names joints that are no motors: {', '.join(unknown)}"
            )
        self.settings = settings
        self._file = settings
        self._motors = tuple(motors)
        self._able = settings.abilities(motors)
        self._status = StatusReporter()
        self._missions = Missions()
        found.load_all()
        self.base = (
            None if self._able.base is None else BaseLimb(self._able.base, sensors, timeouts, settings)
        )
        """What drives, for figures; None if nothing does"""
        self._limbs = _limbs(settings, motors, timeouts, self._status, self.base)
        self._of = {motor: name for name, limb in self._limbs.items() for motor in limb.motors}
        self._started: Nanos | None = None
        self._waiting_noted = False

    def step(
        self, now: Nanos, events: Sequence[Event], tasks: Sequence[BrainTask], stopped: str
    ) -> Sequence[Command]:
        """Perceive, allow, plan, command: return one command per motor, in the order of `motors`.

        `now` must not decrease. `events` are those received since the last step, in order; one stamped after
        `now` counts as measured now, so that it keeps no source from going stale. `stopped` is why the
        gateway has stopped the robot, or "": while it is set every command is Idle, and tasks are dropped."""
        return self.values(now, events, tasks, stopped).commands

    def values(
        self,
        now: Nanos,
        events: Sequence[Event],
        tasks: Sequence[BrainTask],
        stopped: str,
        given: StepValues = NOTHING,
    ) -> StepValues:
        """Do a step; return all that its systems have made. What is given is handed on in their place."""
        known = [event if event.t <= now else replace(event, t=now) for event in events]
        percepts = {
            name: limb.perceive(now, known, given.percepts.get(name)) for name, limb in self._limbs.items()
        }
        allowances = self._allow(now, percepts, tasks, stopped)
        plans = self._plan(now, percepts, allowances, tasks)
        allowed, wanted = {**allowances, **given.allowances}, {**plans, **given.plans}
        self._update_state(allowed, wanted)
        commands = {
            command.motor: command
            for name, limb in self._limbs.items()
            for command in limb.commands(percepts[name], allowed[name], wanted[name])
        }
        every = tuple(commands.get(motor) or msg.Idle(motor) for motor in self._motors)
        return StepValues(percepts, allowances, plans, every)

    def belief(self) -> Belief:
        """Return estimate, goal, path, map and state as a value."""
        mission = self._missions.view()
        state, reason = self._status.state, self._status.reason
        belief = Belief(state, reason, None, None, (), 0, None, {}, 0, mission=mission)
        for limb in self._limbs.values():
            belief = limb.believe(belief, mission)
        return belief

    @property
    def nis(self) -> Mapping[str, Nis]:
        """Normalised innovations squared, by sensor: is the estimate consistent? {} without a base."""
        return self.base.nis if self.base is not None else {}

    def take_notes(self) -> list[Note]:
        """Return the notes for the operator since the last call, in order."""
        own = [note for limb in self._limbs.values() for note in limb.take_notes()]
        return self._missions.take_notes() + own + self._status.take_notes()

    def numbers(self) -> Mapping[str, float]:
        """Return every number of the settings by its key, as it is now."""
        return dict(keys(self.settings))

    def set(self, key: str, value: float) -> str:
        """Change a setting at run time, e.g. "pursuit.lookahead_time"; return "" or why not."""
        settings, why_not = changed(self.settings, key, value, self._file)
        if not why_not:
            self.settings, self._able = settings, settings.abilities(self._motors)
            for limb in self._limbs.values():
                limb.adopt(settings)
        return why_not

    # -- may it move? -------------------------------------------------------------------------------

    def _allow(
        self, now: Nanos, percepts: Mapping[str, Percept], tasks: Sequence[BrainTask], stopped: str
    ) -> dict[str, Allowance]:
        """Return what each limb may do; none moves before all that it takes has reported."""
        by_hand = any(isinstance(task, msg.Drive) for task in tasks)
        own = {name: limb.allow(percepts[name], by_hand=by_hand) for name, limb in self._limbs.items()}
        missing = ", ".join(one.missing for name, one in own.items() if one.missing and self._is_vital(name))
        waiting = self._waiting(now, missing)
        return {name: replace(one, stopped=stopped, waiting=waiting) for name, one in own.items()}

    def _waiting(self, now: Nanos, missing: str) -> str:
        """Return what is missing before the first motion; "" once everything has reported."""
        if self._status.state is not BrainState.INITIALISING:
            return ""
        self._started = now if self._started is None else self._started
        if missing and not self._waiting_noted and now - self._started > WAITING_NOTE_AFTER:
            self._waiting_noted = True
            self._status.add_note("warning", f"still waiting for {missing}")
        return missing and f"waiting for {missing}"

    def _is_vital(self, name: str) -> bool:
        """Return whether the robot needs this limb while it is not used, too."""
        return name != BARE or self.base is None

    # -- tasks --------------------------------------------------------------------------------------

    def _plan(
        self,
        now: Nanos,
        percepts: Mapping[str, Percept],
        allowances: Mapping[str, Allowance],
        tasks: Sequence[BrainTask],
    ) -> dict[str, Plan]:
        """Take tasks, drop what is not allowed any more, do the mission's step; return each limb's plan."""
        for task in tasks:
            if reason := self._accept(now, task, allowances):
                self._status.add_note("warning", f"{type(task).__name__} refused: {reason}")
        for name, limb in self._limbs.items():
            if reason := self._why_paused(name, allowances[name]):
                self._halt(now, reason)
            limb.drop(now, allowances[name])
        if self._missions.running and not any(one.waiting for one in allowances.values()):
            self._do_mission(now, percepts, allowances)
        running = self._missions.running
        return {
            name: limb.plan(percepts[name], allowances[name], running=running)
            for name, limb in self._limbs.items()
        }

    def _accept(self, now: Nanos, task: BrainTask, allowances: Mapping[str, Allowance]) -> str:
        match task:
            case msg.Goal() | msg.Drive():
                return self._drive_to(now, task, allowances)
            case msg.Mission() | msg.Pause() | msg.Resume() | msg.Drop():
                return self._on_mission(now, task, allowances)
            case msg.Locate():
                return self._locate(now, task)
            case msg.Grid():
                return NO_BASE if self.base is None else self.base.take_map(task)
        name = self._of.get(task.motor)
        if name is None:
            hint = suggestion(task.motor, self._able.joints)
            known = ", ".join(self._able.joints) + (f"; {hint}" if hint else "")
            return f"there is no motor {task.motor!r}; there are {known}"
        limb = self._limbs[name]
        if self._missions.moves(task.motor):
            self._halt(now, f"an operator moves {task.motor}")
        if task.motor not in self._able.wheels:
            self._missions.forget()
        reason = limb.objection(now, task, allowances[name])
        if not reason:
            limb.accept(now, task)
        return reason

    def _drive_to(self, now: Nanos, task: msg.Goal | msg.Drive, allowances: Mapping[str, Allowance]) -> str:
        """Take a goal, or drive by hand; return why not, or ""."""
        if self.base is None:
            return NO_BASE
        reason = self.base.objection(now, task, allowances[BASE])
        if not reason and isinstance(task, msg.Goal) and self._missions.running:
            reason = "a mission is running: pause it, or drop it"
        if not reason and isinstance(task, msg.Drive) and self.base.may_be_led and self._missions.paused:
            reason = "the mission is paused: resume it, or drop it"  # who leads goes on sending twists
        if not reason:
            if not (isinstance(task, msg.Drive) and self.base.is_led):
                self._missions.forget()
                self._halt(now, "manual driving")
            self.base.accept(now, task)
        return reason

    def _locate(self, now: Nanos, task: msg.Locate) -> str:
        """Take where the base is; return why not, or "". A mission measures by the pose: it is paused."""
        reason = NO_BASE if self.base is None else self.base.locate(now, task)
        if not reason:
            self._halt(now, "the robot was told where it is")
        return reason

    # -- missions -----------------------------------------------------------------------------------

    def _on_mission(self, now: Nanos, task: MissionTask, allowances: Mapping[str, Allowance]) -> str:
        """Begin, pause, resume or drop a mission; return why not, or ""."""
        missions, base, before = self._missions, self.base, self._missions.phase
        goes = isinstance(task, msg.Mission | msg.Resume)
        if goes and base is not None and base.busy and not missions.running:
            return "there are goals: drop them first"
        refusals = [one.refusal for name, one in allowances.items() if self._is_vital(name)]
        reason = missions.request(task, self._able, next(filter(None, refusals), ""))
        if base is not None and isinstance(task, msg.Drop) and (dropped := base.drop_goals(now)):
            reason = ""
            self._status.add_note("info", f"{dropped}: an operator sent drop")
        if base is not None and goes and not reason:
            base.forget()
        self._settle(now, before)
        return reason

    def _why_paused(self, name: str, allowance: Allowance) -> str:
        """Return why a mission cannot go on with this limb; "" if it can."""
        if self._is_vital(name):
            return allowance.refusal or ("" if allowance.waiting else "; ".join(allowance.lost.values()))
        used = [why for motor, why in allowance.lost.items() if self._missions.moves(motor)]
        return allowance.stopped or "; ".join(used)

    def _do_mission(
        self, now: Nanos, percepts: Mapping[str, Percept], allowances: Mapping[str, Allowance]
    ) -> None:
        """Let the mission do its step, and the limbs what it wants."""
        before, seen = self._missions.phase, Observed(now)
        for name, limb in self._limbs.items():
            seen = limb.see(seen, percepts[name], allowances[name])
        intent = self._missions.advance(seen)
        for limb in self._limbs.values():
            if why := limb.begin(now, intent):
                self._missions.halt(why)
        self._settle(now, before)

    def _halt(self, now: Nanos, reason: str) -> None:
        """Pause the mission, if it is running."""
        before = self._missions.phase
        self._missions.halt(reason)
        self._settle(now, before)

    def _settle(self, now: Nanos, before: MissionPhase) -> None:
        """End what a mission has begun that does not run any more."""
        if before is MissionPhase.RUNNING and self._missions.phase not in (
            MissionPhase.RUNNING,
            MissionPhase.DONE,
        ):
            for limb in self._limbs.values():
                limb.stand(now)

    # -- state --------------------------------------------------------------------------------------

    def _update_state(self, allowances: Mapping[str, Allowance], plans: Mapping[str, Plan]) -> None:
        vital = [(allowances[name], plans[name]) for name in self._limbs if self._is_vital(name)]
        stopped, waiting = vital[0][0].stopped, vital[0][0].waiting
        if waiting:
            self._status.wait(waiting if not stopped else f"{waiting}; stopped: {stopped}")
        elif stopped:
            self._status.enter(BrainState.STOPPED, stopped, "warning")
        else:
            self._status.enter(*self._state(vital))

    def _state(self, vital: Sequence[tuple[Allowance, Plan]]) -> tuple[BrainState, str]:
        """Return the state and its reason: the worst of what the limbs have."""
        mission = self._missions
        lost = [one.reason for one, _ in vital if one.level is HealthLevel.LOST]
        given_up = [plan.given_up for _, plan in vital if plan.given_up and not mission.active]
        failed = [f"mission {mission.name}: {mission.reason}"] if mission.phase is MissionPhase.FAILED else []
        for reason in (*lost, *given_up, *failed):
            return BrainState.STOPPED, reason
        for _, plan in vital:
            if plan.degraded:
                return BrainState.DEGRADED, plan.degraded
        if mission.running or any(plan.busy for _, plan in vital):
            return BrainState.RUNNING, next((plan.why for _, plan in vital if plan.why), "")
        if mission.phase is MissionPhase.PAUSED:
            return BrainState.READY, f"mission {mission.name} is paused: {mission.reason}"
        return BrainState.READY, ""


BASE, BARE = "the base", "bare joints"
"""Names of limbs within the brain: what drives, and the motors that are part of no other limb"""


def brain_of(
    settings: BrainSettings,
    motors: Sequence[str],
    sensors: Mapping[str, Mount],
    timeouts: Mapping[str, Nanos],
) -> Brain | OtherBrain:
    """Return who makes the commands of a robot: ours, or the one that the robot file names."""
    if settings.other is None:
        return Brain(settings, motors, sensors, timeouts)
    _check((*motors, *sensors), timeouts)
    return OtherBrain(settings.other, motors, tuple(sensors), timeouts, settings.health)


def _limbs(
    settings: BrainSettings,
    motors: Sequence[str],
    timeouts: Mapping[str, Nanos],
    status: StatusReporter,
    base: BaseLimb | None,
) -> dict[str, Limb]:
    """Return the limbs by name, the base first and the bare joints last."""
    found: dict[str, Limb] = {} if base is None else {BASE: base}
    for name, limb in limbs(settings.body).items():
        if (linkage := limb.body.as_linkage) is not None:
            found[name] = LinkedJoints(name, linkage, limb.at, timeouts, settings, status)
    used = {motor for limb in found.values() for motor in limb.motors}
    if bare := [motor for motor in motors if motor not in used]:
        found[BARE] = BareJoints(bare, timeouts, settings, status)
    return found


def _check(sources: Sequence[str], timeouts: Mapping[str, Nanos]) -> None:
    """Every source has one timeout, and every timeout one source."""
    wrong = [f"{name!r} is the name of two" for name in dict.fromkeys(sources) if sources.count(name) > 1]
    wrong += [f"{name!r} has no timeout" for name in dict.fromkeys(sources) if name not in timeouts]
    wrong += [f"there is no {name!r} to have a timeout" for name in timeouts if name not in sources]
    wrong += [f"the timeout of {name!r} must be more than 0" for name, t in timeouts.items() if t <= 0]
    if wrong:
        raise ValueError("; ".join(wrong))
