"""Lidars that turn clockwise: rays go in as they come; each time the rear is passed, a scan comes out.

Rules. A scan has as many beams as its lidar is stated to have, at the same angles in every turn, since what
compares two scans compares beams. A beam lies between two rays: it is interpolated between them if both are
readings of one surface, else it is the nearer one; what no ray is near to, since some were lost, is no
reading. A turn is cut behind the lidar, where it passes ±180°. The work is that of the ray, and of the beams
between it and the last one.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass, field
from math import floor, pi

from protocols.messages import SECOND, LaserScan, Nanos

NEIGHBOURS = 1.5
"""Steps from one ray to the next, beyond which there is a gap"""
SURFACE = 0.1
"""Share of the range by which two neighbouring rays on one surface may differ"""
BACK = 350.0
"""Degrees: a ray so far ahead is a little behind the last one"""


@dataclass(frozen=True, slots=True)
class Beams:
    """What the scans of a lidar are like."""

    sensor: str
    count: int
    nearest: float
    """m"""
    farthest: float
    """m"""


@dataclass(slots=True)
class Rays:
    """What is known of a lidar's present turn. Plain data."""

    ranges: list[float] = field(default_factory=list)
    """m, of its beams so far; 0.0: no reading"""
    at: float | None = None
    """Degrees from the rear, clockwise, of the last ray; None: nothing has come,"""
    range: float = 0.0
    """and its range."""
    beam: int = 1
    """The next beam that a ray comes to, counted from the rear, clockwise"""
    whole: bool = False
    """It began at the rear."""
    sweep: float = 0.0
    """s since then"""
    seen: int = 0
    """Beams that a ray was near to"""

    def forget(self) -> None:
        """Begin anew, behind a gap of a turn or more, or where it stands: what was is of another."""
        self.at, self.whole, self.ranges, self.sweep, self.seen = None, False, [], 0.0, 0

    def add(
        self, t: Nanos, clockwise: float, found: float, step: float, speed: float, beams: Beams
    ) -> LaserScan | None:
        """Go on to a ray, and fill the beams on the way; return the scan that it completes.

        Args:
            t: when it was measured [ns].
            clockwise: its angle [degrees from ahead].
            found: its range [m]; what is out of reach is no reading.
            step: from one ray to the next [degrees].
            speed: of the turn [degrees/s].
            beams: of the scan.
        """
        angle = (clockwise - 180.0) % 360.0
        found = found if beams.nearest <= found <= beams.farthest else 0.0
        last, before, width = self.at, self.range, 360.0 / beams.count
        if last is None:
            self.at, self.range, self.beam = angle, found, floor(angle / width) + 1
            return None
        ahead = (angle - last) % 360.0
        if ahead > BACK:
            return None
        scan, self.at, self.range = None, last + ahead, found
        while (way := self.beam * width - last) <= ahead:
            self._beam(before, found, way, ahead - way, step)
            if self.beam == beams.count:
                self.sweep += way / speed
                scan = self._scan(t - round((ahead - way) / speed * SECOND), beams)
                self.sweep = -way / speed
            self.beam += 1
        self.sweep += ahead / speed
        if self.beam > beams.count:
            self.at, self.beam = self.at - 360.0, self.beam - beams.count
        return scan

    def _beam(self, before: float, after: float, back: float, ahead: float, step: float) -> None:
        """Add the next beam, which lies so far [degrees] behind one ray and before the next."""
        apart = back + ahead
        nearer = before if back < ahead else after
        near = min(back, ahead) <= step
        self.seen += near
        if apart > NEIGHBOURS * step:
            self.ranges.append(nearer if near else 0.0)
        elif before and after and abs(before - after) <= SURFACE * min(before, after):
            self.ranges.append(before + (after - before) * back / apart)
        else:
            self.ranges.append(nearer)

    def _scan(self, t: Nanos, beams: Beams) -> LaserScan | None:
        """End the turn at t; return its scan, if it was whole and at least half of it was seen."""
        count = beams.count
        ranges, seen, whole = self.ranges, self.seen, self.whole and len(self.ranges) == count
        sweep = self.sweep
        self.ranges, self.seen, self.whole, self.sweep = [], 0, True, 0.0
        if not whole or 2 * seen < count:
            return None
        duration = round(sweep * (count - 1) / count * SECOND)
        width, limits = 2.0 * pi / count, (beams.nearest, beams.farthest)
        return LaserScan(beams.sensor, t, -pi, width, *limits, tuple(reversed(ranges)), -duration)


def clockwise(scan: LaserScan) -> Iterator[tuple[float, float, Nanos]]:
    """Yield what a lidar that turns clockwise sees of a scan of the world, in the order of time: degrees from
    ahead, m (0.0: nothing comes back), and when."""
    if not (math.isfinite(scan.angle_min) and math.isfinite(scan.angle_increment)):
        return
    count, steps = len(scan.ranges), max(len(scan.ranges) - 1, 1)
    for at in reversed(range(count)):
        found = scan.ranges[at]
        seen = math.isfinite(found) and scan.range_min <= found < scan.range_max
        late = (count - 1 - at) * abs(scan.duration) // steps
        angle = -math.degrees(scan.angle_min + at * scan.angle_increment) % 360.0
        yield angle, found if seen else 0.0, scan.t + min(scan.duration, 0) + late
