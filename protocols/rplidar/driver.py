"""The host's end: it asks, starts the scan, and stops what it started; without `start` it is silent."""

from __future__ import annotations

from collections.abc import Sequence

from protocols.frames import Frame
from protocols.messages import Mode, Nanos
from protocols.plugin import Device
from protocols.rplidar import table as rp
from protocols.rplidar.options import NEAREST
from protocols.rplidar.session import Lidar
from protocols.rplidar.turn import Turn
from protocols.rplidar.wire import Wire
from protocols.toolkit.host import Host, Report
from protocols.toolkit.motor_driver import Rx
from protocols.toolkit.rays import Beams
from protocols.toolkit.sensors import SensorAdapter

SIZES = frozenset(rp.SIZES.values())
"""Of what is repeated; no answer is as long."""


class RplidarAdapter(SensorAdapter[Lidar]):
    """What lidars are sent, and what they report."""

    name, faults = rp.NAME, rp.FAULTS

    def __init__(self) -> None:
        super().__init__()
        self._stream: Wire = Wire()

    def own(self, device: Device) -> Lidar:
        options = device.options
        self._stream = Wire(scan=options.scan)
        beams = Beams(device.name, options.beams, NEAREST, options.farthest)
        return Lidar(Turn(device.line_rate, beams))

    def measured(self, t: Nanos, message: bytes, host: Host[Lidar]) -> Report[Lidar] | Rx:
        own, options, scan = host.own, host.options, None
        if len(message) in SIZES:
            scan = own.see(t, message, self._stream.scan)
        else:
            own.hear(t, message, options)
        mode, faults = (Mode.FAULT, (rp.PROTECTION,)) if own.fault else (Mode.READY, ())
        events = () if scan is None else (scan,)
        return Report(host, host.address, mode, own.text(options), faults, events=events)

    def poll(self, now: Nanos, host: Host[Lidar]) -> Sequence[Frame]:
        return host.own.ask(now, host.options)

    def rest(self, now: Nanos, host: Host[Lidar]) -> Sequence[Frame]:
        return host.own.rest(now, host.options)
