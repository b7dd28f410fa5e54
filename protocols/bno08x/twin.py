"""The device's end: a sensor's firmware, which streams its heading and what it measures of the world."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Annotated, Literal

from protocols.bno08x import table
from protocols.bno08x.table import Packet
from protocols.bounds import Bounds, check
from protocols.frames import Frame
from protocols.messages import SECOND, Event, Imu, Nanos, Obeyed, Torque
from protocols.plugin import Device


@dataclass(frozen=True, slots=True)
class Settings:
    """The sensor in simulation."""

    yaw: Literal["counter-clockwise", "clockwise"] = "counter-clockwise"
    start: Annotated[float, Bounds(-180.0, 180.0, "degrees")] = 0.0
    """Its heading when it is switched on"""

    def __post_init__(self) -> None:
        check(self)


class Bno08xDecoder:
    """What sensors obey: nothing, since they have no receive line in this mode."""

    def __init__(self, devices: Sequence[Device]) -> None:
        pass

    def decode(self, t: Nanos, frame: Frame) -> Sequence[Obeyed]:
        """Return nothing."""
        return ()


class Bno08xTwin:
    """One sensor."""

    def __init__(self, device: Device, seed: int) -> None:
        self.device = device
        self._seen: Imu | None = None
        """The newest measurement of the world,"""
        self._yaw = math.radians(device.settings.start)
        """rad, the integral of its rate about the vertical"""
        self._next: Nanos | None = None
        self._index = 0

    def receive(self, t: Nanos, frame: Frame) -> None:
        """Ignore it."""

    def due(self) -> Nanos | None:
        """Return when the next packet begins."""
        return self._next

    def provoke(self, code: int) -> None:
        """Raise ValueError: it reports no fault."""
        raise ValueError(f"no fault {code}: it has none")

    def step(self, now: Nanos, truth: Sequence[Event]) -> tuple[Sequence[Torque], Sequence[Frame]]:
        """Measure; send a packet when one begins."""
        for event in truth:
            if isinstance(event, Imu) and event.sensor == self.device.name and _is_finite(event):
                if self._seen is not None:
                    self._yaw += event.angular_velocity[2] * max(0, event.t - self._seen.t) / SECOND
                self._seen = event
        self._next = now if self._next is None else self._next
        if self._seen is None or now < self._next:
            return (), ()
        self._next += table.PERIOD * max(1, (now - self._next) // table.PERIOD + 1)
        return (), (self._packet(self._seen),)

    def _packet(self, seen: Imu) -> bytes:
        x, y, z = seen.linear_acceleration
        pitch, roll = math.atan2(-x, math.hypot(y, z)), math.atan2(y, z)
        sign = 1.0 if self.device.settings.yaw == "counter-clockwise" else -1.0
        yaw = math.remainder(sign * self._yaw, math.tau)
        angles = (round(math.degrees(each) * 100.0) for each in (yaw, pitch, roll))
        pushed = (max(table.ENDS[0], min(table.ENDS[1], round(each / table.MG))) for each in (x, y, z))
        self._index = (self._index + 1) % table.ROUND
        return table.encode(Packet(self._index, *angles, *pushed))


def _is_finite(event: Imu) -> bool:
    numbers = (*event.angular_velocity, *event.linear_acceleration)
    return all(math.isfinite(each) and abs(each) < 1e9 for each in numbers)
