"""A brain of another distribution in place of ours: a controller, a learned policy. It makes every command.

Rules. It is asked at every step at which the robot may move: every source has reported and none is lost, and
nothing has stopped the robot. What was stopped begins anew, with a fresh copy. What it raises, or returns and
may not, and a source that is lost, is a failure: it is not asked again before the faults that this leaves in
the joints are cleared. Its commands pass joint and guard, as ours do. Its work cannot be bounded from
outside: a slow one is reported as every step is that takes long.
"""

from __future__ import annotations

import copy
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from importlib.metadata import EntryPoint
from itertools import islice
from typing import Any, Generic, NamedTuple, Protocol, TypeVar, get_args

from brain import doors
from brain.belief import Belief, BrainState, BrainTask
from brain.checks import not_finite
from brain.health import Health, HealthLevel, HealthSettings
from brain.perception.filter_inputs import Nis
from brain.status import Note, StatusReporter
from protocols.entry_points import offered
from protocols.messages import Command, Event, Feedback, Idle, Measurement, Nanos

GROUP = "motor_gateway.brains"
"""Entry points: the brain's name in the robot file = MODULE:NAME of a `BrainKind`."""
MOST_TEXT = 200
"""Characters of what it raises."""
S = TypeVar("S")


@dataclass(frozen=True, slots=True)
class Moment:
    """What is known at one step."""

    now: Nanos
    joints: Mapping[str, Feedback]
    """The newest of each quantity of each motor, at the joint's output shaft"""
    readings: Mapping[str, Measurement]
    """The newest of each sensor"""
    events: Sequence[Event]
    """All that came since the step before, in order"""
    tasks: Sequence[BrainTask]
    """What an operator asks for now, of the kinds that it takes"""


class Commander(Protocol):
    """Makes the commands. Plain data that `copy.deepcopy` and `pickle` can copy: no clock, thread or file,
    and randomness only from a seed."""

    def step(self, moment: Moment) -> Iterable[Command]:
        """Return one command per motor at most; a motor without one is Idle. A bounded amount of work."""


@dataclass(frozen=True, slots=True, kw_only=True)
class BrainKind(Generic[S]):
    """One kind of brain: what its entry point names."""

    name: str
    settings: type[S]
    """A frozen dataclass: its table in the robot file, [brain.NAME]; with bounds (`protocols.bounds`)"""
    make: Callable[[S, Sequence[str]], Commander]
    """Makes one for these motors, before the run; raises ValueError if it cannot be theirs. Copies of it are
    asked: what is large and never changed may be its own deep copy."""
    takes: tuple[type, ...] = ()
    """The tasks and commands of an operator that it takes; all others are refused."""


class Chosen(NamedTuple):
    """A brain of another distribution, with its settings."""

    kind: BrainKind[Any]
    settings: object
    maker: str
    """The distribution that it belongs to, with its version"""


class BrainFailed(Exception):
    """It has failed: which one, and what is wrong with it."""

    def __init__(self, name: str, cause: str) -> None:
        self.name, self.cause = name, cause
        super().__init__(f"{name}: {cause}")


def load(name: str) -> tuple[BrainKind[Any], str]:
    """Return the kind of brain of this name, and whose it is. Raises doors.NotFound or doors.Broken."""
    return doors.load(offered(GROUP), "brain", name, _mistake)


def _mistake(point: EntryPoint, found: object) -> str:
    if not isinstance(found, BrainKind):
        return f"{point.value} is not a brain.other_brain.BrainKind"
    return "" if found.name == point.name else f"it calls itself {found.name!r}"


