"""Framing: a payload and its address ↔ a CAN frame. No state.

Rules. A frame that is not ours is ignored, one of ours with a wrong length is malformed; each is counted
once.

FILL IN the identifiers and lengths from the manual. The clauses "declared", "counts" and "foreign" check
them. The invented device takes frames with the id 0x100 + address, and sends them with 0x200 + address.
"""

from __future__ import annotations

from collections.abc import Collection
from typing import Literal

from protocols.frames import CanFrame, Frame, IdMask, exact
from protocols.plugin import RxCounters

from .codec import SIZE

BUS: Literal["can", "canfd", "serial"] = "can"
FD = False
"""Its frames are CAN FD (with bit-rate switch)."""
COMMAND, STATUS = 0x100, 0x200
"""CAN ids from the host and from the device, less the address."""
MAX_ADDRESS = 0x3F


def ids(kind: int, address: int) -> tuple[IdMask, ...]:
    """Return the CAN ids of this kind (COMMAND or STATUS) at this address."""
    return (exact(kind + address),)


def make_frame(kind: int, address: int, payload: bytes) -> Frame:
    """Return the frame of a payload to or from an address."""
    return CanFrame(kind + address, payload, fd=FD, brs=FD)


class Reader:
    """Extracts (address, payload) from frames; counts those that are ignored or malformed."""

    def __init__(self, kind: int, addresses: Collection[int], counters: RxCounters | None = None) -> None:
        self._addresses = {kind + address: address for address in addresses}
        self.counters = counters or RxCounters()

    def read(self, frame: Frame) -> list[tuple[int, bytes]]:
        """Return the payload in this frame, if it is for one of these addresses and of the right length."""
        ours = isinstance(frame, CanFrame) and not frame.extended and not frame.remote and frame.fd is FD
        if not isinstance(frame, CanFrame) or not ours or frame.id not in self._addresses:
            self.counters.ignored += 1
            return []
        if len(frame.data) != SIZE:
            self.counters.malformed += 1
            return []
        return [(self._addresses[frame.id], frame.data)]

    def drop(self) -> None:
        """Discard a partial message: there is none, a frame arrives whole."""
