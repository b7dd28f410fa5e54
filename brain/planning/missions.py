"""The mission: its steps one after the other, what became of each, and pausing, resuming and dropping it.

Rules. There is one mission at a time. What happens to it is one table, `PHASES`. It survives a stop, a lost
source and manual driving: it is paused, and only an operator resumes it, at the step it was at; what that
step has done already stays done (a distance, an angle, a time). A step that fails ends the innermost Try,
whose other steps follow; outside of every Try it ends the mission. At most one step begins or ends at each
step of the brain, and a failure is followed by a second of standing, so no mission can keep the brain busy.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from enum import StrEnum
from typing import TypeAlias

from brain.belief import MissionView
from brain.bodies.body import Base
from brain.checks import MOST, objection
from brain.planning.mission_steps import STAND, Done, Failed, Performer, Seen, Want, perform, text
from brain.status import Note, NoteLevel
from protocols import messages as msg
from protocols.messages import SECOND, Command, Goal, Mission, Nanos, Step

MissionTask: TypeAlias = Mission | msg.Pause | msg.Resume | msg.Drop
MAX_STEPS, MAX_DEPTH = 500, 6
"""Of a mission: all its steps, and Repeat and Try within each other"""
FARTHEST = 10_000.0
"""m: largest coordinate and distance"""
LONGEST = 86_400.0
"""s"""
AFTER_FAILURE: Nanos = SECOND
"""Standing still before what follows a failed step"""


class Phase(StrEnum):
    """The state of the mission."""

    NONE = "none"
    RUNNING = "running"
    PAUSED = "paused"
    DONE = "done"
    FAILED = "failed"
    DROPPED = "dropped"


class Cause(StrEnum):
    """What changes it."""

    START = "start"
    HALT = "halt"
    """An operator's pause, a stop, a lost source, manual driving"""
    RESUME = "resume"
    DROP = "drop"
    END = "end"
    """Its last step is done."""
    FAIL = "fail"
    """A step has failed, and no Try is about it."""


PHASES: dict[tuple[Phase, Cause], Phase] = {
    (Phase.RUNNING, Cause.HALT): Phase.PAUSED,
    (Phase.RUNNING, Cause.DROP): Phase.DROPPED,
    (Phase.RUNNING, Cause.END): Phase.DONE,
    (Phase.RUNNING, Cause.FAIL): Phase.FAILED,
    (Phase.PAUSED, Cause.RESUME): Phase.RUNNING,
    (Phase.PAUSED, Cause.DROP): Phase.DROPPED,
    (Phase.FAILED, Cause.DROP): Phase.DROPPED,
    **{
        (phase, Cause.START): Phase.RUNNING for phase in (Phase.NONE, Phase.DONE, Phase.FAILED, Phase.DROPPED)
    },
}
"""All there is: any other cause changes nothing."""


@dataclass(slots=True)
class _Frame:
    """Steps being done: those of the mission, or of a Repeat or Try in it."""

    steps: tuple[Step, ...]
    times: int = 1
    """How often they are done; 0: without an end"""
    otherwise: tuple[Step, ...] | None = None
    """What follows if one fails; None: it fails what is about it"""
    at: int = 0
    round: int = 1


