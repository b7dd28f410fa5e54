"""Set-points of one device → RPDOs, and SDO downloads for the objects that are in none.

Rules. Plain data. An RPDO is sent whole: the driver has a value for every object in it. It is sent if it
contains the object that moves the motor, when a value in it has changed, and again every REFRESH. An object
in no RPDO is written by SDO when it changes: offsets and target, then the mode, then the controlword, so that
a drive is never enabled with an old set-point.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

from protocols.canopen.pdo import Packing, is_synchronous, packing
from protocols.cia402 import objects as o
from protocols.cia402.mapping import Pdo
from protocols.cia402.objects import OBJECTS, Key
from protocols.cia402.setpoint import Values
from protocols.frames import CanFrame
from protocols.messages import MILLISECOND, Nanos

REFRESH = 100 * MILLISECOND
"""Period at which an unchanged RPDO is repeated, in case one was lost."""
REWRITE = 20 * MILLISECOND
"""Period at which the target is repeated by SDO, changed or not."""
OFFSETS = (o.VELOCITY_OFFSET, o.TORQUE_OFFSET)


@dataclass(slots=True)
class _Rpdo:
    id: int
    keys: tuple[Key, ...]
    packing: Packing
    data: bytes = b""
    sent_at: Nanos = 0


@dataclass(slots=True)
class SetpointWriter:
    """How the set-points of one device are sent."""

    rpdos: list[_Rpdo] = field(default_factory=list)
    mapped: frozenset[Key] = frozenset()
    """The objects in RPDOs."""
    synchronous: bool = False
    """Set-points take effect with SYNC: one set of RPDOs for each."""
    written: Values = field(default_factory=dict)
    """The values last written by SDO, and confirmed."""
    written_at: dict[Key, Nanos] = field(default_factory=dict)

    def configure(self, pdos: Sequence[Pdo]) -> None:
        """Use these RPDOs from now on. The one with the controlword is sent last."""
        ordered = sorted(pdos, key=lambda pdo: (o.CONTROLWORD in pdo.keys, pdo.number))
        self.rpdos = [_Rpdo(pdo.id, pdo.keys, packing(OBJECTS, pdo.entries)) for pdo in ordered]
        self.mapped = frozenset(key for rpdo in self.rpdos for key in rpdo.keys)
        self.synchronous = any(is_synchronous(pdo.transmission) for pdo in pdos)

    def frames(self, now: Nanos, values: Values, moving: Key) -> list[CanFrame]:
        """Return the RPDOs to be sent now; `moving`: the object that moves the motor, or commands its
        state."""
        frames = []
        for rpdo in self.rpdos:
            data = rpdo.packing.pack([values.get(key, 0) for key in rpdo.keys])
            if data != rpdo.data or moving in rpdo.keys or now >= rpdo.sent_at + REFRESH:
                rpdo.data, rpdo.sent_at = data, now
                frames.append(CanFrame(rpdo.id, data))
        return frames

    def next_download(self, now: Nanos, values: Values, target: Key) -> tuple[Key, int] | None:
        """Return what is to be written by SDO next; None if everything is in RPDOs, or written already."""
        for key in (*OFFSETS, target, o.MODE, o.CONTROLWORD):
            if key in values and key not in self.mapped:
                repeat = key == target and now >= self.written_at.get(key, now) + REWRITE
                if repeat or self.written.get(key) != values[key]:
                    return key, values[key]
        return None

    def confirm(self, now: Nanos, key: Key, value: int) -> None:
        """Note that the device has accepted a value by SDO."""
        self.written[key], self.written_at[key] = value, now

    def forget(self) -> None:
        """Send everything again: what the device has received is unknown."""
        self.written.clear()
        for rpdo in self.rpdos:
            rpdo.data = b""
