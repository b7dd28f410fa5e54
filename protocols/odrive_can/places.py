"""Where a shaft is told to be, and whether one shaft alone can have told it.

Rules. A shaft that leaps away and is back at once, time and again, and faster than it says that it turns, is
two shafts: two devices hold one node id. A single leap proves nothing (a new zero, a restart), nor does one
that does not come back (a loose encoder; frames that an adapter without stamps hands over in pairs, so that
the shaft seems to leap on). Turns, turns/s.
"""

from __future__ import annotations

from dataclasses import dataclass, field

from protocols.messages import MILLISECOND, SECOND, Nanos, seconds

APART = 0.05
"""turns: less than this may be vibration."""
STALE = 500 * MILLISECOND
"""After so long a shaft may be anywhere."""
LEAPS, WITHIN = 8, 2 * SECOND
"""So many leaps there and back, in so long, are no accident."""


@dataclass(slots=True)
class Places:
    """The last two places that were told, and when the shaft leapt back. Plain data."""

    before: tuple[Nanos, float, float] = (-2 * STALE, 0.0, 0.0)
    last: tuple[Nanos, float, float] = (-2 * STALE, 0.0, 0.0)
    leaps: list[Nanos] = field(default_factory=list)

    def handle(self, t: Nanos, position: float, velocity: float) -> bool:
        """Whether this can no longer be one shaft."""
        before, last, now = self.before, self.last, (t, position, velocity)
        self.before, self.last = last, now
        if (last[1] - before[1]) * (position - last[1]) >= 0.0:
            return False  # on and on, not there and back
        if t - before[0] > STALE or _one_way(last, now) or not _one_way(before, now):
            return False
        self.leaps = [at for at in self.leaps if t - at <= WITHIN] + [t]
        return len(self.leaps) >= LEAPS


def _one_way(one: tuple[Nanos, float, float], other: tuple[Nanos, float, float]) -> bool:
    """Whether one shaft can have come from one place to the other."""
    fastest = max(abs(one[2]), abs(other[2]))
    return abs(other[1] - one[1]) <= APART + 2.0 * fastest * seconds(other[0] - one[0])
