"""The host's end of an slcan adapter: python-can's slcan interface, made never to wait.

Why it is not used as it is (python-can 4.6.1, pyserial 3.5): it reads the port byte by byte; each line sent
waits for the port to drain; and a write that was merely delayed by the scheduler for longer than its timeout
raises the same error as a port that is gone. Here reading takes what is there, writing hands over what the
port takes, and a line that is partly sent is finished before another one begins.
"""

from __future__ import annotations

import can
from can.interfaces.slcan import slcanBus

from gateway.buses.adapters.port import MOST_READ, AdapterPort

RELEVANT = "tTrRdDbBVN"
"""First letters of the lines worth reading; the others are acknowledgements."""


class SlcanInterface(slcanBus):
    """An open adapter. Raises as python-can does: CanTimeoutError if it takes no more for now."""

    def __init__(
        self, channel: str, bitrate: int, data_bitrate: int = 0, *, listen_only: bool = False
    ) -> None:
        """Open the port exclusively, set the bit rates, open the channel (with L if `listen_only`).

        Raises CanError, OSError, or ValueError for a rate that the protocol has no command for."""
        self.port = AdapterPort(b"\r")
        self._is_shutdown = True  # what has not been opened need not be shut down
        super().__init__(channel, bitrate=bitrate, sleep_after_open=0.0, timeout=0.0, listen_only=listen_only)
        try:
            # Nothing is sent before the port is ours: it would disturb the program that has it.
            self.serialPortOrig.exclusive = True
            self.port.attach(self.serialPortOrig.fileno())
            if data_bitrate:
                self.set_bitrate(bitrate, data_bitrate)
        except (can.CanError, OSError, ValueError):
            self._is_shutdown = True
            self.serialPortOrig.close()
            raise

    def shutdown(self) -> None:
        """Close the channel and the port, also if the adapter is gone: then it raises CanOperationError."""
        can.BusABC.shutdown(self)
        try:
            self.close()
        finally:
            self.serialPortOrig.close()

    def send(self, msg: can.Message, timeout: float | None = None) -> None:  # noqa: ARG002 -- it never waits
        """Send a frame, whole or not at all."""
        self.port.write()
        if self.port.waiting:
            raise can.CanTimeoutError("the adapter takes no more")
        super().send(msg, self.serialPortOrig.write_timeout)

    def _write(self, string: str) -> None:
        self.port.write(string.encode() + self.LINE_TERMINATOR)

    def _read(self, timeout: float | None) -> str | None:
        """Return the next relevant line; None if there is none within the timeout (in seconds)."""
        self.port.write()
        line = self._next_line()
        if line is None and (data := self.port.read(timeout)):
            self._buffer += data
            line = self._next_line()
        return line

    def _next_line(self) -> str | None:
        """Cut the next relevant line from what has come in."""
        while (end := self._buffer.find(self._OK)) >= 0:
            line = self._buffer[: end + 1].lstrip(self._ERROR).decode("latin-1")
            del self._buffer[: end + 1]
            if line[0] in RELEVANT:
                return line
        if len(self._buffer) > MOST_READ:  # no line at all: this is no adapter
            self._buffer.clear()
        return None
