"""The path that is followed, and whether it is free: checked part by part, all over again each period.

Rules. Checked with the footprint alone, without the margin used for planning: so a wall that shifts by a cell
as it is seen better does not cost a path. Someone in motion where it is obstructed is waited for.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from math import hypot, inf

from brain.planning.costmap import NEAR, Costmap
from brain.planning.footprint import Footprint
from brain.planning.planner import FrontierPath, Path
from brain.planning.polyline import Point, Polyline
from brain.planning.snapshot import is_blocked
from brain.planning.stop_zone import Mover
from protocols.messages import Nanos

MAX_PATH_ERROR = 0.5
"""m off the path, from which on a new one is planned"""
CHECKED_PER_STEP = 4
"""Straight parts of the path, of 2 m at most, that a step checks"""
CHECKED_FIRST = 5.0
"""m ahead of the robot, which are checked first in each period, then the rest in turn"""
CROSSING_SPEED, CROSSING_NEAR = 0.15, 1.0
"""m/s of someone who is waited for, and m from the place where the path is obstructed"""


class PathWatch:
    """The path of one base. State is plain data."""

    def __init__(self) -> None:
        self.path: Path | FrontierPath | None = None
        self.version = 0
        """Of the path"""
        self.blocked = ""
        """Where the last path to this goal was obstructed."""
        self.crossing = ""
        """Where someone in motion obstructs the path"""
        self.crossing_until: Nanos = 0
        """Until when someone is taken to obstruct it"""
        self.line = Polyline(((0.0, 0.0),))
        """The path as a line"""
        self._along = self.checked = self._rest = 0.0
        """m along the line: the robot at the last check, up to where it was checked since, where to go on"""

    def use(self, path: Path | FrontierPath) -> None:
        """Follow another path."""
        self.line, self.checked, self._along, self._rest = Polyline(path.points), path.escape, 0.0, inf
        self.path = path
        self.version += 1

    def drop(self) -> None:
        """Follow none."""
        if self.path is not None:
            self.path = None
            self.version += 1
        self.crossing_until = 0

    def forget(self) -> None:
        """Forget where a path was obstructed: it did not lead to this goal."""
        self.blocked = ""

    def begin_check(self, here: Point) -> str:
        """Check all over again from where the robot is; return why it must be dropped, if it is far off."""
        assert self.path is not None
        self._along, off = self.line.project(here, self._along, self._along + CHECKED_FIRST)
        self._rest = self.checked if self._along < self.checked < self.line.length else inf
        self.checked = max(self._along, self.path.escape)
        return f"the robot is {off:.2f} m off it" if off > MAX_PATH_ERROR else ""

    def check(self, costmap: Costmap, footprint: Footprint, moving: Sequence[Mover], wait: Nanos) -> str:
        """Check the next parts; return why it must be dropped, if one is obstructed. `wait`: until when
        someone who crosses would be waited for; 0: not any more."""
        line = self.line
        for _ in range(CHECKED_PER_STEP):
            if self.checked >= line.length:
                break
            if self._along + CHECKED_FIRST <= self.checked < self._rest < inf:
                self.checked, self._rest = self._rest, inf
            end = line.straight(self.checked, 2.0)
            a, b = line.point(self.checked), line.point(end)
            if is_blocked(costmap, a, b, NEAR) or not footprint.fits_either_way(costmap, a, b):
                near = f"({b[0]:z.2f}, {b[1]:z.2f})"
                if wait and crosses(b, moving):
                    self.crossing, self.crossing_until = f"someone crosses the path near {near}", wait
                    self.checked = line.length
                    break
                self.blocked = f"it is blocked near {near}"
                self.checked = end
                return self.blocked
            self.checked = end
        return ""


def crosses(place: Point, moving: Iterable[Mover]) -> bool:
    """Return whether something moves near a place."""
    return any(
        hypot(one.vx, one.vy) > CROSSING_SPEED and hypot(one.x - place[0], one.y - place[1]) < CROSSING_NEAR
        for one in moving
    )
