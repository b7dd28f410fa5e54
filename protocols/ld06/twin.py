"""The device's end: a lidar's firmware, which streams what its rays see. The world turns it."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence

from protocols.frames import Frame
from protocols.ld06 import table
from protocols.ld06.table import RAYS, TURN, Packet
from protocols.messages import MILLISECOND, SECOND, Event, LaserScan, Nanos, Obeyed, Torque
from protocols.plugin import Device
from protocols.toolkit.rays import clockwise

BLOCKED_HZ = 2.0
"""Turns per second that it reports when its fault is provoked"""


class Ld06Decoder:
    """What lidars obey: nothing, since they have no receive line."""

    def __init__(self, devices: Sequence[Device]) -> None:
        pass

    def decode(self, t: Nanos, frame: Frame) -> Sequence[Obeyed]:
        """Return nothing."""
        return ()


class Ld06Twin:
    """One lidar."""

    def __init__(self, device: Device, seed: int) -> None:
        self.device = device
        self.blocked = False
        self._rays: list[tuple[int, int, Nanos]] = []
        """That no packet has taken yet: 0.01° clockwise, mm, time."""

    def receive(self, t: Nanos, frame: Frame) -> None:
        """Ignore it."""

    def due(self) -> Nanos | None:
        """Return None: it sends when its rays have been measured."""
        return None

    def provoke(self, code: int) -> None:
        """Turn too slowly from now on."""
        self.blocked = True

    def step(self, now: Nanos, truth: Sequence[Event]) -> tuple[Sequence[Torque], Sequence[Frame]]:
        """Take what the rays have seen; send each packet that is full."""
        frames: list[Frame] = []
        for event in truth:
            if isinstance(event, LaserScan) and event.sensor == self.device.name:
                speed = self._speed(event)
                self._rays += _rays(event)
                while len(self._rays) >= RAYS:
                    frames.append(self._packet(speed))
        return (), frames

    def _speed(self, scan: LaserScan) -> int:
        """Return its speed [°/s], by the angle and the time between a part's rays."""
        steps, speed = len(scan.ranges) - 1, 360.0 * float(self.device.settings.speed_hz)
        if scan.duration < 0 and steps > 0 and math.isfinite(scan.angle_increment):
            speed = math.degrees(abs(scan.angle_increment)) * steps * SECOND / -scan.duration
        if self.blocked:
            speed = 360.0 * BLOCKED_HZ
        return round(max(0.0, min(speed, 0xFFFF)))

    def _packet(self, speed: int) -> bytes:
        rays, self._rays = self._rays[:RAYS], self._rays[RAYS:]
        bright = self.device.settings.intensity
        return table.encode(
            Packet(
                speed,
                rays[0][0],
                [distance for _, distance, _ in rays],
                bytes(bright if distance else 0 for _, distance, _ in rays),
                rays[-1][0],
                rays[-1][2] // MILLISECOND % table.ROUND,
            )
        )


def _rays(scan: LaserScan) -> Iterator[tuple[int, int, Nanos]]:
    """Yield what its rays see, in the order of time."""
    for angle, found, t in clockwise(scan):
        yield round(angle * 100.0) % TURN, min(round(found * 1000.0), table.FARTHEST), t
