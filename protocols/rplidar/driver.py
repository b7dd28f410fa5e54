"""The host's end: it asks, starts the scan, and stops what it started; without `start` it is silent."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import groupby

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

    def streamed(
        self, t: Nanos, messages: Sequence[bytes], host: Host[Lidar]
    ) -> Sequence[Report[Lidar] | Rx]:
        own, found = host.own, list[Report[Lidar] | Rx]()
        for repeated, run in groupby(messages, lambda one: len(one) in SIZES):
            several = [*run]
            scans = own.see(t, several, self._stream.scan) if repeated else []
            for answer in () if repeated else several:
                own.hear(t, answer, host.options)
            mode, faults = (Mode.FAULT, (rp.PROTECTION,)) if own.fault else (Mode.READY, ())
            text = own.text(host.options)
            found += (
                Report(host, host.address, mode, text, faults, events=scans),
                *[Rx.TOLD] * len(several[1:]),
            )
        return found

    def poll(self, now: Nanos, host: Host[Lidar]) -> Sequence[Frame]:
        return host.own.ask(now, host.options)

    def rest(self, now: Nanos, host: Host[Lidar]) -> Sequence[Frame]:
        return host.own.rest(now, host.options)
