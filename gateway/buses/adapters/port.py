"""An adapter's serial port, read and written without waiting; and a bus of python-can on such a port."""

from __future__ import annotations

import os
import select
from abc import abstractmethod
from dataclasses import dataclass

import can
import serial

from gateway.buses import ports
from gateway.buses.python_can import frame_of, message_of
from gateway.buses.queues import Stall
from protocols.frames import CanFrame
from protocols.messages import MILLISECOND, Nanos

MOST_READ = 65536
"""Bytes taken in at once."""
JUDGED = 200 * MILLISECOND
"""Time in which an adapter that refuses most of what it is sent shows itself: answers take milliseconds."""
FEWEST = 4
"""Frames sent before an adapter is judged by what it refuses."""


class AdapterPort:
    """The open port of an adapter. What it does not take at once waits, so that lines are sent whole.

    Raises can.CanOperationError if the adapter is gone."""

    def __init__(self, end: bytes = b"") -> None:
        self.waiting = bytearray()
        """What the port has not taken."""
        self._fileno: int | None = None
        self._end = end
        """With which a line that was cut ends; empty: what is cut could be taken for another frame."""
        self._written = 0
        self._stall = Stall()

    def attach(self, fileno: int) -> None:
        """Begin to send, what waits first."""
        self._fileno = fileno
        ports.purge(fileno)  # what a program before us has left
        self.write()

    def write(self, data: bytes = b"") -> None:
        """Send what waits and `data`, as far as the port takes it."""
        self.waiting += data
        if self._fileno is None or not self.waiting:
            return
        try:
            taken = os.write(self._fileno, self.waiting)
            del self.waiting[:taken]
            self._written += taken
        except BlockingIOError:
            return
        except OSError as error:
            raise can.CanOperationError(f"the adapter is gone: {error}") from error

    def purged(self, now: Nanos) -> bool:
        """Purge what waits, here and in the kernel, if the adapter has taken none of it for `STALE`; True if
        it was. Where lines have no end, what is in the kernel stays there."""
        if self._fileno is None:
            return False
        holds = ports.held(self._fileno)
        waiting = holds > 0 or bool(self.waiting)
        if not self._stall.is_stalled(now, self._written - holds, waiting=waiting) or not self._end:
            return False
        self.drop()
        self.waiting += self._end
        return True

    def drop(self) -> None:
        """Drop what waits: closing the port would wait for it."""
        self.waiting.clear()
        if self._fileno is not None:
            ports.purge(self._fileno)

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


@dataclass(slots=True)
class Refusals:
    """Whether an adapter refuses what it is sent, being bus-off, or not open after a reset. Plain data."""

    refused: int = 0
    """What it has refused, all in all."""
    sent: int = 0
    """Frames handed over since it was judged last."""
    _before: int = 0
    _since: Nanos = 0

    def judge(self, now: Nanos) -> bool | None:
        """True if it has refused most of what it was sent of late, False if not; None: it is too early."""
        if not self.sent:
            self._since, self._before = now, self.refused
        if self.sent < FEWEST or now - self._since < JUDGED:
            return None
        refusing = 2 * (self.refused - self._before) > self.sent
        self.sent = 0
        return refusing


class AdapterInterface(can.BusABC):
    """An adapter that python-can has no interface for. It never waits: reading takes what is there, writing
    hands over what the port takes, and what is partly sent is finished before anything else begins.

    Raises as python-can does: CanTimeoutError if it takes no more for now."""

    def __init__(self, channel: str, baudrate: int, end: bytes = b"") -> None:
        """Open the port exclusively; `end`: of a line. Raises OSError or ValueError."""
        self._serial = serial.Serial(channel, baudrate, timeout=0, write_timeout=0, exclusive=True)
        self.port = AdapterPort(end)
        self.refusals = Refusals()
        super().__init__(channel)
        self.port.attach(self.fileno())

    @abstractmethod
    def _encode(self, frame: CanFrame) -> bytes:
        """Encode a frame to be sent."""

    @abstractmethod
    def _feed(self, data: bytes) -> None:
        """Take what has come in. ValueError for what is malformed."""

    @abstractmethod
    def _next_frame(self) -> CanFrame | None:
        """Return the next frame of what has come in. ValueError for what is malformed."""

    def purged(self, now: Nanos) -> bool:
        """As of its port."""
        return self.port.purged(now)

    def turn_off(self) -> None:
        """Leave the bus, if such an adapter can. Raises CanOperationError if it is gone."""

    def turn_on(self) -> None:
        """Join the bus again."""

    def shutdown(self) -> None:
        """Close the port."""
        super().shutdown()
        self._serial.close()

    def fileno(self) -> int:
        """Return the port's file descriptor."""
        return int(self._serial.fileno())

    def send(self, msg: can.Message, timeout: float | None = None) -> None:  # noqa: ARG002 -- it never waits
        """Send a frame, whole or not at all."""
        self.port.write()
        if self.port.waiting:
            raise can.CanTimeoutError("the adapter takes no more")
        self.port.write(self._encode(frame_of(msg)))
        self.refusals.sent += 1

    def _recv_internal(self, timeout: float | None) -> tuple[can.Message | None, bool]:
        """Return the next frame; None if there is none within the timeout."""
        self.port.write()
        frame = self._next_frame()
        if frame is None and (data := self.port.read(timeout)):
            self._feed(data)
            frame = self._next_frame()
        return (None if frame is None else message_of(frame)), False
