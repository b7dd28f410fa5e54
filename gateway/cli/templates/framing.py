"""How a message stands on the wire: its payload and its address ↔ a CAN frame. No state.

Rules. What is not for us is foreign, what is for us and no message is bad; each wire is counted once.

FILL IN the identifiers and lengths from the manual. The clauses "declared", "counts" and "strangers" tell.
The invented device takes frames with the id 0x100 + address, and sends them with 0x200 + address.
"""

from __future__ import annotations

from collections.abc import Collection
from typing import Literal

from protocols.frames import CanFrame, Frame
from protocols.plugin import RxCounters

from .codec import SIZE

BUS: Literal["can", "canfd", "serial"] = "can"
FD = False
"""Whether its frames are CAN FD (with bit-rate switch)."""
COMMAND, STATUS = 0x100, 0x200
"""CAN ids from the host and from the device, less the address."""
MAX_ADDRESS = 0x3F


def ids(kind: int, address: int) -> frozenset[int]:
    """The CAN ids of this kind (COMMAND or STATUS) at this address."""
    return frozenset({kind + address})


def message(kind: int, address: int, payload: bytes) -> Frame:
    """A payload on its way to or from an address."""
    return CanFrame(kind + address, payload, fd=FD, brs=FD)


class Reader:
    """Takes wires apart into (address, payload), and counts the others: not for us, or spoilt."""

    def __init__(self, kind: int, addresses: Collection[int], counters: RxCounters | None = None) -> None:
        self._addresses = {kind + address: address for address in addresses}
        self.counters = counters or RxCounters()

    def read(self, frame: Frame) -> list[tuple[int, bytes]]:
        """What is in this wire for these addresses, of the right length."""
        ours = isinstance(frame, CanFrame) and not frame.extended and not frame.remote and frame.fd is FD
        if not isinstance(frame, CanFrame) or not ours or frame.id not in self._addresses:
            self.counters.ignored += 1
            return []
        if len(frame.data) != SIZE:
            self.counters.malformed += 1
            return []
        return [(self._addresses[frame.id], frame.data)]

    def drop(self) -> None:
        """Forget a message begun, since its rest will not come: a frame comes whole."""
