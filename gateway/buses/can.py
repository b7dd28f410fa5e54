"""A CAN bus by an interface of python-can, or of ours: "slcan:/dev/ttyACM0", "fdcanusb:/dev/ttyACM0",
"virtual:test". SocketCAN has its own file.

Rules. Opening says in a sentence what is missing; afterwards nothing is raised, everything is told as a
BusState, once for each change. Reading drains what is there, a bounded number of frames at a time, and never
waits. Own frames are not heard. What cannot go out at once waits in a bounded queue in which a newer frame
replaces an older one of the same id: no stale command goes out after a newer one was given. What waits when
the interface vanishes is thrown away; whether it has come back is looked for once a second.
"""

from __future__ import annotations

import errno
import select
from collections.abc import Sequence

import can

from gateway.buses import Bus
from gateway.buses.can_errors import CanError, state_of
from gateway.buses.can_open import open_interface
from gateway.buses.socketcan.bus import open_socketcan
from gateway.buses.stamps import Stamps
from gateway.buses.states import Outbox, States
from gateway.core.clock import Clock, WallClock
from gateway.core.robot import BusSettings
from gateway.errors import BusError
from protocols.frames import BusState, CanFrame, Frame, Packet
from protocols.messages import SECOND, Nanos

MOST_READ = 1024
"""Frames taken in by one read: more than a full bus of 1 Mbit/s carries in 0.1 s."""
SEND_PATIENCE = 0.005
"""Seconds that an adapter on a serial line may take for one frame."""
REOPEN = SECOND
_FULL = (errno.ENOBUFS, errno.EAGAIN)


def open_can(settings: BusSettings, clock: Clock, *, listen_only: bool = False) -> Bus:
    """Open the bus. Raises BusError with what is missing and how to get it.

    `listen_only`: nothing is ever sent, not even an acknowledgement where the interface can be told so."""
    if settings.interface.startswith("socketcan:"):
        return open_socketcan(settings, clock, listen_only=listen_only)
    frame = open_interface(settings, listen_only=listen_only)
    return CanBus(settings, clock, frame, listen_only=listen_only)


