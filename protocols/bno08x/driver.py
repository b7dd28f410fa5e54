"""The host's end: it listens. What it sends has no angular rates: they are those of its heading.

Rules. The rate about the vertical is how far the heading has gone from one packet to the next, in the time
that their indices say; those about the other axes are that of pitch and roll, in the same way. A reading is
made of two packets, hence; the first behind a gap gives none. Its time is the middle of the two.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import Annotated, Literal

from protocols.bno08x import table
from protocols.bno08x.table import Packet
from protocols.bounds import Bounds, check
from protocols.messages import SECOND, Imu, Nanos
from protocols.plugin import Device
from protocols.toolkit.device_clock import DeviceClock
from protocols.toolkit.host import Host
from protocols.toolkit.motor_driver import Rx
from protocols.toolkit.sensors import SensorAdapter

FARTHEST = 10
"""Periods between two packets, beyond which they make no rate"""
Vector = tuple[float, float, float]


@dataclass(frozen=True, slots=True)
class Options:
    """Configuration of the driver."""

    yaw: Literal["counter-clockwise", "clockwise"] = "counter-clockwise"
    """Which way its heading grows, seen from above"""
    offline_ms: Annotated[float, Bounds(20.0, 60_000.0)] = 500.0
    """Time without a packet after which it is offline"""

    def __post_init__(self) -> None:
        check(self)


@dataclass(slots=True)
class Heading:
    """What is known of a sensor. Plain data."""

    line_rate: int
    clock: DeviceClock = field(default_factory=lambda: DeviceClock(table.ROUND * table.PERIOD))
    last: Packet | None = None
    lost: int = 0
    """Packets that were missing, since the start"""
    clipped: int = 0
    """Packets at the end of a scale, since the start"""

    def forget(self) -> None:
        """Begin anew."""
        self.clock.forget()
        self.last = None

    def text(self) -> str:
        """Return how it is, for a person."""
        lost = f"{self.lost} packets lost" if self.lost else ""
        clipped = f"{self.clipped} readings at the end of a scale" if self.clipped else ""
        return ", ".join(filter(None, ("streams", lost, clipped)))

    def add(self, t: Nanos, packet: Packet, sensor: str, options: Options) -> Imu | None:
        """Take a packet that came at t; return its reading."""
        began = t - (10 * table.PACKET_BYTES * SECOND // self.line_rate if self.line_rate else 0)
        stamp, last = packet.number * table.PERIOD, self.last
        since, at = self.clock.since(began, stamp), self.clock.read(began, stamp)
        self.last = packet
        if since is None or last is None:
            return None
        steps = since // table.PERIOD
        self.lost += max(0, steps - 1)
        if not 0 < steps <= FARTHEST:
            return None
        pushed = packet.x, packet.y, packet.z
        if any(each in table.ENDS for each in pushed):
            self.clipped += 1
            return None
        sign = 1.0 if options.yaw == "counter-clockwise" else -1.0
        rates = _rates(last, packet, since / SECOND, sign)
        x, y, z = (each * table.MG for each in pushed)
        return Imu(sensor, at - since // 2, rates, (x, y, z), _orientation(packet, sign))


def _rates(last: Packet, packet: Packet, time: float, sign: float) -> Vector:
    """Return rad/s about the sensor's axes, of its angles' rates (yaw, then pitch, then roll)."""
    yaw, pitch, roll = (
        math.radians((now - before + 18_000) % 36_000 - 18_000) / 100.0 / time
        for now, before in zip(packet[1:4], last[1:4], strict=True)
    )
    tilt, turn = math.radians(packet.pitch / 100.0), math.radians(packet.roll / 100.0)
    yaw *= sign
    return (
        roll - yaw * math.sin(tilt) + 0.0,
        pitch * math.cos(turn) + yaw * math.cos(tilt) * math.sin(turn) + 0.0,
        yaw * math.cos(tilt) * math.cos(turn) - pitch * math.sin(turn) + 0.0,
    )


def _orientation(packet: Packet, sign: float) -> tuple[float, float, float, float]:
    """Return x, y, z, w of Rz(yaw) Ry(pitch) Rx(roll)."""
    yaw, pitch, roll = (math.radians(each / 100.0) / 2.0 for each in packet[1:4])
    (cr, sr), (cp, sp), (cy, sy) = ((math.cos(a), math.sin(a)) for a in (roll, pitch, sign * yaw))
    return (
        sr * cp * cy - cr * sp * sy + 0.0,
        cr * sp * cy + sr * cp * sy + 0.0,
        cr * cp * sy - sr * sp * cy + 0.0,
        cr * cp * cy + sr * sp * sy + 0.0,
    )


class Bno08xAdapter(SensorAdapter[Heading]):
    """What sensors report."""

    name = table.NAME

    def __init__(self) -> None:
        super().__init__(table.FRAMING)

    def own(self, device: Device) -> Heading:
        return Heading(device.line_rate)

    def measured(self, t: Nanos, message: bytes, host: Host[Heading]) -> Imu | Rx | None:
        packet = table.decode(message)
        return Rx.MALFORMED if packet is None else host.own.add(t, packet, host.name, host.options)

    def state(self, t: Nanos, host: Host[Heading]) -> tuple[str, tuple[int, ...]]:
        return host.own.text(), ()
