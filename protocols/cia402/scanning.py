"""Looking for devices on a bus: an upload of object 1000 from every node id, then of the identity of each
that answered. Nothing else is said, so nothing is enabled, cleared or changed.

Rules. Node ids of the robot file are not asked: their own client does that all the time. An answer counts
only while a scan runs, and only to what it asked.

Source: package canopen 2.4.1 `network.py` `NodeScanner.search`.
"""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import dataclass, field

from protocols.cia402 import objects as o
from protocols.cia402 import sdo
from protocols.cia402.codec import MAX_NODE, sdo_rx_id
from protocols.cia402.objects import Key
from protocols.frames import CanFrame
from protocols.messages import MILLISECOND, Nanos

BURST = 8
"""Node ids that are asked at once."""
BURST_EVERY = 10 * MILLISECOND
PATIENCE = 300 * MILLISECOND
"""For the last answers."""
IDENTITY: tuple[Key, ...] = (o.VENDOR_ID, o.PRODUCT_CODE, o.SERIAL_NUMBER)


@dataclass(slots=True)
class Scanner:
    """One scan. Plain data."""

    bus: str
    own: tuple[int, ...]
    next: Nanos
    at: int = 1
    """The node id that is asked next."""
    asked: dict[int, Nanos] = field(default_factory=dict)
    """When each node id was asked last."""
    found: dict[int, dict[Key, int | None]] = field(default_factory=dict)
    """What was asked of whom: None is not answered yet, -1 was refused."""
    ask: list[tuple[int, Key]] = field(default_factory=list)
    duplicate_address: set[int] = field(default_factory=set)
    ends: Nanos | None = None

    def say(self, now: Nanos) -> list[CanFrame]:
        """The next questions."""
        questions, self.ask = self.ask, []
        if now >= self.next and self.at <= MAX_NODE:
            ids = [n for n in range(self.at, MAX_NODE + 1) if n not in self.own][:BURST]
            questions += [(node, o.DEVICE_TYPE) for node in ids]
            self.at = ids[-1] + 1 if ids else MAX_NODE + 1
            self.next = now + BURST_EVERY
        if questions:
            self.ends = now + PATIENCE
        elif self.ends is None:
            self.ends = now
        self.asked |= {node: now for node, _ in questions}
        return [CanFrame(sdo_rx_id(node), sdo.encode(sdo.Upload(*key))) for node, key in questions]

    def handle(self, t: Nanos, node: int, answer: sdo.Answer) -> bool:
        """An answer of a node that nobody has in the robot file; False if it was not asked for."""
        late = t > self.asked.get(node, t - 2 * PATIENCE) + PATIENCE
        if late or not isinstance(answer, sdo.Uploaded | sdo.Abort):
            return False
        key = answer.index, answer.sub
        known = self.found.get(node)
        if known is None:
            if key != o.DEVICE_TYPE:
                return False
            known = self.found[node] = {}
        elif key == o.DEVICE_TYPE:
            self.duplicate_address.add(node)
            return True
        elif known.get(key, 0) is not None:
            return False
        known[key] = -1 if isinstance(answer, sdo.Abort) else int.from_bytes(answer.data, "little")
        missing = next((k for k in IDENTITY if k not in known), None)
        if missing is not None:
            known[missing] = None
            self.ask.append((node, missing))
        return True

    def over(self, now: Nanos) -> bool:
        """Whether all have been asked, and had time to answer."""
        return self.at > MAX_NODE and not self.ask and self.ends is not None and now >= self.ends

    def due(self) -> Nanos:
        """When it has something to do."""
        if self.ask:
            return 0
        return self.next if self.at <= MAX_NODE or self.ends is None else self.ends


def describe(known: dict[Key, int | None], own: Collection[str] = ()) -> tuple[int | None, str]:
    """(serial number, what a device is) from what it told."""

    def reported(key: Key) -> int | None:
        value = known.get(key)
        return None if value is None or value < 0 else value

    kind = reported(o.DEVICE_TYPE)
    profile = "unknown device profile" if kind is None else f"device profile {kind & 0xFFFF}"
    vendor, product = reported(o.VENDOR_ID), reported(o.PRODUCT_CODE)
    parts = [*own, profile]
    parts += [f"vendor {vendor:#x}"] if vendor is not None else []
    parts += [f"product {product:#x}"] if product is not None else []
    return reported(o.SERIAL_NUMBER) or None, ", ".join(parts)
