"""What one host produces for all devices of a bus: SYNC, and its own heartbeat.

Rules. SYNC has one producer a bus: this host with `sync_ms`, another one with 0; all devices must agree. It
is sent while a device that this host commands needs it, at absolute times; a missed one is left out. Another
producer at that time is reported once, and stops nothing: which of the two is right, a person must decide.
The heartbeat feeds the watchdogs of all devices that monitor it at once: it is sent only in a step in which
each of them was commanded.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from protocols.canopen.services import Heartbeat, NmtState, Sync, encode
from protocols.cia402.drive_state import DriveState
from protocols.cia402.options import WATCHDOG_SHARE
from protocols.frames import CanFrame
from protocols.messages import MILLISECOND, Nanos
from protocols.plugin import Device

SECOND_PRODUCER = (
    "there is a second producer of SYNC (0x080): synchronous set-points take effect at two rates, and drives"
    " send twice as often. Stop it there (a drive produces SYNC with bit 30 of its object 1005), or leave"
    " SYNC to it and set sync_ms = 0 here"
)


def check_agreement(devices: Sequence[Device]) -> None:
    """Raise ValueError if the devices of a bus need a host that does two things at once."""
    synced = [device for device in devices if device.options.feedback == "sync"]
    errors = _differ("sync_ms", synced) + _differ("host_id", devices)
    taken = {device.address for device in devices}
    errors += [
        f"host_id {device.options.host_id} of {device.name} is the address of a device"
        for device in devices
        if device.options.watchdog_ms and device.options.host_id in taken
    ]
    if errors:
        raise ValueError("; ".join(errors))


def _differ(option: str, devices: Sequence[Device]) -> list[str]:
    values = [(device.name, getattr(device.options, option)) for device in devices]
    return [
        f"{option} must be the same for all drives of one bus: it is {values[0][1]} for {values[0][0]} and"
        f" {value} for {name}"
        for name, value in values
        if value != values[0][1]
    ][:1]


@dataclass(slots=True)
class HostProducer:
    """SYNC and heartbeat of this host on one bus. Plain data."""

    sync_period: Nanos
    """0: another host's SYNC, or none."""
    host_id: int
    sync_next: Nanos | None = None
    """When SYNC is due; None: not running."""
    sync_missed: bool = False
    """The last SYNC was sent without set-points."""
    heartbeat_next: Nanos | None = None
    second_producer_reported: bool = False

    def at_sync(self, now: Nanos) -> bool:
        """True if set-points that take effect with SYNC should be sent now."""
        return not self.sync_period or self.sync_next is None or now >= self.sync_next or self.sync_missed

    def sync(self, now: Nanos, drives: Sequence[DriveState], commanded: bool) -> list[CanFrame]:
        """Return SYNC, if it is due. `commanded`: set-points were sent in this step."""
        needed = any(d.owned and d.configured and d.options.feedback == "sync" for d in drives)
        if not self.sync_period or not needed:
            self.sync_next, self.sync_missed = None, False
            return []
        if self.sync_next is None:
            self.sync_next = now
        if now < self.sync_next:
            self.sync_missed = self.sync_missed and not commanded
            return []
        self.sync_next += (1 + (now - self.sync_next) // self.sync_period) * self.sync_period
        self.sync_missed = not commanded
        return [encode(Sync())]

    def heartbeat(self, now: Nanos, drives: Sequence[DriveState]) -> list[CanFrame]:
        """Return this host's heartbeat, if it is due and all that monitor it were commanded."""
        consumers = [drive for drive in drives if drive.monitors_host]
        if not consumers or any(drive.commanded_at != now for drive in consumers):
            return []
        if self.heartbeat_next is not None and now < self.heartbeat_next:
            return []
        shortest = min(drive.options.watchdog_ms for drive in consumers)
        self.heartbeat_next = now + shortest * MILLISECOND // WATCHDOG_SHARE
        return [encode(Heartbeat(self.host_id, NmtState.OPERATIONAL))]
