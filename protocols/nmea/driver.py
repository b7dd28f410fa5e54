"""The host's end: it listens.

Rules. A fix is a GGA whose quality is one that is measured. Its time is the receiver's own (UTC), brought to
ours by the sentence that took least to come. What RMC and VTG tell of its motion is said in the state, and
not used; an RMC that is void takes the fix of its time back before it is reported late.
"""

from __future__ import annotations

from dataclasses import dataclass, field

from protocols.messages import MILLISECOND, SECOND, Fix, Nanos
from protocols.nmea import table
from protocols.nmea.options import Options
from protocols.nmea.table import Gga
from protocols.plugin import Device
from protocols.toolkit.device_clock import DeviceClock
from protocols.toolkit.host import Host
from protocols.toolkit.motor_driver import Rx
from protocols.toolkit.sensors import SensorAdapter


@dataclass(slots=True)
class Receiver:
    """What is known of a receiver. Plain data."""

    line_rate: int
    clock: DeviceClock = field(default_factory=lambda: DeviceClock(table.DAY))
    void: Nanos | None = None
    """The time of the newest RMC that was void"""
    text: str = ""
    """How well it knows where it is"""

    def forget(self) -> None:
        """Begin anew."""
        self.clock.forget()
        self.void = None

    def locate(self, t: Nanos, gga: Gga, size: int, sensor: str, options: Options) -> Fix | None:
        """Take a GGA of so many bytes that came at t; return its fix."""
        began = t - (10 * size * SECOND // self.line_rate if self.line_rate else 0)
        measured = self.clock.read(began, gga.time) - round(options.latency_ms * MILLISECOND)
        sigma = options.sigma(gga.quality)
        self.text = table.QUALITIES[gga.quality]
        if sigma is None or self.void == gga.time:
            self.text += " (void)" if self.void == gga.time else ", which is not used"
            return None
        variance = (sigma * max(gga.hdop or 1.0, 0.1)) ** 2
        return Fix(sensor, measured, gga.latitude, gga.longitude, gga.altitude, variance)

    def move(self, motion: table.Motion) -> None:
        """Take an RMC."""
        self.void = None if motion.valid else motion.time


class NmeaAdapter(SensorAdapter[Receiver]):
    """What receivers report."""

    name = table.NAME

    def __init__(self) -> None:
        super().__init__(table.SENTENCES)

    def own(self, device: Device) -> Receiver:
        return Receiver(device.line_rate)

    def measured(self, t: Nanos, message: bytes, host: Host[Receiver]) -> Fix | Rx | None:
        fields, own = message.decode("ascii").split(","), host.own
        match table.kind_of(fields):
            case "GGA" if (gga := table.gga(fields)) is not None:
                return own.locate(t, gga, len(message) + 6, host.name, host.options)
            case "RMC" if (motion := table.rmc(fields)) is not None:
                own.move(motion)
            case "GGA" | "RMC":
                return Rx.MALFORMED
            case "VTG" if table.vtg(fields) is None:
                return Rx.MALFORMED
        return None

    def state(self, t: Nanos, host: Host[Receiver]) -> tuple[str, tuple[int, ...]]:
        return host.own.text, ()
