"""The mission: its steps one after the other, what became of each, and pausing, resuming and dropping it.

Rules. There is one mission at a time. What happens to it is one table, `PHASES`. It survives a stop, a lost
source and manual driving: it is paused, and only an operator resumes it, at the step it was at; what that
step has done already stays done (a distance, an angle, a time). A step that fails ends the innermost Try,
whose other steps follow; outside of every Try it ends the mission. At most one step begins or ends at each
step of the brain, and a failure is followed by a second of standing, so no mission can keep the brain busy.
"""

from __future__ import annotations

from dataclasses import dataclass
from enum import StrEnum
from typing import TypeAlias

from brain.belief import MissionView
from brain.bodies.limbs import Abilities
from brain.checks import MOST
from brain.skills import found
from brain.skills.skill import STAND, Done, Failed, Intent, Observed, Performer
from brain.status import Note, NoteLevel
from protocols import messages as msg
from protocols.messages import SECOND, Mission, Nanos, Repeat, Step, Try

MissionTask: TypeAlias = Mission | msg.Pause | msg.Resume | msg.Drop
MAX_STEPS, MAX_DEPTH = 500, 6
"""Of a mission: all its steps, and Repeat and Try within each other"""
AFTER_FAILURE: Nanos = SECOND
"""Standing still before what follows a failed step"""


class MissionPhase(StrEnum):
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


PHASES: dict[tuple[MissionPhase, Cause], MissionPhase] = {
    (MissionPhase.RUNNING, Cause.HALT): MissionPhase.PAUSED,
    (MissionPhase.RUNNING, Cause.DROP): MissionPhase.DROPPED,
    (MissionPhase.RUNNING, Cause.END): MissionPhase.DONE,
    (MissionPhase.RUNNING, Cause.FAIL): MissionPhase.FAILED,
    (MissionPhase.PAUSED, Cause.RESUME): MissionPhase.RUNNING,
    (MissionPhase.PAUSED, Cause.DROP): MissionPhase.DROPPED,
    (MissionPhase.FAILED, Cause.DROP): MissionPhase.DROPPED,
    **{
        (phase, Cause.START): MissionPhase.RUNNING
        for phase in (MissionPhase.NONE, MissionPhase.DONE, MissionPhase.FAILED, MissionPhase.DROPPED)
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

    def advance(self) -> None:
        """Go to the next step."""
        self.at += 1

    def repeat(self) -> None:
        """Begin with the first step again."""
        self.at, self.round = 0, self.round + 1


class Missions:
    """The mission of one brain. State is plain data."""

    def __init__(self) -> None:
        self.phase = MissionPhase.NONE
        self.reason = ""
        """Why it is in this phase; "" if that needs none."""
        self.mission: Mission | None = None
        self.notes: list[Note] = []
        self._frames: list[_Frame] = []
        self._performer: Performer | None = None
        self._able = Abilities(None, {}, ())
        """What the robot could do when the mission began."""
        self._not_before: Nanos = 0

    @property
    def name(self) -> str:
        """The name of the mission; "" before the first."""
        return self.mission.name if self.mission else ""

    @property
    def running(self) -> bool:
        """True while it runs."""
        return self.phase is MissionPhase.RUNNING

    @property
    def paused(self) -> bool:
        """True if it waits for an operator."""
        return self.phase is MissionPhase.PAUSED

    @property
    def active(self) -> bool:
        """True if it is running or paused."""
        return self.phase in (MissionPhase.RUNNING, MissionPhase.PAUSED)

    def request(self, task: MissionTask, able: Abilities, may_not_move: str) -> str:
        """Carry out what an operator asks; return why not, or ""."""
        match task:
            case Mission():
                if self.active:
                    return f"{self._why_not('done')}: drop it first"
                if reason := may_not_move or why_not(task, able):
                    return reason
                self._happens(Cause.START, "")
                self.mission, self._frames, self._performer = task, [_Frame(task.steps)], None
                self._able, self._not_before = able, 0
                self._note("info", f"begins: {len(task.steps)} step{'s' * (len(task.steps) > 1)}")
                return ""
            case msg.Pause():
                running = self.phase is MissionPhase.RUNNING
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
        return self.phase is MissionPhase.RUNNING and step is not None and motor in found.motors(step)

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
        if self.phase is MissionPhase.FAILED:
            self.drop("")

    def advance(self, seen: Observed) -> Intent:
        """Return what the mission asks for now: of the present step, which ends or fails here."""
        if self.phase is not MissionPhase.RUNNING or seen.now < self._not_before:
            return STAND
        if self._performer is None:
            step = self._open()
            if step is None:
                return STAND
            self._performer = found.perform(step, self._able)
            self._note("info", f"{self._where()}: {text(step)}")
        result = self._performer.advance(seen)
        if isinstance(result, Intent):
            return result
        self._performer = None
        if isinstance(result, Done):
            self._note("info", f"{self._where()}: done{f': {result.text}' * bool(result.text)}")
            self._frames[-1].advance()
            self._open()
        else:
            self._fail(seen.now, result)
        return STAND

    def take_notes(self) -> list[Note]:
        """Return the notes for the operator since the last call."""
        notes, self.notes = self.notes, []
        return notes

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
                    case Repeat(times, steps):
                        self._frames.append(_Frame(steps, times))
                    case Try(steps, otherwise):
                        self._frames.append(_Frame(steps, otherwise=otherwise))
                    case _:
                        return step
            elif frame.round != frame.times:
                frame.repeat()
            else:
                self._leave()
        if self._happens(Cause.END, ""):
            self._note("info", "done")
        return None

    def _leave(self) -> None:
        self._frames.pop()
        if self._frames:
            self._frames[-1].advance()

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


def why_not(mission: Mission, able: Abilities) -> str:
    """Return why a robot cannot do a mission, for its first step that is wrong; "" if it can."""
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
            if wrong := _wrong(step, able):
                return f"step {at}: {wrong}"
            if isinstance(step, Repeat | Try):
                todo.append((f"{at}.", step.steps))
            if isinstance(step, Try) and step.otherwise:
                todo.append((f"{at}.", step.otherwise))
    return ""


def _wrong(step: Step, able: Abilities) -> str:
    """Return what is wrong with a step, but for those that it holds."""
    match step:
        case Try():
            return ""
        case Repeat(times):
            return "" if 0 <= times <= MOST else f"it cannot be repeated {times} times"
    return found.wrong(step, able)


def text(step: Step) -> str:
    """Return a step in words."""
    match step:
        case Repeat(times, steps):
            return f"repeat {len(steps)} steps {f'{times} times' if times else 'without an end'}"
        case Try(steps):
            return f"try {len(steps)} steps"
    return found.text(step)
