"""A CAN bus offered as adapters on ptys: "slcan:/dev/pts/N" and "fdcanusb:/dev/pts/N" for any program.

Rules. Every port is one adapter, for one program at a time; what one port says, the others and the devices
hear. A program that hangs up leaves its adapter as a loss of power would: in its first state, and all that
waited thrown away, so that the next one begins afresh. Whoever does not read loses the oldest frames, and
only he. Nothing is throttled here: the time that frames take on the bus is the twins' matter.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Protocol

from gateway.buses.adapters import fdcanusb, slcan
from gateway.buses.adapters.pty import Pty, open_pty
from gateway.core.clock import Clock
from gateway.core.robot import BusSettings
from protocols.frames import BusState, CanFrame, Frame, Packet
from protocols.messages import Nanos


class Adapter(Protocol):
    """What an adapter does with a serial line on one side, a CAN bus on the other."""

    open: bool
    """Whether it is on the bus."""
    overrun: bool
    """Frames were lost because the other end did not read."""

    @property
    def wrong_rate(self) -> bool:
        """Whether it was set to another bit rate than the bus has."""
        ...

    def feed(self, data: bytes) -> tuple[list[CanFrame], bytes]:
        """Bytes from the serial line: the frames that go onto the bus, and the answers."""
        ...

    def report(self, t: Nanos, frame: CanFrame) -> bytes:
        """What the serial line gets of a frame on the bus."""
        ...


KINDS: dict[str, Callable[[int, int], Adapter]] = {"slcan": slcan.Adapter, "fdcanusb": fdcanusb.Adapter}
"""By the name of the interface that a program opens; made of the bus's two bit rates."""


class _Port:
    """One adapter behind its pty."""

    def __init__(self, settings: BusSettings, kind: str) -> None:
        self.pty: Pty = open_pty(settings)
        self.kind = kind
        self._settings = settings
        self.adapter = self._powered_up()

    @property
    def joined(self) -> bool:
        """Whether a program is on the bus by this port."""
        return self.pty.connected and self.adapter.open

    def _powered_up(self) -> Adapter:
        return KINDS[self.kind](self._settings.bitrate, self._settings.data_bitrate)

    def read(self) -> list[CanFrame]:
        connected = self.pty.connected
        frames, answers = self.adapter.feed(self.pty.read())
        if connected and not self.pty.connected:
            self.adapter = self._powered_up()
        elif answers:
            self.pty.write(answers)
        return frames

    def report(self, t: Nanos, frame: CanFrame) -> None:
        lost = self.pty.dropped
        if line := self.adapter.report(t, frame):
            self.pty.write(line)
        self.adapter.overrun = self.adapter.overrun or self.pty.dropped > lost


class AdapterPty:
    """The devices' end of a CAN bus without a CAN interface."""

    def __init__(
        self,
        settings: BusSettings,
        clock: Clock,  # noqa: ARG002 -- as open_can
        kinds: Sequence[str] = ("slcan",),
    ) -> None:
        """`kinds`: of each port, one of KINDS. Raises BusError if no pty can be made."""
        self.name = settings.name
        self._ports = [_Port(settings, kind) for kind in kinds]
        self._state = BusState.GONE

    @property
    def paths(self) -> list[str]:
        """What to open, one program each."""
        return [port.pty.path for port in self._ports]

    @property
    def dropped(self) -> int:
        """Lines that programs did not read in time."""
        return sum(port.pty.dropped for port in self._ports)

    def read(self, now: Nanos) -> tuple[Sequence[BusState], Sequence[Packet]]:
        """The frames that programs have sent, stamped now.

        BACK: somebody is on the bus; GONE: nobody is any more; PASSIVE: one has set his adapter to another
        bit rate than the bus has."""
        packets: list[Packet] = []
        for port in self._ports:
            for frame in port.read():
                packets.append(Packet(now, self.name, frame))
                for other in self._ports:
                    if other is not port:
                        other.report(now, frame)
        return self._changes(), packets

    def write(self, now: Nanos, frames: Sequence[Frame]) -> None:
        """Frames for everybody on the bus."""
        for frame in frames:
            assert isinstance(frame, CanFrame), f"{self.name} is a CAN bus"
            for port in self._ports:
                port.report(now, frame)

    def close(self) -> None:
        """Hang up; the paths are gone with it."""
        for port in self._ports:
            port.pty.close()

    def _changes(self) -> list[BusState]:
        joined = [port.adapter for port in self._ports if port.joined]
        state = BusState.BACK if joined else BusState.GONE
        if any(adapter.wrong_rate for adapter in joined):
            state = BusState.PASSIVE
        if state is self._state:
            return []
        self._state = state
        return [state]
