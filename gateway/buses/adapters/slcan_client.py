"""Our end of an adapter that speaks Lawicel's protocol: python-can's slcan interface, made never to wait.

Why it is not taken as it is (python-can 4.6.1, pyserial 3.5): it reads the port byte by byte; each line sent
waits for the port to drain; and a write that was merely put off by the scheduler for longer than its timeout
raises the same error as a port that is gone. Here reading takes what is there, writing hands over what the
port takes, and a line that has partly gone out is finished before another one begins.
"""

from __future__ import annotations

import os
import select

import can
from can.interfaces.slcan import slcanBus

MOST_READ = 65536
"""Bytes taken in at once."""
SAID = "tTrRdDbBVN"
"""What the lines worth reading begin with; the others are acknowledgements and bells."""


class SlcanInterface(slcanBus):
    """An open adapter. Raises as python-can does: CanTimeoutError if it takes no more for now."""

    def __init__(
        self, channel: str, bitrate: int, data_bitrate: int = 0, *, listen_only: bool = False
    ) -> None:
        """Open the port for us alone, set the bit rates, open the channel (with L if `listen_only`).

        Raises CanError, OSError, or ValueError for a rate that the protocol has no command for."""
        self._out = bytearray()
        self._ours = False
        self._is_shutdown = True  # what has not been opened need not be shut down
        super().__init__(channel, bitrate=bitrate, sleep_after_open=0.0, timeout=0.0, listen_only=listen_only)
        try:
            self._claim()
            if data_bitrate:
                self.set_bitrate(bitrate, data_bitrate)
        except (can.CanError, OSError, ValueError):
            self._is_shutdown = True
            self.serialPortOrig.close()
            raise

    def _claim(self) -> None:
        """From now on the port is ours. Nothing is said before: it would disturb whoever has it."""
        self.serialPortOrig.exclusive = True
        self._ours = True
        self._push()

    def shutdown(self) -> None:
        """Close the channel and the port, also if the adapter is gone: then it raises CanOperationError."""
        can.BusABC.shutdown(self)
        try:
            self.close()
        finally:
            self.serialPortOrig.close()

    def send(self, msg: can.Message, timeout: float | None = None) -> None:  # noqa: ARG002 -- it never waits
        """Hand a frame over, whole or not at all."""
        self._push()
        if self._out:
            raise can.CanTimeoutError("the adapter takes no more")
        super().send(msg, self.serialPortOrig.write_timeout)

    def _write(self, string: str) -> None:
        self._out += string.encode() + self.LINE_TERMINATOR
        self._push()

    def _push(self) -> None:
        if not (self._out and self._ours):
            return
        try:
            del self._out[: os.write(self.serialPortOrig.fileno(), self._out)]
        except BlockingIOError:
            return
        except OSError as error:
            raise can.CanOperationError(f"the adapter is gone: {error}") from error

    def _read(self, timeout: float | None) -> str | None:
        """The next line that says something; None if there is none within the timeout (in seconds)."""
        self._push()
        line = self._next_line()
        if line is None:
            ready, _, _ = select.select([self.serialPortOrig.fileno()], [], [], timeout)
            if ready:
                self._take()
                line = self._next_line()
        return line

    def _take(self) -> None:
        try:
            data = os.read(self.serialPortOrig.fileno(), MOST_READ)
        except BlockingIOError:
            return
        except OSError as error:
            raise can.CanOperationError(f"the adapter is gone: {error}") from error
        if not data:
            raise can.CanOperationError("the adapter is gone: the port has hung up")
        self._buffer += data

    def _next_line(self) -> str | None:
        """Cut the next line that says something from what has come in."""
        while (end := self._buffer.find(self._OK)) >= 0:
            line = self._buffer[: end + 1].lstrip(self._ERROR).decode("latin-1")
            del self._buffer[: end + 1]
            if line[0] in SAID:
                return line
        if len(self._buffer) > MOST_READ:  # no line at all: this is no adapter
            self._buffer.clear()
        return None
