"""The host's end: it listens. A lidar takes nothing: it turns and streams as soon as it has power."""

from __future__ import annotations

from collections.abc import Mapping

from protocols.ld06 import table
from protocols.ld06.options import NEAREST
from protocols.ld06.turn import Turn
from protocols.messages import MILLISECOND, SECOND, LaserScan, Nanos
from protocols.plugin import Device, FaultInfo
from protocols.toolkit.host import Host
from protocols.toolkit.motor_driver import Rx
from protocols.toolkit.rays import Beams
from protocols.toolkit.sensors import SensorAdapter

SPEED = 1
FAULTS: Mapping[int, FaultInfo] = {
    SPEED: FaultInfo(
        "speed out of range",
        "its motor is blocked, its supply too weak (5 V), or its PWM pin neither grounded nor driven",
        "free what turns; ground the PWM pin, so that it keeps 10 Hz by itself",
        latching=False,
    )
}


class Ld06Adapter(SensorAdapter[Turn]):
    """What lidars report."""

    name, faults = table.NAME, FAULTS

    def __init__(self) -> None:
        super().__init__(table.FRAMING)

    def own(self, device: Device) -> Turn:
        options, rate = device.options, device.line_rate
        carried = 10 * table.PACKET_BYTES * SECOND // rate if rate else 0
        return Turn(Beams(device.name, options.count, NEAREST, options.farthest), carried)

    def measured(self, t: Nanos, message: bytes, host: Host[Turn]) -> LaserScan | Rx | None:
        packet = table.decode(message)
        return Rx.MALFORMED if packet is None else host.own.add(t, packet, host.options)

    def state(self, t: Nanos, host: Host[Turn]) -> tuple[str, tuple[int, ...]]:
        turn, options = host.own, host.options
        if turn.unsteady > options.unsteady_ms * MILLISECOND:
            return f"turns at {turn.speed / 360.0:.1f} Hz", (SPEED,)
        return f"turns, {turn.lost} packets lost" if turn.lost else "turns", ()
