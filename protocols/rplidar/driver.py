"""The host's end: it asks, starts the scan, and stops what it started; without `start` it is silent."""

from __future__ import annotations

from collections.abc import Sequence

from protocols.frames import Frame
from protocols.messages import LaserScan, Nanos
from protocols.plugin import Device
from protocols.rplidar import table as rp
from protocols.rplidar.options import NEAREST
from protocols.rplidar.session import Lidar
from protocols.rplidar.turn import Turn
from protocols.rplidar.wire import Wire
from protocols.toolkit.host import Host
from protocols.toolkit.rays import Beams
from protocols.toolkit.sensors import SensorAdapter
from protocols.toolkit.serial import Stream

SIZES = frozenset(rp.SIZES.values())
"""Of what is repeated; no answer is as long."""


class RplidarAdapter(SensorAdapter[Lidar]):
    """What lidars are sent, and what they report."""

    name, faults = rp.NAME, rp.FAULTS

    def __init__(self) -> None:
        super().__init__(Wire())

    def own(self, device: Device) -> Lidar:
        options = device.options
        self._wire = Wire(options.scan)
        self._stream = Stream(self._wire)
        beams = Beams(device.name, options.beams, NEAREST, options.farthest)
        return Lidar(Turn(device.line_rate, beams))

    def interrupted(self) -> None:
        super().interrupted()
        self._wire.lose()

    def measured(self, t: Nanos, message: bytes, host: Host[Lidar]) -> LaserScan | None:
        if len(message) in SIZES:
            return host.own.see(t, message, self._wire.scan)
        host.own.hear(t, message, host.options)
        return None

    def state(self, t: Nanos, host: Host[Lidar]) -> tuple[str, tuple[int, ...]]:
        return host.own.text(host.options), (rp.PROTECTION,) if host.own.fault else ()

    def poll(self, now: Nanos, host: Host[Lidar]) -> Sequence[Frame]:
        return host.own.ask(now, host.options)

    def rest(self, now: Nanos, host: Host[Lidar]) -> Sequence[Frame]:
        return host.own.rest(now, host.options)
