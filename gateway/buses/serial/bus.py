"""The bus on a serial port: a stream of bytes, cut anywhere.

Rules. Opening raises a BusError with what is missing; afterwards nothing is raised, everything is reported as
a BusState, once per change. Reading takes what is there and never waits. What was read at once is stamped in
pieces, each by when its last byte can have arrived at the latest: one byte after the other, at the line's
rate. Writing never waits either: what the port does not take waits in a bounded queue. What waits, here and
in the kernel, is dropped when the port takes nothing for `STALE`, and when it is lost, so that no old command
goes out later; a lost port is tried again once a second, by its USB name under whatever path it has then.
"""

from __future__ import annotations

import logging
import os
import select
from collections import Counter
from collections.abc import Iterator, Sequence
from contextlib import suppress

import serial

from gateway.buses import ports
from gateway.buses.queues import STALE, ByteQueue, Stall
from gateway.buses.serial.echo import Echo
from gateway.buses.serial.opening import close_port, holds_back, line_errors, open_port
from gateway.buses.states import CALM
from gateway.buses.troubles import FEW, Trouble, of_writes
from gateway.core.robot import BusSettings
from gateway.errors import BusError
from protocols.frames import BusState, Frame, Packet
from protocols.line import BITS
from protocols.messages import MILLISECOND, SECOND, Nanos

log = logging.getLogger("gateway")

MOST_READ = 65536
"""Bytes taken in by one read."""
HELD = 1024
"""A read that returns as much may have left more: a pty gives 4 kB at a time."""
PIECE: Nanos = MILLISECOND
"""Of what was read at once, what arrived within this time has one stamp,"""
LEAST_PIECE = 16
"""and so many bytes in any case."""
MOST_WAITING = 8192
"""Bytes that may wait to be sent."""
REOPEN = SECOND
"""Period of the attempts to reopen a lost port."""


def open_serial(settings: BusSettings) -> SerialBus:
    """Open the port. Raises BusError with what is missing and which ports there are."""
    return SerialBus(settings, open_port(settings))


