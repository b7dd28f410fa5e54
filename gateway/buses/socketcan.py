"""A CAN interface of the Linux kernel: python-can opens its socket, and this file reads and writes it.

Rules. As in can.py: nothing is raised once it is open, everything is told as a BusState, reading never waits,
and no stale command goes out after a newer one was given. Beyond that:
- A frame bears the kernel's stamp, moved onto our clock (stamps.py). Own frames are not heard; those of other
  processes on this machine are.
- What the kernel has taken and the controller has not is watched: if some of it has stood there for longer
  than `PATIENCE`, no more is handed over until all of it has gone, and only the newest of each id waits here.
  So a long transmit queue (`txqueuelen`) cannot fill with old commands while nobody listens.
- While the line is OFF or GONE nothing is kept for later. The socket stays open while the interface is down,
  so that nothing is lost when it comes up; only an interface that was removed needs a new one.
- The state of the controller comes from its error frames and, where they may have been lost, from the kernel
  (link.py): once a second, ten times a second while the interface is gone.

python-can's own `recv` and `send` are not used (4.6.1, can/interfaces/socketcan/socketcan.py): `recv` allows
for no other ancillary message than the stamp, so that lost frames cannot be counted, and rounds the stamp to
a float; `send` says as text that a queue is full; each asks `select` for every frame.
"""

from __future__ import annotations

import errno
import logging
import socket
import struct
from collections import Counter
from collections.abc import Sequence
from typing import Protocol

from can.interfaces.socketcan import SocketcanBus as PythonCan

from gateway.buses import BusError
from gateway.buses.can_errors import CanError, kinds, sentence, state_of
from gateway.buses.can_open import check_fit, open_interface
from gateway.buses.can_struct import FD, pack, unpack
from gateway.buses.link import Device, Link, Standing
from gateway.buses.stamps import Stamps
from gateway.buses.states import Outbox, States
from gateway.clock import Clock, WallClock
from gateway.robot import BusSettings
from protocols.wire import BusState, CanFrame, Packet, Wire
from protocols.words import MILLISECOND, SECOND, Nanos

log = logging.getLogger("gateway")

MOST_READ = 2048
"""Frames taken in by one read: more than a full bus of 1 Mbit/s carries in 0.1 s."""
PATIENCE = 20 * MILLISECOND
"""So long may the kernel hold what we gave it before it gets no more."""
SELDOM, OFTEN = SECOND, SECOND // 10
"""How often the interface is looked at: while it is there, and while it is gone."""
ROOM = 4 << 20
"""Bytes of the receive buffer where it may be had (CAP_NET_ADMIN): a default of 208 KiB holds 278 frames."""

_SO_TIMESTAMPNS, _SO_RCVBUFFORCE, _SO_RXQ_OVFL, _SO_MEMINFO = 35, 33, 40, 55
_QUEUED = 2
"""SK_MEMINFO_WMEM_ALLOC: which of SO_MEMINFO's nine numbers is what the transmit queue holds of us."""
_MEMINFO = struct.Struct("=9I")
_TIMESPEC = struct.Struct("@ll")
_COUNT = struct.Struct("=I")
_ANCILLARY = socket.CMSG_SPACE(_TIMESPEC.size) + socket.CMSG_SPACE(_COUNT.size)
_FULL = (errno.ENOBUFS, errno.EAGAIN)
_DOWN = (errno.ENETDOWN,)
_REMOVED = (errno.ENODEV, errno.ENXIO, errno.EBADF)


class Opened(Protocol):
    """What is used of python-can's SocketcanBus."""

    socket: socket.socket

    def shutdown(self) -> None:
        """Close the socket."""
        ...


class Interface(Protocol):
    """What is asked of the kernel (link.Device)."""

    def standing(self) -> Standing | None:
        """Whether it is there and up."""
        ...

    def link(self) -> Link | None:
        """All that is known of it."""
        ...

    def close(self) -> None:
        """Ask no more."""
        ...


def open_socketcan(settings: BusSettings, clock: Clock, *, listen_only: bool = False) -> SocketcanBus:
    """Open "socketcan:NAME". Raises BusError: what is missing, or not set up as the robot file has it."""
    name = settings.interface.partition(":")[2]
    wire = _open(settings, listen_only)
    device = Device(name)
    link = device.link()
    bus = SocketcanBus(settings, clock, wire, device, listen_only=listen_only)
    try:
        if link is not None:
            check_fit(settings, link)
    except BusError:
        bus.close()
        raise
    if link is not None and link.listen_only and not listen_only:
        log.warning("%s: %s is in listen-only mode: nothing that is sent goes out", settings.name, name)
    return bus


def _open(settings: BusSettings, listen_only: bool) -> Opened:
    wire = open_interface(settings, listen_only=listen_only)
    assert isinstance(wire, PythonCan)
    return wire


