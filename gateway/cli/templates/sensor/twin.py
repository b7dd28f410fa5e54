"""The device's end: its firmware, which streams what it measures of the world."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

from protocols.frames import Frame
from protocols.messages import Event, Imu, Nanos, Obeyed, Torque
from protocols.plugin import Device

from . import table
from .table import Packet


@dataclass(frozen=True, slots=True)
class Settings:
    """What is configured on the device itself. FILL IN: its rate, its ranges, what it sends."""


class StreamDecoder:
    """What the devices obey. FILL IN (clause "obeyed"): here nothing, since it has no receive line."""

    def __init__(self, devices: Sequence[Device]) -> None:
        pass

    def decode(self, t: Nanos, frame: Frame) -> Sequence[Obeyed]:
        """Return nothing."""
        return ()


class StreamTwin:
    """One device."""

    def __init__(self, device: Device, seed: int) -> None:
        self.device = device
        self._seen: Imu | None = None
        """The newest measurement of the world"""
        self._next: Nanos | None = None
        self._number = 0

    def receive(self, t: Nanos, frame: Frame) -> None:
        """Ignore it."""

    def due(self) -> Nanos | None:
        """Return when the next packet begins."""
        return self._next

    def provoke(self, code: int) -> None:
        """Raise ValueError: it reports no fault. FILL IN (clause "faults"): trip it, if it has any."""
        raise ValueError(f"no fault {code}: it has none")

    def step(self, now: Nanos, truth: Sequence[Event]) -> tuple[Sequence[Torque], Sequence[Frame]]:
        """Measure; send a packet when one begins."""
        for event in truth:
            if isinstance(event, Imu) and event.sensor == self.device.name:
                self._seen = event
        self._next = now if self._next is None else self._next
        if self._seen is None or now < self._next:
            return (), ()
        self._next += table.PERIOD * ((now - self._next) // table.PERIOD + 1)
        return (), (self._packet(self._seen),)

    def _packet(self, seen: Imu) -> bytes:
        self._number = (self._number + 1) % 256
        rates = _counts(seen.angular_velocity, table.RATE_UNIT)
        return table.encode(Packet(self._number, rates, _counts(seen.linear_acceleration, table.PUSH_UNIT)))


def _counts(values: Sequence[float], unit: float) -> tuple[int, int, int]:
    """Return numbers in counts, limited to their scale; what is not finite stands at its end."""
    low, high = table.ENDS
    x, y, z = (
        max(low, min(high, round(each / unit))) if math.isfinite(each / unit) else high for each in values
    )
    return x, y, z