class SerialBus:
    """An open serial port."""

    def __init__(self, settings: BusSettings, port: serial.Serial) -> None:
        self.name = settings.name
        self._settings = settings
        self._port: serial.Serial | None = None
        self._poll = select.poll()
        self._byte = BITS * SECOND // settings.baudrate
        self._piece = max(LEAST_PIECE, PIECE // self._byte)
        """Bytes with one stamp."""
        self._looked: Nanos = 0
        """When it was last read: what is there now has arrived since."""
        self._held_back = ""
        """What was last said of a port that delays."""
        self.write_errors: Counter[int] = Counter()
        """How often a write failed with each errno."""
        self.echo = Echo(
            settings.echo if settings.line != "free" or settings.echo == "yes" else "no",
            settings.name,
            settings.baudrate,
            settings.latency,
        )
        """Leaves out our own bytes, if they come back."""
        self._queue = ByteQueue(MOST_WAITING)
        self._state = BusState.UP
        self._changes: list[BusState] = []
        self._reopen_at: Nanos = 0
        self._stall = Stall()
        self._written = 0
        self._holds = True
        """Whether the port may hold something that has been written, and not sent."""
        self._calm_at: Nanos = 0
        """When a port that was purged counts as going on."""
        self._errors = 0
        """Counted by the driver before this port was opened."""
        self._attach(port)

    @property
    def errors(self) -> int:
        """Bytes that came without their stop bit, or breaks, since the port was opened; 0 where its driver
        does not count them."""
        return line_errors(self._port.fileno()) - self._errors if self._port is not None else 0

    @property
    def dropped(self) -> int:
        """Messages never sent, because the queue was full or the port was gone."""
        return self._queue.dropped

    def troubles(self) -> Iterator[Trouble]:
        """Yield what port and adapter say of themselves that hinders the devices."""
        if self._held_back:
            text, timer, todo = self._held_back.partition(" (its latency timer)")
            older = "each answer is that much older, and one that is too late counts as lost"
            yield Trouble(False, f"{text}{timer}", older, todo.lstrip(";: "))
        if self.errors >= FEW:
            text = f"{self.errors} bytes came without their stop bit, or as a break"
            todo = "the same baud rate on both ends; ground, bias and termination of the line"
            yield Trouble(False, text, "what they belong to is lost", todo)
        yield from of_writes(self.write_errors, self.name)

    def read(self, now: Nanos) -> tuple[Sequence[BusState], Sequence[Packet]]:
        """Return the state changes, and the bytes that have come in since it was read last."""
        if self._port is None:
            self._reopen(now)
        data = self._receive(now)
        if data:
            data = self.echo.strip(now, data)
            for note in self.echo.take_notes():
                log.warning("%s: %s", self.name, note)
        self._flush(now)
        packets = list(self._stamped(now, data))
        self._looked = max(self._looked, now)
        changes, self._changes = self._changes, []
        return changes, packets

    def _stamped(self, now: Nanos, data: bytes) -> Iterator[Packet]:
        """Yield what was read at once in pieces: bytes follow each other no faster than the line carries
        them, the last of them is there now, and none was when it was read before."""
        for at in range(0, len(data), self._piece):
            behind = max(0, len(data) - at - self._piece)
            yield Packet(max(now - behind * self._byte, self._looked), self.name, data[at : at + self._piece])

    def wakes(self, now: Nanos) -> tuple[Sequence[int], Nanos | None]:  # noqa: ARG002 -- a real port has no plan
        """Return the port's file; without one, when it is tried again."""
        return ((self._port.fileno(),), None) if self._port is not None else ((), self._reopen_at)

    def write(self, now: Nanos, frames: Sequence[Frame]) -> None:
        """Send bytes, in order; what the port does not take waits."""
        for frame in frames:
            assert isinstance(frame, bytes), f"{self.name} is a serial line"
            self._queue.put(frame)
            self.echo.sent(now, frame)
        self._flush(now)
        if self._queue.trim():
            self._report(BusState.FULL)

    def close(self) -> None:
        """Release the port."""
        self._close_port()
        self._reopen_at = 1 << 63

    def _receive(self, now: Nanos) -> bytes:
        if self._port is None or not self._poll.poll(0):
            return b""
        data = self._read_piece()
        if not data:  # it can be read, and there is nothing: the other end has hung up
            self._lose(now)
        piece = data
        while len(piece) >= HELD and len(data) < MOST_READ:
            piece = self._read_piece()
            data += piece
        return data

    def _read_piece(self) -> bytes:
        assert self._port is not None
        try:
            return os.read(self._port.fileno(), MOST_READ)
        except OSError:  # nothing is left (EAGAIN), or hung up
            return b""

    def _flush(self, now: Nanos) -> None:
        """Write until the port takes no more. (pyserial's own write spins when its timeout is 0.)"""
        if self._port is None:
            self._queue.clear()
        elif not (self._holds or self._queue):
            self._stall.is_stalled(now, self._written, waiting=False)
        else:
            port = self._port.fileno()
            try:
                empty = self._queue.drain(self._write)
                self._check_stall(now, port, empty=empty)
                if not empty:
                    return
            except OSError as error:
                self.write_errors[error.errno or 0] += 1
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
        self._holds = holds > 0 or not empty
        if self._stall.is_stalled(now, self._written - holds, waiting=self._holds):
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
            self._attach(open_port(self._settings))
            self._report(BusState.BACK)

    def _attach(self, port: serial.Serial) -> None:
        self._port = port
        self._poll.register(port.fileno(), select.POLLIN)
        self._errors = line_errors(port.fileno())
        held_back = holds_back(self._settings, str(port.port))
        if held_back and held_back != self._held_back:
            log.warning("%s: %s", self.name, held_back)
        self._held_back = held_back

    def _close_port(self) -> None:
        port, self._port = self._port, None
        if port is not None:
            self._poll.unregister(port.fileno())
            close_port(self._settings, port)
