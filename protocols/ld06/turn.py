"""Revolutions of rays: packets go in as they come; each time the lidar passes its rear, a scan comes out.

Rules. A scan has as many beams as its lidar is stated to have, at the same angles in every turn, since what
compares two scans compares beams. A beam lies between two rays: it is interpolated between them if both are
readings of one surface, else it is the nearer one; what no ray is near to, since a packet was lost, is no
reading. A turn is cut behind the lidar, where it passes ±180°. The work is that of a packet's twelve rays,
and of the beams between them.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from math import floor, pi

from protocols.ld06 import table
from protocols.ld06.options import NEAREST, Options
from protocols.ld06.table import RAYS, Packet
from protocols.messages import MILLISECOND, SECOND, LaserScan, Nanos

DRIFT = 500
"""ns by which the lidar's clock may run slow in a ms"""
PAUSE: Nanos = 5 * SECOND
"""Silence after which its clock is not compared with what it was,"""
JUMP: Nanos = SECOND
"""and by how much it then may differ from ours, since what it sends may come late"""
NEIGHBOURS = 1.5
"""Steps from one ray to the next, beyond which there is a gap"""
SURFACE = 0.1
"""Share of the range by which two neighbouring rays on one surface may differ"""
BACK = 350.0
"""Degrees: a packet that begins so far ahead begins a little behind the end of the last one"""


@dataclass(slots=True)
class LidarClock:
    """The lidar's time in ours: that of the packet that took least to come, since what is late is late by
    the machine."""

    stamp: int | None = None
    elapsed: Nanos = 0
    """By its clock"""
    offset: Nanos = 0
    """Ours minus its"""
    at: Nanos = 0
    """When the last packet came"""

    def since(self, t: Nanos, stamp: int) -> Nanos | None:
        """Return the time since the last packet, by its clock; None if that was set anew, as by a restart, or
        it has been silent for long."""
        if self.stamp is None or t - self.at > PAUSE:
            return None
        since = table.since(stamp, self.stamp)
        return since if abs(since - (t - self.at)) < JUMP else None

    def read(self, t: Nanos, stamp: int) -> Nanos:
        """Return when a packet was made that came at t; never later than that."""
        since = self.since(t, stamp)
        self.elapsed += since or 0
        offset = t - self.elapsed
        self.offset = offset if since is None else min(offset, self.offset + since // MILLISECOND * DRIFT)
        self.stamp, self.at = stamp, t
        return self.elapsed + self.offset


@dataclass(slots=True)
class Turn:
    """What is known of a lidar's present turn. Plain data."""

    clock: LidarClock = field(default_factory=LidarClock)
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
    lost: int = 0
    """Packets that were missing, since the start"""
    steady: Nanos | None = None
    """When its speed was last within the bounds"""

    def forget(self) -> None:
        """Begin anew, where the next packet begins."""
        self._break()
        self.clock, self.steady = LidarClock(), None

    def unsteady(self, t: Nanos, packet: Packet, options: Options) -> bool:
        """True if the lidar has turned too slowly or too fast for as long as that matters."""
        good = options.slowest_hz <= packet.speed / 360.0 <= options.fastest_hz
        self.steady = t if good or self.steady is None else self.steady
        return t - self.steady > options.unsteady_ms * MILLISECOND

    def add(self, t: Nanos, packet: Packet, sensor: str, options: Options) -> LaserScan | None:
        """Take a packet that came at t; return the scan that it completes."""
        since, step = self.clock.since(t, packet.stamp), packet.step
        end, scan = self.clock.read(t, packet.stamp), None
        if not packet.speed or not step:
            self._break()
            return None
        self._count_lost(packet, step, since or 0)
        for ray, distance in enumerate(packet.distances):
            angle = (packet.start / 100.0 + ray * step - 180.0) % 360.0
            measured = end - round((RAYS - 1 - ray) * step / packet.speed * SECOND)
            found = distance / 1000.0
            found = found if NEAREST <= found <= options.farthest else 0.0
            scan = self._ray(measured, angle, found, step, packet.speed, sensor, options) or scan
        return scan

    def _count_lost(self, packet: Packet, step: float, since: Nanos) -> None:
        """Count the packets that are missing before this one, which ended so long after the last."""
        if self.at is None:
            return
        ahead = (packet.start / 100.0 - 180.0 - self.at) % 360.0
        turned = packet.speed * since / SECOND - step * (RAYS - 1)
        turns = max(0, round((turned - ahead) / 360.0))
        if turns or ahead < BACK:
            self.lost += max(0, round(((ahead + 360.0 * turns) / step - 1.0) / RAYS))
        if turns:
            self._break()

    def _break(self) -> None:
        """Begin anew, behind a gap of a turn or more, or where it stands: what was is of another."""
        self.at, self.whole, self.ranges, self.sweep, self.seen = None, False, [], 0.0, 0

    def _ray(
        self, t: Nanos, angle: float, found: float, step: float, speed: int, sensor: str, options: Options
    ) -> LaserScan | None:
        """Go on to a ray [degrees from the rear, clockwise; m], and fill the beams on the way."""
        last, before, width = self.at, self.range, 360.0 / options.count
        if last is None:
            self.at, self.range, self.beam = angle, found, floor(angle / width) + 1
            return None
        ahead = (angle - last) % 360.0
        if ahead > BACK:
            return None
        scan, self.at, self.range = None, last + ahead, found
        while (way := self.beam * width - last) <= ahead:
            self._beam(before, found, way, ahead - way, step)
            if self.beam == options.count:
                self.sweep += way / speed
                scan = self._scan(t - round((ahead - way) / speed * SECOND), sensor, options)
                self.sweep = -way / speed
            self.beam += 1
        self.sweep += ahead / speed
        if self.beam > options.count:
            self.at, self.beam = self.at - 360.0, self.beam - options.count
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

    def _scan(self, t: Nanos, sensor: str, options: Options) -> LaserScan | None:
        """End the turn at t; return its scan, if it was whole and at least half of it was seen."""
        count = options.count
        ranges, seen, whole = self.ranges, self.seen, self.whole and len(self.ranges) == count
        sweep = self.sweep
        self.ranges, self.seen, self.whole, self.sweep = [], 0, True, 0.0
        if not whole or 2 * seen < count:
            return None
        duration = round(sweep * (count - 1) / count * SECOND)
        width, limits = 2.0 * pi / count, (NEAREST, options.farthest)
        return LaserScan(sensor, t, -pi, width, *limits, tuple(reversed(ranges)), -duration)
