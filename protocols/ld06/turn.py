"""Turns of a lidar: packets go in as they come, with the time that the lidar gives; scans come out."""

from __future__ import annotations

from dataclasses import dataclass, field

from protocols.ld06 import table
from protocols.ld06.options import Options
from protocols.ld06.table import RAYS, Packet
from protocols.messages import MILLISECOND, SECOND, LaserScan, Nanos
from protocols.toolkit.device_clock import DeviceClock
from protocols.toolkit.rays import BACK, Beams, Rays


@dataclass(slots=True)
class Turn:
    """What is known of a lidar's present turn. Plain data."""

    beams: Beams
    """Of its scans"""
    carried: Nanos
    """How long a packet takes on the line"""
    clock: DeviceClock = field(default_factory=lambda: DeviceClock(table.ROUND * MILLISECOND))
    rays: Rays = field(default_factory=Rays)
    lost: int = 0
    """Packets that were missing, since the start"""
    speed: int = 0
    """°/s, as it told last"""
    steady: Nanos | None = None
    """When that was last within the bounds; None: nothing has come,"""
    unsteady: Nanos = 0
    """and for how long it was not, when it told last"""

    def forget(self) -> None:
        """Begin anew, where the next packet begins."""
        self.rays.forget()
        self.clock.forget()
        self.steady = None

    def add(self, t: Nanos, packet: Packet, options: Options) -> LaserScan | None:
        """Take a packet that came at t; return the scan that it completes."""
        speed, stamp, step = packet.speed, packet.stamp * MILLISECOND, packet.step
        if self.steady is None or options.slowest_hz <= speed / 360.0 <= options.fastest_hz:
            self.steady = t
        self.speed, self.unsteady = speed, t - self.steady
        since, end = self.clock.since(t, stamp), self.clock.read(t, stamp) - self.carried
        if not speed or not step:
            self.rays.forget()
            return None
        self._count_lost(packet, step, since or 0)
        first, apart = packet.start / 100.0, step / speed * SECOND
        return self.rays.add(end, apart, first, packet.distances, step, speed, self.beams)

    def _count_lost(self, packet: Packet, step: float, since: Nanos) -> None:
        """Count the packets that are missing before this one, which ended so long after the last."""
        if (at := self.rays.at) is None:
            return
        ahead = (packet.start / 100.0 - 180.0 - at) % 360.0
        turned = packet.speed * since / SECOND - step * (RAYS - 1)
        turns = max(0, round((turned - ahead) / 360.0))
        if turns or ahead < BACK:
            self.lost += max(0, round(((ahead + 360.0 * turns) / step - 1.0) / RAYS))
        if turns:
            self.rays.forget()
