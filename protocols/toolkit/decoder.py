"""What devices would obey, for protocols with a table."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Generic, TypeVar

from protocols.frames import Frame
from protocols.messages import Nanos, Obeyed
from protocols.plugin import Device
from protocols.toolkit.table import Decoded, Table

Memory = TypeVar("Memory")


class TableDecoder(Generic[Memory]):
    """The command decoder of the devices on one bus.

    `memory`: what a device keeps of earlier messages, as it is when switched on; `obey`: what it does with a
    message to any address, given and updating its memory; `table`: that of a device."""

    def __init__(
        self,
        devices: Sequence[Device],
        table: Callable[[Device], Table],
        memory: Callable[[Device], Memory],
        obey: Callable[[Memory, Decoded], Sequence[Obeyed]],
    ) -> None:
        self._memories = [(table(device), memory(device)) for device in devices]
        self._obey = obey

    def decode(self, t: Nanos, frame: Frame) -> Sequence[Obeyed]:  # noqa: ARG002 -- the interface's
        """Return what the devices would obey in this frame; [] if nothing."""
        obeyed: list[Obeyed] = []
        for table, memory in self._memories:
            decoded = table.decode(frame, "to_device")
            if decoded is not None and decoded.name:
                obeyed += self._obey(memory, decoded)
        return obeyed
