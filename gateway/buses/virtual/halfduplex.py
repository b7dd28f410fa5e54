"""A half-duplex serial line in virtual time: one wire, on which everybody hears everybody and nobody waits.

Rules. A frame takes the time of its bytes at the line's rate, from when its sender gives it (or has sent what
it gave before). Nothing keeps two apart: of bytes that are on the wire at the same time, everybody hears the
wired AND of both, shifted as they overlap; a collision is counted once for each pair of frames. A frame
arrives when it ends.
"""

from __future__ import annotations

from dataclasses import dataclass

from gateway.buses.frame_time import SERIAL_BITS
from gateway.buses.virtual.medium import Medium, Transmission
from protocols.frames import Frame
from protocols.messages import SECOND, Nanos


@dataclass(slots=True)
class _Sending:
    """A frame that is on the wire, or was while another still is."""

    start: Nanos
    end: Nanos
    sender: str
    data: bytearray
    over: bool = False


class HalfDuplex(Medium):
    """One wire of a serial line, for both directions."""

    def __init__(self, baudrate: int) -> None:
        super().__init__(baudrate)
        self.collisions: list[tuple[Nanos, str, str]] = []
        """When two sent at once, and who."""
        self._byte = SERIAL_BITS * SECOND // baudrate
        self._sending: list[_Sending] = []
        self._until: dict[str, Nanos] = {}
        """When each sender has sent what it was given."""
        self._idle: Nanos = 0

    def send(self, t: Nanos, sender: str, frame: Frame) -> bool:
        """Begin to send, or go on behind what this sender is sending."""
        if not isinstance(frame, bytes):
            return True
        start = max(t, self._until.get(sender, 0))
        new = _Sending(start, start + len(frame) * self._byte, sender, bytearray(frame))
        self._until[sender] = new.end
        for other in self._sending:
            if other.sender != sender and other.start < new.end and start < other.end and not other.over:
                self.collisions.append((max(start, other.start), other.sender, sender))
                self._garble(new, other)
        self._sending.append(new)
        self.pending += 1
        self.busy += max(0, new.end - max(start, self._idle))
        self._idle = max(self._idle, new.end)
        return True

    def _garble(self, one: _Sending, other: _Sending) -> None:
        before = bytes(one.data), bytes(other.data)
        for at in range(len(one.data)):
            begins = one.start + at * self._byte
            first = (begins - other.start) // self._byte
            for k in (first, first + 1):
                if 0 <= k < len(other.data) and other.start + k * self._byte < begins + self._byte:
                    both = before[0][at] & before[1][k] ^ 0x01  # a start bit in the middle of a byte
                    one.data[at], other.data[k] = both, both

    def waiting(self, sender: str) -> int:
        """Return how many frames of a sender have not arrived."""
        return sum(not one.over and one.sender == sender for one in self._sending)

    def drop(self, sender: str) -> None:
        """Drop what a sender has not sent."""
        self.pending -= self.waiting(sender)
        self._sending = [one for one in self._sending if one.sender != sender]
        self._until.pop(sender, None)

    def first_end(self) -> Nanos | None:
        """Return when the next frame ends; None if nothing is sent."""
        return min((one.end for one in self._sending if not one.over), default=None)

    def run(self, until: Nanos) -> list[Transmission]:
        """Return all that arrives up to a time, in order."""
        ended = sorted(
            (one for one in self._sending if not one.over and one.end <= until), key=lambda one: one.end
        )
        for one in ended:
            one.over = True
        self.pending -= len(ended)
        oldest = min((one.start for one in self._sending if not one.over), default=until)
        self._sending = [one for one in self._sending if not one.over or one.end > oldest]
        return [Transmission(one.end, one.sender, bytes(one.data)) for one in ended]
