"""A shared medium in virtual time: arbitration among the senders, transmission time, errors, arrival.

Rules. One frame at a time, each for its duration, bit by bit (`frame_time`). It arrives when it ends; the
interframe space follows. A sender's frames go out in the order given; CAN FD data is padded to a valid
length, as on a real bus. Of the senders that wait when a CAN bus becomes idle the highest priority wins; on a
serial line the first come is first. A frame that `destroyed` hits is followed by an error frame and sent
again; its sender counts as ISO 11898-1:2015, 12.1.4 has it: 8 up at an error, 1 down at a success,
error-passive from 128 on, bus-off from 256 on. Acknowledgement is not simulated.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable

from gateway.buses.frame_time import INTERFRAME_BITS, frame_time, padded, priority
from protocols.frames import CanFrame, Frame
from protocols.messages import SECOND, Nanos, value

QUEUE_DEPTH = 256
"""Frames of one sender that may wait."""
ERROR_FRAME_BITS = 12 + 8 + INTERFRAME_BITS
"""Flags of sender and receivers one after the other, delimiter, interframe space."""
ERROR_PASSIVE, BUS_OFF = 128, 256
"""Values of a transmit error counter."""


@value
class Transmission:
    """A frame and its sender; `t` is when it was queued or, once it has arrived, when it ended."""

    t: Nanos
    sender: str
    frame: Frame


class Medium:
    """A CAN bus, or one direction of a serial line."""

    def __init__(self, bitrate: int, data_bitrate: int = 0, limit: int = QUEUE_DEPTH) -> None:
        self.bitrate, self.data_bitrate = bitrate, data_bitrate
        self.limit = limit
        """Frames of one sender that may wait."""
        self.destroyed: Callable[[Transmission], int] | None = None
        """From a CAN frame that is being sent: after how many bits an error destroys it; 0 if none does."""
        self.errors: dict[str, int] = {}
        """Transmit error counters, by sender; `BUS_OFF` until `drop`."""
        self.busy: Nanos = 0
        """Time during which the medium was not idle."""
        self._waiting: dict[str, deque[Transmission]] = {}
        self.pending = 0
        """Frames that have not arrived yet."""
        self._idle_at: Nanos | None = None
        self.nothing_before: Nanos = 0
        """Nothing arrives before, unless something is queued or dropped."""

    def send(self, t: Nanos, sender: str, frame: Frame) -> bool:
        """Queue a frame. False if the sender's queue was full and its oldest frame was dropped instead.

        A sender in bus-off sends nothing."""
        queue = self._waiting.get(sender)
        if queue is None:
            queue = self._waiting[sender] = deque()
        if self.errors and self.errors.get(sender, 0) >= BUS_OFF:
            return True
        full = len(queue) >= self.limit
        if full:
            queue.popleft()
        if isinstance(frame, CanFrame) and frame.fd:
            frame = padded(frame)
        queue.append(Transmission(t, sender, frame))
        self.pending += not full
        self.nothing_before = 0
        return not full

    def waiting(self, sender: str) -> int:
        """Return how many frames of a sender have not arrived."""
        return len(self._waiting.get(sender, ()))

    def drop(self, sender: str) -> None:
        """Drop all that waits of a sender, and let it begin anew."""
        self.pending -= len(self._waiting.pop(sender, ()))
        self.errors.pop(sender, None)
        self.nothing_before = 0

    def first_end(self) -> Nanos | None:
        """Return when the next frame of a serial line ends; None if nothing is sent."""
        heads = [queue[0] for queue in self._waiting.values() if queue]
        if not heads:
            return None
        head = min(heads, key=lambda head: head.t)
        start = head.t if self._idle_at is None else max(head.t, self._idle_at)
        return start + frame_time(head.frame, self.bitrate)

    def run(self, until: Nanos) -> list[Transmission]:
        """Return all that arrives up to a time, in order."""
        arrived: list[Transmission] = []
        while self.pending and until >= self.nothing_before:
            heads = [queue[0] for queue in self._waiting.values() if queue]
            winner = heads[0]
            first = winner.t if len(heads) == 1 else min([head.t for head in heads])
            start = first if self._idle_at is None else max(first, self._idle_at)
            if start > until:
                self.nothing_before = start
                break
            if len(heads) > 1:
                contending = [head for head in heads if head.t <= start]
                winner = min(contending, key=lambda head: (priority(head.frame), head.t))
            taken = frame_time(winner.frame, self.bitrate, self.data_bitrate)
            serial = isinstance(winner.frame, bytes)
            end = start + taken - (0 if serial else INTERFRAME_BITS * SECOND // self.bitrate)
            if end > until:
                self.nothing_before = end
                break
            if self.destroyed is not None and not serial and (bits := self.destroyed(winner)):
                taken = min(bits * SECOND // self.bitrate, taken) + ERROR_FRAME_BITS * SECOND // self.bitrate
                self._count_error(winner.sender)
            else:
                self._waiting[winner.sender].popleft()
                self.pending -= 1
                if count := self.errors.get(winner.sender):
                    self.errors[winner.sender] = count - 1
                arrived.append(Transmission(end, winner.sender, winner.frame))
            self._idle_at = start + taken
            self.busy += taken
        return arrived

    def _count_error(self, sender: str) -> None:
        self.errors[sender] = self.errors.get(sender, 0) + 8
        if self.errors[sender] >= BUS_OFF:
            self.pending -= len(self._waiting.pop(sender))
