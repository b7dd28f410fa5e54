"""A back end of python-can that waits, or that nobody could measure: read, written and opened by threads.

Rules. The bus above never waits: it takes what the reader has received, and gives the writer what is to be
sent; both queues are bounded. Whatever the back end raises comes out of `recv`, in its order; after
`MOST_FAILURES` in a row, or one that says that the interface is gone, it says so. What waits to be sent when
nothing is taken any more for `STALE` is dropped: no old command goes out later.
"""

from __future__ import annotations

import threading
from collections import deque
from collections.abc import Callable
from contextlib import suppress

import can

from gateway.buses.queues import Stall
from protocols.messages import Nanos

MOST_RECEIVED = 4096
"""Frames that may wait to be taken: half a second of a full bus of 1 Mbit/s."""
MOST_TO_SEND = 64
"""Frames that may wait for the writer; the rest wait in the bus, where newer ones replace them."""
WAIT = 0.1
"""Seconds that a back end is given to wait for a frame."""
ENDING = 0.5
"""Seconds that closing waits for what is still to be sent."""
MOST_FAILURES = 64
"""Exceptions in a row after which a back end counts as gone."""


class Opening:
    """An interface that is being opened, in a thread: it may take seconds."""

    def __init__(self, make: Callable[[], can.BusABC]) -> None:
        self.interface: can.BusABC | None = None
        self._make = make
        self._cancelled = False
        self._thread = threading.Thread(target=self._open, daemon=True)
        self._thread.start()

    def _open(self) -> None:
        with suppress(Exception):  # it is tried again
            self.interface = self._make()
            if self._cancelled:
                self.interface.shutdown()

    def cancel(self) -> None:
        """Have it closed as soon as it is open."""
        self._cancelled = True

    @property
    def done(self) -> bool:
        """Whether it is open, or could not be opened."""
        return not self._thread.is_alive()


class ThreadedInterface(can.BusABC):
    """An open back end, behind two threads."""

    def __init__(self, inner: can.BusABC) -> None:
        super().__init__(channel=inner.channel_info)
        self.missed = 0
        """Frames that came faster than they were taken."""
        self._inner = inner
        self._received: deque[can.Message | Exception] = deque()
        self._to_send: deque[can.Message] = deque()
        self._wake = threading.Semaphore(0)
        self._ends = False
        self._sent = 0
        self._stall = Stall()
        self._threads = [threading.Thread(target=each, daemon=True) for each in (self._read, self._write)]
        for thread in self._threads:
            thread.start()

    def send(self, msg: can.Message, timeout: float | None = None) -> None:  # noqa: ARG002 -- it never waits
        """Give the writer a frame. Raises CanTimeoutError if it has no room for it."""
        if len(self._to_send) >= MOST_TO_SEND:
            raise can.CanTimeoutError("the back end takes no more")
        self._to_send.append(msg)
        self._wake.release()

    def purged(self, now: Nanos) -> bool:
        """Drop what waits to be sent, if the back end has taken none of it for `STALE`; True if it was."""
        if not self._stall.is_stalled(now, self._sent, waiting=bool(self._to_send)):
            return False
        self.drop()
        return True

    def drop(self) -> None:
        """Drop what waits to be sent."""
        self._to_send.clear()

    def shutdown(self) -> None:
        """Send what waits, within a bound; then close the back end."""
        super().shutdown()
        self._end()

    def abandon(self) -> None:
        """Close a back end that has gone, without waiting for it."""
        super().shutdown()
        self.drop()
        threading.Thread(target=self._end, daemon=True).start()

    def _end(self) -> None:
        self._ends = True
        self._wake.release()
        for thread in self._threads:
            thread.join(ENDING)
        with suppress(Exception):  # what has vanished cannot be closed either
            self._inner.shutdown()

    def _recv_internal(self, timeout: float | None) -> tuple[can.Message | None, bool]:  # noqa: ARG002 -- it never waits
        """Return the next frame; raise what the back end has raised."""
        if not self._received:
            return None, False
        found = self._received.popleft()
        if isinstance(found, Exception):
            raise found
        return found, False

    # -- the threads --------------------------------------------------------------------------

    def _read(self) -> None:
        failures = 0
        while not self._ends:
            try:
                message = self._inner.recv(WAIT)
            except Exception as error:  # noqa: BLE001 -- whatever a back end raises
                failures += 1
                gone = isinstance(error, (can.CanError, OSError)) or failures > MOST_FAILURES
                self._received.append(can.CanOperationError(f"it has gone: {error!r}") if gone else error)
                if gone:
                    return
                continue
            failures = 0
            if message is None:
                continue
            if len(self._received) >= MOST_RECEIVED:
                self.missed += 1
                self._received.popleft()
            self._received.append(message)

    def _write(self) -> None:
        while True:
            self._wake.acquire()
            if not self._to_send:
                if self._ends:
                    return
                continue
            message = self._to_send.popleft()
            try:
                self._inner.send(message, WAIT)
                self._sent += 1
            except can.CanTimeoutError:
                if not self._ends:
                    self._to_send.appendleft(message)
                    self._wake.release()
            except Exception as error:  # noqa: BLE001 -- the same
                self._received.append(can.CanOperationError(f"it cannot send: {error!r}"))
                return
