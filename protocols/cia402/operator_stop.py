"""An operator's stop of one drive: sent again until it is obeyed, and in force until it is cleared."""

from __future__ import annotations

from protocols.canopen.client import NEVER
from protocols.cia402.drive_state import CALM
from protocols.cia402.profile import PowerState
from protocols.messages import MILLISECOND, Nanos

STOP_AGAIN = 50 * MILLISECOND


class OperatorStop:
    """The stop of one drive. Plain data."""

    def __init__(self) -> None:
        self._since: Nanos | None = None
        self._next: Nanos = 0

    @property
    def in_force(self) -> bool:
        """Whether it was given, and not cleared."""
        return self._since is not None

    def begin(self, now: Nanos) -> None:
        """Stop the drive."""
        self._since = self._next = now

    def end(self) -> None:
        """Clear it."""
        self._since = None

    def restart(self) -> None:
        """Send it again: the drive may have restarted."""
        self._next = 0

    def disobeyed(self, power: PowerState | None) -> bool:
        """True while the drive does not obey."""
        at = self._since
        return at is not None and (self._next <= at or power not in (PowerState.QUICK_STOP, *CALM))

    def sends(self, now: Nanos, power: PowerState | None) -> bool:
        """True if it is to be sent now."""
        due = now >= self.due(power)
        self._next = now + STOP_AGAIN if due else self._next
        return due

    def is_repeated(self, now: Nanos) -> bool:
        """True if it was sent before."""
        return now != self._since

    def due(self, power: PowerState | None) -> Nanos:
        """Return when it is to be sent next."""
        return self._next if self.disobeyed(power) else NEVER
