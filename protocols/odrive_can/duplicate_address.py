"""Two devices with one node id: noticed by positions or heartbeats that contradict each other in turn.

Rules. A shaft that jumps away and back again, repeatedly, and faster than its reported velocity allows, is
two shafts. A single jump proves nothing (a new zero, a restart), nor does one that does not come back (a
loose encoder; frames that an adapter without time stamps delivers in pairs, so that the shaft seems to jump
on). Heartbeats that alternate, A B A B, while the host requested no change come from two devices. (The third
sign, two serial numbers that answer for one node id, is the driver's.) Turns, turns/s.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

from protocols import messages as msg
from protocols.messages import MILLISECOND, SECOND, Event, Nanos, seconds
from protocols.odrive_can.codec import MAX_EXTENDED_NODE
from protocols.odrive_can.faults import DUPLICATE_NODE

POSITION_TOLERANCE = 0.05
"""turns: a smaller difference may be vibration."""
STALE = 500 * MILLISECOND
"""Age after which the shaft may be anywhere."""
JUMPS, WINDOW = 8, 2 * SECOND
"""This number of jumps there and back within the window is no accident."""

Sample = tuple[Nanos, float, float]
"""Time, position, velocity."""


@dataclass(slots=True)
class PositionCheck:
    """The last two samples of a shaft, and when it jumped back. Plain data."""

    before: Sample = (-2 * STALE, 0.0, 0.0)
    last: Sample = (-2 * STALE, 0.0, 0.0)
    jumps: list[Nanos] = field(default_factory=list)

    def add(self, t: Nanos, position: float, velocity: float) -> bool:
        """Add a sample. True if the samples can no longer be of one shaft."""
        before, last, now = self.before, self.last, (t, position, velocity)
        self.before, self.last = last, now
        if (last[1] - before[1]) * (position - last[1]) >= 0.0:
            return False  # onwards, not there and back
        if t - before[0] > STALE or _reachable(last, now) or not _reachable(before, now):
            return False
        self.jumps = [at for at in self.jumps if t - at <= WINDOW] + [t]
        return len(self.jumps) >= JUMPS


def _reachable(one: Sample, other: Sample) -> bool:
    """True if one shaft can have moved from one sample to the other."""
    fastest = max(abs(one[2]), abs(other[2]))
    return abs(other[1] - one[1]) <= POSITION_TOLERANCE + 2.0 * fastest * seconds(other[0] - one[0])


def alternating(heartbeats: Sequence[tuple[Nanos, int, int]], state_requested_at: Nanos) -> bool:
    """True if the last four heartbeats (time, state, errors) alternate since the host's last state
    request."""
    if len(heartbeats) < 4:
        return False
    first, second, third, fourth = [(state, errors) for _, state, errors in heartbeats]
    return first == third != second == fourth and state_requested_at < heartbeats[0][0]


def duplicate_events(
    t: Nanos, protocol: str, node: int, motor: str, cause: str, serials: Sequence[int | None] = (None,)
) -> list[Event]:
    """Return the events for a duplicate node id: one Found per serial number, and a Fault of the motor, if
    any."""
    node &= MAX_EXTENDED_NODE
    events: list[Event] = [
        msg.Found(t, protocol, node, serial, cause, duplicate_address=True) for serial in serials
    ]
    if motor:
        remedy = "take one off the bus, or give it another node id (SetId with its serial number)"
        events.append(msg.Fault(motor, t, DUPLICATE_NODE, f"duplicate node id {node}", cause, remedy))
    return events
