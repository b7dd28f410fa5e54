"""A CAN interface of the Linux kernel: "socketcan:can0".

Rules. As in can.py: nothing is raised once it is open, everything is reported as a BusState, reading never
waits, and no stale command is sent after a newer one was given. Beyond that:
- A frame has the kernel's timestamp, mapped onto our clock (timestamps.py). Own frames are not received;
  those of other processes on this machine are.
- What the kernel has accepted and the controller has not sent is monitored: if some of it is older than
  `Patience` allows, no more is handed over until all of it has gone, and waits here (`FrameQueue`). So a long
  transmit queue (`txqueuelen`) cannot fill with old commands while no node acknowledges. Only root can purge
  it: after a second it is said how many may wait, and in the end how late they went out.
- While the bus is OFF or GONE nothing is kept for later: the kernel drops its queue, which is checked. The
  socket stays open while the interface is down, so that nothing is lost when it comes up; only an interface
  that was removed needs a new one.
- The state of the controller comes from its error frames and, where they may have been lost, from the kernel
  (link.py): once a second, ten times a second while the interface is gone.
"""

from __future__ import annotations

import errno
import logging
from collections import Counter
from collections.abc import Iterator, Sequence
from contextlib import suppress

from can.interfaces.socketcan import SocketcanBus as PythonCan

from gateway.buses.error_frames import CanError, describe, kinds, state_of
from gateway.buses.interfaces import check_fit, open_interface
from gateway.buses.netlink import NetDevice, NetLink, NetStatus
from gateway.buses.queues import FrameQueue, Patience
from gateway.buses.socketcan.raw_socket import OpenSocket, RawSocket
from gateway.buses.states import StateTracker
from gateway.buses.timestamps import TimestampMapper
from gateway.buses.troubles import TOO_FAST, Trouble, of_counters, of_writes
from gateway.buses.usb import resolved
from gateway.core.clock import Clock, WallClock
from gateway.core.robot import BusSettings
from gateway.errors import BusError
from protocols.frames import BusState, CanFrame, Frame, Packet
from protocols.messages import MILLISECOND, SECOND, Nanos

log = logging.getLogger("gateway")

MOST_READ = 2048
"""Frames taken in by one read: more than a full bus of 1 Mbit/s carries in 0.1 s."""
SLOW_POLL, FAST_POLL = SECOND, SECOND // 10
"""Polling period of the interface's status: while it is there, and while it is gone."""
_FULL = (errno.ENOBUFS, errno.EAGAIN)
_DOWN = (errno.ENETDOWN,)
_REMOVED = (errno.ENODEV, errno.ENXIO, errno.EBADF)


def open_socketcan(settings: BusSettings, clock: Clock, *, listen_only: bool = False) -> SocketcanBus:
    """Open "socketcan:NAME". Raises BusError: what is missing, or not configured as the robot file has it.

    With `listen_only` any configuration is accepted, and every id is received."""
    device = NetDevice(_channel(settings))
    try:
        opened = _open(settings, device.link(), listen_only)
    except BusError:
        device.close()
        raise
    return SocketcanBus(settings, clock, opened, device, listen_only=listen_only)


def _channel(settings: BusSettings) -> str:
    return resolved(settings).interface.partition(":")[2]


def _open(settings: BusSettings, link: NetLink | None, listen_only: bool) -> OpenSocket:
    opened = open_interface(settings, listen_only=listen_only)
    assert isinstance(opened, PythonCan)
    if link is not None and not listen_only:
        try:
            check_fit(settings, link)
        except BusError:
            opened.shutdown()
            raise
        if link.listen_only:
            log.warning("%s: %s is in listen-only mode: nothing is sent", settings.name, link.name)
    return opened


