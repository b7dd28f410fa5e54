"""`tool = [x, y, z]`: bring the tip of an arm to a place in the robot's frame [m]."""

from __future__ import annotations

from dataclasses import dataclass
from math import radians

from brain import reading
from brain.bodies.body import Placement
from brain.bodies.limbs import Abilities
from brain.skills.skill import (
    NONE_ENDED,
    STAND,
    Done,
    Failed,
    Intent,
    Observed,
    Result,
    Skill,
    ToolPlace,
    Words,
    too_long,
)
from protocols.messages import MoveTool


@dataclass(slots=True)
class _Placing:
    step: MoveTool
    before: int | None = None
    """How many places had ended when this one was given"""

    def advance(self, seen: Observed) -> Result:
        step = self.step
        ended = seen.places.get(step.limb) or next(iter(seen.places.values()), NONE_ENDED)
        if self.before is None:
            self.before = ended.number
            at = Placement(step.x, step.y, step.z, step.attitude)
            return Intent(place=ToolPlace(at, step.seconds, step.limb))
        if ended.number == self.before:
            return STAND
        return Failed(ended.why) if ended.why else Done()

    def halt(self) -> None:
        self.before = None


def _make(given: reading.Given) -> MoveTool:
    x, y, z = given["tool"]
    return MoveTool(x, y, z, given.get("attitude_deg"), given.get("seconds", 0.0), given.get("limb", ""))


def _parse(words: list[str], able: Abilities) -> MoveTool:
    limb, words = (words[0], words[1:]) if words and words[0] in able.arms else ("", words)
    numbers = [reading.number_of(word) for word in words]
    if len(numbers) not in (3, 6):
        raise reading.InvalidError("a place has three numbers, and an attitude three more")
    roll, pitch, yaw = map(radians, numbers[3:] or (0.0, 0.0, 0.0))
    attitude = (roll, pitch, yaw) if numbers[3:] else None
    return MoveTool(numbers[0], numbers[1], numbers[2], attitude, limb=limb)


def _wrong(step: MoveTool, able: Abilities) -> str:
    if unclear := able.which_arm(step.limb):
        return unclear
    if not all(abs(angle) <= 1000.0 for angle in step.attitude or ()):
        return "an angle beyond 1000 rad"
    return too_long(step.seconds)


def _text(step: MoveTool) -> str:
    tool = f"the tool of {step.limb}" if step.limb else "the tool"
    return f"bring {tool} to ({step.x:g}, {step.y:g}, {step.z:g})"


skill = Skill(
    name="tool",
    step=MoveTool,
    own=reading.several(3),
    keys={
        "attitude_deg": reading.several(3, reading.degrees),
        "seconds": reading.number,
        "limb": reading.name,
    },
    make=_make,
    words=Words("[ARM] X Y Z [ROLL PITCH YAW]", "arms: bring the tip to a place [m, degrees]", _parse),
    wrong=_wrong,
    text=_text,
    perform=_Placing,
)
