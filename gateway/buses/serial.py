"""A serial port: "serial:/dev/ttyUSB0". A stream of bytes, cut anywhere.

Rules. Opening raises a BusError with what is missing; afterwards nothing is raised, everything is reported as
a BusState, once per change. Reading takes what is there as one packet and never waits. Writing never waits
either: what the port does not take waits in a bounded queue. What waits, here and in the kernel, is dropped
when the port takes nothing for `STALE`, and when it is lost, so that no old command goes out later; a lost
port is tried again once a second.
"""

from __future__ import annotations

import errno
import logging
import os
from collections.abc import Sequence
from contextlib import suppress

import serial

from gateway.buses import ports, usb
from gateway.buses.queues import STALE, ByteQueue, Stall
from gateway.buses.states import CALM
from gateway.core.robot import BusSettings
from gateway.errors import BusError
from protocols.frames import BusState, Frame, Packet
from protocols.messages import MILLISECOND, SECOND, Nanos

log = logging.getLogger("gateway")

MOST_READ = 65536
"""Bytes taken in by one read."""
MOST_WAITING = 8192
"""Bytes that may wait to be sent."""
REOPEN = SECOND
"""Period of the attempts to reopen a lost port."""


def open_serial(settings: BusSettings) -> SerialBus:
    """Open the port. Raises BusError with what is missing and which ports there are."""
    return SerialBus(settings, _open(settings))


class SerialBus:
    """An open serial port."""

    def __init__(self, settings: BusSettings, port: serial.Serial) -> None:
        self.name = settings.name
        self._settings = settings
        self._port: serial.Serial | None = port
        self._queue = ByteQueue(MOST_WAITING)
        self._state = BusState.UP
        self._changes: list[BusState] = []
        self._reopen_at: Nanos = 0
        self._stall = Stall()
        self._written = 0
        self._calm_at: Nanos = 0
        """When a port that was purged counts as going on."""

    @property
    def dropped(self) -> int:
        """Messages never sent, because the queue was full or the port was gone."""
        return self._queue.dropped

    def read(self, now: Nanos) -> tuple[Sequence[BusState], Sequence[Packet]]:
        """Return the state changes, and the bytes that have come in, timestamped now."""
        if self._port is None:
            self._reopen(now)
        data = self._receive(now)
        self._flush(now)
        changes, self._changes = self._changes, []
        return changes, [Packet(now, self.name, data)] if data else []

    def write(self, now: Nanos, frames: Sequence[Frame]) -> None:
        """Send bytes, in order; what the port does not take waits."""
        for frame in frames:
            assert isinstance(frame, bytes), f"{self.name} is a serial line"
            self._queue.put(frame)
        self._flush(now)
        if self._queue.trim():
            self._report(BusState.FULL)

    def close(self) -> None:
        """Release the port."""
        self._close_port()
        self._reopen_at = 1 << 63

    def _receive(self, now: Nanos) -> bytes:
        if self._port is None:
            return b""
        try:
            return self._port.read(MOST_READ)
        except OSError:  # SerialException is one: the other end has hung up
            self._lose(now)
            return b""

    def _flush(self, now: Nanos) -> None:
        """Write until the port takes no more. (pyserial's own write spins when its timeout is 0.)"""
        if self._port is None:
            self._queue.clear()
        else:
            port = self._port.fileno()
            try:
                empty = self._queue.drain(self._write)
                self._check_stall(now, port, empty=empty)
                if not empty:
                    return
            except OSError:
                self._lose(now)
                return
        if self._state is BusState.FULL and now >= self._calm_at:
            self._report(BusState.UP)

    def _write(self, data: bytes) -> int:
        assert self._port is not None
        taken = os.write(self._port.fileno(), data)
        self._written += taken
        return taken

    def _check_stall(self, now: Nanos, port: int, *, empty: bool) -> None:
        """Purge what waits if the port has stopped taking it."""
        holds = ports.held(port)
        if self._stall.is_stalled(now, self._written - holds, waiting=holds > 0 or not empty):
            self._purge(port)
            self._calm_at = now + CALM
            self._report(BusState.FULL)

    def _purge(self, port: int) -> None:
        before = self.dropped
        ports.purge(port)
        self._queue.clear()
        log.warning(
            "%s: nothing was sent for %d ms: what waited was purged, %d messages here and all in the kernel",
            *(self.name, STALE // MILLISECOND, self.dropped - before),
        )

    def _report(self, state: BusState) -> None:
        after = BusState.UP if state is BusState.BACK else state
        if after is not self._state:
            self._changes.append(state)
            self._state = after

    def _lose(self, now: Nanos) -> None:
        if self._port is not None:
            ports.purge(self._port.fileno())  # closing would wait for it
        self._close_port()
        self._queue.clear()
        self._reopen_at = now + REOPEN
        self._report(BusState.GONE)

    def _reopen(self, now: Nanos) -> None:
        if now < self._reopen_at:
            return
        self._reopen_at = now + REOPEN
        with suppress(BusError):
            self._port = _open(self._settings)
            self._report(BusState.BACK)

    def _close_port(self) -> None:
        port, self._port = self._port, None
        if port is not None:
            with suppress(OSError):  # a port that has vanished cannot be closed either
                port.close()


def _open(settings: BusSettings) -> serial.Serial:
    path = usb.resolved(settings).interface.partition(":")[2]
    try:
        port = serial.Serial(path, settings.baudrate, timeout=0, write_timeout=0, exclusive=True)
    except (OSError, ValueError) as error:
        raise BusError(_reason(settings, path, error)) from error
    ports.purge(port.fileno())
    return port


def _reason(settings: BusSettings, path: str, error: OSError | ValueError) -> str:
    head = f"bus {settings.name!r} cannot be opened as {settings.interface!r}"
    code = getattr(error, "errno", None)
    if code in (errno.EAGAIN, errno.EBUSY):
        return f"{head}: another program has {path} open"
    if code == errno.EACCES:
        return f"{head}: no permission; be a member of the group that owns {path} (often dialout)"
    return f"{head}: {error}. Serial ports of this machine: {usb.listed(usb.port_names())}."
