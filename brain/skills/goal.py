"""`goto = [x, y]`: plan a path to a place on the map [m], and drive it.

An operator's goals are no mission's: the navigator has them.
"""

from __future__ import annotations

from dataclasses import dataclass
from math import degrees

from brain import reading
from brain.skills.skill import Done, Failed, Intent, Observed, Result, Skill, too_far
from protocols.messages import Goal


@dataclass(slots=True)
class Going:
    """Drives to a goal."""

    goal: Goal
    before: int | None = None
    """How many goals had ended when this one was given"""

    def advance(self, seen: Observed) -> Result:
        """Give the goal, then wait for its end."""
        if self.before is None:
            self.before = seen.goals.number
            return Intent(goal=self.goal)
        if seen.goals.number == self.before:
            return Intent(keep=True)
        return Failed(seen.goals.why) if seen.goals.why else Done(f"at {_place(seen)}")

    def turn_to(self, goal: Goal) -> Intent:
        """Go to another goal, without a stop on the way."""
        self.goal = goal
        return Intent(goal=goal, passing=True)

    def halt(self) -> None:
        """Plan anew after a pause."""
        self.before = None


def _place(seen: Observed) -> str:
    return "an unknown place" if seen.pose is None else f"({seen.pose.x:z.2f}, {seen.pose.y:z.2f})"


def _make(given: reading.Given) -> Goal:
    x, y = given["goto"]
    return Goal(x, y, given.get("yaw_deg"), given.get("near", False))


def _text(goal: Goal) -> str:
    turned = "" if goal.yaw is None else f", {degrees(goal.yaw):.0f}°"
    return f"go {'near' if goal.near else 'to'} ({goal.x:g}, {goal.y:g}{turned})"


skill = Skill(
    name="goto",
    step=Goal,
    own=reading.several(2),
    keys={"yaw_deg": reading.degrees, "near": reading.flag},
    make=_make,
    needs_base=True,
    wrong=lambda goal, _: too_far((goal.x, goal.y)),
    text=_text,
    perform=Going,
)
