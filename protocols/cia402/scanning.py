"""Scan of a bus: an upload of object 1000 from every node id, then of the identity of each that responded.
Nothing else is sent, so nothing is enabled, cleared or changed.

Rules. Node ids of the robot file are not scanned: their own client polls them all the time. A response counts
only during a scan, and only to what the scan has requested.

Source: package canopen 2.4.1 `network.py` `NodeScanner.search`.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping
from dataclasses import dataclass, field

from protocols.canopen import sdo
from protocols.canopen.services import MAX_NODE, sdo_rx_id
from protocols.cia402 import objects as o
from protocols.cia402.objects import Key
from protocols.frames import CanFrame
from protocols.messages import MILLISECOND, Nanos

BURST = 8
"""Node ids requested at once."""
BURST_EVERY = 10 * MILLISECOND
PATIENCE = 300 * MILLISECOND
"""Time for the last responses."""
IDENTITY: tuple[Key, ...] = (o.VENDOR_ID, o.PRODUCT_CODE, o.SERIAL_NUMBER)


@dataclass(slots=True)
class Scanner:
    """One scan. Plain data."""

    bus: str
    own: tuple[int, ...]
    """Node ids that are not scanned."""
    next: Nanos
    at: int = 1
    """The next node id."""
    requested_at: dict[int, Nanos] = field(default_factory=dict)
    """By node id."""
    found: dict[int, dict[Key, int | None]] = field(default_factory=dict)
    """The objects requested of each node: None without a response yet, -1 if refused."""
    pending: list[tuple[int, Key]] = field(default_factory=list)
    """The uploads to be requested next."""
    duplicates: set[int] = field(default_factory=set)
    ends: Nanos | None = None

    def send(self, now: Nanos) -> list[CanFrame]:
        """Return the next requests."""
        requests, self.pending = self.pending, []
        if now >= self.next and self.at <= MAX_NODE:
            ids = [n for n in range(self.at, MAX_NODE + 1) if n not in self.own][:BURST]
            requests += [(node, o.DEVICE_TYPE) for node in ids]
            self.at = ids[-1] + 1 if ids else MAX_NODE + 1
            self.next = now + BURST_EVERY
        if requests:
            self.ends = now + PATIENCE
        elif self.ends is None:
            self.ends = now
        self.requested_at |= {node: now for node, _ in requests}
        return [CanFrame(sdo_rx_id(node), sdo.encode(sdo.Upload(*key))) for node, key in requests]

    def receive(self, t: Nanos, node: int, response: sdo.Response) -> bool:
        """Handle a response of a node that is not in the robot file; return False if it was not requested."""
        late = t > self.requested_at.get(node, t - 2 * PATIENCE) + PATIENCE
        if late or not isinstance(response, sdo.Uploaded | sdo.Abort):
            return False
        key = response.index, response.sub
        known = self.found.get(node)
        if known is None:
            if key != o.DEVICE_TYPE:
                return False
            known = self.found[node] = {}
        elif key == o.DEVICE_TYPE:
            self.duplicates.add(node)
            return True
        elif known.get(key, 0) is not None:
            return False
        known[key] = -1 if isinstance(response, sdo.Abort) else int.from_bytes(response.data, "little")
        missing = next((k for k in IDENTITY if k not in known), None)
        if missing is not None:
            known[missing] = None
            self.pending.append((node, missing))
        return True

    def over(self, now: Nanos) -> bool:
        """True if all node ids were requested, and had time to respond."""
        return self.at > MAX_NODE and not self.pending and self.ends is not None and now >= self.ends

    def due(self) -> Nanos:
        """Return when it has something to do."""
        if self.pending:
            return 0
        return self.next if self.at <= MAX_NODE or self.ends is None else self.ends


def describe(known: Mapping[Key, int | None], own: Collection[str] = ()) -> tuple[int | None, str]:
    """Return (serial number, description) of a device, from the objects that were read."""

    def value(key: Key) -> int | None:
        found = known.get(key)
        return None if found is None or found < 0 else found

    kind = value(o.DEVICE_TYPE)
    profile = "unknown device profile" if kind is None else f"device profile {kind & 0xFFFF}"
    vendor, product = value(o.VENDOR_ID), value(o.PRODUCT_CODE)
    parts = [*own, profile]
    parts += [f"vendor {vendor:#x}"] if vendor is not None else []
    parts += [f"product {product:#x}"] if product is not None else []
    return value(o.SERIAL_NUMBER) or None, ", ".join(parts)
