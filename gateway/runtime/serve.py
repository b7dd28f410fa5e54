"""The serving loop: simulate the devices behind real buses, for another program to drive.

Rules. As in the live loop, buses and clock are the loop's own, and it yields what happened. A real host waits
for no world: so this one keeps pace with the clock. What was missed is made up for, in slices, so that an
iteration is short whatever happened before it, and what was received is handed to the devices at its own
time, as far as that is known. A world that is too far behind stands still instead. On lines whose devices
speak only when asked, it wakes when something is sent to them, and when they answer.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Collection, Generator, Mapping, Sequence
from dataclasses import dataclass

from gateway.buses import Bus, WakingBus
from gateway.buses.virtual.bus import TwinBus
from gateway.core.clock import Clock
from gateway.runtime.loop import moments, read, write
from gateway.runtime.timing import LoopStats
from protocols.frames import BusState, Packet
from protocols.messages import MILLISECOND, SECOND, Nanos

PERIOD: Nanos = MILLISECOND
LEAST: Nanos = 20_000
"""Between two iterations."""
WAKING: Nanos = 50_000
"""What this process and a pty take at each end: what wakes it has come so much sooner, if there was nothing
before, and what it sends on a line is handed over so much sooner. A quiet machine takes longer: nothing is
there before its time."""
MADE_UP: Nanos = 100 * MILLISECOND
"""What one iteration makes up for at most: steps of the world."""
STALL: Nanos = SECOND // 2
"""A world that is further behind the clock does not make up for it."""


@dataclass(slots=True)
class ServeStats:
    """What a serving loop counts."""

    received: int = 0
    """Packets"""
    sent: int = 0
    """Packets"""
    late: Nanos = 0
    """The longest time that the world was behind the clock."""
    stalled: Nanos = 0
    """How long the world stood still because this process did, or could not keep up."""
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
    """How long the world stood still; what was received meanwhile was dropped."""


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

    If the world is further behind than `STALL`, it has stood still for that time, and what was received
    meanwhile is dropped: devices that were off obey no old commands. `age` is the world's own time now, if it
    has run already."""
    stats = stats if stats is not None else ServeStats()
    reached = last = clock.now()
    behind = 0 if age is None else last - age
    waiting: deque[tuple[Nanos, Packet]] = deque()
    lines = _Lines(world_buses, buses, clock)
    for now in moments(clock, PERIOD, lines.due, LoopStats(), lines.wait, LEAST):
        if until is not None and now >= until:
            return
        states, packets = read(buses, now)
        waiting += _arrivals(packets, last, now, lines.names)
        stalled = now - reached if now - reached > STALL else 0
        if stalled:
            behind += stalled
            stats.stalled += stalled
            stats.dropped += len(waiting)
            waiting.clear()
            reached = now
        stats.late = max(stats.late, now - reached)
        reached = min(now + lines.ahead, reached + MADE_UP)
        lines.behind = behind
        received: list[Packet] = []
        while waiting and waiting[0][0] <= reached:
            t, packet = waiting.popleft()
            world_buses[packet.bus].write(t - behind, (packet.frame,))
            received.append(packet)
        _, sent = read(world_buses, reached - behind)
        write(buses, now, sent)
        stats.received += len(received)
        stats.sent += len(sent)
        last = max(now, reached)
        yield ServeTick(now, tuple(states), tuple(received), tuple(sent), stalled)


class _Lines:
    """The lines whose devices speak only when asked, and when there is something to do for them."""

    def __init__(self, world: Mapping[str, Bus], buses: Mapping[str, Bus], clock: Clock) -> None:
        self.behind: Nanos = 0
        """How long the world stood still."""
        prompt = {name: bus for name, bus in world.items() if isinstance(bus, TwinBus) and bus.prompt}
        self.names = frozenset(prompt)
        self._world, self._clock = list(prompt.values()), clock
        self._outer = [one for name in prompt if isinstance(one := buses[name], WakingBus)]
        self.ahead = WAKING if self._outer else 0
        """How far the world is ahead of the clock."""

    def due(self) -> Nanos | None:
        """Return when something next happens on one of them."""
        times = [at for bus in self._world if (at := bus.wakes(0)[1]) is not None]
        return min(times, default=1 << 62) + self.behind - self.ahead

    def wait(self, until: Nanos) -> None:
        """Wait until then, or until something is sent to one of them."""
        files = [file for bus in self._outer for file in bus.wakes(0)[0]]
        self._clock.wait(until, files)


def _arrivals(
    packets: Sequence[Packet], last: Nanos, now: Nanos, lines: Collection[str] = ()
) -> list[tuple[Nanos, Packet]]:
    """Return when each packet arrived, in order: after the last iteration, at its own time if it has one.

    Packets of a bus without stamps (stamped now) are spread evenly over the time since then; on `lines` they
    have woken us."""
    unstamped: dict[str, int] = {}
    for packet in packets:
        unstamped[packet.bus] = unstamped.get(packet.bus, 0) + (packet.t >= now)
    timed: list[tuple[Nanos, Packet]] = []
    placed = dict.fromkeys(unstamped, 0)
    for packet in packets:
        t = max(packet.t, last)
        if packet.t >= now:
            placed[packet.bus] += 1
            t = last + max(0, now - last) * placed[packet.bus] // (unstamped[packet.bus] + 1)
        if packet.bus in lines:
            t = max(last, packet.t - WAKING)
        timed.append((t, packet))
    timed.sort(key=lambda one: one[0])
    return timed
