"""The host's end: it listens. A sensor streams as it is configured, by the vendor's tool.

Rules. The packets of one cycle come one after the other, by type; a reading is made of those of one cycle,
when that with its orientation, or else its angular rates, has come: also where the former is not sent. It was
measured when the first of them began. What stands at the end of its scale may as well be beyond: a cycle with
such a number is no reading.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field

from protocols.messages import SECOND, Imu, Nanos
from protocols.plugin import Device
from protocols.toolkit.host import Host
from protocols.toolkit.sensors import SensorAdapter
from protocols.witmotion import table as wit
from protocols.witmotion.options import Options

LAST = {"angle": wit.ANGLE, "quaternion": wit.QUATERNION, "none": wit.ANGULAR_RATE}
"""The packet with which a reading is complete"""
LACKS = 2
"""Cycles in a row without it, by which it is not sent"""
Quaternion = tuple[float, float, float, float]


@dataclass(slots=True)
class Cycle:
    """The packets of the present cycle. Plain data."""

    line_rate: int
    words: dict[int, tuple[int, ...]] = field(default_factory=dict)
    """By type"""
    lacking: int = 0
    """Cycles in a row, up to `LACKS`, that had no packet with the orientation"""
    clipped: int = 0
    """Cycles at the end of a scale, since the start"""

    def forget(self) -> None:
        """Begin anew."""
        self.words = {}

    def add(self, t: Nanos, kind: int, words: tuple[int, ...], sensor: str, options: Options) -> Imu | None:
        """Take a packet that came at t; return the reading that it completes."""
        last = LAST[options.orientation]
        if self.words and kind <= max(self.words):
            self.lacking = 0 if last in self.words else min(self.lacking + 1, LACKS)
            self.words = {}
        self.words[kind] = words
        complete = kind == (wit.ANGULAR_RATE if self.lacking == LACKS else last)
        if not complete or not {wit.ACCELERATION, wit.ANGULAR_RATE} <= self.words.keys():
            return None
        pushed, turning = self.words[wit.ACCELERATION][:3], self.words[wit.ANGULAR_RATE][:3]
        if any(each in wit.ENDS for each in (*pushed, *turning)):
            self.clipped += 1
            return None
        size = wit.PACKET_BYTES * len(self.words)
        began = t - (10 * size * SECOND // self.line_rate if self.line_rate else 0)
        rates, accelerations = _scaled(turning, wit.RATE_MOST), _scaled(pushed, wit.G_MOST)
        return Imu(sensor, began, rates, accelerations, self._orientation(options))

    def _orientation(self, options: Options) -> Quaternion | None:
        if self.lacking == LACKS:
            return None
        if options.orientation == "angle":
            return _of_angles(*_scaled(self.words[wit.ANGLE], wit.ANGLE_MOST))
        if options.orientation == "quaternion":
            w, x, y, z = self.words[wit.QUATERNION]
            length = math.sqrt(w * w + x * x + y * y + z * z)
            return None if not length else (x / length, y / length, z / length, w / length)
        return None


def _scaled(words: Sequence[int], most: float) -> tuple[float, float, float]:
    x, y, z = (word * most / wit.FULL for word in words[:3])
    return x, y, z


def _of_angles(roll: float, pitch: float, yaw: float) -> Quaternion:
    """Return x, y, z, w of Rz(yaw) Ry(pitch) Rx(roll)."""
    (cr, sr), (cp, sp), (cy, sy) = ((math.cos(each / 2), math.sin(each / 2)) for each in (roll, pitch, yaw))
    return (
        sr * cp * cy - cr * sp * sy + 0.0,
        cr * sp * cy + sr * cp * sy + 0.0,
        cr * cp * sy - sr * sp * cy + 0.0,
        cr * cp * cy + sr * sp * sy + 0.0,
    )


class WitmotionAdapter(SensorAdapter[Cycle]):
    """What sensors report."""

    name = wit.NAME

    def __init__(self) -> None:
        super().__init__(wit.PACKETS)

    def own(self, device: Device) -> Cycle:
        return Cycle(device.line_rate)

    def measured(self, t: Nanos, message: bytes, host: Host[Cycle]) -> Imu | None:
        return host.own.add(t, message[1], wit.words_of(message), host.name, host.options)

    def state(self, t: Nanos, host: Host[Cycle]) -> tuple[str, tuple[int, ...]]:
        own = host.own
        detail = f"{own.clipped} readings at the end of a scale" if own.clipped else "streams"
        if own.lacking == LACKS:
            detail += f", no packet {LAST[host.options.orientation]:02X}: no orientation"
        return detail, ()
