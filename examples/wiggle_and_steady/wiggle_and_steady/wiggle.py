"""`wiggle = 20`: turn to the left and to the right by an angle [degrees], several times."""

from __future__ import annotations

from dataclasses import dataclass
from math import degrees

from brain import reading
from brain.bodies.limbs import Abilities
from brain.skills.skill import STAND, Done, Observed, Result, Skill, Words
from brain.skills.turn import Turning
from protocols.messages import Turn


@dataclass(frozen=True, slots=True)
class Wiggle:
    """What a mission says, and a recording keeps: numbers, texts, truth values, None, tuples of these."""

    angle: float
    """rad, to each side"""
    times: int = 1


@dataclass(slots=True)
class Wiggling:
    """Does it. Plain data: a copy goes on as the original."""

    step: Wiggle
    done: int = 0
    """Turns that are done"""
    turning: Turning | None = None

    def advance(self, seen: Observed) -> Result:
        """Return what is wanted now, or the outcome. Called at every step, so it computes little."""
        if self.done == 2 * self.step.times + 1:
            return Done(f"{self.step.times} times")
        first_or_last = self.done in (0, 2 * self.step.times)
        way = (1.0 if self.done % 2 == 0 else -1.0) * (1.0 if first_or_last else 2.0)
        self.turning = self.turning or Turning(Turn(way * self.step.angle))
        result = self.turning.advance(seen)
        if not isinstance(result, Done):
            return result
        self.done, self.turning = self.done + 1, None
        return STAND

    def halt(self) -> None:
        """Be ready to go on after a pause."""
        if self.turning is not None:
            self.turning.halt()


def wrong(step: Wiggle, able: Abilities) -> str:
    """Return what is wrong with it for this robot."""
    if able.base is not None and able.base.turning_radius:
        return "this base does not turn on the spot"
    return "" if 0.0 < step.angle <= 3.0 and 1 <= step.times <= 100 else "up to 171°, and up to 100 times"


def parse(words: list[str], _: Abilities) -> Wiggle:
    """Make it of an operator's words."""
    if len(words) != 1:
        raise reading.InvalidError("one angle is needed")
    return Wiggle(reading.angle_of(words[0]))


skill = Skill(
    name="wiggle",
    step=Wiggle,
    own=reading.degrees,
    keys={"times": reading.whole},
    make=lambda given: Wiggle(given["wiggle"], given.get("times", 1)),
    words=Words("ANGLE", "turn to both sides [degrees]", parse),
    needs_base=True,
    wrong=wrong,
    text=lambda step: f"wiggle by {degrees(step.angle):.0f}°",
    perform=Wiggling,
)
