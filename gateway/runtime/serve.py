"""The serving loop: simulate the devices behind real buses, for another program to drive.

Rules. As in the live loop, buses and clock are the loop's own, and it yields what happened. The world keeps
pace with the clock: what a late iteration has missed is made up for, and what was received is handed to the
devices at its own time, as far as that is known.
"""

from __future__ import annotations

from collections.abc import Generator, Mapping, Sequence
from dataclasses import dataclass

from gateway.buses import Bus
from gateway.core.clock import Clock
from gateway.runtime.loop import moments, read, write
from gateway.runtime.timing import LoopStats
from protocols.frames import BusState, Packet
from protocols.messages import MILLISECOND, SECOND, Nanos

PERIOD: Nanos = MILLISECOND
STALL: Nanos = SECOND // 2
"""A serving loop that did not run for longer than this does not make up for it."""


@dataclass(slots=True)
class ServeStats:
    """What a serving loop counts."""

    received: int = 0
    """Packets"""
    sent: int = 0
    """Packets"""
    late: Nanos = 0
    """The longest time that the world had to make up for at once."""
    stalled: Nanos = 0
    """How long the world stood still because this process did."""
    dropped: int = 0
    """Packets received meanwhile, which no device obeyed."""


@dataclass(frozen=True, slots=True)
class ServeTick:
    """One iteration of a serving loop."""

    now: Nanos
    states: tuple[tuple[str, BusState], ...]
    """Changes of the outer buses."""
    received: tuple[Packet, ...]
    sent: tuple[Packet, ...]
    stalled_for: Nanos = 0
    """How long the world stood still just before; what was received meanwhile was dropped."""


def serve(
    world_buses: Mapping[str, Bus],
    buses: Mapping[str, Bus],
    clock: Clock,
    *,
    until: Nanos | None = None,
    stats: ServeStats | None = None,
    age: Nanos | None = None,
) -> Generator[ServeTick]:
    """Carry what the outer buses receive to the simulated world, and back, until `until` or until closed.

    If this process did not run for longer than `STALL`, the world has stood still with it, and what was
    received meanwhile is dropped: devices that were off obey no old commands. `age` is the world's own time
    now, if it has run already."""
    stats = stats if stats is not None else ServeStats()
    last = clock.now()
    behind = 0 if age is None else last - age
    for now in moments(clock, PERIOD, lambda: None, LoopStats()):
        if until is not None and now >= until:
            return
        states, packets = read(buses, now)
        stalled = now - last if now - last > STALL else 0
        if stalled:
            behind += stalled
            stats.stalled += stalled
            stats.dropped += len(packets)
            packets = []
        stats.late = max(stats.late, now - last - stalled)
        for t, packet in _arrivals(packets, last, now):
            world_buses[packet.bus].write(t - behind, (packet.frame,))
        _, sent = read(world_buses, now - behind)
        write(buses, now, sent)
        stats.received += len(packets)
        stats.sent += len(sent)
        last = now
        yield ServeTick(now, tuple(states), tuple(packets), tuple(sent), stalled)


def _arrivals(packets: Sequence[Packet], last: Nanos, now: Nanos) -> list[tuple[Nanos, Packet]]:
    """Return when each packet arrived, in order: after the last iteration, at its own time if it has one.

    Packets of a bus without stamps (stamped now) are spread evenly over the time since then."""
    unstamped: dict[str, int] = {}
    for packet in packets:
        unstamped[packet.bus] = unstamped.get(packet.bus, 0) + (packet.t >= now)
    timed: list[tuple[Nanos, Packet]] = []
    placed = dict.fromkeys(unstamped, 0)
    for packet in packets:
        t = max(packet.t, last)
        if packet.t >= now:
            placed[packet.bus] += 1
            t = last + (now - last) * placed[packet.bus] // (unstamped[packet.bus] + 1)
        timed.append((t, packet))
    timed.sort(key=lambda one: one[0])
    return timed