class Missions:
    """The mission of one brain. State is plain data."""

    def __init__(self) -> None:
        self.phase = Phase.NONE
        self.reason = ""
        """Why it is in this phase; "" if that needs none."""
        self.mission: Mission | None = None
        self.notes: list[Note] = []
        self._frames: list[_Frame] = []
        self._performer: Performer | None = None
        self._not_before: Nanos = 0

    @property
    def name(self) -> str:
        """The name of the mission; "" before the first."""
        return self.mission.name if self.mission else ""

    @property
    def active(self) -> bool:
        """True if it is running or paused."""
        return self.phase in (Phase.RUNNING, Phase.PAUSED)

    def request(self, task: MissionTask, base: Base | None, joints: Sequence[str], may_not_move: str) -> str:
        """Carry out what an operator asks; return why not, or ""."""
        match task:
            case Mission():
                if self.active:
                    return f"{self._why_not('done')}: drop it first"
                if reason := may_not_move or why_not(task, base, joints):
                    return reason
                self._happens(Cause.START, "")
                self.mission, self._frames, self._performer = task, [_Frame(task.steps)], None
                self._not_before = 0
                self._note("info", f"begins: {len(task.steps)} step{'s' * (len(task.steps) > 1)}")
                return ""
            case msg.Pause():
                running = self.phase is Phase.RUNNING
                self.halt("an operator sent pause")
                return "" if running else self._why_not("running")
            case msg.Resume():
                return may_not_move if self.active and may_not_move else self.resume()
            case msg.Drop():
                return self.drop("an operator sent drop")

    def moves(self, motor: str) -> bool:
        """Whether the present step gives this joint its target."""
        frame = self._frames[-1] if self._frames else None
        step = frame.steps[frame.at] if frame and frame.at < len(frame.steps) else None
        here = isinstance(step, msg.Reach) and any(target.motor == motor for target in step.targets)
        return self.phase is Phase.RUNNING and here

    def halt(self, reason: str) -> None:
        """Pause it, if it is running."""
        if self._happens(Cause.HALT, reason):
            if self._performer is not None:
                self._performer.halt()
            self._note("warning", f"paused at {self._where()}: {reason}; resume it, or drop it")

    def resume(self) -> str:
        """Go on; return why not, or ""."""
        if not self._happens(Cause.RESUME, ""):
            return self._why_not("paused")
        self._note("info", f"goes on at {self._where()}")
        return ""

    def drop(self, reason: str) -> str:
        """Forget it; return why not, or ""."""
        if not self._happens(Cause.DROP, reason):
            return self._why_not("to be dropped")
        if self._frames:
            self._note("info", f"dropped at {self._where()}")
        self._frames, self._performer = [], None
        return ""

    def forget(self) -> None:
        """Take a failure as known: something else is to be done."""
        if self.phase is Phase.FAILED:
            self.drop("")

    def advance(self, seen: Seen) -> Want:
        """Return what the mission asks for now: of the present step, which ends or fails here."""
        if self.phase is not Phase.RUNNING or seen.now < self._not_before:
            return STAND
        if self._performer is None:
            step = self._open()
            if step is None:
                return STAND
            self._performer = perform(step)
            self._note("info", f"{self._where()}: {text(step)}")
        result = self._performer.advance(seen)
        if isinstance(result, Want):
            return result
        self._performer = None
        if isinstance(result, Done):
            self._note("info", f"{self._where()}: done{f': {result.text}' * bool(result.text)}")
            self._frames[-1].at += 1
            self._open()
        else:
            self._fail(seen.now, result)
        return STAND

    def view(self) -> MissionView | None:
        """Return name, state and progress for observers; None before the first mission."""
        if self.mission is None:
            return None
        count = len(self.mission.steps)
        if not self._frames:
            return MissionView(self.mission.name, self.phase.value, "", "", count, self.reason)
        at, frame = ".".join(str(one.at + 1) for one in self._frames), self._frames[-1]
        now = text(frame.steps[frame.at]) if frame.at < len(frame.steps) else ""
        return MissionView(self.mission.name, self.phase.value, at, now, count, self.reason)

    # -- private ------------------------------------------------------------------------------

    def _happens(self, cause: Cause, reason: str) -> bool:
        """Change the phase, if this cause does; return whether it does."""
        after = PHASES.get((self.phase, cause))
        if after is None:
            return False
        self.phase, self.reason = after, reason
        return True

    def _why_not(self, wanted: str) -> str:
        if self.mission is None:
            return "there is no mission"
        return f"mission {self.mission.name!r} is {self.phase}, not {wanted}"

    def _open(self) -> Step | None:
        """Go to the next single step and return it; None at the end of the mission, which then is done."""
        while self._frames:
            frame = self._frames[-1]
            if frame.at < len(frame.steps):
                step = frame.steps[frame.at]
                match step:
                    case msg.Repeat(times, steps):
                        self._frames.append(_Frame(steps, times))
                    case msg.Try(steps, otherwise):
                        self._frames.append(_Frame(steps, otherwise=otherwise))
                    case _:
                        return step
            elif frame.round != frame.times:
                frame.at, frame.round = 0, frame.round + 1
            else:
                self._leave()
        if self._happens(Cause.END, ""):
            self._note("info", "done")
        return None

    def _leave(self) -> None:
        self._frames.pop()
        if self._frames:
            self._frames[-1].at += 1

    def _fail(self, now: Nanos, failed: Failed) -> None:
        where = self._where()
        self._not_before = now + AFTER_FAILURE
        while self._frames:
            frame = self._frames[-1]
            if frame.otherwise:
                self._note("warning", f"{where} failed: {failed.reason}; what is to be done then follows")
                self._frames[-1] = _Frame(frame.otherwise)
                return
            if frame.otherwise is not None:
                self._note("warning", f"{where} failed: {failed.reason}; it is skipped")
                self._leave()
                self._open()
                return
            self._frames.pop()
        self._happens(Cause.FAIL, f"{where} failed: {failed.reason}")
        self._note("error", f"failed at {where}: {failed.reason}")

    def _where(self) -> str:
        """Return the present step as a person counts it: "step 3 of 5", "step 4.1 of 5, round 2 of 3"."""
        if not self._frames:
            return "its end"
        at = ".".join(str(frame.at + 1) for frame in self._frames)
        rounds = [frame for frame in self._frames if frame.times != 1]
        words = f"step {at} of {len(self._frames[0].steps)}"
        if rounds:
            words += f", round {rounds[-1].round}{f' of {rounds[-1].times}' if rounds[-1].times else ''}"
        return words

    def _note(self, level: NoteLevel, words: str) -> None:
        assert self.mission is not None
        self.notes.append((level, f"mission {self.mission.name}: {words}"))


# -- what is no mission of this robot ----------------------------------------------------------


