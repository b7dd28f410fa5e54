"""One wire in virtual time: who waits to send, who sends next, when it has arrived.

Rules. One wire at a time, each as long as it takes (`timing`). A sender's wires go out in the order in
which it gave them; CAN FD data fill a length that there is, as they must on a real bus. Of the senders that
wait when a CAN bus falls free the highest priority wins; on a serial line the first come is first. No errors,
no acknowledgement: every wire arrives.
"""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass

from gateway.buses.frame_time import frame_time, priority
from gateway.buses.lengths import padded
from protocols.frames import CanFrame, Frame
from protocols.messages import Nanos


@dataclass(frozen=True, slots=True)
class Sent:
    """A wire and who sent it; `t` is when it was given or, once it has arrived, when it ended."""

    t: Nanos
    sender: str
    frame: Frame


class Line:
    """A CAN bus, or one direction of a serial line."""

    def __init__(self, bitrate: int, data_bitrate: int = 0, limit: int = 256) -> None:
        self.bitrate, self.data_bitrate = bitrate, data_bitrate
        self.limit = limit
        """How many wires of one sender may wait."""
        self._waiting: dict[str, deque[Sent]] = {}
        self.pending = 0
        """How many wires wait or are on their way."""
        self._free: Nanos | None = None

    def send(self, t: Nanos, sender: str, frame: Frame) -> bool:
        """Queue a wire. False if the sender's queue was full, and its oldest wire was dropped for it."""
        queue = self._waiting.setdefault(sender, deque())
        full = len(queue) >= self.limit
        if full:
            queue.popleft()
        queue.append(Sent(t, sender, padded(frame) if isinstance(frame, CanFrame) and frame.fd else frame))
        self.pending += not full
        return not full

    def waiting(self, sender: str) -> int:
        """How many wires of a sender have not begun."""
        return len(self._waiting.get(sender, ()))

    def clear(self) -> None:
        """Drop all that waits."""
        self._waiting.clear()
        self.pending = 0

    def run(self, until: Nanos) -> list[Sent]:
        """All that has arrived up to a time, in order."""
        arrived: list[Sent] = []
        while self.pending:
            first = min(queue[0].t for queue in self._waiting.values() if queue)
            start = first if self._free is None else max(first, self._free)
            if start > until:
                break
            heads = [queue[0] for queue in self._waiting.values() if queue and queue[0].t <= start]
            best = min(heads, key=lambda head: (priority(head.frame), head.t))
            end = start + frame_time(best.frame, self.bitrate, self.data_bitrate)
            if end > until:
                break
            self._waiting[best.sender].popleft()
            self.pending -= 1
            self._free = end
            arrived.append(Sent(end, best.sender, best.frame))
        return arrived
