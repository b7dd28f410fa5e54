"""What one host does for all devices of a bus: SYNC, and its own heartbeat.

Rules. SYNC has one producer a bus: us with `sync_ms`, somebody else with 0; all devices must agree. It goes
while a device that we command needs it, at absolute times; a missed one is left out. Another producer at that
time is told of once, and stops nothing: which of the two is right, a person must say. The heartbeat feeds the
watchdogs of all devices that expect it at once: it goes only in a step in which each of them was commanded.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from protocols.cia402.codec import Heartbeat, NmtState, Sync, encode
from protocols.cia402.node import Node
from protocols.cia402.options import WATCHDOG_SHARE
from protocols.frames import CanFrame
from protocols.messages import MILLISECOND, Nanos
from protocols.plugin import Device

DISTURBED = (
    "SYNC, 0x080, comes from somebody else, too: synchronous set-points take effect at two beats, and drives"
    " answer twice as often. Stop it there (a drive says SYNC with bit 30 of its object 1005), or leave it to"
    " the other and set sync_ms = 0 here"
)


def agree(devices: Sequence[Device]) -> None:
    """ValueError if the devices of a bus need a host that does two things at once."""
    synced = [device for device in devices if device.options.feedback == "sync"]
    wrong = _differ("sync_ms", synced) + _differ("host_id", devices)
    taken = {device.address for device in devices}
    wrong += [
        f"host_id {device.options.host_id} of {device.name} is the address of a device"
        for device in devices
        if device.options.watchdog_ms and device.options.host_id in taken
    ]
    if wrong:
        raise ValueError("; ".join(wrong))


def _differ(option: str, devices: Sequence[Device]) -> list[str]:
    said = [(device.name, getattr(device.options, option)) for device in devices]
    return [
        f"{option} must be the same for all drives of one bus: it is {said[0][1]} for {said[0][0]} and"
        f" {value} for {name}"
        for name, value in said
        if value != said[0][1]
    ][:1]


@dataclass(slots=True)
class Pulse:
    """SYNC and heartbeat of one bus. Plain data."""

    period: Nanos
    """Of SYNC; 0: somebody else's, or nobody's."""
    host_id: int
    next: Nanos | None = None
    """When SYNC is due; None: not running."""
    missed: bool = False
    """The last SYNC went without set-points."""
    beat_next: Nanos | None = None
    disturbed: bool = False
    """That somebody else says SYNC, too, has been told."""

    def due_now(self, now: Nanos) -> bool:
        """Whether set-points that take effect with SYNC should go now."""
        return not self.period or self.next is None or now >= self.next or self.missed

    def sync(self, now: Nanos, nodes: Sequence[Node], steered: bool) -> list[CanFrame]:
        """SYNC, if it is due. `steered`: set-points went out in this step."""
        wanted = any(node.owned and node.configured and node.options.feedback == "sync" for node in nodes)
        if not self.period or not wanted:
            self.next, self.missed = None, False
            return []
        if self.next is None:
            self.next = now
        if now < self.next:
            self.missed = self.missed and not steered
            return []
        self.next += (1 + (now - self.next) // self.period) * self.period
        self.missed = not steered
        return [encode(Sync())]

    def beat(self, now: Nanos, nodes: Sequence[Node]) -> list[CanFrame]:
        """This host's heartbeat, if it is due and deserved."""
        fed = [node for node in nodes if node.watched]
        if not fed or any(node.commanded_at != now for node in fed):
            return []
        if self.beat_next is not None and now < self.beat_next:
            return []
        self.beat_next = now + min(node.options.watchdog_ms for node in fed) * MILLISECOND // WATCHDOG_SHARE
        return [encode(Heartbeat(self.host_id, NmtState.OPERATIONAL))]

    def due(self) -> Nanos | None:
        """When SYNC is due."""
        return self.next
