"""Scan of a bus: an upload of object 1000 from every node id, then of the identity of each that responded.
Nothing else is sent, so nothing is enabled, cleared or changed.

Source: package canopen 2.4.1 `network.py` `NodeScanner.search`.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping
from dataclasses import dataclass, field

from protocols.canopen import objects as o
from protocols.canopen import sdo
from protocols.canopen.objects import Key
from protocols.canopen.services import MAX_NODE, sdo_rx_id
from protocols.frames import CanFrame
from protocols.messages import MILLISECOND

BURST = 8
"""Node ids requested at once."""
PERIOD = 10 * MILLISECOND
"""Between bursts."""
DURATION = (MAX_NODE // BURST + 1) * PERIOD + 400 * MILLISECOND
"""Of a scan, with time for the last responses."""
IDENTITY: tuple[Key, ...] = (o.DEVICE_TYPE, o.VENDOR_ID, o.PRODUCT_CODE, o.SERIAL_NUMBER)


@dataclass(slots=True)
class NodeScan:
    """One scan. Plain data."""

    skipped: Collection[int]
    """Node ids that are not scanned: their own client polls them."""
    found: dict[int, dict[Key, int]] = field(default_factory=dict)
    """The objects that each node has."""
    serials: dict[int, list[int]] = field(default_factory=dict)
    """The serial numbers that respond for each node."""
    _at: int = 1
    """The next node id."""
    _asked: dict[int, Key] = field(default_factory=dict)
    """What each node is asked for now."""
    _next: list[tuple[int, Key]] = field(default_factory=list)

    def frames(self) -> list[CanFrame]:
        """Return the next requests: once every PERIOD."""
        burst = [node for node in range(self._at, MAX_NODE + 1) if node not in self.skipped][:BURST]
        self._at = burst[-1] + 1 if burst else MAX_NODE + 1
        requests = [*self._next, *((node, IDENTITY[0]) for node in burst)]
        self._asked |= dict(requests)
        self._next = []
        return [CanFrame(sdo_rx_id(node), sdo.encode(sdo.Upload(*key))) for node, key in requests]

    def receive(self, node: int, response: sdo.Response | None) -> bool:
        """Record a response of a node; return False if it is not to what it was asked for."""
        if not isinstance(response, sdo.Uploaded | sdo.Abort):
            return False
        key = response.index, response.sub
        if self._asked.get(node) != key:
            return False
        known = self.found.setdefault(node, {})
        value = int.from_bytes(response.data, "little") if isinstance(response, sdo.Uploaded) else -1
        if key == o.SERIAL_NUMBER and value > 0 and value not in self.serials.get(node, ()):
            self.serials.setdefault(node, []).append(value)
        if key not in known:
            known[key] = value
            if len(known) < len(IDENTITY):
                self._next.append((node, IDENTITY[len(known)]))
        return True


def describe(known: Mapping[Key, int]) -> str:
    """Describe a device by the objects of IDENTITY that it has (-1: not)."""
    names = ((o.VENDOR_ID, "vendor"), (o.PRODUCT_CODE, "product"))
    parts = [f"{name} {known[key]:#x}" for key, name in names if known.get(key, -1) >= 0]
    kind = known.get(o.DEVICE_TYPE, -1)
    return ", ".join([f"device profile {kind & 0xFFFF}" if kind >= 0 else "unknown device profile", *parts])
