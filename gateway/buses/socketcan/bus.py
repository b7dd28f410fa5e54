"""A CAN interface of the Linux kernel: "socketcan:can0".

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
"""

from __future__ import annotations

import errno
import logging
from collections import Counter
from collections.abc import Sequence
from typing import Protocol

from can.interfaces.socketcan import SocketcanBus as PythonCan

from gateway.buses.can_errors import CanError, kinds, sentence, state_of
from gateway.buses.can_open import check_fit, open_interface
from gateway.buses.socketcan.link import Device, Link, Standing
from gateway.buses.socketcan.raw_socket import Opened, RawSocket
from gateway.buses.stamps import Stamps
from gateway.buses.states import Outbox, States
from gateway.core.clock import Clock, WallClock
from gateway.core.robot import BusSettings
from gateway.errors import BusError
from protocols.frames import BusState, CanFrame, Frame, Packet
from protocols.messages import MILLISECOND, SECOND, Nanos

log = logging.getLogger("gateway")

MOST_READ = 2048
"""Frames taken in by one read: more than a full bus of 1 Mbit/s carries in 0.1 s."""
PATIENCE = 20 * MILLISECOND
"""So long may the kernel hold what we gave it before it gets no more."""
SELDOM, OFTEN = SECOND, SECOND // 10
"""How often the interface is looked at: while it is there, and while it is gone."""
SHORT_QUEUE = 100
"""Frames; where the kernel's own queue is shorter and runs full, a longer one is proposed."""
_FULL = (errno.ENOBUFS, errno.EAGAIN)
_DOWN = (errno.ENETDOWN,)
_REMOVED = (errno.ENODEV, errno.ENXIO, errno.EBADF)


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
    """Open "socketcan:NAME". Raises BusError: what is missing, or not set up as the robot file has it.

    With `listen_only` it is taken as it is set up, and every id is heard."""
    name = settings.interface.partition(":")[2]
    device = Device(name)
    try:
        frame = _open(settings, device.link(), listen_only)
    except BusError:
        device.close()
        raise
    return SocketcanBus(settings, clock, frame, device, listen_only=listen_only)


def _open(settings: BusSettings, link: Link | None, listen_only: bool) -> Opened:
    frame = open_interface(settings, listen_only=listen_only)
    assert isinstance(frame, PythonCan)
    if link is not None and not listen_only:
        try:
            check_fit(settings, link)
        except BusError:
            frame.shutdown()
            raise
        if link.listen_only:
            log.warning("%s: %s only listens (listen-only on): nothing goes out", settings.name, link.name)
    return frame


