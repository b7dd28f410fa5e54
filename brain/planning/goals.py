"""The queue of a base's goals: which is driven to now, how many were reached or given up, and why."""

from __future__ import annotations

from protocols.messages import Goal


class Goals:
    """The goals, the present one first. State is plain data."""

    def __init__(self) -> None:
        self.waiting: list[Goal] = []
        self.reached = 0
        self.ended = 0
        """Number of goals that were reached or given up"""
        self.why = ""
        """Why the last of these was given up; "" if it was reached"""
        self.given_up = ""
        """Why the last goals were given up; "" after a new task."""

    @property
    def present(self) -> Goal | None:
        """The present goal."""
        return self.waiting[0] if self.waiting else None

    @property
    def name(self) -> str:
        """The present goal's in words."""
        return f"goal {self.ended + 1}"

    def forget(self) -> None:
        """Take goals that were given up as known: something else is to be done."""
        self.given_up = ""

    def add(self, goal: Goal) -> str:
        """Add a goal; return what that is in words."""
        self.waiting.append(goal)
        return f"goal {self.ended + len(self.waiting)} accepted: {text_of(goal)}"

    def take(self, goal: Goal) -> None:
        """Take a goal in place of all."""
        self.waiting = [goal]

    def drop(self) -> str:
        """Drop all; return what that is in words."""
        count, self.waiting = len(self.waiting), []
        return "nothing to drop" if not count else f"{count} goal{'s' if count > 1 else ''} dropped"

    def reach(self) -> str:
        """Note that the present goal is reached; return that in words."""
        self.reached, self.ended, self.why = self.reached + 1, self.ended + 1, ""
        return f"goal {self.ended} reached: {text_of(self.waiting.pop(0))}"

    def give_up(self, reason: str) -> str:
        """Give up the present goal, and go on with the next; return that in words."""
        self.waiting.pop(0)
        self.ended, self.why = self.ended + 1, reason
        left = len(self.waiting)
        self.given_up = "" if left else reason
        return f"{reason}; it is given up" + (f", {left} to go" if left else "")


def text_of(goal: Goal) -> str:
    """Return where a goal is."""
    yaw = "" if goal.yaw is None else f", yaw {goal.yaw:z.2f}"
    return f"({goal.x:z.2f}, {goal.y:z.2f}{yaw})"
