"""What one host produces for all devices of a bus: SYNC, and its own heartbeat.

Rules. SYNC has one producer a bus. It is sent while a device needs it, at absolute times; a missed one is
left out. Another producer at that time is reported once, and stops nothing: which of the two is right, a
person must decide. The heartbeat feeds the watchdogs of all devices that monitor it at once.
"""

from __future__ import annotations

from dataclasses import dataclass

from protocols.canopen.services import Heartbeat, NmtState, Sync, encode
from protocols.frames import CanFrame
from protocols.messages import Found, Nanos

BEATS = 4
"""Heartbeats of the host within a device's watchdog time."""
SECOND_PRODUCER = (
    "there is a second producer of SYNC (0x080): synchronous set-points take effect at two rates, and drives"
    " send twice as often. Stop it there (a drive produces SYNC with bit 30 of its object 1005), or leave"
    " SYNC to it and set sync_ms = 0 here"
)


@dataclass(slots=True)
class Master:
    """SYNC and heartbeat of this host on one bus. Plain data."""

    sync_period: Nanos
    """0: another host's SYNC, or none."""
    host_id: int
    sync_next: Nanos | None = None
    """When SYNC is due; None: it is not sent."""
    _missed: bool = False
    """The last SYNC was sent without set-points."""
    _beat_next: Nanos = 0
    _reported: bool = False
    """Another producer of SYNC was."""

    def at_sync(self, now: Nanos) -> bool:
        """True if set-points that take effect with SYNC should be sent now."""
        return not self.sync_period or self.sync_next is None or now >= self.sync_next or self._missed

    def sync(self, now: Nanos, *, needed: bool, commanded: bool) -> list[CanFrame]:
        """Return SYNC, if it is due. `commanded`: set-points were sent in this step."""
        if not self.sync_period or not needed:
            self.sync_next, self._missed = None, False
            return []
        due = now if self.sync_next is None else self.sync_next
        if now < due:
            self._missed = self._missed and not commanded
            return []
        self.sync_next = due + (1 + (now - due) // self.sync_period) * self.sync_period
        self._missed = not commanded
        return [encode(Sync())]

    def heartbeat(self, now: Nanos, watchdog: Nanos) -> list[CanFrame]:
        """Return this host's heartbeat, if it is due; `watchdog`: the shortest timeout of those that monitor
        it. To be called only in a step in which each of them was commanded."""
        if now < self._beat_next:
            return []
        self._beat_next = now + watchdog // BEATS
        return [encode(Heartbeat(self.host_id, NmtState.OPERATIONAL))]

    def on_sync(self, t: Nanos, protocol: str) -> list[Found] | None:
        """Handle a SYNC that was received: None if it is expected here, else what is to be reported."""
        if self.sync_next is None:
            return None
        reported, self._reported = self._reported, True
        return [] if reported else [Found(t, protocol, 0, None, SECOND_PRODUCER, duplicate_address=True)]

    def forget(self) -> None:
        """Forget what was reported: the bus was gone."""
        self._reported = False
