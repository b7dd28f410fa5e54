"""What we want an object of the device to be → RPDOs, and SDO for what stands in none.

Rules. Plain data. An RPDO goes out whole: every object in it has a number of ours. It is sent when it holds
what moves the motor now, when a value in it has changed, and again every REFRESH. What stands in no RPDO is
written by SDO when it changes: offsets and target, then the mode, then the controlword, so that a drive is
never enabled with an old set-point.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

from protocols.cia402 import objects as o
from protocols.cia402.mapping import Pdo
from protocols.cia402.objects import Key
from protocols.cia402.pdo import Packing, is_synchronous, packing
from protocols.cia402.setpoint import Values
from protocols.frames import CanFrame
from protocols.messages import MILLISECOND, Nanos

REFRESH = 100 * MILLISECOND
"""An RPDO whose values stay the same is sent again so often, in case one was lost."""
REWRITE = 20 * MILLISECOND
"""What moves the motor is written by SDO again so often, whether it has changed or not."""
OFFSETS = (o.VELOCITY_OFFSET, o.TORQUE_OFFSET)


@dataclass(slots=True)
class _Way:
    """One RPDO, made ready."""

    id: int
    keys: tuple[Key, ...]
    packing: Packing
    data: bytes = b""
    sent_at: Nanos = 0


@dataclass(slots=True)
class SetpointWriter:
    """Where a device's set-points go."""

    ways: list[_Way] = field(default_factory=list)
    mapped: frozenset[Key] = frozenset()
    synchronous: bool = False
    """Set-points take effect with SYNC: one round of RPDOs for each."""
    reported: Values = field(default_factory=dict)
    """What was last written by SDO, and confirmed."""
    reported_at: dict[Key, Nanos] = field(default_factory=dict)

    def configure(self, pdos: Sequence[Pdo]) -> None:
        """Use these PDOs to the device from now on. The one with the controlword goes last."""
        ordered = sorted(pdos, key=lambda pdo: (o.CONTROLWORD in pdo.keys, pdo.number))
        self.ways = [_Way(pdo.id, pdo.keys, packing(pdo.entries)) for pdo in ordered]
        self.mapped = frozenset(key for way in self.ways for key in way.keys)
        self.synchronous = any(is_synchronous(pdo.transmission) for pdo in pdos)

    def frames(self, now: Nanos, values: Values, moving: Key) -> list[CanFrame]:
        """The RPDOs to be sent now; `moving`: the object that moves the motor, or commands its state."""
        frames = []
        for way in self.ways:
            data = way.packing.pack([values.get(key, 0) for key in way.keys])
            if data != way.data or moving in way.keys or now >= way.sent_at + REFRESH:
                way.data, way.sent_at = data, now
                frames.append(CanFrame(way.id, data))
        return frames

    def by_sdo(self, now: Nanos, values: Values, target: Key) -> tuple[Key, int] | None:
        """What is next to be written by SDO; None if everything stands in RPDOs or is there already."""
        for key in (*OFFSETS, target, o.MODE, o.CONTROLWORD):
            if key in values and key not in self.mapped:
                old = key == target and now >= self.reported_at.get(key, now) + REWRITE
                if old or self.reported.get(key) != values[key]:
                    return key, values[key]
        return None

    def confirm(self, now: Nanos, key: Key, value: int) -> None:
        """The device has taken a value by SDO."""
        self.reported[key], self.reported_at[key] = value, now

    def forget(self) -> None:
        """Nothing is known of what the device has taken."""
        self.reported.clear()
        for way in self.ways:
            way.data = b""
