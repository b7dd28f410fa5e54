"""A serial port: "serial:/dev/ttyUSB0". A stream of bytes, cut anywhere.

Rules. Opening says in a sentence what is missing; afterwards nothing is raised, everything is told as a
BusState, once for each change. Reading takes what is there as one packet and never waits. Writing never waits
either: what the port does not take stands in a bounded queue, whose oldest whole wires are dropped first (a
wire that has partly gone out is finished, so that the other end stays in step). What waits when the port
hangs up is thrown away; whether it has come back is looked for once a second.
"""

from __future__ import annotations

import errno
import os
from collections import deque
from collections.abc import Sequence

import serial
from serial.tools.list_ports import comports

from gateway.core.clock import Clock
from gateway.core.robot import BusSettings
from gateway.errors import BusError
from protocols.frames import BusState, Frame, Packet
from protocols.messages import SECOND, Nanos

MOST_READ = 65536
"""Bytes taken in by one read."""
MOST_WAITING = 8192
"""Bytes that may wait to go out."""
REOPEN = SECOND


def open_serial(settings: BusSettings, clock: Clock) -> SerialBus:  # noqa: ARG001 -- as open_can: bytes have no stamp
    """Open the port. Raises BusError with what is missing and what there is."""
    return SerialBus(settings, _open(settings))


class SerialBus:
    """A serial port that is open."""

    def __init__(self, settings: BusSettings, port: serial.Serial) -> None:
        self.name = settings.name
        self.dropped = 0
        """Wires that never went out, because the queue was full or the port was gone."""
        self._settings = settings
        self._port: serial.Serial | None = port
        self._waiting: deque[bytes] = deque()
        self._begun = False
        """Whether the first wire in the queue has partly gone out."""
        self._state = BusState.UP
        self._reported: list[BusState] = []
        self._reopen_at: Nanos = 0

    def read(self, now: Nanos) -> tuple[Sequence[BusState], Sequence[Packet]]:
        """What has changed, and the bytes that have come in, stamped now."""
        if self._port is None:
            self._come_back(now)
        data = self._receive(now)
        self._flush(now)
        reported, self._reported = self._reported, []
        return reported, [Packet(now, self.name, data)] if data else []

    def write(self, now: Nanos, frames: Sequence[Frame]) -> None:
        """Put bytes on the line, in order; whatever finds no room waits."""
        for frame in frames:
            assert isinstance(frame, bytes), f"{self.name} is a serial line"
            self._waiting.append(frame)
        self._flush(now)
        self._bound()

    def close(self) -> None:
        """Give the port back."""
        port, self._port = self._port, None
        self._reopen_at = 1 << 63
        if port is not None:
            _shut(port)

    def _receive(self, now: Nanos) -> bytes:
        if self._port is None:
            return b""
        try:
            return self._port.read(MOST_READ)
        except OSError:  # SerialException is one: the other end has hung up
            self._lose(now)
            return b""

    def _flush(self, now: Nanos) -> None:
        """Write until the port takes no more. (pyserial's own write spins when told never to wait.)"""
        if self._port is None:
            self._forget()
        while self._waiting and self._port is not None:
            frame = self._waiting.popleft()
            try:
                taken = os.write(self._port.fileno(), frame) if frame else 0
            except BlockingIOError:
                taken = 0
            except OSError:
                self.dropped += 1
                self._lose(now)
                return
            if taken < len(frame):
                self._waiting.appendleft(frame[taken:])
                self._begun = self._begun or taken > 0
                return
            self._begun = False
        if self._state is BusState.FULL:
            self._report(BusState.UP)

    def _bound(self) -> None:
        """Drop the oldest whole wires when too much waits."""
        while len(self._waiting) > 1 + self._begun and sum(map(len, self._waiting)) > MOST_WAITING:
            del self._waiting[int(self._begun)]
            self.dropped += 1
            self._report(BusState.FULL)

    def _report(self, state: BusState) -> None:
        after = BusState.UP if state is BusState.BACK else state
        if after is not self._state:
            self._reported.append(state)
            self._state = after

    def _forget(self) -> None:
        self.dropped += len(self._waiting)
        self._waiting.clear()
        self._begun = False

    def _lose(self, now: Nanos) -> None:
        port, self._port = self._port, None
        if port is not None:
            _shut(port)
        self._forget()
        self._reopen_at = now + REOPEN
        self._report(BusState.GONE)

    def _come_back(self, now: Nanos) -> None:
        if now < self._reopen_at:
            return
        self._reopen_at = now + REOPEN
        try:
            self._port = _open(self._settings)
        except BusError:
            return
        self._report(BusState.BACK)


def _shut(port: serial.Serial) -> None:
    try:
        port.close()
    except OSError:
        return  # what has vanished cannot be closed either


def _open(settings: BusSettings) -> serial.Serial:
    path = settings.interface.partition(":")[2]
    try:
        return serial.Serial(path, settings.baudrate, timeout=0, write_timeout=0, exclusive=True)
    except (OSError, ValueError) as error:
        raise BusError(_refusal(settings, path, error)) from error


def _refusal(settings: BusSettings, path: str, error: OSError | ValueError) -> str:
    head = f"bus {settings.name!r} cannot be opened as {settings.interface!r}"
    code = getattr(error, "errno", None)
    if code in (errno.EAGAIN, errno.EBUSY):
        return f"{head}: another program has {path} open"
    if code == errno.EACCES:
        return f"{head}: no permission; be a member of the group that owns {path} (often dialout)"
    ports = ", ".join(sorted(port.device for port in comports())) or "none"
    return f"{head}: {error}. Serial ports of this machine: {ports}."
