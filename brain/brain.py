"""The brain: `step(now, events, tasks, stopped)` gives one command per motor. It knows no vendor and no bus.

Rules. What a body needs of a brain stands in that body's file (`driving`, `bench`); here is what all share.
Time is an argument, work is bounded, state is plain data: a deep copy goes on as the original, and the
same inputs give the same commands.

    timeouts = {"left": 100 * MILLISECOND, "right": 100 * MILLISECOND, "lidar": 500 * MILLISECOND}
    brain = Brain(settings, ["left", "right"], {"lidar": Mount(x=0.12)}, timeouts)
    commands = brain.step(now, events, [Goal(4.0, 2.0)], "")
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from brain.belief import Belief
from brain.bench import JointBrain
from brain.driving import BaseBrain
from brain.health import HealthSettings
from brain.perception.mount import Mount
from brain.planning.mission import Note
from brain.settings import BrainSettings, changed
from protocols.messages import Command, Drive, Event, Goal, Nanos

__all__ = ["Brain", "BrainSettings", "HealthSettings"]


class Brain:
    """One brain for one body. `timeouts` are by motor and by sensor: from which age on its newest
    measurement is too old; the brain acts at shares of it (`health`).

    Raises ValueError if the settings lack the body's own table, or if not each motor and sensor has one
    timeout above 0 and nobody else has any."""

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
        self, now: Nanos, events: Sequence[Event], tasks: Sequence[Goal | Drive | Command], stopped: str
    ) -> Sequence[Command]:
        """Perceive, plan, control: one command per motor, in the order in which they were named.

        `now` must not go back. `events` are what was heard since the last step, in order; `stopped` is why
        the gateway has stopped the robot, or "": while it is there, every command is Idle, and
        what was asked for is dropped."""
        return self._body.step(now, events, tasks, stopped)

    def belief(self) -> Belief:
        """What is believed and wanted, as a value."""
        return self._body.belief()

    def take_notes(self) -> list[Note]:
        """(level, sentence) for the operator, in order, since this was last asked."""
        return self._body.take_notes()

    def set(self, key: str, value: float) -> str:
        """Change a number of the settings while running, e.g. "pursuit.lookahead_time"; "" or why not."""
        settings, why = changed(self.settings, key, value, self._file)
        if not why:
            self.settings = settings
            self._body.adopt(settings)
        return why


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
    if settings.body == "differential":
        if settings.differential is None:
            raise ValueError('the body "differential" needs its table, brain.differential')
        wheels = (settings.differential.left, settings.differential.right)
        if strange := [name for name in wheels if name not in motors]:
            raise ValueError(f"brain.differential names wheels that are no motors: {', '.join(strange)}")
        return BaseBrain(settings, settings.differential, motors, sensors, timeouts)
    return JointBrain(settings, motors, timeouts)