class SocketcanBus:
    """A SocketCAN interface that is open."""

    def __init__(
        self,
        settings: BusSettings,
        clock: Clock,
        wire: Opened,
        device: Interface,
        *,
        listen_only: bool = False,
    ) -> None:
        self.name = settings.name
        self.bad = 0
        """What came in and was no frame."""
        self.missed = 0
        """Frames that came faster than they were read: the kernel threw them away."""
        self.errors: Counter[str] = Counter()
        """What the controller has said of itself, in words, and how often."""
        self._settings = settings
        self._clock = clock
        self._device = device
        self._link: Link | None = None
        self._listen_only = listen_only
        self._states = States()
        self._stamps = Stamps()
        self._outbox = Outbox()
        self._wire: Opened | None = None
        self._lost = 0
        """Frames that were refused, or given while the line was dead."""
        self._number = 0
        self._look_at: Nanos = 0
        self._taken = False
        """Whether the kernel may still hold something of ours."""
        self._empty_at: Nanos = 0
        """When it last held nothing."""
        self._stuck = False
        self._told: set[str] = set()
        self._overflow = 0
        """The kernel's own count of what it threw away, of this socket."""
        self._missed_before = 0
        self._use(wire)
        self._link = link = device.link()
        if link is not None and link.state is not None:
            self._set(link.state)

    @property
    def dropped(self) -> int:
        """Frames that never went out: a newer one took their place, or the interface was gone or refused."""
        return self._outbox.dropped + self._lost

    def read(self, now: Nanos) -> tuple[Sequence[BusState], Sequence[Packet]]:
        """What has changed and what has come in up to `now`; stamps never run backwards."""
        if now >= self._look_at:
            self._look(now)
        packets = self._drain(now) if self._wire is not None else []
        self._flush(now)
        return self._states.take(now), packets

    def write(self, now: Nanos, wires: Sequence[Wire]) -> None:
        """Put frames on the bus, in order; whatever finds no room waits."""
        assert not self._listen_only, f"{self.name} is listened to"
        self._flush(now)
        for wire in wires:
            assert isinstance(wire, CanFrame), f"{self.name} is a CAN bus"
            if self._states.dead:
                self._lost += 1
            elif self._stuck or self._outbox or not self._send(wire, now):
                self._outbox.put(wire)

    def close(self) -> None:
        """Give the interface back; what waits, the safe word above all, is tried once more."""
        self._hand_over(self._empty_at)
        self._drop_socket()
        self._device.close()
        self._look_at = 1 << 63

    # -- out ----------------------------------------------------------------------------------

    def _send(self, frame: CanFrame, now: Nanos) -> bool:
        """Whether the frame is off our hands: with the kernel, refused, or lost with the interface."""
        if self._wire is None:
            self._lost += 1
            return True
        try:
            self._socket.send(pack(frame), socket.MSG_DONTWAIT)
        except ValueError as error:
            self._refused("ValueError", str(error))
        except OSError as error:
            if error.errno in _FULL:
                self._jam(now)
                return False
            self._fail(error, frame)
        else:
            self._taken = True
        return True

    def _flush(self, now: Nanos) -> None:
        """Look at what the kernel holds of us, and hand over what waits if it is not stuck."""
        if self._taken and self._wire is not None:
            self._taken = self._queued() > 0
        if not self._taken:
            self._empty_at = now
        self._stuck = now - self._empty_at > PATIENCE
        if not self._stuck:
            self._hand_over(now)
        if self._stuck or self._outbox:
            self._states.full(now)

    def _hand_over(self, now: Nanos) -> None:
        while self._outbox:
            frame = self._outbox.take()
            if not self._send(frame, now):
                self._outbox.put_back(frame)
                return

    def _queued(self) -> int:
        """Bytes that the kernel has of us and the controller has not."""
        try:
            return int(_MEMINFO.unpack(self._socket.getsockopt(socket.SOL_SOCKET, _SO_MEMINFO, 36))[_QUEUED])
        except (OSError, struct.error):  # a kernel older than 4.12 does not tell
            return 0

    def _jam(self, now: Nanos) -> None:
        self._states.full(now)
        if self._link is not None and self._link.queue < 100:
            self._say_once(
                "queue",
                f"the kernel's transmit queue of {self._link.name} holds {self._link.queue} frames; a longer"
                f" one: sudo ip link set {self._link.name} txqueuelen 100",
            )

    def _refused(self, kind: str, why: str) -> None:
        self._lost += 1
        self._say_once(kind, f"a frame was refused: {why}")

    # -- in -----------------------------------------------------------------------------------

    def _drain(self, now: Nanos) -> list[Packet]:
        packets: list[Packet] = []
        name, stamps, receive = self.name, self._stamps, self._socket.recvmsg
        clock = self._clock
        stamps.begin(now, clock.system_offset() if isinstance(clock, WallClock) else None)
        for _ in range(MOST_READ):
            try:
                raw, extra, _, _ = receive(FD.size, _ANCILLARY, socket.MSG_DONTWAIT)
            except BlockingIOError:
                stamps.end()
                break
            except OSError as error:
                self._fail(error)
                if error.errno in _DOWN:  # told once; what came before is still there
                    continue
                break
            wire = unpack(raw)
            if isinstance(wire, CanFrame):
                packets.append(Packet(stamps.move(self._stamp(extra)), name, wire))
            elif wire is not None:
                self._hear_error(wire)
            else:
                self.bad += 1
        if self.missed != self._missed_before:
            self._tell_missed()
        return packets

    def _stamp(self, ancillary: list[tuple[int, int, bytes]]) -> Nanos:
        """The kernel's stamp, in nanoseconds since 1970; on the way, how many frames were lost so far."""
        stamp = 0
        for _, kind, data in ancillary:
            if kind == _SO_TIMESTAMPNS:
                seconds, nanos = _TIMESPEC.unpack_from(data)
                stamp = seconds * SECOND + nanos
            elif kind == _SO_RXQ_OVFL:
                self._count_missed(_COUNT.unpack_from(data)[0])
        return stamp

    def _count_missed(self, so_far: int) -> None:
        self.missed += (so_far - self._overflow) % (1 << 32)
        self._overflow = so_far

    def _tell_missed(self) -> None:
        count, self._missed_before = self.missed - self._missed_before, self.missed
        log.warning("%s: %d frames came faster than they were read, and are lost", self.name, count)

    def _hear_error(self, error: CanError) -> None:
        new = [kind for kind in kinds(error) if kind not in self.errors]
        self.errors.update(kinds(error))
        if new:
            log.info("%s: %s", self.name, sentence(error))
        state = state_of(error)
        if state is not None:
            self._set(state)

    # -- the state of the line -----------------------------------------------------------------------

    def _set(self, line: BusState) -> None:
        was_dead = self._states.dead
        self._states.set(line)
        if self._states.dead and not was_dead:
            self._outbox.clear()
            self._taken = False
            if line is BusState.OFF:
                self._tell_restart()

    def _tell_restart(self) -> None:
        if self._link is None or self._link.restart_ms is None:
            return
        name = self._link.name
        if self._link.restart_ms:
            text = f"{name} starts again by itself {self._link.restart_ms} ms after bus-off"
        else:
            text = (
                f"{name} stays off until somebody types: sudo ip link set {name} type can restart; to have it"
                f" start again by itself: sudo ip link set {name} down; sudo ip link set {name} type can"
                f" restart-ms 100; sudo ip link set {name} up"
            )
        log.warning("%s: %s", self.name, text)

    def _fail(self, error: OSError, frame: CanFrame | None = None) -> None:
        """A call on the socket failed: the interface is down or removed, or it does not take this frame."""
        if error.errno in _DOWN:
            self._set(BusState.GONE)
            self._look_at = 0  # it may be up again already
        elif error.errno in _REMOVED:
            self._drop_socket()
            self._set(BusState.GONE)
            self._look_at = 0
        elif frame is not None:
            self._refused(str(error.errno), f"{frame}: {error.strerror}")
            return
        self._lost += frame is not None

    def _look(self, now: Nanos) -> None:
        """What the kernel says, in case that an error frame was lost or never came."""
        standing = self._device.standing()
        line = self._states.line
        if standing is None or not standing.up:
            self._set(BusState.GONE)
        elif line is BusState.GONE:
            self._come_back(standing)
        elif line is not BusState.UP or not standing.running:
            link = self._device.link()
            if link is not None and link.state is not None:
                self._set(link.state)
        self._look_at = now + (OFTEN if self._states.line is BusState.GONE else SELDOM)

    def _come_back(self, standing: Standing) -> None:
        """The interface is up: with the old socket if it is the same one, else with a new one."""
        link = self._device.link()
        try:
            if self._wire is None or standing.number != self._number:
                self._drop_socket()
                self._use(_open(self._settings, self._listen_only))
            if link is not None:
                check_fit(self._settings, link)
        except BusError as error:
            self._say_once(str(error), str(error))
            return
        self._link = link
        self._set((link.state if link is not None else None) or BusState.UP)

    def _use(self, wire: Opened) -> None:
        """Take the socket that python-can has opened and bound."""
        self._wire = wire
        self._socket: socket.socket = wire.socket
        self._overflow = 0
        standing = self._device.standing()
        self._number = standing.number if standing is not None else 0
        for level, what in ((_SO_RCVBUFFORCE, ROOM), (_SO_RXQ_OVFL, 1)):
            try:
                self._socket.setsockopt(socket.SOL_SOCKET, level, what)
            except PermissionError:
                self._socket.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, ROOM)  # as much as is allowed

    def _drop_socket(self) -> None:
        wire, self._wire = self._wire, None
        if wire is not None:
            wire.shutdown()

    def _say_once(self, kind: str, text: str) -> None:
        if kind not in self._told:
            self._told.add(kind)
            log.warning("%s: %s", self.name, text)
