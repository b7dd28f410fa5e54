"""The host's end: it listens."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Annotated

from protocols.bounds import Bounds, check
from protocols.messages import SECOND, Imu, Nanos
from protocols.plugin import Device
from protocols.toolkit.device_clock import DeviceClock
from protocols.toolkit.host import Host
from protocols.toolkit.sensors import SensorAdapter

from . import table


@dataclass(frozen=True, slots=True)
class Options:
    """Configuration of the driver. FILL IN: what is not in a packet, and the driver must know."""

    offline_ms: Annotated[float, Bounds(20.0, 60_000.0)] = 500.0
    """Time without a packet after which it is offline"""

    def __post_init__(self) -> None:
        check(self)


@dataclass(slots=True)
class Sensor:
    """What is known of one device. Plain data."""

    line_rate: int
    clock: DeviceClock = field(default_factory=lambda: DeviceClock(256 * table.PERIOD))
    """FILL IN (clause "measurements"): by what the device tells of its time; without that, leave it out."""
    clipped: int = 0
    """Packets at the end of a scale, since the start"""

    def forget(self) -> None:
        """Begin anew: it may have restarted."""
        self.clock.forget()

    def reading(self, t: Nanos, message: bytes, name: str) -> Imu | None:
        """Return what a packet says that came at t; None if a number may as well be beyond its range."""
        packet = table.decode(message)
        began = t - (10 * table.PACKET_BYTES * SECOND // self.line_rate if self.line_rate else 0)
        measured = self.clock.read(began, packet.number * table.PERIOD)
        if any(each in table.ENDS for each in (*packet.rates, *packet.pushes)):
            self.clipped += 1
            return None
        rates, pushes = _scaled(packet.rates, table.RATE_UNIT), _scaled(packet.pushes, table.PUSH_UNIT)
        return Imu(name, measured, rates, pushes)


def _scaled(counts: Sequence[int], unit: float) -> tuple[float, float, float]:
    x, y, z = (each * unit for each in counts)
    return x, y, z


class StreamAdapter(SensorAdapter[Sensor]):
    """What the devices report."""

    name = table.NAME

    def __init__(self) -> None:
        super().__init__(table.FRAMING)

    def own(self, device: Device) -> Sensor:
        return Sensor(device.line_rate)

    def measured(self, t: Nanos, message: bytes, host: Host[Sensor]) -> Imu | None:
        return host.own.reading(t, message, host.name)

    def state(self, t: Nanos, host: Host[Sensor]) -> tuple[str, tuple[int, ...]]:
        # FILL IN (clause "faults"): the codes, if the device tells that it is not well.
        clipped = host.own.clipped
        return f"{clipped} readings at the end of a scale" if clipped else "streams", ()
