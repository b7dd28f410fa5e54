"""A CAN bus by way of python-can: "slcan:/dev/ttyACM0", "fdcanusb:/dev/ttyACM0", "virtual:test".

Rules. Opening raises a BusError with what is missing; afterwards nothing is raised, everything is reported as
a BusState, once per change. Reading drains what is there, a bounded number of frames at a time, and never
waits. Own frames are not received. What cannot be sent at once waits in a bounded queue (`FrameQueue`): no
stale command is sent after a newer one was given. When the interface is lost, the queue is dropped; it is
tried again once a second. An adapter that refuses most of what it is sent is taken off the bus, and joins it
again after a second; if it still does, after 2, 4 and at most 8 s.
"""

from __future__ import annotations

import errno
import logging
import select
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from contextlib import suppress
from functools import partial

import can

from gateway.buses.adapters.port import AdapterInterface
from gateway.buses.error_frames import CanError, state_of
from gateway.buses.interfaces import open_interface, waits
from gateway.buses.python_can import frame_of, message_of
from gateway.buses.queues import STALE, FrameQueue
from gateway.buses.states import StateTracker
from gateway.buses.threaded import MOST_FAILURES, Opening, ThreadedInterface
from gateway.buses.timestamps import TimestampMapper
from gateway.buses.troubles import TOO_FAST, Trouble, of_writes
from gateway.core.clock import Clock, WallClock
from gateway.core.robot import BusSettings
from gateway.errors import BusError
from protocols.frames import BusState, CanFrame, Frame, Packet
from protocols.messages import MILLISECOND, SECOND, Nanos

log = logging.getLogger("gateway")

MOST_READ = 1024
"""Frames taken in by one read: more than a full bus of 1 Mbit/s carries in 0.1 s."""
SEND_TIMEOUT = 0.005
"""Seconds that an adapter on a serial line may take for one frame."""
REOPEN = SECOND
"""Period of the attempts to reopen a lost interface."""
LONGEST_OFF = 8
"""Times as long an adapter that refuses what it is sent stays off the bus at most."""
_FULL = (errno.ENOBUFS, errno.EAGAIN)


def open_can(settings: BusSettings, clock: Clock, *, listen_only: bool = False) -> CanBus:
    """Open an interface of python-can. Raises BusError with what is missing and how to get it."""
    interface = open_interface(settings, listen_only=listen_only)
    return CanBus(settings, clock, interface, listen_only=listen_only)


