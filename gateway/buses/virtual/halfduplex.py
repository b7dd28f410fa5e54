"""A half-duplex serial line in virtual time: a `protocols.wire.Wire` as a medium of a simulated bus."""

from __future__ import annotations

from gateway.buses.virtual.medium import Medium, Transmission
from protocols.frames import Frame
from protocols.messages import Nanos
from protocols.wire import Wire


class HalfDuplex(Medium):
    """One wire of a serial line, for both directions."""

    def __init__(self, baudrate: int) -> None:
        super().__init__(baudrate)
        self.wire = Wire(baudrate)

    @property
    def collisions(self) -> list[tuple[Nanos, str, str]]:
        """When two sent at once, and who."""
        return self.wire.collisions

    def send(self, t: Nanos, sender: str, frame: Frame) -> bool:
        """Begin to send, or go on behind what this sender is sending."""
        if isinstance(frame, bytes):
            self.wire.send(t, sender, frame)
            self._count()
        return True

    def waiting(self, sender: str) -> int:
        """Return how many frames of a sender have not arrived."""
        return self.wire.waiting(sender)

    def drop(self, sender: str) -> None:
        """Drop what a sender has not sent."""
        self.wire.drop(sender)
        self._count()

    def first_end(self) -> Nanos | None:
        """Return when the next frame ends; None if nothing is sent."""
        return self.wire.first_end()

    def run(self, until: Nanos) -> list[Transmission]:
        """Return all that arrives up to a time, in order."""
        arrived = [Transmission(one.t, one.sender, one.data) for one in self.wire.run(until)]
        self._count()
        return arrived

    def _count(self) -> None:
        self.pending, self.busy = self.wire.waiting(), self.wire.busy
