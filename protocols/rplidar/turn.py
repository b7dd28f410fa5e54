"""Turns of a lidar: nodes and capsules go in as they come; scans come out.

Rules. Nothing on the line has a time. A ray's is that of the bytes that it came in, less what these took on
the line and the rays behind it; and since what is late is late by the machine, no later than the rays since
the ones before can have taken. How long a ray takes is what the lidar tells, and what is measured then.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

from protocols.messages import MILLISECOND, SECOND, LaserScan, Nanos
from protocols.rplidar import capsules
from protocols.rplidar import table as rp
from protocols.toolkit.rays import BACK, Beams, Rays, ascending

STANDARD, EXPRESS = 508_000.0, 254_000.0
"""ns per ray, if it does not tell"""
DRIFT = 0.01
"""Share by which its rays may be slower than they seem"""
LATE: Nanos = 20 * MILLISECOND
"""What is later than this has stopped in between."""
LOST = 1.5
"""Usual ways from one capsule to the next, from which on one is missing between them"""
SLOWLY = 64
"""Messages, of 32 rays at least, by which a mean follows"""
UNTOLD = frozenset({"ultra", "hq"})
"""Of which GET_SAMPLERATE does not tell how long a ray takes:"""
QUICKER = 4
"""so many times less than in an express scan, until it is measured"""
ENOUGH = 1 << 20
"""Rays, of what is told"""
JUMP = 20.0
"""Degrees from one node to the next, beyond which some are missing"""


@dataclass(slots=True)
class Turn:
    """What is known of a lidar's present turn. Plain data."""

    line_rate: int
    beams: Beams
    """Of its scans"""
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
    """Rays of this stream by which that was, and what was taken for it before"""
    held: bytes = b""
    """The last capsule: where its rays are depends on the next"""
    way: float = 0.0
    """Degrees, the usual one from capsule to capsule, or from node to node"""
    last: float = 0.0
    """Degrees, of the last node, or of the first ray of the last capsule"""
    lost: int = 0
    """Capsules that were missing, since the start"""

    def tell(self, standard: float, express: float) -> None:
        """Note how long a ray takes [ns], as the lidar tells; 0: not known."""
        self.told = standard or self.told[0], express or self.told[1]

    def begin(self, scan: str) -> None:
        """Begin a stream of this scan anew."""
        self.sample = self.told[scan != "standard"] / (QUICKER if scan in UNTOLD else 1)
        self.measured = rp.RAYS[scan] if scan in UNTOLD else ENOUGH
        self.rays.forget()
        self.ended, self.held, self.way = 0, b"", 0.0

    def add(self, t: Nanos, data: bytes, scan: str) -> LaserScan | None:
        """Take a node or capsule of a scan that came at t; return the scan that it completes."""
        if scan == "standard":
            return self._node(t, data)
        return self._packet(t, data) if scan == "hq" else self._capsule(t, data, scan)

    def _node(self, t: Nanos, data: bytes) -> LaserScan | None:
        one, before = rp.node(data), self.ended
        self._measure(t, 1, 1, rp.NODE_BYTES)
        ahead, self.last = (one.angle - self.last) % 360.0, one.angle
        if ahead < JUMP and before:
            self.way += (ahead - self.way) / SLOWLY if self.way else ahead
        elif not before or ahead < BACK:
            self.rays.forget()
        return self._go_on(self.ended, self.ended, one.angle, (one.distance,), self.way)

    def _packet(self, t: Nanos, data: bytes) -> LaserScan | None:
        """Take a packet of HQ, whose rays have their angles."""
        (angles, found), ended, count = capsules.packet(data), self.ended, rp.RAYS["hq"]
        step = (angles[-1] - angles[0]) % 360.0 / (count - 1)
        ahead, self.last = (angles[0] - self.last) % 360.0, angles[-1]
        ways = 1 + (max(0, round((ahead / step - 1.0) / count)) if ended and step and ahead < BACK else 0)
        self._measure(t, count, ways, len(data))
        return self._go_on(self.ended, ended or self.ended, ascending(angles), found, step)

    def _capsule(self, t: Nanos, data: bytes, scan: str) -> LaserScan | None:
        """Take a capsule, which tells where the rays of the one before are."""
        (first, start), held, ended, count = capsules.head(data), self.held, self.ended, rp.RAYS[scan]
        begun, self.held, self.last = self.last, data, start
        if first or len(held) != len(data):
            self.rays.forget()
            self.way, self.ended = 0.0, 0
            self._measure(t, count, 1, len(data))
            return None
        way = (start - begun) % 360.0
        ways = round(way / self.way) if self.way and way > LOST * self.way else 1
        self.way = way / ways
        self._measure(t, count, ways, len(data))
        found, offsets = capsules.rays(held, scan, data if ways == 1 else b"")
        step = self.way / count
        if not offsets:
            return self._go_on(ended, ended, begun, found, step)
        angles = [begun + ray * step - off for ray, off in enumerate(offsets)]
        if angles != sorted(angles):
            order = sorted(range(count), key=angles.__getitem__)
            angles, found = [angles[ray] for ray in order], [found[ray] for ray in order]
        return self._go_on(ended, ended, angles, found, step)

    def _go_on(
        self,
        ended: Nanos,
        before: Nanos,
        angles: Sequence[float] | float,
        found: Sequence[float],
        step: float,
    ) -> LaserScan | None:
        """Go on by rays [degrees, mm], of which the last was measured at `ended`; the rays before the last
        message ended at `before`."""
        if not step or self.ended - before > SECOND:  # it stands, or a turn is missing
            self.rays.forget()
            return None
        speed = step / self.sample * SECOND
        return self.rays.add(ended, self.sample, angles, found, step, speed, self.beams)

    def _measure(self, t: Nanos, count: int, ways: int, size: int) -> None:
        """Note that so many rays came at t, in so many bytes; so many ways on from those before."""
        self.lost += ways - 1
        arrived = t - (10 * size * SECOND // self.line_rate if self.line_rate else 0)
        taken, rays = t - self.came, count * ways
        if self.ended and 0 <= taken < LATE + 4 * rays * self.sample:
            self.measured = min(self.measured + rays, SLOWLY * max(32, count))
            self.sample = max(1.0, self.sample + (taken - rays * self.sample) / self.measured)
        soonest = self.ended + round(rays * self.sample * (1.0 + DRIFT))
        self.ended = arrived if not self.ended or arrived - soonest > LATE else min(arrived, soonest)
        self.came = t
