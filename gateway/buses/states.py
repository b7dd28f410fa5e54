"""Which state changes of a CAN bus are reported. One small object, no I/O.

Rules. Each change is reported once, as a `BusState`. OFF and GONE mask everything else; a congested transmit
queue (FULL) masks whether the bus is up or error-passive. BACK is reported when OFF or GONE ends, followed by
what else there is to report. Congestion has ended when nothing had to wait for `CALM`, so that a queue
slightly too short for each tick's frames is reported once and not at every tick.
"""

from __future__ import annotations

from protocols.frames import BusState
from protocols.messages import MILLISECOND, Nanos

CALM = 500 * MILLISECOND
"""Congestion is over when nothing has had to wait for this time."""
DEAD = (BusState.OFF, BusState.GONE)


class StateTracker:
    """The state of the bus (up, passive, off, gone), its congestion, and the changes not yet reported."""

    def __init__(self) -> None:
        self.state = BusState.UP
        self._full_until: Nanos | None = None
        self._visible = BusState.UP
        self._changes: list[BusState] = []

    @property
    def dead(self) -> bool:
        """True if nothing can be sent."""
        return self.state in DEAD

    def set(self, state: BusState) -> None:
        """The bus is now up, passive, off or gone; BACK means up."""
        self.state = BusState.UP if state is BusState.BACK else state
        if self.dead:
            self._full_until = None
        self._update()

    def full(self, now: Nanos) -> None:
        """Note that a frame found the transmit queue full."""
        if not self.dead:
            self._full_until = now + CALM
            self._update()

    def take(self, now: Nanos) -> list[BusState]:
        """Return the changes since the last call, in order."""
        if self._full_until is not None and now >= self._full_until:
            self._full_until = None
            self._update()
        changes, self._changes = self._changes, []
        return changes

    def _update(self) -> None:
        before, congested = self._visible, self._full_until is not None
        self._visible = BusState.FULL if congested and not self.dead else self.state
        if self._visible is before:
            return
        if before in DEAD and not self.dead:
            self._changes.append(BusState.BACK)
            if self._visible is BusState.UP:
                return
        self._changes.append(self._visible)
