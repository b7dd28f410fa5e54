"""The buses: the only package that touches CAN interfaces, serial ports, I²C adapters and cameras.

`open_bus` opens a real one; `gateway.buses.virtual` makes buses of a simulated world,
`gateway.buses.adapters` offers a bus to other programs. Knows frames and no protocol; imports no driver, no
brain and no runtime.

Rules. A bus never blocks. Once open it raises nothing for what happens on the medium: it reports a
`BusState`, once per change. It timestamps what it reads with the clock that it was opened with, and is closed
exactly once.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Protocol, runtime_checkable

from protocols.frames import BusState, Frame, Packet
from protocols.messages import Nanos

if TYPE_CHECKING:
    from gateway.core.clock import Clock
    from gateway.core.robot import BusSettings

__all__ = ["Bus", "WakingBus", "open_bus"]


class Bus(Protocol):
    """One CAN interface, one serial port, one I²C adapter, one camera, or a simulated bus."""

    name: str
    """The bus's name in the robot file."""

    def read(self, now: Nanos) -> tuple[Sequence[BusState], Sequence[Packet]]:
        """Return the state changes and the packets received up to `now`, in order of arrival."""
        ...

    def write(self, now: Nanos, frames: Sequence[Frame]) -> None:
        """Transmit frames, in order."""
        ...

    def close(self) -> None:
        """Release the interface."""
        ...


@runtime_checkable
class WakingBus(Protocol):
    """A bus that tells when there may be something to read, so that nobody has to look again and again."""

    def wakes(self, now: Nanos) -> tuple[Sequence[int], Nanos | None]:
        """Return the files that can be read when something has come in, and when to look in any case (None:
        at no time)."""
        ...


def open_bus(settings: BusSettings, clock: Clock, *, listen_only: bool = False) -> Bus:
    """Open the real interface of a bus. Raises BusError with what is missing and how to get it.

    `listen_only`: nothing is ever sent, nor acknowledged where the interface can be configured so."""
    if settings.kind == "serial":
        from gateway.buses.serial.bus import open_serial

        return open_serial(settings)
    if settings.kind == "i2c":
        from gateway.buses.i2c import open_i2c

        return open_i2c(settings)
    if settings.kind == "camera":
        from gateway.buses.camera import open_camera

        return open_camera(settings)
    if settings.interface.startswith("socketcan:"):
        from gateway.buses.socketcan.bus import open_socketcan

        return open_socketcan(settings, clock, listen_only=listen_only)
    from gateway.buses.can import open_can

    return open_can(settings, clock, listen_only=listen_only)