class SocketcanBus:
    """A SocketCAN interface that is open."""

    def __init__(
        self,
        settings: BusSettings,
        clock: Clock,
        frame: Opened,
        device: Interface,
        *,
        listen_only: bool = False,
    ) -> None:
        self.name = settings.name
        self.errors: Counter[str] = Counter()
        """What the controller has said of itself, in words, and how often."""
        self._settings = settings
        self._clock = clock
        self._device = device
        self._listen_only = listen_only
        self._states = States()
        self._stamps = Stamps()
        self._outbox = Outbox()
        self._lost = 0
        """Frames that were refused, or given while the line was dead."""
        self._before = (0, 0)
        """What earlier sockets have counted: bad, missed."""
        self._look_at: Nanos = 0
        self._taken = False
        """Whether the kernel may still hold something of ours."""
        self._empty_at: Nanos = 0
        """When it last held nothing."""
        self._stuck = False
        self._said: set[str] = set()
        self._missed_told = 0
        self._socket: RawSocket | None = RawSocket(frame)
        self._number = self._standing_number()
        self._link = device.link()
        if self._link is not None and self._link.state is not None:
            self._set(self._link.state)

    @property
    def dropped(self) -> int:
        """Frames that never went out: a newer one took their place, or the interface was gone or refused."""
        return self._outbox.dropped + self._lost

    @property
    def bad(self) -> int:
        """What came in and was no frame."""
        return self._before[0] + (self._socket.bad if self._socket is not None else 0)

    @property
    def missed(self) -> int:
        """Frames that came faster than they were read: the kernel threw them away."""
        return self._before[1] + (self._socket.missed if self._socket is not None else 0)

    def read(self, now: Nanos) -> tuple[Sequence[BusState], Sequence[Packet]]:
        """What has changed and what has come in up to `now`; stamps never run backwards."""
        if now >= self._look_at:
            self._look(now)
        packets = self._drain(self._socket, now) if self._socket is not None else []
        self._flush(now)
        return self._states.take(now), packets

    def write(self, now: Nanos, frames: Sequence[Frame]) -> None:
        """Put frames on the bus, in order; whatever finds no room waits."""
        assert not self._listen_only, f"{self.name} is listened to"
        self._flush(now)
        for frame in frames:
            assert isinstance(frame, CanFrame), f"{self.name} is a CAN bus"
            if self._states.dead:
                self._lost += 1
            elif self._stuck or self._outbox or not self._send(frame, now):
                self._outbox.put(frame)

    def close(self) -> None:
        """Give the interface back; what waits, the safe word above all, is tried once more."""
        self._hand_over(self._empty_at)
        self._drop_socket()
        self._device.close()
        self._look_at = 1 << 63

    # -- out ----------------------------------------------------------------------------------

    def _send(self, frame: CanFrame, now: Nanos) -> bool:
        """Whether the frame is off our hands: with the kernel, refused, or lost with the interface."""
        if self._socket is None:
            self._lost += 1
            return True
        try:
            self._socket.send(frame)
        except ValueError as error:
            self._refuse("ValueError", str(error))
        except OSError as error:
            if error.errno in _FULL:
                self._report_queue()
                self._states.full(now)
                return False
            if not self._died(error):
                self._refuse(str(error.errno), f"{frame}: {error.strerror}")
            else:
                self._lost += 1
        else:
            self._taken = True
        return True

    def _flush(self, now: Nanos) -> None:
        """Look at what the kernel holds of us, and hand over what waits if it is not stuck."""
        if self._taken:
            self._taken = self._socket is not None and self._socket.queued() > 0
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

    def _report_queue(self) -> None:
        link = self._link
        if link is not None and link.queue < SHORT_QUEUE:
            holds = f"the kernel's transmit queue of {link.name} holds {link.queue} frames"
            longer = f"sudo ip link set {link.name} txqueuelen {SHORT_QUEUE}"
            self._say_once("queue", f"{holds}; for a longer one: {longer}")

    def _refuse(self, kind: str, why: str) -> None:
        self._lost += 1
        self._say_once(kind, f"a frame was refused: {why}")

    # -- in -----------------------------------------------------------------------------------

    def _drain(self, socket: RawSocket, now: Nanos) -> list[Packet]:
        packets: list[Packet] = []
        name, stamps, receive, clock = self.name, self._stamps, socket.receive, self._clock
        stamps.begin(now, clock.system_offset() if isinstance(clock, WallClock) else None)
        for _ in range(MOST_READ):
            try:
                stamp, frame = receive()
            except BlockingIOError:
                stamps.end()
                break
            except OSError as error:
                self._died(error)
                if error.errno in _DOWN:  # said once, and what came before it is still there
                    continue
                break
            if isinstance(frame, CanFrame):
                packets.append(Packet(stamps.move(stamp), name, frame))
            else:
                self._on_error(frame)
        if self.missed != self._missed_told:
            count, self._missed_told = self.missed - self._missed_told, self.missed
            log.warning("%s: %d frames came faster than they were read, and are lost", name, count)
        return packets

    def _on_error(self, error: CanError) -> None:
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
                self._report_restart()

    def _report_restart(self) -> None:
        link = self._link
        if link is None or link.restart_ms is None:
            return
        name, ip = link.name, f"sudo ip link set {link.name}"
        if link.restart_ms:
            text = f"{name} starts again by itself {link.restart_ms} ms after bus-off"
        else:
            text = (
                f"{name} stays off until somebody types: {ip} type can restart; to have it start again by"
                f" itself: {ip} down; {ip} type can restart-ms 100; {ip} up"
            )
        log.warning("%s: %s", self.name, text)

    def _died(self, error: OSError) -> bool:
        """Whether a call on the socket failed because the interface is down or was removed."""
        if error.errno in _REMOVED:
            self._drop_socket()
        elif error.errno not in _DOWN:
            return False
        self._set(BusState.GONE)
        self._look_at = 0  # it may be back already
        return True

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
            if self._socket is None or standing.number != self._number:
                self._drop_socket()
                self._socket = RawSocket(_open(self._settings, link, self._listen_only))
                self._number = self._standing_number()
            elif link is not None and not self._listen_only:
                check_fit(self._settings, link)
        except BusError as error:
            self._say_once(str(error), str(error))
            return
        self._link = link
        self._set((link.state if link is not None else None) or BusState.UP)

    def _standing_number(self) -> int:
        standing = self._device.standing()
        return standing.number if standing is not None else 0

    def _drop_socket(self) -> None:
        gone = self._socket
        if gone is not None:
            self._before = (self.bad, self.missed)
            self._socket = None
            gone.close()

    def _say_once(self, kind: str, text: str) -> None:
        if kind not in self._said:
            self._said.add(kind)
            log.warning("%s: %s", self.name, text)
