"""What devices would obey, for protocols with a table."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Protocol

from protocols.frames import Frame
from protocols.messages import Command, Nanos, Obeyed
from protocols.toolkit.table import Decoded, Table


class Memory(Protocol):
    """What a device keeps of the frames it received. The twin's firmware runs on the very same object, so
    that decoder and twin cannot disagree."""

    def obey(self, decoded: Decoded) -> Sequence[Obeyed]:
        """Apply a message to any address; return what the device then does."""
        ...


class TableDecoder:
    """The command decoder of the devices on one bus: of each its table, its memory as it is when switched on,
    and the canonical form of its commands."""

    def __init__(self, devices: Sequence[tuple[Table, Memory, Callable[[Command], Command]]]) -> None:
        self._devices = devices

    def decode(self, t: Nanos, frame: Frame) -> Sequence[Obeyed]:
        """Return what the devices would obey in this frame; [] if nothing."""
        obeyed: list[Obeyed] = []
        for table, memory, canonical in self._devices:
            decoded = table.decode(frame, "to_device")
            if decoded is not None and decoded.name:
                does = memory.obey(decoded)
                obeyed += [canonical(each) if isinstance(each, Command) else each for each in does]
        return obeyed