class CanBus:
    """A CAN interface that is open."""

    def __init__(
        self, settings: BusSettings, clock: Clock, frame: can.BusABC, *, listen_only: bool = False
    ) -> None:
        self.name = settings.name
        self._settings = settings
        self._clock = clock
        self._frame: can.BusABC | None = frame
        self._listen_only = listen_only
        self.bad = 0
        """What came in and could not be read as a frame."""
        self._patience = None if settings.interface.startswith("virtual:") else SEND_PATIENCE
        self._hears_itself = settings.interface.startswith("udp_multicast:")
        self._echoes: dict[CanFrame, int] = {}
        self._outbox = Outbox()
        self._states = States()
        self._stamps = Stamps()
        self._lost = 0
        self._reopen_at: Nanos = 0

    @property
    def dropped(self) -> int:
        """Frames that never went out, because a newer one took their place or the interface was gone."""
        return self._outbox.dropped + self._lost

    def read(self, now: Nanos) -> tuple[Sequence[BusState], Sequence[Packet]]:
        """What has changed and what has come in up to `now`; stamps never run backwards."""
        packets: list[Packet] = []
        if self._frame is None:
            self._come_back(now)
        clock = self._clock
        self._stamps.begin(now, clock.system_offset() if isinstance(clock, WallClock) else None)
        for _ in range(MOST_READ):
            bad = self.bad
            message = self._receive(now)
            if message is None:
                if self.bad > bad or self._more():
                    continue
                self._stamps.end()
                break
            if message.is_error_frame:
                self._on_error(message)
                continue
            frame = _frame(message)
            if not self._is_echo(frame):
                stamp = round(message.timestamp * SECOND)
                t = self._stamps.move(stamp) if stamp else self._stamps.none()
                packets.append(Packet(t, self.name, frame))
        self._flush(now)
        return self._states.take(now), packets

    def write(self, now: Nanos, frames: Sequence[Frame]) -> None:
        """Put frames on the bus, in order; whatever finds no room waits."""
        assert not self._listen_only, f"{self.name} is listened to"
        self._flush(now)
        for frame in frames:
            assert isinstance(frame, CanFrame), f"{self.name} is a CAN bus"
            if self._outbox or not self._send(frame, now):
                self._outbox.put(frame)

    def close(self) -> None:
        """Give the interface back."""
        frame, self._frame = self._frame, None
        self._reopen_at = 1 << 63
        if frame is not None:
            _shut(frame)

    # -- out ----------------------------------------------------------------------------------

    def _send(self, frame: CanFrame, now: Nanos) -> bool:
        """Whether the frame is off our hands: sent, or lost with the interface."""
        if self._frame is None:
            self._lost += 1
            return True
        try:
            self._frame.send(_message(frame), timeout=self._patience)
        except can.CanTimeoutError:
            self._states.full(now)
            return False
        except (can.CanError, OSError) as error:
            if _is_full(error):
                self._states.full(now)
                return False
            self._lose(now)
            self._lost += 1
            return True
        if self._hears_itself:
            self._echoes[frame] = self._echoes.get(frame, 0) + 1
        return True

    def _flush(self, now: Nanos) -> None:
        while self._outbox:
            frame = self._outbox.take()
            if not self._send(frame, now):
                self._outbox.put_back(frame)
                return

    # -- in -----------------------------------------------------------------------------------

    def _receive(self, now: Nanos) -> can.Message | None:
        if self._frame is None:
            return None
        try:
            return self._frame.recv(timeout=0)
        except (can.CanError, OSError):
            self._lose(now)
        except (ValueError, IndexError, KeyError):
            self.bad += 1  # an adapter's line that python-can could not read
        return None

    def _more(self) -> bool:
        """Whether a None was an adapter's own line (slcan acknowledges each frame), and more is waiting."""
        try:
            return self._frame is not None and bool(select.select([self._frame.fileno()], [], [], 0)[0])
        except (NotImplementedError, OSError, ValueError):  # a back end without a file, or one that has gone
            return False

    def _is_echo(self, frame: CanFrame) -> bool:
        """Whether a frame is our own, come back over an interface that hears itself."""
        sent = self._echoes.get(frame, 0)
        if sent > 1:
            self._echoes[frame] = sent - 1
        elif sent == 1:
            del self._echoes[frame]
        return sent > 0

    def _on_error(self, message: can.Message) -> None:
        """Some back ends bring error frames as SocketCAN has them."""
        state = state_of(CanError(message.arbitration_id, bytes(message.data).ljust(8, b"\0")))
        if state is BusState.OFF:
            self._forget()
        if state is not None:
            self._states.set(state)

    # -- gone and back ------------------------------------------------------------------------

    def _forget(self) -> None:
        self._outbox.clear()
        self._echoes.clear()

    def _lose(self, now: Nanos) -> None:
        frame, self._frame = self._frame, None
        if frame is not None:
            _shut(frame)
        self._forget()
        self._reopen_at = now + REOPEN
        self._states.set(BusState.GONE)

    def _come_back(self, now: Nanos) -> None:
        if now < self._reopen_at:
            return
        self._reopen_at = now + REOPEN
        try:
            self._frame = open_interface(self._settings, listen_only=self._listen_only)
        except BusError:
            return
        self._states.set(BusState.BACK)


def _frame(message: can.Message) -> CanFrame:
    return CanFrame(
        message.arbitration_id,
        b"" if message.is_remote_frame else bytes(message.data),
        message.is_extended_id,
        message.is_remote_frame,
        message.is_fd,
        message.bitrate_switch,
    )


def _message(frame: CanFrame) -> can.Message:
    return can.Message(
        arbitration_id=frame.id,
        data=frame.data,
        is_extended_id=frame.extended,
        is_remote_frame=frame.remote,
        is_fd=frame.fd,
        bitrate_switch=frame.brs,
    )


def _is_full(error: Exception) -> bool:
    """Whether the transmit queue is full, as the kernel or python-can itself says it."""
    code = error.error_code if isinstance(error, can.CanError) else getattr(error, "errno", None)
    return code in _FULL or "buffer full" in str(error) or "timeout" in str(error).lower()


def _shut(frame: can.BusABC) -> None:
    try:
        frame.shutdown()
    except (can.CanError, OSError):
        return  # what has vanished cannot be shut down either
