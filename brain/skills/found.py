"""Skills by name and by step: ours; and those of other distributions, whose steps the tick has as `Perform`.

Rules. A skill of ours that raises is a defect of ours. What another distribution's skill raises, or wants and
may not, is a failure of its step, in words; nothing of it gets any further. Its work cannot be bounded from
outside: a slow one is reported as every step is that takes long.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, fields, is_dataclass
from functools import cache
from importlib.metadata import EntryPoint
from math import isfinite
from typing import Any, TypeVar

from brain import doors
from brain.bodies.limbs import Abilities
from brain.checks import MOST, not_finite, objection
from brain.reading import InvalidError
from brain.skills.reach import wrong_target
from brain.skills.skill import Done, Failed, Intent, Observed, Performer, Result, Skill, too_far, too_long
from protocols.entry_points import Offered, is_ours, offered
from protocols.messages import STEPS, Perform, Step

GROUP = "motor_gateway.skills"
"""Entry points: the skill's key in a mission file = MODULE:NAME of a `brain.skills.skill.Skill`."""
RESERVED = ("repeat", "steps", "name", "on_failure")
"""Keys of a mission file with a meaning of their own."""
MOST_TEXT = 200
"""Characters of another distribution's text."""
MOST_VALUES, DEPTH = 64, 6
"""In one tuple of a step's values, and tuples within each other: what a recording takes."""
T = TypeVar("T")
_PLAIN = "is no finite number, text, truth value, None, or tuple of these"


@cache
def _offered() -> Offered:
    return offered(GROUP)


@cache
def ours() -> Mapping[type, Skill[Any]]:
    """Return the skills of this distribution by the type of their step, in the order of `STEPS`."""
    own = [load(point.name) for point in _offered().points if is_ours(point)]
    order = list(STEPS.values())
    return {one.step: one for one in sorted(own, key=lambda one: order.index(one.step))}


def others() -> list[str]:
    """Return the names of other distributions' skills; imports none."""
    own = [one.name for one in ours().values()]
    return [name for name in dict.fromkeys(point.name for point in _offered().points) if name not in own]


def names() -> list[str]:
    """Return the names of all skills, ours first."""
    return [*(one.name for one in ours().values()), *others()]


def load(name: str) -> Skill[Any]:
    """Return the skill of this name, and import no other. Raises doors.NotFound or doors.Broken."""
    found = _loaded(name)
    if isinstance(found, doors.Closed):
        raise found.with_traceback(None)
    skill: Skill[Any] = found.object
    return skill


def load_all() -> None:
    """Import all skills, before a run: then no step waits for one."""
    for name in names():
        _loaded(name)


@cache
def _loaded(name: str) -> doors.Loaded | doors.Closed:
    try:
        return doors.load(_offered(), "skill", name, _mistake)
    except doors.Closed as error:
        return error


def _mistake(point: EntryPoint, found: object) -> str:
    """Return what is wrong with what an entry point leads to."""
    if not isinstance(found, Skill):
        return f"{point.value} is not a brain.skills.skill.Skill"
    if found.name != point.name:
        return f"it calls itself {found.name!r}"
    if found.name in RESERVED:
        return f"{found.name!r} has a meaning of its own in a mission file"
    if found.step in STEPS.values() and not is_ours(point):
        return f"its step, {found.step.__name__}, is a skill's of ours; expected one of its own"
    return "" if is_dataclass(found.step) else f"its step, {found.step!r}, is no dataclass"


def read(skill: Skill[Any], call: Callable[..., T], *given: Any) -> T:  # noqa: ANN401 -- what the call takes
    """Call what reads or makes a skill's step. Raises InvalidError: what is given is wrong; doors.Broken: a
    skill of another distribution has failed."""
    try:
        return call(*given)
    except InvalidError:
        raise
    except Exception as error:
        if skill.step in ours():
            raise
        raise _failure(skill.name, error) from error


def crossing(skill: Skill[Any], made: Any) -> Step:  # noqa: ANN401 -- of the skill's own type
    """Return a step as the tick has it."""
    if skill.step in ours():
        step: Step = made
        return step
    values = tuple((one.name, getattr(made, one.name)) for one in fields(made))
    if not _is_plain(values):
        raise TypeError(f"{made!r} has what {_PLAIN}")
    return Perform(skill.name, values)


# -- what is asked of a skill --------------------------------------------------------------------


