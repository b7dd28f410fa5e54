"""`wait = 5`: stand still for a time [s]."""

from __future__ import annotations

from dataclasses import dataclass

from brain import reading
from brain.bodies.limbs import Abilities
from brain.skills.skill import STAND, Done, Observed, Result, Skill, Words, too_long
from protocols.messages import SECOND, Nanos, Wait


@dataclass(slots=True)
class _Waiting:
    left: Nanos
    at: Nanos | None = None

    def advance(self, seen: Observed) -> Result:
        if self.at is not None:
            self.left -= seen.now - self.at
        self.at = seen.now
        return STAND if self.left > 0 else Done()

    def halt(self) -> None:
        self.at = None


def _parse(texts: list[str], _: Abilities) -> Wait:
    words = reading.joined(texts)
    if len(words) != 1:
        raise reading.InvalidError("one time is needed")
    return Wait(reading.quantity_of(words[0], ("s",)))


skill = Skill(
    name="wait",
    step=Wait,
    own=reading.number,
    make=lambda given: Wait(given["wait"]),
    words=Words("SECONDS", "stand still", _parse),
    wrong=lambda step, _: too_long(step.seconds),
    text=lambda step: f"wait {step.seconds:g} s",
    perform=lambda step: _Waiting(round(step.seconds * SECOND)),
)
