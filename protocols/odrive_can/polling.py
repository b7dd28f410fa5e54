"""What a device is asked for and when: remote frames only, which neither firmware line obeys.

Rules. What comes by the device's own clock is not asked for. Nothing is asked for faster than the periods
below and those of the options, whether it is answered or not.
"""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import dataclass, field

from protocols.messages import MILLISECOND, SECOND, Nanos
from protocols.odrive_can.codec import cmd_of
from protocols.odrive_can.dialect import DIALECTS
from protocols.odrive_can.identify import Identity
from protocols.odrive_can.messages import GetBusVoltageCurrent, GetEncoderEstimates, GetVersion, Heartbeat
from protocols.odrive_can.options import Options

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
    asked: dict[int, Nanos] = field(default_factory=dict)
    """When each command was last asked for."""
    polls: dict[int, Nanos] = field(default_factory=dict)
    """When each polled one is to be asked for next."""
    heartbeat_at: Nanos | None = None
    """When one was last heard."""
    unanswered: bool = False
    """An encoder estimate was asked for and has not come."""
    cyclic_at: Nanos = 0
    """When one last came unasked."""

    def handle(self, t: Nanos, cmd: int) -> None:
        """A message came."""
        if cmd == ESTIMATES:
            if not self.unanswered:
                self.cyclic_at = t
            self.unanswered = False
        elif cmd == HEARTBEAT:
            self.heartbeat_at = t
        elif cmd in self.polls:
            self.polls[cmd] = t + self.options.poll_ms * MILLISECOND

    def ask(self, now: Nanos, cmd: int) -> None:
        """A question goes out."""
        self.asked[cmd] = now
        self.unanswered = self.unanswered or cmd == ESTIMATES
        if cmd in self.polls:
            self.polls[cmd] = now + self.options.poll_ms * MILLISECOND

    def plan(self, identity: Identity, wanted: Collection[int], alive: bool) -> list[tuple[Nanos, int]]:
        """When each question is next to be asked. `wanted`: error words; `alive`: heartbeats come."""
        dialect = DIALECTS[identity.reading]
        plan = [(self._version_at(identity), VERSION), (self._estimates_at(alive), ESTIMATES)]
        if dialect.heartbeat_asked or not identity.expects:
            plan.append((self._heartbeat_at(), HEARTBEAT))
        if identity.expects:  # else it is asked what both lines answer alike, and no more
            plan += [(self._again(cmd), cmd) for cmd in wanted]
            plan += [(at, cmd) for cmd, at in self._polls(dialect.polled, alive).items()]
        return plan

    def due(self, identity: Identity, wanted: Collection[int], alive: bool) -> Nanos:
        """When the first question of the plan is to be asked: called at every step, so without the plan."""
        due = self.pressing(identity, wanted, alive)
        if identity.expects:
            due = min(due, *self._polls(DIALECTS[identity.reading].polled, alive).values(), NEVER)
        return due

    def pressing(self, identity: Identity, wanted: Collection[int], alive: bool) -> Nanos:
        """When the first question is due that is worth a step of its own, in which every set-point goes out
        once more. Polls are not: with twelve motors, they would nearly double what is on the bus."""
        due = min(self._version_at(identity), self._estimates_at(alive))
        if DIALECTS[identity.reading].heartbeat_asked or not identity.expects:
            due = min(due, self._heartbeat_at())
        if identity.expects:
            due = min(due, *map(self._again, wanted), NEVER)
        return due

    def _heartbeat_at(self) -> Nanos:
        received = self.started if self.heartbeat_at is None else self.heartbeat_at
        return max(self._again(HEARTBEAT), received + HEARTBEAT_MISSED)

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

    def _polls(self, polled: tuple[int, ...], alive: bool) -> dict[int, Nanos]:
        """What is polled, spread over the period at first; nothing while no heartbeat comes."""
        period = self.options.poll_ms * MILLISECOND
        if not period or not alive:
            return {}
        if tuple(self.polls) != polled:
            now = max(self.started, self.heartbeat_at or 0)
            count = len(polled)
            self.polls = {cmd: now + period * (1 + i) // count for i, cmd in enumerate(polled)}
        return self.polls