def wrong(step: Step, able: Abilities) -> str:
    """Return what is wrong with a step for a robot, "" if nothing is."""

    def ask(skill: Skill[Any], made: Any) -> str:  # noqa: ANN401 -- of the skill's own type
        if skill.needs_base and able.base is None:
            return f"{skill.called}: there is no base to drive"
        return objection(made) or _cut(skill.wrong(made, able))

    if isinstance(step, Perform) and not _is_plain(step.values):
        return f"its values have what {_PLAIN}"
    try:
        return _ask(step, ask)
    except doors.Closed as error:
        return str(error)


def text(step: Step) -> str:
    """Return a step in words."""
    try:
        return _ask(step, lambda skill, made: _cut(skill.text(made)))
    except doors.Closed:
        return f"do {step.skill}" if isinstance(step, Perform) else type(step).__name__


def motors(step: Step) -> tuple[str, ...]:
    """Return the joints to which a step gives targets."""
    try:
        return _ask(step, lambda skill, made: tuple(skill.motors(made)))
    except doors.Closed:
        return ()


def perform(step: Step, able: Abilities) -> Performer:
    """Return what does this step."""
    if isinstance(step, Perform):
        return _Guarded(step, able)
    performer: Performer = ours()[type(step)].perform(step)
    return performer


def _ask(step: Step, ask: Callable[[Skill[Any], Any], T]) -> T:
    """Ask the skill of a step. Raises doors.Closed: it is not there, or another distribution's has failed."""
    if not isinstance(step, Perform):
        return ask(ours()[type(step)], step)
    skill = load(step.skill)
    try:
        return ask(skill, skill.step(**dict(step.values)))
    except (Exception, SystemExit) as error:
        raise _failure(step.skill, error) from error


def _failure(name: str, error: BaseException) -> doors.Broken:
    found = _loaded(name)
    of = found.maker if isinstance(found, doors.Loaded) else "?"
    return doors.Broken(f"skill {name!r} of {of} has failed: {type(error).__name__}: {_cut(error)}")


def _cut(text: object) -> str:
    return str(text)[:MOST_TEXT]


def _is_plain(value: object, depth: int = DEPTH) -> bool:
    if isinstance(value, tuple):
        return len(value) <= MOST_VALUES and depth > 0 and all(_is_plain(one, depth - 1) for one in value)
    if isinstance(value, int):
        return abs(value) < 1 << 63
    return value is None or isinstance(value, str) or (isinstance(value, float) and isfinite(value))


@dataclass(slots=True)
class _Guarded:
    """Does a step of another distribution's skill, and lets nothing of its failures out."""

    step: Perform
    able: Abilities
    performer: Performer | None = None
    failed: str = ""

    def advance(self, seen: Observed) -> Result:
        if self.failed:
            return Failed(self.failed)
        try:
            if self.performer is None:
                self.performer = _ask(self.step, lambda skill, made: skill.perform(made))
            return self._fit(self.performer.advance(seen))
        except doors.Closed as error:
            return Failed(str(error))
        except (Exception, SystemExit) as error:  # noqa: BLE001 -- another's code may raise anything
            return Failed(str(_failure(self.step.skill, error)))

    def _fit(self, result: object) -> Result:
        match result:
            case Intent():
                strange = _strange(result, self.able)
                return Failed(f"{self.step.skill} wants what it may not: {strange}") if strange else result
            case Done(text):
                return Done(_cut(text))
            case Failed(reason):
                return Failed(_cut(reason) or "for no reason that it gives")
        raise TypeError(f"it returned {type(result).__name__}, not Intent, Done or Failed")

    def halt(self) -> None:
        try:
            if self.performer is not None:
                self.performer.halt()
        except (Exception, SystemExit) as error:  # noqa: BLE001 -- another's code may raise anything
            self.failed = str(_failure(self.step.skill, error))


def _strange(intent: Intent, able: Abilities) -> str:
    """Return what no step may want, "" if it may."""
    goal, twist, place = intent.goal, intent.twist, intent.place
    if goal is not None and (why := not_finite(goal) or objection(goal) or too_far((goal.x, goal.y))):
        return f"a goal: {why}"
    if twist is not None and not all(isfinite(part) for part in twist):
        return f"a twist that is not finite: {tuple(twist)}"
    for target in intent.targets:
        if why := not_finite(target) or wrong_target(target, able):
            return f"a target: {why}"
    if place is not None:
        numbers = (*place.at[:3], *(place.at.attitude or ()))
        why = able.which_arm(place.limb) or too_long(place.seconds)
        return why or ("" if all(abs(each) <= MOST for each in numbers) else "a place that is nowhere")
    return too_long(intent.seconds)
