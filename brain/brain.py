"""The brain: `step(now, events, tasks, stopped)` returns one command per motor.

Rules. It knows no vendor and no bus. What is specific to a body is in `base_brain` and `joint_brain`. Time is
an argument, work is bounded, state is plain data: a deep copy continues exactly as the original, and equal
inputs give equal commands.

    timeouts = {"left": 100 * MILLISECOND, "right": 100 * MILLISECOND, "lidar": 500 * MILLISECOND}
    brain = Brain(settings, ["left", "right"], {"lidar": Mount(x=0.12)}, timeouts)
    commands = brain.step(now, events, [Goal(4.0, 2.0)], "")
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

from brain.base_brain import BaseBrain
from brain.belief import Belief, BrainTask
from brain.bodies.body import Base
from brain.health import HealthSettings
from brain.joint_brain import JointBrain
from brain.perception.filter_inputs import Nis
from brain.perception.mount import Mount
from brain.settings import BrainSettings, changed
from brain.status import Note
from protocols.messages import Command, Event, Nanos

__all__ = ["Brain", "BrainSettings", "HealthSettings"]


class Brain:
    """One brain for one body.

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
        self.settings = settings
        self._file = settings
        self._body = _body(settings, motors, sensors, timeouts)

    def step(
        self, now: Nanos, events: Sequence[Event], tasks: Sequence[BrainTask], stopped: str
    ) -> Sequence[Command]:
        """Perceive, plan, control: return one command per motor, in the order of `motors`.

        `now` must not decrease. `events` are those received since the last step, in order; one stamped after
        `now` counts as measured now, so that it keeps no source from going stale. `stopped` is why the
        gateway has stopped the robot, or "": while it is set every command is Idle, and tasks are dropped."""
        known = [event if event.t <= now else replace(event, t=now) for event in events]
        return self._body.step(now, known, tasks, stopped)

    def belief(self) -> Belief:
        """Return estimate, goal, path, map and state as a value."""
        return self._body.belief()

    @property
    def nis(self) -> Mapping[str, Nis]:
        """Normalised innovations squared, by sensor: is the estimate consistent? {} without a base."""
        return self._body.perception.nis if isinstance(self._body, BaseBrain) else {}

    def take_notes(self) -> list[Note]:
        """Return the notes for the operator since the last call, in order."""
        return self._body.take_notes()

    def set(self, key: str, value: float) -> str:
        """Change a setting at run time, e.g. "pursuit.lookahead_time"; return "" or why not."""
        settings, why_not = changed(self.settings, key, value, self._file)
        if not why_not:
            self.settings = settings
            self._body.adopt(settings)
        return why_not


def _check(sources: Sequence[str], timeouts: Mapping[str, Nanos]) -> None:
    """Every source has one timeout, and every timeout one source."""
    wrong = [f"{name!r} is the name of two" for name in dict.fromkeys(sources) if sources.count(name) > 1]
    wrong += [f"{name!r} has no timeout" for name in dict.fromkeys(sources) if name not in timeouts]
    wrong += [f"there is no {name!r} to have a timeout" for name in timeouts if name not in sources]
    wrong += [f"the timeout of {name!r} must be more than 0" for name, t in timeouts.items() if t <= 0]
    if wrong:
        raise ValueError("; ".join(wrong))


def _body(
    settings: BrainSettings,
    motors: Sequence[str],
    sensors: Mapping[str, Mount],
    timeouts: Mapping[str, Nanos],
) -> BaseBrain | JointBrain:
    body = settings.body
    if unknown := [name for name in body.joints if name not in motors]:
        raise ValueError(f"brain.{body.kind} names joints that are no motors: {', '.join(unknown)}")
    if isinstance(body, Base):
        return BaseBrain(settings, body, motors, sensors, timeouts)
    return JointBrain(settings, motors, timeouts)
