"""An adapter's serial port, read and written without waiting."""

from __future__ import annotations

import os
import select

import can

MOST_READ = 65536
"""Bytes taken in at once."""


class AdapterPort:
    """The open port of an adapter. What it does not take at once waits, so that lines are sent whole.

    Raises can.CanOperationError if the adapter is gone."""

    def __init__(self) -> None:
        self.waiting = bytearray()
        """What the port has not taken."""
        self._fileno: int | None = None

    def attach(self, fileno: int) -> None:
        """Begin to send, what waits first."""
        self._fileno = fileno
        self.write()

    def write(self, data: bytes = b"") -> None:
        """Send what waits and `data`, as far as the port takes it."""
        self.waiting += data
        if self._fileno is None or not self.waiting:
            return
        try:
            del self.waiting[: os.write(self._fileno, self.waiting)]
        except BlockingIOError:
            return
        except OSError as error:
            raise can.CanOperationError(f"the adapter is gone: {error}") from error

    def read(self, timeout: float | None) -> bytes:
        """Return what comes in within the timeout (in seconds; None: no limit)."""
        assert self._fileno is not None
        ready, _, _ = select.select([self._fileno], [], [], timeout)
        if not ready:
            return b""
        try:
            data = os.read(self._fileno, MOST_READ)
        except BlockingIOError:
            return b""
        except OSError as error:
            raise can.CanOperationError(f"the adapter is gone: {error}") from error
        if not data:
            raise can.CanOperationError("the adapter is gone: the port has hung up")
        return data
