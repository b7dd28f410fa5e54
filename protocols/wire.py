"""One wire of a serial line in virtual time: everybody receives from everybody, and nobody waits for another.

Rules. What is sent takes the time of its bytes at the line's rate, from when its sender gives it (or has sent
what it gave before). Nothing keeps two apart: of bytes that are on the wire at the same time, everybody
receives the wired AND of both, shifted as they overlap; a collision is counted once for each pair. What is
sent arrives when it ends. For buses that are simulated, and for the contract; no protocol has one.
"""

from __future__ import annotations

from dataclasses import dataclass

from protocols.line import BITS
from protocols.messages import SECOND, Nanos, value


@dataclass(slots=True)
class _Sending:
    """Bytes that are on the wire, or were while others still are."""

    start: Nanos
    end: Nanos
    sender: str
    data: bytearray
    over: bool = False


@value
class Arrived:
    """Bytes as everybody receives them, and when they end."""

    t: Nanos
    sender: str
    data: bytes


class Wire:
    """One wire: both directions of a half-duplex line, or one direction of another."""

    def __init__(self, rate: int) -> None:
        """`rate` in bit/s."""
        self.collisions: list[tuple[Nanos, str, str]] = []
        """When two sent at once, and who."""
        self.busy: Nanos = 0
        """Time during which the wire was not idle."""
        self.byte: Nanos = BITS * SECOND // rate
        """Time of one byte."""
        self._sending: list[_Sending] = []
        self._until: dict[str, Nanos] = {}
        """When each sender has sent what it was given."""
        self._idle: Nanos = 0

    def send(self, t: Nanos, sender: str, data: bytes) -> None:
        """Begin to send, or go on behind what this sender is sending."""
        start = max(t, self._until.get(sender, 0))
        new = _Sending(start, start + len(data) * self.byte, sender, bytearray(data))
        self._until[sender] = new.end
        for other in self._sending:
            if other.sender != sender and other.start < new.end and start < other.end and not other.over:
                self.collisions.append((max(start, other.start), other.sender, sender))
                self._garble(new, other)
        self._sending.append(new)
        self.busy += max(0, new.end - max(start, self._idle))
        self._idle = max(self._idle, new.end)

    def _garble(self, one: _Sending, other: _Sending) -> None:
        before = bytes(one.data), bytes(other.data)
        for at in range(len(one.data)):
            begins = one.start + at * self.byte
            first = (begins - other.start) // self.byte
            for k in (first, first + 1):
                if 0 <= k < len(other.data) and other.start + k * self.byte < begins + self.byte:
                    both = before[0][at] & before[1][k] ^ 0x01  # a start bit in the middle of a byte
                    one.data[at], other.data[k] = both, both

    def waiting(self, sender: str | None = None) -> int:
        """Return how much of what a sender (None: anybody) was given has not arrived."""
        return sum(not one.over and sender in (None, one.sender) for one in self._sending)

    def drop(self, sender: str) -> None:
        """Drop what a sender has not sent."""
        self._sending = [one for one in self._sending if one.sender != sender]
        self._until.pop(sender, None)

    def first_end(self) -> Nanos | None:
        """Return when the next bytes end; None if nothing is sent."""
        ends = [one.end for one in self._sending if not one.over]
        return min(ends) if ends else None

    def run(self, until: Nanos) -> list[Arrived]:
        """Return all that arrives up to a time, in order."""
        ended = sorted(
            (one for one in self._sending if not one.over and one.end <= until), key=lambda one: one.end
        )
        for one in ended:
            one.over = True
        oldest = min((one.start for one in self._sending if not one.over), default=until)
        self._sending = [one for one in self._sending if not one.over or one.end > oldest]
        return [Arrived(one.end, one.sender, bytes(one.data)) for one in ended]
