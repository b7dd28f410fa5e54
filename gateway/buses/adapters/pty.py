"""A pty: a serial line between two programs of one machine. We hold one end; the other has a path to open.

Rules. Nothing waits and nothing is raised once it is open. While nobody has the other end open, what is
written is lost, as on a plug without a cable; whoever opens it next finds no old bytes. What a slow reader
does not take stands in a bounded queue, whose oldest whole wires are dropped first (a wire that has partly
gone out is finished, so that the other end stays in step). A pty has no bit rate: how long bytes take is the
twins' matter.
"""

from __future__ import annotations

import os
import select
import termios
import tty
from collections import deque
from collections.abc import Sequence

from gateway.core.clock import Clock
from gateway.core.robot import BusSettings
from gateway.errors import BusError
from protocols.frames import BusState, Frame, Packet
from protocols.messages import Nanos

MOST_READ = 65536
"""Bytes taken in by one read."""
MOST_WAITING = 4096
"""Bytes that may wait to go out, beside the 16 kB that the kernel holds: more would only be older."""


class Pty:
    """Our end of a pty, open; `path` is what another program opens."""

    def __init__(self) -> None:
        """Raises OSError where there is no pty to be had."""
        self._end, other = os.openpty()
        self.path = os.ttyname(other)
        self.connected = False
        """Whether somebody had the other end open at the last `read`."""
        self.dropped = 0
        """Wires that a slow reader has never seen."""
        self._waiting: deque[bytes] = deque()
        self._begun = False
        """Whether the first wire in the queue has partly gone out."""
        tty.setraw(other)  # neither echoes nor translates; it stays so as long as our end is open
        os.close(other)
        os.set_blocking(self._end, False)
        self._poll = select.poll()
        self._poll.register(self._end, select.POLLIN)

    def read(self) -> bytes:
        """What has come in; looks also whether somebody is there."""
        events = self._poll.poll(0)
        reported = events[0][1] if events else 0
        here = not reported & (select.POLLHUP | select.POLLERR)
        data = self._receive() if reported & select.POLLIN else b""
        if self.connected and not here:
            self._hang_up()
        self.connected = here
        self._flush()
        return data

    def write(self, frame: bytes) -> None:
        """Bytes for the other end, in order."""
        if not self.connected:
            return
        self._waiting.append(frame)
        self._flush()
        while len(self._waiting) > 1 + self._begun and sum(map(len, self._waiting)) > MOST_WAITING:
            del self._waiting[int(self._begun)]
            self.dropped += 1

    def close(self) -> None:
        """Hang up. The path is gone with it."""
        if self._end >= 0:
            os.close(self._end)
        self._end = -1

    def _receive(self) -> bytes:
        """All that is there: also what somebody has said just before he hung up."""
        data = b""
        while len(data) < MOST_READ:
            try:
                piece = os.read(self._end, MOST_READ)
            except OSError:  # nothing more (EAGAIN), or hung up (EIO)
                break
            data += piece
        return data

    def _flush(self) -> None:
        while self._waiting:
            frame = self._waiting.popleft()
            try:
                taken = os.write(self._end, frame) if frame else 0
            except OSError:  # it takes no more (EAGAIN), or has just hung up, which the next read finds out
                taken = 0
            if taken < len(frame):
                self._waiting.appendleft(frame[taken:])
                self._begun = self._begun or taken > 0
                return
            self._begun = False

    def _hang_up(self) -> None:
        """Throw away what nobody has read: what waits here, and what the kernel holds for the other end."""
        self._waiting.clear()
        self._begun = False
        try:
            other = os.open(self.path, os.O_RDWR | os.O_NOCTTY | os.O_NONBLOCK)
        except OSError:  # somebody has it for himself alone (TIOCEXCL): he has flushed it himself
            return
        try:
            termios.tcflush(other, termios.TCIFLUSH)
        finally:
            os.close(other)


def open_pty(settings: BusSettings) -> Pty:
    """A pty for a bus. Raises BusError with what is missing."""
    try:
        return Pty()
    except OSError as error:
        raise BusError(f"bus {settings.name!r}: no pty can be made here: {error}") from error


class SerialPty:
    """A serial bus at whose other end another program may be: the devices' end of it."""

    def __init__(self, settings: BusSettings, clock: Clock) -> None:  # noqa: ARG002 -- as open_can
        """Raises BusError if no pty can be made."""
        self.name = settings.name
        self.pty = open_pty(settings)
        self._state = BusState.GONE

    def read(self, now: Nanos) -> tuple[Sequence[BusState], Sequence[Packet]]:
        """The bytes that have come in, stamped now. BACK and GONE: somebody opens, closes the other end."""
        data = self.pty.read()
        reported: list[BusState] = []
        state = BusState.BACK if self.pty.connected else BusState.GONE
        if state is not self._state:
            reported.append(state)
            self._state = state
        return reported, [Packet(now, self.name, data)] if data else []

    def write(self, now: Nanos, frames: Sequence[Frame]) -> None:  # noqa: ARG002 -- bytes have no stamp
        """Bytes for the other end."""
        for frame in frames:
            assert isinstance(frame, bytes), f"{self.name} is a serial line"
            self.pty.write(frame)

    def close(self) -> None:
        """Hang up."""
        self.pty.close()
