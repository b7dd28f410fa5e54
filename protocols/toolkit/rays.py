"""Lidars that turn clockwise: rays go in as they come; each time the rear is passed, a scan comes out.

Rules. A scan has as many beams as its lidar is stated to have, at the same angles in every turn, since what
compares two scans compares beams. A beam lies between two rays: it is interpolated between them if both are
readings of one surface, else it is the nearer one; what no ray is near to, since some were lost, is no
reading. A turn is cut behind the lidar, where it passes ±180°. The work is that of the ray, and of the beams
between it and the last one.
"""

from __future__ import annotations

import math
from bisect import bisect_left
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, field
from functools import cache
from math import floor, pi

from protocols.messages import SECOND, LaserScan, Nanos

NEIGHBOURS = 1.5
"""Steps from one ray to the next, beyond which there is a gap"""
SURFACE = 1.1
"""Times as far as one ray, at most, goes a neighbouring one on the same surface"""
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
    reading: float = 0.0
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
        self,
        ended: Nanos,
        apart: float,
        clockwise: Sequence[float] | float,
        found: Sequence[float],
        step: float,
        speed: float,
        beams: Beams,
    ) -> LaserScan | None:
        """Go on by a run of rays, and fill the beams on the way; return the scan that they complete.

        Args:
            ended: when the last of them was measured [ns].
            apart: from one to the next [ns].
            clockwise: their angles [degrees from ahead], which ascend, also beyond a turn; of rays that
                are a step apart, that of the first.
            found: their ranges [mm]; what is out of reach is no reading.
            step: from one ray to the next, as a rule [degrees].
            speed: of the turn [degrees/s].
            beams: of the scan.
        """
        nearest, farthest, count, scan = beams.nearest, beams.farthest, beams.count, None
        begins = clockwise if isinstance(clockwise, float) else clockwise[0]
        width, first = 360.0 / count, (begins - 180.0) % 360.0
        if self.at is None:
            self.at, self.beam = first, floor(first / width) + 1
        began = self.at
        ahead = (first - began) % 360.0
        off = began + (ahead if ahead <= BACK else ahead - 360.0) - begins
        if isinstance(clockwise, float):
            places = [begins + ray * step + off for ray in range(-1, len(found))]
            places[0] = began
        else:
            places = [began, *[degrees + off for degrees in clockwise]]
        ranges = [m if nearest <= (m := mm / 1000.0) <= farthest else 0.0 for mm in found]
        ranges.insert(0, self.reading)
        if ahead > BACK:  # what is behind the last ray is known
            known = bisect_left(places, began, 1) - 1
            del places[1 : known + 1], ranges[1 : known + 1]
        last = floor(places[-1] / width)
        while last >= count:
            self._fill(angles(count)[self.beam :], places, ranges, step)
            self.sweep += (360.0 - began) / speed
            ray = bisect_left(places, 360.0, 0, len(places) - 1)
            late = round((len(places) - 1 - ray) * apart) + round((places[ray] - 360.0) / speed * SECOND)
            scan = self._scan(ended - late, beams) or scan
            places, ranges = [place - 360.0 for place in places[ray - 1 :]], ranges[ray - 1 :]
            self.beam, self.sweep, began, last = 1, 0.0, 0.0, last - count
        if last >= self.beam:
            self._fill(angles(count)[self.beam : last + 1], places, ranges, step)
            self.beam = last + 1
        self.sweep += (places[-1] - began) / speed
        self.at, self.reading = places[-1], ranges[-1]
        return scan

    def _fill(
        self, beams: Sequence[float], places: Iterable[float], ranges: Iterable[float], step: float
    ) -> None:
        """Add beams at these angles, each between two of these rays, the first of which is before them."""
        # No call for a beam that lies on a surface: lidars have 4,500 to 32,000 rays a second.
        near, add, rays = NEIGHBOURS * step, self.ranges.append, zip(places, ranges, strict=True)
        (place, before), (reached, after) = next(rays), next(rays)
        self.seen += len(beams)
        for at in beams:
            while reached < at and (ray := next(rays, None)):
                place, before = reached, after
                reached, after = ray
            apart = reached - place
            if apart <= near and after <= before * SURFACE and before <= after * SURFACE and apart:
                add(before + (after - before) * (at - place) / apart)
            else:
                add(self._beside(before, after, at - place, reached - at, step))

    def _beside(self, before: float, after: float, back: float, ahead: float, step: float) -> float:
        """Return the range of a beam that lies so far [degrees] behind one ray and before the next, which are
        not of one surface."""
        if back + ahead > NEIGHBOURS * step and min(back, ahead) > step:
            self.seen -= 1
            return 0.0
        return before if back < ahead else after

    def _scan(self, t: Nanos, beams: Beams) -> LaserScan | None:
        """End the turn at t; return its scan, if it was whole and at least half of it was seen."""
        count = beams.count
        ranges, seen, whole = self.ranges, self.seen, self.whole and len(self.ranges) == count
        ranges.reverse()  # beams of a scan go counter-clockwise
        sweep = self.sweep
        self.ranges, self.seen, self.whole, self.sweep = [], 0, True, 0.0
        if not whole or 2 * seen < count:
            return None
        duration = round(sweep * (count - 1) / count * SECOND)
        width, limits = 2.0 * pi / count, (beams.nearest, beams.farthest)
        return LaserScan(beams.sensor, t, -pi, width, *limits, tuple(ranges), -duration)


@cache
def angles(count: int) -> Sequence[float]:
    """Return where the beams of a turn are, of so many: degrees from the rear, clockwise, up to the rear."""
    return tuple(beam * (360.0 / count) for beam in range(count + 1))


def ascending(angles: list[float]) -> list[float]:
    """Return angles [degrees] of a turn that go on beyond its end; what is a little behind stands still."""
    if angles == sorted(angles):
        return angles
    places = angles[:1]
    for angle in angles[1:]:
        ahead = (angle - places[-1]) % 360.0
        places.append(places[-1] + (ahead if ahead <= BACK else 0.0))
    return places


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