class CanBus:
    """An open CAN interface."""

    def __init__(
        self, settings: BusSettings, clock: Clock, interface: can.BusABC, *, listen_only: bool = False
    ) -> None:
        self.name = settings.name
        self._settings = settings
        self._clock = clock
        self._interface: can.BusABC | None = interface
        self._listen_only = listen_only
        self.bad = 0
        """Malformed input: what could not be read as a frame."""
        self.turned_off = 0
        """How often an adapter that refused what it was sent was taken off the bus, to join it again."""
        self.write_errors: Counter[int] = Counter()
        """How often a write failed with each errno."""
        self._failures = 0
        """Exceptions of a back end in a row."""
        self._opening: Opening | None = None
        self._refused = 0
        """What was refused by interfaces before this one."""
        self._refusing = 0
        """How often it was taken off the bus since it last took what it was sent."""
        self._on_at: Nanos | None = None
        """When it joins the bus again; None: it is on it."""
        self._send_timeout = None if settings.interface.startswith("virtual:") else SEND_TIMEOUT
        self._loopback = settings.interface.startswith("udp_multicast:")
        """Whether the interface receives its own frames."""
        self._echoes: Counter[CanFrame] = Counter()
        """Own frames that will still be received."""
        self._queue = FrameQueue(settings.devices)
        self._states = StateTracker()
        self._timestamps = TimestampMapper()
        self._lost = self._missed = 0
        self._reopen_at: Nanos = 0

    @property
    def dropped(self) -> int:
        """Frames never sent, because a newer one took their place or the interface was gone."""
        return self._queue.dropped + self._lost

    def troubles(self) -> Iterator[Trouble]:
        """Yield what has failed in writing."""
        yield from of_writes(self.write_errors, self._settings.interface.partition(":")[2])

    @property
    def refused(self) -> int:
        """Frames and commands that the adapter has refused."""
        adapter = self._interface
        return self._refused + (adapter.refusals.refused if isinstance(adapter, AdapterInterface) else 0)

    def read(self, now: Nanos) -> tuple[Sequence[BusState], Sequence[Packet]]:
        """Return the state changes and the packets up to `now`; timestamps never run backwards."""
        packets: list[Packet] = []
        if self._interface is None:
            self._reopen(now)
        elif self._on_at is not None and now >= self._on_at:
            self._turn_on(now)
        clock = self._clock
        self._timestamps.begin(now, clock.system_offset() if isinstance(clock, WallClock) else None)
        for _ in range(MOST_READ):
            bad = self.bad
            message = self._receive(now)
            if message is None:
                if self.bad > bad or self._more():
                    continue
                self._timestamps.end()
                break
            if message.is_error_frame:
                self._on_error(message)
                continue
            frame = frame_of(message)
            if not self._is_echo(frame):
                t = self._timestamps.map(round(message.timestamp * SECOND) or None)
                packets.append(Packet(t, self.name, frame))
        self._flush(now)
        return self._states.take(now), packets

    def write(self, now: Nanos, frames: Sequence[Frame]) -> None:
        """Send frames, in order; those that the transmit queue has no room for wait."""
        assert not self._listen_only, f"{self.name} is listen-only"
        self._flush(now)
        self._queue.give(frames, lambda frame: self._send(frame, now))

    def close(self) -> None:
        """Release the interface."""
        self._shut_down()
        if self._opening is not None:
            self._opening.cancel()
        self._opening, self._reopen_at = None, 1 << 63

    # -- transmit -----------------------------------------------------------------------------

    def _send(self, frame: CanFrame, now: Nanos) -> bool:
        """Send a frame; False if it has to wait, True if it was sent, or lost with the interface."""
        if self._interface is None or self._on_at is not None:
            self._lost += 1
            return True
        try:
            self._interface.send(message_of(frame), timeout=self._send_timeout)
        except Exception as error:  # noqa: BLE001 -- whatever a back end raises is a state of the bus
            self.write_errors[_number(error)] += 1
            if _is_full(error):
                self._states.full(now)
                return False
            self._lose(now)
            self._lost += 1
            return True
        if self._loopback:
            self._echoes[frame] += 1
        return True

    def _flush(self, now: Nanos) -> None:
        if isinstance(self._interface, AdapterInterface | ThreadedInterface):
            self._watch(self._interface, now)
        self._queue.drain(lambda frame: self._send(frame, now))

    def _watch(self, adapter: AdapterInterface | ThreadedInterface, now: Nanos) -> None:
        """Purge what an adapter does not take; take one off the bus that refuses what it is sent."""
        if adapter.purged(now):
            log.warning(
                "%s: its adapter took nothing for %d ms: what waited for it was purged",
                *(self.name, STALE // MILLISECOND),
            )
            self._states.full(now)
        if isinstance(adapter, ThreadedInterface):
            if (count := adapter.missed - self._missed) > 0:
                log.warning(TOO_FAST, self.name, count)
            self._missed = adapter.missed
            return
        refuses = adapter.refusals.judge(now)
        if refuses:
            self._turn_off(adapter, now)
        elif refuses is False:
            self._refusing = 0

    def _turn_off(self, adapter: AdapterInterface, now: Nanos) -> None:
        delay = min(1 << self._refusing, LONGEST_OFF)
        self._refusing += 1
        self.turned_off += 1
        self._forget()
        self._states.set(BusState.OFF)
        self._on_at = now + delay * REOPEN
        log.warning(
            "%s: its adapter refuses what it is sent (%d times by now): it is bus-off, was reset, or cannot "
            "send such frames; it is taken off the bus for %d s (time %d)",
            *(self.name, self.refused, delay, self.turned_off),
        )
        adapter.port.drop()
        self._try(adapter.turn_off, now)

    def _turn_on(self, now: Nanos) -> None:
        assert isinstance(self._interface, AdapterInterface)
        self._on_at = None
        self._states.set(BusState.BACK)
        self._try(self._interface.turn_on, now)

    def _try(self, tell: Callable[[], None], now: Nanos) -> None:
        try:
            tell()
        except can.CanError:
            self._lose(now)

    # -- receive ------------------------------------------------------------------------------

    def _receive(self, now: Nanos) -> can.Message | None:
        if self._interface is None:
            return None
        try:
            message = self._interface.recv(timeout=0)
        except (can.CanError, OSError):
            self._lose(now)
        except Exception:  # noqa: BLE001 -- what a back end could not parse, or has stumbled over
            self.bad += 1
            self._failures += not isinstance(self._interface, AdapterInterface)  # those parse by themselves
            if self._failures > MOST_FAILURES:
                self._lose(now)
        else:
            self._failures = 0
            return message
        return None

    def _more(self) -> bool:
        """True if a None was an adapter's own line (slcan acknowledges each frame), and more is waiting."""
        try:
            return self._interface is not None and bool(
                select.select([self._interface.fileno()], [], [], 0)[0]
            )
        except Exception:  # noqa: BLE001 -- a back end without a file, or one that has gone
            return False

    def _is_echo(self, frame: CanFrame) -> bool:
        """True if a frame is our own, received over an interface with loopback."""
        sent = self._echoes[frame]
        if sent > 1:
            self._echoes[frame] = sent - 1
        elif sent == 1:
            del self._echoes[frame]
        return sent > 0

    def _on_error(self, message: can.Message) -> None:
        """Some back ends return error frames in SocketCAN's format."""
        state = state_of(CanError(message.arbitration_id, bytes(message.data).ljust(8, b"\0")))
        if state is BusState.OFF:
            self._forget()
        if state is not None:
            self._states.set(state)

    # -- lost and back ------------------------------------------------------------------------

    def _forget(self) -> None:
        self._queue.clear()
        self._echoes.clear()

    def _lose(self, now: Nanos) -> None:
        self._refused = self.refused
        self._on_at = None
        self._shut_down(lost=True)
        self._forget()
        self._reopen_at = now + REOPEN
        self._states.set(BusState.GONE)

    def _reopen(self, now: Nanos) -> None:
        opening, again = self._opening, partial(open_interface, self._settings, listen_only=self._listen_only)
        if opening is not None and opening.done:
            self._interface, self._opening = opening.interface, None
        elif opening is None and now >= self._reopen_at:
            self._reopen_at = now + REOPEN
            if waits(self._settings):
                self._opening = Opening(again)
            else:
                with suppress(BusError):
                    self._interface = again()
        if self._interface is not None:
            self._failures = 0
            self._states.set(BusState.BACK)

    def _shut_down(self, *, lost: bool = False) -> None:
        interface, self._interface = self._interface, None
        with suppress(Exception):  # an interface that has vanished cannot be shut down either
            if lost and isinstance(interface, ThreadedInterface):
                interface.abandon()
                return
            if lost and isinstance(interface, AdapterInterface):
                interface.port.drop()
            if interface is not None:
                interface.shutdown()


def _number(error: Exception) -> int:
    """Return the errno of what a back end has raised: its own, that of its cause, EIO if it has none."""
    if isinstance(error, can.CanTimeoutError):
        return errno.ETIMEDOUT
    own = error.error_code if isinstance(error, can.CanError) else getattr(error, "errno", None)
    return own or getattr(error.__cause__, "errno", None) or errno.EIO


def _is_full(error: Exception) -> bool:
    """True if the transmit queue is full, as the kernel, python-can or an adapter's timeout reports it."""
    if isinstance(error, can.CanTimeoutError):
        return True
    code = error.error_code if isinstance(error, can.CanError) else getattr(error, "errno", None)
    return code in _FULL or "buffer full" in str(error) or "timeout" in str(error).lower()
