"""`follow = [[x, y], …]`: drive along points on the map [m], past each but the last; planned as goals are."""

from __future__ import annotations

from dataclasses import dataclass
from math import hypot

from brain import reading
from brain.bodies.limbs import Abilities
from brain.skills.goal import Going
from brain.skills.skill import STAND, Done, Failed, Observed, Result, Skill, Words, too_far
from protocols.messages import Follow, Goal

PASS = 0.3
"""m from a point at which the base goes on to the next without stopping"""


@dataclass(slots=True)
class _Following:
    step: Follow
    at: int = 0
    going: Going | None = None

    def advance(self, seen: Observed) -> Result:
        points = self.step.points
        last = self.at == len(points) - 1
        x, y = points[self.at]
        if self.going is None:
            self.going = Going(Goal(x, y))
        elif not last and seen.pose is not None and hypot(seen.pose.x - x, seen.pose.y - y) < PASS:
            self.at += 1
            return self.going.turn_to(Goal(*points[self.at]))
        result = self.going.advance(seen)
        if isinstance(result, Failed):
            return Failed(f"point {self.at + 1} of {len(points)}: {result.reason}")
        if isinstance(result, Done) and not last:
            self.at, self.going = self.at + 1, None
            return STAND
        return result

    def halt(self) -> None:
        self.going = None


def _points(value: object) -> tuple[tuple[float, ...], ...]:
    if not isinstance(value, list) or not value:
        raise reading.InvalidError("points: [[x, y], …]")
    return tuple(reading.several(2)(each) for each in value)


def _parse(words: list[str], _: Abilities) -> Follow:
    numbers = [reading.number_of(word) for word in words]
    if not numbers or len(numbers) % 2:
        raise reading.InvalidError("points have two numbers each")
    return Follow(tuple(zip(numbers[::2], numbers[1::2], strict=True)))


def _text(step: Follow) -> str:
    x, y = step.points[-1]
    return f"follow {len(step.points)} points to ({x:g}, {y:g})"


skill = Skill(
    name="follow",
    step=Follow,
    own=_points,
    make=lambda given: Follow(given["follow"]),
    words=Words("X,Y X,Y …", "drive along points on the map [m]", _parse),
    needs_base=True,
    wrong=lambda step, _: too_far(*step.points) if step.points else "there are no points to follow",
    text=_text,
    perform=_Following,
)
