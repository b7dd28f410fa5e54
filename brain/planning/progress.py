"""Whether a base gets further: away from where it was, or along a path that has been free for some time."""

from __future__ import annotations

from math import hypot, inf

from brain.planning.polyline import Point
from protocols.messages import SECOND, Nanos

PROGRESS = 0.3
"""m that the robot must get away from where it was, within `patience`"""
FLOWING: Nanos = 2 * SECOND
"""Following a path for this long without an obstacle is progress, too."""


class GoalProgress:
    """The progress of one base. State is plain data."""

    def __init__(self) -> None:
        self._was: Point = (0.0, 0.0)
        """Where the robot was when it last got further"""
        self._at: Nanos = 0
        """When it last got further"""
        self._flowing_since: Nanos | None = None

    def begin(self, now: Nanos) -> None:
        """Begin with another goal."""
        self._was, self._at = (inf, inf), now

    def pause(self) -> None:
        """Do not count this time: the robot may not move now."""
        self._was = (inf, inf)

    def watch(self, now: Nanos, here: Point, *, follows: bool) -> None:
        """Note where the robot is, and whether it follows a path that is free."""
        since = self._flowing_since if self._flowing_since is not None else now
        self._flowing_since = since if follows else None
        flows = follows and now - since > FLOWING
        if flows or not hypot(here[0] - self._was[0], here[1] - self._was[1]) < PROGRESS:
            self._was, self._at = here, now

    def none_for(self, now: Nanos) -> Nanos:
        """Return for how long there has been none."""
        return now - self._at
