"""A CAN bus offered as adapters on ptys: "slcan:/dev/pts/N", "fdcanusb:/dev/pts/N" … for any program.

Rules. Every port is one adapter, for one program at a time; what one port sends, the others and the devices
receive. A program that hangs up leaves its adapter as after a loss of power: in its initial state, with all
that waited discarded, so that the next one starts afresh. A program that does not read loses the oldest
frames, and no other does. Nothing is throttled here: the time that frames take on the bus is simulated
elsewhere.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import TypeAlias

from gateway.buses.adapters import dm_serial, fdcanusb, slcan
from gateway.buses.adapters.pty import open_pty
from gateway.core.robot import CLASSIC_ADAPTERS, BusSettings
from gateway.errors import BusError
from protocols.frames import BusState, CanFrame, Frame, Packet
from protocols.messages import Nanos

Adapter: TypeAlias = slcan.EmulatedAdapter | fdcanusb.EmulatedAdapter | dm_serial.EmulatedAdapter
KINDS: dict[str, type[Adapter]] = {
    "slcan": slcan.EmulatedAdapter,
    "fdcanusb": fdcanusb.EmulatedAdapter,
    "dm-serial": dm_serial.EmulatedAdapter,
}
"""By the interface that a program opens."""


class _Port:
    """One adapter behind its pty."""

    def __init__(self, settings: BusSettings, kind: str) -> None:
        self.pty = open_pty(settings)
        self._settings, self._kind = settings, kind
        self.adapter = self._powered_up()

    def _powered_up(self) -> Adapter:
        return KINDS[self._kind](self._settings.bitrate, self._settings.data_bitrate)

    def read(self) -> list[CanFrame]:
        """Return the frames that the program has sent."""
        connected = self.pty.connected
        frames, replies = self.adapter.feed(self.pty.read())
        if connected and not self.pty.connected:
            self.adapter = self._powered_up()
        elif replies:
            self.pty.write(replies)
        return frames

    def report(self, t: Nanos, frame: CanFrame) -> None:
        """Pass a frame on the bus to the program."""
        dropped = self.pty.dropped
        if line := self.adapter.report(t, frame):
            self.pty.write(line)
        self.adapter.overrun = self.adapter.overrun or self.pty.dropped > dropped


class AdapterPty:
    """The devices' end of a CAN bus, offered to other programs."""

    def __init__(self, settings: BusSettings, kinds: Sequence[str] = ("slcan",)) -> None:
        """`kinds`: of each port, one of KINDS. Raises BusError if no pty can be made, or for CAN FD on an
        adapter of classic CAN."""
        for kind in kinds:
            if settings.kind == "canfd" and kind in CLASSIC_ADAPTERS:
                raise BusError(f"bus {settings.name!r}: a {kind} adapter carries classic CAN only")
        self.name = settings.name
        self._ports = [_Port(settings, kind) for kind in kinds]
        self._state = BusState.GONE

    @property
    def paths(self) -> list[str]:
        """The paths to open, one program each."""
        return [port.pty.path for port in self._ports]

    @property
    def dropped(self) -> int:
        """Lines that programs did not read in time."""
        return sum(port.pty.dropped for port in self._ports)

    def read(self, now: Nanos) -> tuple[Sequence[BusState], Sequence[Packet]]:
        """Return the frames that programs have sent, timestamped now.

        BACK: a program is on the bus; GONE: none is any more; PASSIVE: one has set its adapter to another bit
        rate than the bus has."""
        packets: list[Packet] = []
        for port in self._ports:
            for frame in port.read():
                packets.append(Packet(now, self.name, frame))
                for other in self._ports:
                    if other is not port:
                        other.report(now, frame)
        return self._changes(), packets

    def write(self, now: Nanos, frames: Sequence[Frame]) -> None:
        """Send frames to all programs on the bus."""
        for frame in frames:
            assert isinstance(frame, CanFrame), f"{self.name} is a CAN bus"
            for port in self._ports:
                port.report(now, frame)

    def close(self) -> None:
        """Hang up; the paths are gone with it."""
        for port in self._ports:
            port.pty.close()

    def _changes(self) -> list[BusState]:
        active = [port.adapter for port in self._ports if port.pty.connected and port.adapter.open]
        state = BusState.BACK if active else BusState.GONE
        if any(adapter.wrong_rate for adapter in active):
            state = BusState.PASSIVE
        before, self._state = self._state, state
        return [state] if state is not before else []