class SocketcanBus:
    """An open SocketCAN interface."""

    def __init__(
        self,
        settings: BusSettings,
        clock: Clock,
        opened: OpenSocket,
        device: NetDevice,
        *,
        listen_only: bool = False,
    ) -> None:
        self.name = settings.name
        self.errors: Counter[str] = Counter()
        """How often the controller reported each kind of error."""
        self.write_errors: Counter[int] = Counter()
        """How often a write failed with each errno."""
        self._settings = settings
        self._clock = clock
        self._device = device
        self._channel = _channel(settings)
        self._listen_only = listen_only
        self._states = StateTracker()
        self._timestamps = TimestampMapper()
        self._queue = FrameQueue(settings.devices)
        self._lost = 0
        """Frames that were refused, or given while the bus was dead."""
        self._earlier = (0, 0)
        """Counters of earlier sockets: bad, missed."""
        self._poll_at: Nanos = 0
        self._pending = 0
        """Frames of ours of which the kernel may still hold some."""
        self._patience = Patience()
        self._stuck = False
        self._stuck_since: Nanos = 0
        self._told = False
        """Whether it has been said that they are stuck."""
        self._logged: set[str] = set()
        self._missed_logged = 0
        self._socket: RawSocket | None = RawSocket(opened)
        status = device.status()
        self._ifindex = status.ifindex if status is not None else 0
        self._link = device.link()
        if self._link is not None and self._link.state is not None:
            self._set(self._link.state)

    @property
    def dropped(self) -> int:
        """Frames never sent: a newer one took their place, or the interface was gone or refused them."""
        return self._queue.dropped + self._lost

    @property
    def bad(self) -> int:
        """Malformed input: no frame."""
        return self._earlier[0] + (self._socket.bad if self._socket is not None else 0)

    @property
    def missed(self) -> int:
        """Frames that the kernel dropped, since they came faster than they were read."""
        return self._earlier[1] + (self._socket.missed if self._socket is not None else 0)

    def troubles(self) -> Iterator[Trouble]:
        """Yield what interface and controller say of themselves that hinders the devices."""
        name, link = self._channel, self._device.link()
        down = f"sudo ip link set {name} down; sudo ip link set {name}"
        if link is not None and link.listen_only:
            text = f"{name} is in listen-only mode"
            todo = f"{down} type can listen-only off; sudo ip link set {name} up"
            yield Trouble(True, text, "nothing is sent, and nothing acknowledged", todo)
        if link is not None and link.restart_ms == 0:
            text, stays = (
                f"{name} does not restart by itself",
                "after bus-off it stays off until somebody does",
            )
            yield Trouble(False, text, stays, f"{down} type can restart-ms 100; sudo ip link set {name} up")
        yield from of_counters(link.counters if link is not None else None, self.errors, name)
        yield from of_writes(self.write_errors, name)

    def read(self, now: Nanos) -> tuple[Sequence[BusState], Sequence[Packet]]:
        """Return the state changes and the packets up to `now`; timestamps never run backwards."""
        if now >= self._poll_at:
            self._poll(now)
        packets = self._drain(self._socket, now) if self._socket is not None else []
        self._flush(now)
        return self._states.take(now), packets

    def write(self, now: Nanos, frames: Sequence[Frame]) -> None:
        """Send frames, in order; those that the transmit queue has no room for wait."""
        assert not self._listen_only, f"{self.name} is listen-only"
        self._flush(now)
        self._queue.give(frames, lambda frame: self._send(frame, now), wait=self._stuck)

    def close(self) -> None:
        """Release the interface, after one more attempt to send what waits, the stop commands above all."""
        self._hand_over(0)
        self._drop_socket()
        self._device.close()
        self._poll_at = 1 << 63

    # -- transmit -----------------------------------------------------------------------------

    def _send(self, frame: CanFrame, now: Nanos) -> bool:
        """Send a frame; False if it has to wait, True if it was sent, refused, or lost with the interface."""
        if self._socket is None or self._states.dead:
            self._lost += 1
            return True
        try:
            self._socket.send(frame)
        except ValueError as error:
            self._refused("ValueError", str(error))
        except OSError as error:
            self.write_errors[error.errno or 0] += 1
            if error.errno in _FULL:
                self._log_short_queue()
                self._states.full(now)
                return False
            if self._is_gone(error):
                self._lost += 1
            else:
                self._refused(str(error.errno), f"{frame}: {error.strerror}")
        else:
            self._pending += 1
        return True

    def _flush(self, now: Nanos) -> None:
        """Check what the kernel holds of ours, and hand over what waits unless it is stuck."""
        if self._pending and not self._queued():
            self._on_emptied(now)
        self._stuck = self._patience.is_over(now, holds=self._pending > 0)
        if not self._stuck:
            self._stuck_since, self._told = now, False
            self._hand_over(now)
        elif now - self._stuck_since > SECOND and not self._told:
            self._told = True
            self._log_stuck()
        if self._stuck or self._queue:
            self._states.full(now)

    def _queued(self) -> bool:
        """True if the kernel holds frames of ours, or its controller."""
        return self._socket is not None and self._socket.queued() > 0

    def _log_stuck(self) -> None:
        held = f"up to {self._pending} frames wait in the kernel's queue"
        name = self._channel
        remedy = f"to purge them: sudo ip link set {name} down; sudo ip link set {name} up"
        log.warning("%s: %s; nothing is added until they are gone; %s", self.name, held, remedy)

    def _on_emptied(self, now: Nanos) -> None:
        """Say what became of frames that waited in the kernel's queue, if that is news."""
        held, self._pending = self._pending, 0
        if self._states.dead:  # the kernel drops its queue with the bus
            text = "%s: up to %d frames that waited in the kernel's queue were purged"
            log.warning(text, self.name, held)
        elif self._told:
            waited = (now - self._stuck_since) // MILLISECOND
            log.warning("%s: what waited in the kernel's queue went out, %d ms late", self.name, waited)

    def _hand_over(self, now: Nanos) -> None:
        self._queue.drain(lambda frame: self._send(frame, now))

    def _log_short_queue(self) -> None:
        link, wanted = self._link, self._settings.transmit_queue
        if link is not None and link.queue < wanted:
            holds = f"the kernel's transmit queue of {link.name} holds {link.queue} frames"
            longer = f"sudo ip link set {link.name} txqueuelen {wanted}"
            self._log_once("queue", f"{holds}; for a longer one: {longer}")

    def _refused(self, kind: str, reason: str) -> None:
        self._lost += 1
        self._log_once(kind, f"a frame was refused: {reason}")

    # -- receive ------------------------------------------------------------------------------

    def _drain(self, socket: RawSocket, now: Nanos) -> list[Packet]:
        packets: list[Packet] = []
        name, timestamps, receive, clock = self.name, self._timestamps, socket.receive, self._clock
        timestamps.begin(now, clock.system_offset() if isinstance(clock, WallClock) else None)
        for _ in range(MOST_READ):
            try:
                stamp, frame = receive()
            except BlockingIOError:
                timestamps.end()
                break
            except OSError as error:
                self._is_gone(error)
                if error.errno in _DOWN:  # the kernel reports it once; what came before it is still there
                    continue
                break
            if isinstance(frame, CanFrame):
                packets.append(Packet(timestamps.map(stamp), name, frame))
            else:
                self._on_error(frame)
        if self.missed != self._missed_logged:
            count, self._missed_logged = self.missed - self._missed_logged, self.missed
            log.warning(TOO_FAST, name, count)
        return packets

    def _on_error(self, error: CanError) -> None:
        new = any(kind not in self.errors for kind in kinds(error))
        self.errors.update(kinds(error))
        if new:
            log.info("%s: %s", self.name, describe(error))
        state = state_of(error)
        if state is not None:
            self._set(state)

    # -- bus state ----------------------------------------------------------------------------

    def _set(self, state: BusState) -> None:
        was_dead = self._states.dead
        self._states.set(state)
        if self._states.dead and not was_dead:
            self._queue.clear()
            if state is BusState.OFF:
                self._log_restart()

    def _log_restart(self) -> None:
        link = self._link
        if link is None or link.restart_ms is None:
            return
        name, ip = link.name, f"sudo ip link set {link.name}"
        if link.restart_ms:
            text = f"{name} restarts by itself {link.restart_ms} ms after bus-off"
        else:
            text = (
                f"{name} stays bus-off until it is restarted: {ip} type can restart; to have it restart by"
                f" itself: {ip} down; {ip} type can restart-ms 100; {ip} up"
            )
        log.warning("%s: %s", self.name, text)

    def _is_gone(self, error: OSError) -> bool:
        """True if a call on the socket failed because the interface is down or was removed; then note it."""
        if error.errno in _REMOVED:
            self._drop_socket()
        elif error.errno not in _DOWN:
            return False
        self._set(BusState.GONE)
        self._poll_at = 0  # it may be back already
        return True

    def _poll(self, now: Nanos) -> None:
        """Ask the kernel for the state, in case that an error frame was lost or never came."""
        state = self._states.state
        if state is BusState.GONE:
            self._find()
        status = self._device.status()
        if status is None or not status.up:
            self._set(BusState.GONE)
        elif state is BusState.GONE:
            self._come_back(status)
        elif state is not BusState.UP or not status.running:
            link = self._device.link()
            if link is not None and link.state is not None:
                self._set(link.state)
        self._poll_at = now + (FAST_POLL if self._states.state is BusState.GONE else SLOW_POLL)

    def _find(self) -> None:
        """Look for an adapter that may have come back under another name."""
        with suppress(BusError):
            name = _channel(self._settings)
            if name != self._channel:
                self._device.close()
                self._device, self._channel = NetDevice(name), name

    def _come_back(self, status: NetStatus) -> None:
        """The interface is up: keep the socket if it is the same interface, else open a new one."""
        link = self._device.link()
        try:
            if self._socket is None or status.ifindex != self._ifindex:
                self._drop_socket()
                self._socket = RawSocket(_open(self._settings, link, self._listen_only))
                self._ifindex = status.ifindex
            elif link is not None and not self._listen_only:
                check_fit(self._settings, link)
        except BusError as error:
            self._log_once(str(error), str(error))
            return
        self._link = link
        self._set((link.state if link is not None else None) or BusState.UP)

    def _drop_socket(self) -> None:
        socket = self._socket
        if socket is not None:
            self._earlier = (self.bad, self.missed)
            self._socket = None
            socket.close()

    def _log_once(self, kind: str, text: str) -> None:
        if kind not in self._logged:
            self._logged.add(kind)
            log.warning("%s: %s", self.name, text)
