"""A device's clock in our time: by the message that took least to come, since what is late is late by the
machine."""

from __future__ import annotations

from dataclasses import dataclass

from protocols.messages import MILLISECOND, SECOND, Nanos

DRIFT = 500
"""ns by which the device's clock may run slow in a ms"""
PAUSE: Nanos = 5 * SECOND
"""Silence after which its clock is not compared with what it was,"""
JUMP: Nanos = SECOND
"""and by how much it then may differ from ours, since what it sends may come late"""


@dataclass(slots=True)
class DeviceClock:
    """The clock of one device. Plain data."""

    around: Nanos
    """Time after which its stamps begin anew"""
    stamp: Nanos | None = None
    elapsed: Nanos = 0
    """By its clock"""
    offset: Nanos = 0
    """Ours minus its"""
    at: Nanos = 0
    """When the last message came"""

    def forget(self) -> None:
        """Begin anew."""
        self.stamp, self.elapsed, self.offset, self.at = None, 0, 0, 0

    def since(self, t: Nanos, stamp: Nanos) -> Nanos | None:
        """Return the time since the last message, by its clock; None if that was set anew, as by a restart,
        or it has been silent for long."""
        if self.stamp is None or t - self.at > PAUSE:
            return None
        since = (stamp - self.stamp) % self.around
        return since if abs(since - (t - self.at)) < JUMP else None

    def read(self, t: Nanos, stamp: Nanos) -> Nanos:
        """Return when a message was made that came at t; never later than that."""
        since = self.since(t, stamp)
        self.elapsed += since or 0
        offset = t - self.elapsed
        self.offset = offset if since is None else min(offset, self.offset + since // MILLISECOND * DRIFT)
        self.stamp, self.at = stamp, t
        return self.elapsed + self.offset
