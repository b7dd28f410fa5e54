"""The way to a goal that no known path leads to: which frontier of known ground is worth going to.

Rules. A frontier that stays unknown when seen from near is excluded, so exploring ends. Unknown ground under
the robot counts as free, so about a frontier that is excluded there is always another within the robot's
radius: it must not creep from one to the next.
"""

from __future__ import annotations

from math import dist

from brain.planning.planner import FrontierPath, Path
from brain.planning.polyline import Point
from protocols.messages import SECOND, Nanos

FRONTIER_TOLERANCE = 0.2
"""m: a frontier this near is reached, and two frontiers this close are the same"""
FRONTIER_TIMEOUT: Nanos = SECOND
"""Time that a reached frontier may stay unknown before it is excluded."""


class Exploring:
    """The exploring of one base. State is plain data."""

    def __init__(self) -> None:
        self.excluded: tuple[Point, ...] = ()
        """Frontiers that stayed unknown."""
        self._there_since: Nanos | None = None
        """Since when the robot stands at the frontier that it went to."""
        self._looked_twice = False
        """Whether a search has ended at a frontier before the base moved: the next may know more"""

    def begin(self) -> None:
        """Begin with another goal."""
        self._looked_twice, self.excluded = False, ()

    def forget(self) -> None:
        """Exclude nothing."""
        self.excluded = ()

    def leave(self) -> None:
        """Note that the path to the frontier is dropped."""
        self._there_since = None

    def arrive(self, now: Nanos) -> None:
        """Note that the robot stands at the frontier."""
        self._there_since = now if self._there_since is None else self._there_since

    def looks_again(self) -> bool:
        """Return whether to search once more before the base moves."""
        again, self._looked_twice = not self._looked_twice, True
        return again

    def keeps(
        self, now: Nanos, here: Point, result: FrontierPath, old: Path | FrontierPath | None, radius: float
    ) -> bool:
        """True if the result leads to where the robot already is, or equals the path it is following."""
        same = isinstance(old, FrontierPath) and dist(old.beyond, result.beyond) < FRONTIER_TOLERANCE
        near = FRONTIER_TOLERANCE + (radius if self.excluded else 0.0)
        there = dist(result.points[-1], here) <= near or (same and self._there_since is not None)
        if not there:
            self._there_since = None
            return same
        if self._there_since is None:
            self._there_since = now
        elif now - self._there_since > FRONTIER_TIMEOUT:
            self.excluded = (*self.excluded, result.beyond)
            self._there_since = None
        return old is not None