def why_not(mission: Mission, base: Base | None, joints: Sequence[str]) -> str:
    """Return why a body cannot do a mission, for its first step that is wrong; "" if it can.

    `joints` are the motors that take targets: bare ones, and those that a base carries."""
    todo: list[tuple[str, tuple[Step, ...]]] = [("", mission.steps)]
    count = 0
    while todo:
        prefix, steps = todo.pop()
        count += len(steps)
        if count > MAX_STEPS:
            return f"it has more than {MAX_STEPS} steps"
        if not steps:
            return f"step {prefix[:-1]} has no steps" if prefix else "it has no steps"
        if prefix.count(".") > MAX_DEPTH:
            return f"step {prefix[:-1]} is nested more than {MAX_DEPTH} deep"
        for number, step in enumerate(steps, 1):
            at = f"{prefix}{number}"
            if wrong := _wrong(step, base, joints):
                return f"step {at}: {wrong}"
            if isinstance(step, msg.Repeat | msg.Try):
                todo.append((f"{at}.", step.steps))
            if isinstance(step, msg.Try) and step.otherwise:
                todo.append((f"{at}.", step.otherwise))
    return ""


def _wrong(step: Step, base: Base | None, joints: Sequence[str]) -> str:
    """Return what is wrong with a single step."""
    if base is not None and isinstance(step, msg.MoveTool):
        return "there is no arm to bring the tool there"
    if base is None and isinstance(step, Goal | msg.Move | msg.Turn | msg.Follow | msg.Dock):
        return f"{kind_of(step)}: there is no base to drive"
    if wrong := objection(step):
        return wrong
    match step:
        case Goal(x, y):
            return _far(((x, y),))
        case msg.Follow(points):
            return _far(points) if points else "there are no points to follow"
        case msg.Move():
            assert base is not None
            return _wrong_move(step, base)
        case msg.Turn(angle):
            return "" if abs(angle) <= 1000.0 else "an angle beyond 1000 rad"
        case msg.Wait(span):
            return "" if 0.0 <= span <= LONGEST else f"its time must be from 0 to {LONGEST:g} s, not {span:g}"
        case msg.Dock(_, distance, lateral):
            near = 0.0 < distance <= 5.0 and abs(lateral) <= 5.0
            return "" if near else "its place must be within 5 m of the marker, and before it"
        case msg.MoveTool(attitude=attitude) if not all(abs(angle) <= 1000.0 for angle in attitude or ()):
            return "an angle beyond 1000 rad"
        case msg.MoveTool(seconds=span):
            return "" if 0.0 <= span <= LONGEST else f"its time must be from 0 to {LONGEST:g} s, not {span:g}"
        case msg.Reach(targets, span):
            return _wrong_reach(targets, span, joints)
        case msg.Repeat(times):
            return "" if 0 <= times <= MOST else f"it cannot be repeated {times} times"
    return ""


def _far(points: Sequence[tuple[float, float]]) -> str:
    far = next((point for point in points if not all(abs(part) <= FARTHEST for part in point)), None)
    return "" if far is None else f"({far[0]:g}, {far[1]:g}) is beyond {FARTHEST:g} m"


def _wrong_move(move: msg.Move, base: Base) -> str:
    if move.seconds is None and move.distance is None:
        return "a motion needs a time or a distance"
    if move.distance is not None and not (move.linear or move.lateral):
        return "a distance needs a speed"
    if not (move.linear or move.lateral or move.angular):
        return "a motion needs a speed; to stand, wait"
    if move.lateral and not base.moves_sideways:
        return "this base does not move sideways"
    if move.angular and base.turning_radius and abs(move.linear) < base.turning_radius * abs(move.angular):
        return f"this base turns with a radius of {base.turning_radius:g} m at least"
    able = (base.max_linear, base.max_lateral or base.max_linear, base.max_angular)
    asked = (("linear", move.linear), ("lateral", move.lateral), ("angular", move.angular))
    for (name, value), most in zip(asked, able, strict=True):
        if abs(value) > most + 1e-9:
            return f"its {name} speed, {value:g}, is beyond this base's {most:g}"
    if not 0.0 <= (move.seconds or 0.0) <= LONGEST or not 0.0 <= (move.distance or 0.0) <= FARTHEST:
        return f"its time must be from 0 to {LONGEST:g} s, and its distance from 0 to {FARTHEST:g} m"
    return ""


def _wrong_reach(targets: Sequence[Command], span: float, joints: Sequence[str]) -> str:
    if not targets:
        return "there are no targets"
    if not 0.0 <= span <= LONGEST:
        return f"its time must be from 0 to {LONGEST:g} s, not {span:g}"
    names = [target.motor for target in targets]
    if len(set(names)) < len(names):
        return "a joint has two targets"
    for target in targets:
        if target.motor not in joints:
            there = f"there are {', '.join(joints)}" if joints else "there are none"
            return f"{target.motor!r} is no joint that takes a target; {there}"
        if wrong := objection(target):
            return f"{target.motor}: {wrong}"
    return ""


def kind_of(step: Step) -> str:
    """Return the name of a kind of step, as mission files have it."""
    return {"Goal": "goto", "Reach": "joints", "MoveTool": "tool"}.get(
        type(step).__name__, type(step).__name__.lower()
    )
