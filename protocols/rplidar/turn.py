"""Turns of a lidar: nodes and capsules go in as they come; scans come out.

Rules. Nothing on the line has a time. A ray's is that of the bytes that it came in, less what these took on
the line and the rays behind it; and since what is late is late by the machine, no later than the rays since
the ones before can have taken. How long a ray takes is what the lidar tells, and what is measured then.
"""

from __future__ import annotations

from dataclasses import dataclass, field

from protocols.messages import MILLISECOND, SECOND, LaserScan, Nanos
from protocols.rplidar import capsules
from protocols.rplidar import table as rp
from protocols.toolkit.rays import BACK, Beams, Rays

STANDARD, EXPRESS = 508_000.0, 254_000.0
"""ns per ray, if it does not tell"""
DRIFT = 0.01
"""Share by which its rays may be slower than they seem"""
LATE: Nanos = 20 * MILLISECOND
"""What is later than this has stopped in between."""
LOST = 1.5
"""Usual ways from one capsule to the next, from which on one is missing between them"""
SLOWLY = 64
"""Messages by which a mean follows"""
UNTOLD = frozenset({rp.ULTRA, rp.HQ})
"""Of which GET_SAMPLERATE does not tell how long a ray takes:"""
QUICKER = 4
"""so many times less than in an express scan, until it is measured"""
ENOUGH = 1 << 20
"""Messages, of what is told"""
JUMP = 20.0
"""Degrees from one node to the next, beyond which some are missing"""


@dataclass(slots=True)
class Turn:
    """What is known of a lidar's present turn. Plain data."""

    line_rate: int
    told: tuple[float, float] = (STANDARD, EXPRESS)
    """ns per ray of a standard and an express scan"""
    sample: float = EXPRESS
    """ns per ray, as measured"""
    rays: Rays = field(default_factory=Rays)
    ended: Nanos = 0
    """When the last ray was measured; 0: none was"""
    came: Nanos = 0
    """When the last message came"""
    measured: int = 0
    """Messages of this stream by which that was, and what was taken for it before"""
    held: bytes = b""
    """The last capsule: where its rays are depends on the next"""
    way: float = 0.0
    """Degrees, the usual one from capsule to capsule, or from node to node"""
    last: float = 0.0
    """Degrees, of the last node"""
    lost: int = 0
    """Capsules that were missing, since the start"""

    def tell(self, standard: float, express: float) -> None:
        """Note how long a ray takes [ns], as the lidar tells; 0: not known."""
        self.told = standard or self.told[0], express or self.told[1]

    def begin(self, kind: int) -> None:
        """Begin a stream of this type anew."""
        self.sample = self.told[kind != rp.NODES] / (QUICKER if kind in UNTOLD else 1)
        self.measured = 1 if kind in UNTOLD else ENOUGH
        self.rays.forget()
        self.ended, self.held, self.way = 0, b"", 0.0

    def node(self, t: Nanos, data: bytes, beams: Beams) -> LaserScan | None:
        """Take a node that came at t; return the scan that it completes."""
        one, before = rp.node(data), self.ended
        self._measure(t, 1, 1, rp.NODE_BYTES)
        ahead, self.last = (one.angle - self.last) % 360.0, one.angle
        if ahead < JUMP and before:
            self.way += (ahead - self.way) / SLOWLY if self.way else ahead
        elif not before or ahead < BACK:
            self.rays.forget()
        speed = self.way / self.sample * SECOND
        if not speed:
            return None
        return self.rays.add(self.ended, one.angle, one.distance / 1000.0, self.way, speed, beams)

    def capsule(self, t: Nanos, data: bytes, kind: int, beams: Beams) -> LaserScan | None:
        """Take a capsule that came at t; return the scan that the one before completes."""
        (first, start), held, ended, count = capsules.head(data), self.held, self.ended, capsules.RAYS[kind]
        self.held = data
        if first or len(held) != len(data):
            self.rays.forget()
            self.way, self.ended = 0.0, 0
            self._measure(t, count, 1, len(data))
            return None
        way = (start - capsules.head(held)[1]) % 360.0
        ways = round(way / self.way) if self.way and way > LOST * self.way else 1
        self.lost += ways - 1
        self.way = way / ways
        self._measure(t, count, ways, len(data))
        before = capsules.capsule(held, kind, data if ways == 1 else b"")
        step = self.way / count
        if not step or self.ended - ended > SECOND:  # it stands, or a turn is missing
            self.rays.forget()
            return None
        scan, speed, places = None, step / self.sample * SECOND, list[tuple[float, int]]()
        for ray, offset in enumerate(before.offsets):
            places.append((before.start + ray * step - offset, ray))
        for angle, ray in sorted(places):
            measured = ended - round((count - 1 - ray) * self.sample)
            found = before.distances[ray] / 1000.0
            scan = self.rays.add(measured, angle, found, step, speed, beams) or scan
        return scan

    def packet(self, t: Nanos, data: bytes, beams: Beams) -> LaserScan | None:
        """Take a packet of HQ that came at t, whose rays have their angles; return the scan that it
        completes."""
        found, ended = capsules.packet(data), self.ended
        count = len(found)
        step = (found[-1].angle - found[0].angle) % 360.0 / (count - 1)
        ahead = (found[0].angle - self.last) % 360.0
        ways = 1 + (max(0, round((ahead / step - 1.0) / count)) if ended and step and ahead < BACK else 0)
        self.lost += ways - 1
        self.last = found[-1].angle
        self._measure(t, count, ways, len(data))
        if not step or (ended and self.ended - ended > SECOND):  # it stands, or a turn is missing
            self.rays.forget()
            return None
        scan, speed = None, step / self.sample * SECOND
        for ray, one in enumerate(found):
            measured = self.ended - round((count - 1 - ray) * self.sample)
            scan = self.rays.add(measured, one.angle, one.distance / 1000.0, step, speed, beams) or scan
        return scan

    def _measure(self, t: Nanos, count: int, ways: int, size: int) -> None:
        """Note that a message with so many rays came at t; so many ways on from the one before."""
        arrived = t - (10 * size * SECOND // self.line_rate if self.line_rate else 0)
        taken, rays = t - self.came, count * ways
        if self.ended and 0 <= taken < LATE + 4 * rays * self.sample:
            self.measured = min(self.measured + 1, SLOWLY * (32 // count or 1))
            self.sample += (taken / rays - self.sample) / self.measured
        soonest = self.ended + round(rays * self.sample * (1.0 + DRIFT))
        self.ended = arrived if not self.ended or arrived - soonest > LATE else min(arrived, soonest)
        self.came = t
