"""A pseudo-terminal: a serial line between two programs of one machine, whose other end has a path to open.

Rules. Nothing waits and nothing is raised once it is open. While no program has the other end open, what is
written is lost, as on a connector without a cable; a program that opens it finds no old bytes. What a slow
reader does not take waits in a bounded queue. A pty has no bit rate: transmission time is simulated
elsewhere (of a serial line by its `TwinBus`, which also garbles what two send at once, and echoes).
"""

from __future__ import annotations

import os
import select
import termios
import tty
from collections.abc import Sequence

from gateway.buses.queues import ByteQueue
from gateway.core.robot import BusSettings
from gateway.errors import BusError
from protocols.frames import BusState, Frame, Packet
from protocols.messages import Nanos

MOST_READ = 65536
"""Bytes taken in by one read."""
MOST_WAITING = 4096
"""Bytes that may wait, besides the 16 kB that the kernel holds: more would only be older."""


class Pty:
    """Our end of an open pty; `path` is what another program opens."""

    def __init__(self) -> None:
        """Raises OSError where there are no ptys."""
        self._end, other = os.openpty()
        self.path = os.ttyname(other)
        self.connected = False
        """Whether a program had the other end open at the last `read`."""
        self._queue = ByteQueue(MOST_WAITING)
        tty.setraw(other)  # no echo, no translation; it stays so as long as our end is open
        os.close(other)
        os.set_blocking(self._end, False)
        self._poll = select.poll()
        self._poll.register(self._end, select.POLLIN)

    @property
    def dropped(self) -> int:
        """Messages that the other end did not read in time."""
        return self._queue.dropped

    def fileno(self) -> int:
        """Return the file of our end."""
        return self._end

    def read(self) -> bytes:
        """Return what has come in; updates `connected`."""
        ready = self._poll.poll(0)
        events = ready[0][1] if ready else 0
        connected = not events & (select.POLLHUP | select.POLLERR)
        data = self._receive() if events & select.POLLIN else b""
        if self.connected and not connected:
            self._discard()
        self.connected = connected
        self._queue.drain(self._write)
        return data

    def write(self, message: bytes) -> None:
        """Send bytes to the other end, in order."""
        if self.connected:
            self._queue.put(message)
            self._queue.drain(self._write)
            self._queue.trim()

    def close(self) -> None:
        """Hang up. The path is gone with it."""
        if self._end >= 0:
            os.close(self._end)
        self._end = -1

    def _receive(self) -> bytes:
        """Return all that is there, including what a program sent just before it hung up."""
        data = b""
        while len(data) < MOST_READ:
            try:
                piece = os.read(self._end, MOST_READ)
            except OSError:  # nothing more (EAGAIN), or hung up (EIO)
                break
            data += piece
        return data

    def _write(self, data: bytes) -> int:
        try:
            return os.write(self._end, data)
        except OSError:  # it takes no more (EAGAIN), or has just hung up, which the next read detects
            return 0

    def _discard(self) -> None:
        """Discard what was not read: what waits here, and what the kernel holds for the other end."""
        self._queue.clear()
        try:
            other = os.open(self.path, os.O_RDWR | os.O_NOCTTY | os.O_NONBLOCK)
        except OSError:  # another program has it exclusively (TIOCEXCL): it has flushed it itself
            return
        try:
            termios.tcflush(other, termios.TCIFLUSH)
        finally:
            os.close(other)


def open_pty(settings: BusSettings) -> Pty:
    """Make a pty for a bus. Raises BusError if there is none."""
    try:
        return Pty()
    except OSError as error:
        raise BusError(f"bus {settings.name!r}: no pty can be made here: {error}") from error


class SerialPty:
    """The devices' end of a serial bus, offered to another program."""

    def __init__(self, settings: BusSettings) -> None:
        """Raises BusError if no pty can be made."""
        self.name = settings.name
        self.pty = open_pty(settings)
        self._state = BusState.GONE

    def read(self, now: Nanos) -> tuple[Sequence[BusState], Sequence[Packet]]:
        """Return the bytes received, timestamped now. BACK, GONE: a program opened, closed the other end."""
        data = self.pty.read()
        before, self._state = self._state, BusState.BACK if self.pty.connected else BusState.GONE
        changes = [self._state] if self._state is not before else []
        return changes, [Packet(now, self.name, data)] if data else []

    def write(self, now: Nanos, frames: Sequence[Frame]) -> None:  # noqa: ARG002 -- bytes have no timestamp
        """Send bytes to the other end."""
        for frame in frames:
            assert isinstance(frame, bytes), f"{self.name} is a serial line"
            self.pty.write(frame)

    def wakes(self, now: Nanos) -> tuple[Sequence[int], Nanos | None]:  # noqa: ARG002 -- it has no plan
        """Return the file that can be read when a program has sent something; none while nobody has the other
        end open: it would count as hung up all the time."""
        return ((self.pty.fileno(),), None) if self.pty.connected else ((), None)

    def close(self) -> None:
        """Hang up."""
        self.pty.close()
