"""A twin's bus in a run that has real buses, too: the loop's clock waits for no world there.

Rules. Between two looks the world makes up for a hiccup of the machine at most (`MADE_UP`); for what is more
it stands still, as a device does that is off for a moment. What is received has the loop's time.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

from gateway.buses import Bus
from gateway.buses.virtual.bus import TwinBus, TwinWorld
from gateway.core.clock import MADE_UP
from protocols.frames import BusState, Frame, Packet
from protocols.messages import Nanos


def buses(world: TwinWorld) -> dict[str, Bus]:
    """Return a world's buses, with bounded work."""
    time = WorldTime()
    return {name: BesideReal(bus, time) for name, bus in world.buses.items()}


@dataclass(slots=True)
class WorldTime:
    """The time of a world, shared by its buses."""

    behind: Nanos = 0
    """How long it stood still."""
    reached: Nanos | None = None

    def at(self, now: Nanos) -> Nanos:
        """Return how far the world is to be moved at a time of the loop's."""
        if self.reached is not None:
            self.behind = max(self.behind, now - self.reached - MADE_UP)
        self.reached = now - self.behind
        return self.reached


class BesideReal:
    """A bus of twins with bounded work."""

    def __init__(self, bus: TwinBus, time: WorldTime) -> None:
        self.name, self._bus, self._time = bus.name, bus, time

    def read(self, now: Nanos) -> tuple[Sequence[BusState], Sequence[Packet]]:
        """Move the world by a slice at most; return what the host received."""
        states, packets = self._bus.read(self._time.at(now))
        return states, [replace(packet, t=packet.t + self._time.behind) for packet in packets]

    def wakes(self, now: Nanos) -> tuple[Sequence[int], Nanos | None]:
        """As of the bus itself."""
        files, look = self._bus.wakes(now - self._time.behind)
        return files, None if look is None else look + self._time.behind

    def write(self, now: Nanos, frames: Sequence[Frame]) -> None:
        """Queue frames."""
        self._bus.write(self._time.at(now), frames)

    def close(self) -> None:
        """Release the bus."""
        self._bus.close()
