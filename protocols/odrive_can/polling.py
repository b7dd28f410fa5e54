"""Which messages of a device are requested and when: remote frames only, which neither firmware line obeys.

Rules. What a device sends cyclically is not requested. Nothing is requested faster than the periods below and
those of the options, whether it is answered or not.
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

VERSION, HEARTBEAT, ESTIMATES, SUPPLY = map(
    cmd_of, (GetVersion, Heartbeat, GetEncoderEstimates, GetBusVoltageCurrent)
)
"""SUPPLY: both firmware lines answer it alike, and do not send it cyclically by default."""
RETRY_PERIOD = 100 * MILLISECOND
"""Period in which an unanswered request is repeated."""
VERSION_PERIOD = 5 * SECOND
"""Period of Get_Version to a device that was identified without it, or not at all."""
HEARTBEAT_TIMEOUT = 250 * MILLISECOND
"""Time without a heartbeat after which one is requested."""
NEVER: Nanos = 1 << 62


@dataclass(slots=True)
class Polling:
    """The requests to one device. Plain data."""

    options: Options
    started: Nanos = 0
    requested: dict[int, Nanos] = field(default_factory=dict)
    """When each command was last requested."""
    next_polls: dict[int, Nanos] = field(default_factory=dict)
    """When each polled command is due next."""
    heartbeat_at: Nanos | None = None
    """When the last one was received."""
    estimates_pending: bool = False
    """Encoder estimates were requested and have not been received."""
    cyclic_estimates_at: Nanos = 0
    """When they were last received without a request."""

    def on_message(self, t: Nanos, cmd: int) -> None:
        """Handle a received message."""
        if cmd == ESTIMATES:
            if not self.estimates_pending:
                self.cyclic_estimates_at = t
            self.estimates_pending = False
        elif cmd == HEARTBEAT:
            self.heartbeat_at = t
        elif cmd in self.next_polls:
            self.next_polls[cmd] = t + self.options.poll_ms * MILLISECOND

    def on_request(self, now: Nanos, cmd: int) -> None:
        """Handle a request that is sent now."""
        self.requested[cmd] = now
        self.estimates_pending = self.estimates_pending or cmd == ESTIMATES
        if cmd in self.next_polls:
            self.next_polls[cmd] = now + self.options.poll_ms * MILLISECOND

    def plan(self, identity: Identity, awaited: Collection[int], alive: bool) -> list[tuple[Nanos, int]]:
        """Return when each command is due. `awaited`: error words; `alive`: heartbeats are received."""
        dialect = DIALECTS[identity.decoded_as]
        plan = [(self._version_due(identity), VERSION), (self._estimates_due(alive), ESTIMATES)]
        if dialect.heartbeat_on_request or not identity.as_expected:
            plan.append((self._heartbeat_due(), HEARTBEAT))
        if identity.as_expected:  # else only what both lines answer alike is requested
            plan += [(self._retry_due(cmd), cmd) for cmd in awaited]
            plan += [(at, cmd) for cmd, at in self._polls(dialect.polled, alive).items()]
        return plan

    def due(self, identity: Identity, awaited: Collection[int], alive: bool) -> Nanos:
        """Return when the first request of the plan is due; called at every step, so without making the
        plan."""
        due = self.urgent_due(identity, awaited, alive)
        if identity.as_expected:
            due = min(due, *self._polls(DIALECTS[identity.decoded_as].polled, alive).values(), NEVER)
        return due

    def urgent_due(self, identity: Identity, awaited: Collection[int], alive: bool) -> Nanos:
        """Return when the first request is due that is worth a step of its own, which repeats every
        set-point. Polls are not: with twelve motors they would nearly double the bus load."""
        due = min(self._version_due(identity), self._estimates_due(alive))
        if DIALECTS[identity.decoded_as].heartbeat_on_request or not identity.as_expected:
            due = min(due, self._heartbeat_due())
        if identity.as_expected:
            due = min(due, *map(self._retry_due, awaited), NEVER)
        return due

    def _heartbeat_due(self) -> Nanos:
        received = self.started if self.heartbeat_at is None else self.heartbeat_at
        return max(self._retry_due(HEARTBEAT), received + HEARTBEAT_TIMEOUT)

    def _retry_due(self, cmd: int) -> Nanos:
        requested = self.requested.get(cmd)
        return self.started if requested is None else requested + RETRY_PERIOD

    def _version_due(self, identity: Identity) -> Nanos:
        if identity.version is not None and not identity.wrong:
            return NEVER
        settled = (identity.line or identity.wrong) and VERSION in self.requested
        return self.requested[VERSION] + VERSION_PERIOD if settled else self._retry_due(VERSION)

    def _estimates_due(self, alive: bool) -> Nanos:
        if not alive:
            return self._retry_due(ESTIMATES)
        period = self.options.feedback_ms * MILLISECOND
        return max(self.requested.get(ESTIMATES, 0), self.cyclic_estimates_at + period) + period

    def _polls(self, polled: tuple[int, ...], alive: bool) -> dict[int, Nanos]:
        """Return when each polled command is due, spread over the first period; none without heartbeats."""
        period = self.options.poll_ms * MILLISECOND
        if not period or not alive:
            return {}
        if tuple(self.next_polls) != polled:
            now = max(self.started, self.heartbeat_at or 0)
            count = len(polled)
            self.next_polls = {cmd: now + period * (1 + i) // count for i, cmd in enumerate(polled)}
        return self.next_polls
