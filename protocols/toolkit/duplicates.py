"""Two devices with one address, which both obey: four ways to notice them.

Rules. A device counts for two rounds of identification. What is noticed is reported once, until ClearFault.
"""

from __future__ import annotations

from collections.abc import Hashable, Sequence
from dataclasses import dataclass, field
from typing import TypeAlias

from protocols.frames import Frame
from protocols.messages import SECOND, Event, Found, Nanos, seconds

Sample: TypeAlias = tuple[Nanos, float, float]
"""Time, position and velocity."""
IDENTIFY_PERIOD = 5 * SECOND
"""Period in which serial numbers are asked for."""


@dataclass(slots=True)
class SerialNumbers:
    """Serial numbers by address, and which addresses were reported as duplicate."""

    protocol: str
    known: dict[int, dict[int, Nanos]] = field(default_factory=dict)
    """By address: each serial number, and when it was received."""
    reported: set[int] = field(default_factory=set)

    def add(self, t: Nanos, address: int, serial: int) -> str:
        """Record that a serial number answers for an address. Returns why it is a duplicate, or ""."""
        for other, serials in self.known.items():
            if other != address:  # it may have been given another address
                serials.pop(serial, None)
        before = self.known.get(address, {})
        recent = {each: at for each, at in before.items() if t - at <= 2 * IDENTIFY_PERIOD} | {serial: t}
        self.known[address] = recent
        held_by = " and ".join(f"{each:X}" for each in sorted(recent))
        return f"serial numbers {held_by}" if len(recent) > 1 else ""

    def at(self, address: int) -> set[int]:
        """Return the serial numbers that answer for an address."""
        return set(self.known.get(address, ()))

    def report(self, t: Nanos, address: int, cause: str) -> list[Event]:
        """Return one Found for each known device at a duplicate address; [] if it was reported."""
        if address in self.reported:
            return []
        self.reported.add(address)
        detail = f"duplicate address {address}: {cause}"
        serials: list[int | None] = [*sorted(self.known.get(address, ()))] or [None]
        return [Found(t, self.protocol, address, each, detail, duplicate_address=True) for each in serials]

    def clear(self, address: int) -> None:
        """Forget what was reported of an address, and what answered for it."""
        self.reported.discard(address)
        self.known.pop(address, None)


@dataclass(slots=True)
class ShaftCheck:
    """Positions that jump there and back are of two shafts. A single jump proves nothing (a new zero, a
    restart), nor does one that does not come back (a loose encoder; frames that are delivered in pairs)."""

    tolerance: float
    """A smaller difference may be vibration; the unit is that of the positions."""
    needed: int = 8
    """Jumps there and back within 2 s."""
    stale: Nanos = SECOND // 2
    """Age after which the shaft may be anywhere."""
    before: Sample = (-SECOND, 0.0, 0.0)
    last: Sample = (-SECOND, 0.0, 0.0)
    jumps: list[Nanos] = field(default_factory=list)

    def add(self, t: Nanos, position: float, velocity: float) -> bool:
        """Add a sample. True if the samples can no longer be of one shaft."""
        before, last, now = self.before, self.last, (t, position, velocity)
        self.before, self.last = last, now
        if (last[1] - before[1]) * (position - last[1]) >= 0.0:
            return False  # onwards, not there and back
        if t - before[0] > self.stale or self._reachable(last, now) or not self._reachable(before, now):
            return False
        self.jumps = [at for at in self.jumps if t - at <= 2 * SECOND] + [t]
        return len(self.jumps) >= self.needed

    def _reachable(self, one: Sample, other: Sample) -> bool:
        fastest = max(abs(one[2]), abs(other[2]))
        return abs(other[1] - one[1]) <= self.tolerance + 2.0 * fastest * seconds(other[0] - one[0])


@dataclass(slots=True)
class StateCheck:
    """States that alternate, A B A B, while the host asked for no change, are of two devices."""

    states: list[tuple[Nanos, Hashable]] = field(default_factory=list)
    """The last four, and when they were received."""

    def add(self, t: Nanos, state: Hashable, asked_at: Nanos) -> bool:
        """Add a reported state; `asked_at`: when the host last asked for another."""
        self.states = [*self.states[-3:], (t, state)]
        if len(self.states) < 4:
            return False
        first, second, third, fourth = [each for _, each in self.states]
        return first == third != second == fourth and asked_at < self.states[0][0]


@dataclass(slots=True)
class AnswerCount:
    """Half as many answers again as there were questions, over a second, are those of two devices. Who asks
    nothing only receives: then they answer another host. Questions of the second before that were not
    answered then may be answered now: a busy machine, or an adapter, reads late."""

    since: Nanos | None = None
    asked: int = 0
    answered: int = 0
    owed: int = 0
    """Questions of the second before without an answer."""
    sent_at: Nanos = -(1 << 62)
    """When frames were last sent."""

    def sent(self, now: Nanos, frames: Sequence[Frame]) -> Sequence[Frame]:
        """Record frames, each of which is answered; return them."""
        self.sent_at = now if frames else self.sent_at
        self.ask(len(frames))
        return frames

    def add(self, t: Nanos) -> str:
        """Count an answer. Returns why there must be two devices, "" if there need not be."""
        if self.since is None:
            self.since = t
        self.answered += 1
        if t - self.since < SECOND:
            return ""
        many = self.asked and self.answered > 1.5 * max(self.asked, 4) + self.owed
        self.owed = min(self.asked, max(0, self.owed + self.asked - self.answered))
        self.since, self.asked, self.answered = t, 0, 0
        return "more answers than questions" if many else ""

    def ask(self, count: int = 1) -> None:
        """Count frames that are answered."""
        self.asked += count