class OtherBrain:
    """Stands where `brain.brain.Brain` does, and asks the other one."""

    nis: Mapping[str, Nis] = {}

    def __init__(
        self,
        chosen: Chosen,
        motors: Sequence[str],
        sensors: Sequence[str],
        timeouts: Mapping[str, Nanos],
        health: HealthSettings,
    ) -> None:
        self._chosen, self._motors, self._sensors = chosen, tuple(motors), tuple(sensors)
        self._health = Health(motors, sensors, timeouts, health)
        self._fresh: Commander = chosen.kind.make(chosen.settings, self._motors)
        self._commander: Commander | None = None
        """None: a fresh one is asked next"""
        self._joints = {motor: Feedback(motor, 0) for motor in motors}
        self._readings: dict[str, Measurement] = {}
        self._status = StatusReporter()

    def step(
        self, now: Nanos, events: Sequence[Event], tasks: Sequence[BrainTask], stopped: str
    ) -> Sequence[Command]:
        """Return one command per motor. Raises BrainFailed."""
        known = [event if event.t <= now else replace(event, t=now) for event in events]
        self._observe(known)
        taken = self._taken(tasks, stopped)
        waiting = self._health.missing() if self._status.state is BrainState.INITIALISING else ""
        if stopped or waiting:
            self._commander = None
            self._say_why(stopped, waiting)
            return [Idle(motor) for motor in self._motors]
        commands = self._ask(Moment(now, dict(self._joints), dict(self._readings), known, taken))
        moves = any(not isinstance(each, Idle) for each in commands.values())
        self._status.enter(BrainState.RUNNING if moves else BrainState.READY, "")
        return [commands.get(motor) or Idle(motor) for motor in self._motors]

    def _observe(self, events: Sequence[Event]) -> None:
        self._health.observe(events)
        for event in events:
            if isinstance(event, Measurement):
                self._readings[event.sensor] = event
            elif isinstance(event, Feedback) and event.motor in self._joints:
                given = {name: value for name in _QUANTITIES if (value := getattr(event, name)) is not None}
                self._joints[event.motor] = replace(self._joints[event.motor], t=event.t, **given)

    def _taken(self, tasks: Sequence[BrainTask], stopped: str) -> list[BrainTask]:
        """Return the tasks that it takes; note why the others are refused."""
        kind, taken = self._chosen.kind, list[BrainTask]()
        for task in tasks:
            takes = ", ".join(one.__name__ for one in kind.takes) or "nothing"
            why = f"stopped: {stopped}" if stopped else ""
            why = why if isinstance(task, kind.takes) else f"the brain {kind.name!r} takes {takes}"
            if why:
                self._status.add_note("warning", f"{type(task).__name__} refused: {why}")
            else:
                taken.append(task)
        return taken

    def _say_why(self, stopped: str, waiting: str) -> None:
        """Note why it is not asked."""
        if waiting:
            self._status.wait(f"waiting for {waiting}" + (f"; stopped: {stopped}" if stopped else ""))
        else:
            self._status.enter(BrainState.STOPPED, stopped, "warning")

    def _ask(self, moment: Moment) -> dict[str, Command]:
        """Return its commands by motor. Raises BrainFailed."""
        try:
            self._check_sources(moment.now)
            if self._commander is None:
                self._commander = copy.deepcopy(self._fresh)
            return self._checked(self._commander.step(moment))
        except (Exception, SystemExit) as error:
            self._commander = None
            cause = str(error) if isinstance(error, _UnfitError) else f"{type(error).__name__}: {error}"
            name = f"the brain {self._chosen.kind.name!r} of {self._chosen.maker} has failed"
            self._status.enter(BrainState.STOPPED, name, "error")
            raise BrainFailed(name, cause[:MOST_TEXT]) from error

    def _check_sources(self, now: Nanos) -> None:
        """Raise if it would go by what is not known any more."""
        for name in (*self._motors, *self._sensors):
            health = self._health.source(now, name)
            if health.level >= HealthLevel.HALT:
                raise _UnfitError(health.reason)

    def _checked(self, commands: Iterable[Command]) -> dict[str, Command]:
        """Return what it has returned by motor. Raises if that is no set of commands."""
        found: dict[str, Command] = {}
        for command in islice(commands, len(self._motors) + 1):
            if not isinstance(command, get_args(Command)):
                raise _UnfitError(f"it returned {type(command).__name__}, which is no command")
            if command.motor not in self._motors:
                raise _UnfitError(f"it commands {command.motor!r}; there are {', '.join(self._motors)}")
            if command.motor in found:
                raise _UnfitError(f"it gives {command.motor!r} two commands")
            if why := not_finite(command):
                raise _UnfitError(f"its {type(command).__name__} to {command.motor}: {why}")
            found[command.motor] = replace(command)  # it may change its own
        return found

    # -- for observers, as of ours -------------------------------------------------------------------

    def belief(self) -> Belief:
        """Return state and reason; it tells no estimate and no map."""
        return Belief(self._status.state, self._status.reason, None, None, (), 0, None, {}, 0)

    def take_notes(self) -> list[Note]:
        """Return the notes for the operator since the last call, in order."""
        return self._status.take_notes()

    def numbers(self) -> Mapping[str, float]:
        """Return none: its settings are its own."""
        return {}

    def set(self, key: str, value: float) -> str:  # noqa: ARG002 -- as of ours
        """Refuse to change a setting at run time."""
        return f"{key} is fixed at the start: change it in the robot file"


_QUANTITIES = ("position", "velocity", "torque", "current", "voltage", "temperature")


class _UnfitError(Exception):
    """What it has returned, or would have to go by, is not fit."""
