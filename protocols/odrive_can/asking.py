"""What a device is asked for and when: remote frames only, which neither firmware line obeys.

Rules. What comes by the device's own clock is not asked for. Nothing is asked for faster than the periods
below and those of the options, whether it is answered or not.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, field

from protocols.odrive_can.codec import cmd_of
from protocols.odrive_can.dialect import DIALECTS
from protocols.odrive_can.identify import Identity
from protocols.odrive_can.messages import GetBusVoltageCurrent, GetEncoderEstimates, GetVersion, Heartbeat
from protocols.odrive_can.options import Options
from protocols.words import MILLISECOND, SECOND, Nanos

VERSION, HEARTBEAT, ESTIMATES, OTHER = map(
    cmd_of, (GetVersion, Heartbeat, GetEncoderEstimates, GetBusVoltageCurrent)
)
"""OTHER: the question that both firmware lines answer alike, and not by themselves as they come."""
ASK_AGAIN = 100 * MILLISECOND
"""An unanswered question is repeated so often."""
VERSION_AGAIN = 5 * SECOND
"""A device that was told apart without Get_Version, or not at all, is asked for it so often."""
HEARTBEAT_MISSED = 250 * MILLISECOND
"""Without a heartbeat for so long, one is asked for."""
NEVER: Nanos = 1 << 62


@dataclass(slots=True)
class Asking:
    """The questions to one device. Plain data."""

    options: Options
    started: Nanos = 0
    heard: dict[int, Nanos] = field(default_factory=dict)
    """When each command was last heard."""
    asked: dict[int, Nanos] = field(default_factory=dict)
    """When each was last asked for."""
    unanswered: bool = False
    """An encoder estimate was asked for and has not come."""
    cyclic_at: Nanos = 0
    """When one last came unasked."""

    def hear(self, t: Nanos, cmd: int) -> None:
        """A message came."""
        self.heard[cmd] = t
        if cmd != ESTIMATES:
            return
        if not self.unanswered:
            self.cyclic_at = t
        self.unanswered = False

    def ask(self, now: Nanos, cmd: int) -> None:
        """A question goes out."""
        self.asked[cmd] = now
        self.unanswered = self.unanswered or cmd == ESTIMATES

    def plan(self, identity: Identity, wanted: Iterable[int], alive: bool) -> list[tuple[Nanos, int]]:
        """When each question is next to be asked. `wanted`: error words; `alive`: heartbeats come."""
        dialect = DIALECTS[identity.reading]
        plan = [(self._version_at(identity), VERSION), (self._estimates_at(alive), ESTIMATES)]
        if dialect.heartbeat_asked or not identity.expects:
            missed = self.heard.get(HEARTBEAT, self.started) + HEARTBEAT_MISSED
            plan.append((max(self._again(HEARTBEAT), missed), HEARTBEAT))
        if identity.expects:  # else it is asked what both lines answer alike, and no more
            plan += [(self._again(cmd), cmd) for cmd in wanted]
            plan += [(self._poll_at(cmd, dialect.polled, alive), cmd) for cmd in dialect.polled]
        return plan

    def _again(self, cmd: int) -> Nanos:
        asked = self.asked.get(cmd)
        return self.started if asked is None else asked + ASK_AGAIN

    def _version_at(self, identity: Identity) -> Nanos:
        if identity.version is not None and not identity.wrong:
            return NEVER
        settled = (identity.line or identity.wrong) and VERSION in self.asked
        return self.asked[VERSION] + VERSION_AGAIN if settled else self._again(VERSION)

    def _estimates_at(self, alive: bool) -> Nanos:
        if not alive:
            return self._again(ESTIMATES)
        period = self.options.feedback_ms * MILLISECOND
        return max(self.asked.get(ESTIMATES, 0), self.cyclic_at + period) + period

    def _poll_at(self, cmd: int, polled: tuple[int, ...], alive: bool) -> Nanos:
        period = self.options.poll_ms * MILLISECOND
        if not period or not alive:
            return NEVER
        first = self.started + period * (1 + polled.index(cmd)) // len(polled)
        return max(self.heard.get(cmd, first - period), self.asked.get(cmd, first - period)) + period
