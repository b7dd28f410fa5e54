"""A shared medium in virtual time: arbitration among the senders, transmission time, arrival.

Rules. One frame at a time, each for its duration (`frame_time`). A sender's frames go out in the order given;
CAN FD data is padded to a valid length, as on a real bus. Of the senders that wait when a CAN bus becomes
idle the highest priority wins; on a serial line the first come is first. No errors, no acknowledgement: every
frame arrives.
"""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass

from gateway.buses.frame_time import frame_time, padded, priority
from protocols.frames import CanFrame, Frame
from protocols.messages import Nanos


@dataclass(frozen=True, slots=True)
class Transmission:
    """A frame and its sender; `t` is when it was queued or, once it has arrived, when it ended."""

    t: Nanos
    sender: str
    frame: Frame


class Medium:
    """A CAN bus, or one direction of a serial line."""

    def __init__(self, bitrate: int, data_bitrate: int = 0, limit: int = 256) -> None:
        self.bitrate, self.data_bitrate = bitrate, data_bitrate
        self.limit = limit
        """Frames of one sender that may wait."""
        self._waiting: dict[str, deque[Transmission]] = {}
        self.pending = 0
        """Frames that have not arrived yet."""
        self._idle_at: Nanos | None = None

    def send(self, t: Nanos, sender: str, frame: Frame) -> bool:
        """Queue a frame. False if the sender's queue was full and its oldest frame was dropped instead."""
        queue = self._waiting.setdefault(sender, deque())
        full = len(queue) >= self.limit
        if full:
            queue.popleft()
        if isinstance(frame, CanFrame):
            frame = padded(frame)
        queue.append(Transmission(t, sender, frame))
        self.pending += not full
        return not full

    def waiting(self, sender: str) -> int:
        """Return how many frames of a sender have not arrived."""
        return len(self._waiting.get(sender, ()))

    def clear(self) -> None:
        """Drop all that waits."""
        self._waiting.clear()
        self.pending = 0

    def run(self, until: Nanos) -> list[Transmission]:
        """Return all that arrives up to a time, in order."""
        arrived: list[Transmission] = []
        while self.pending:
            first = min(queue[0].t for queue in self._waiting.values() if queue)
            start = first if self._idle_at is None else max(first, self._idle_at)
            if start > until:
                break
            heads = [queue[0] for queue in self._waiting.values() if queue and queue[0].t <= start]
            winner = min(heads, key=lambda head: (priority(head.frame), head.t))
            end = start + frame_time(winner.frame, self.bitrate, self.data_bitrate)
            if end > until:
                break
            self._waiting[winner.sender].popleft()
            self.pending -= 1
            self._idle_at = end
            arrived.append(Transmission(end, winner.sender, winner.frame))
        return arrived
