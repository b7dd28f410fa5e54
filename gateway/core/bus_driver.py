"""One driver of a robot, of all devices of its protocol on a bus: what it is asked, and whether it fails."""

from __future__ import annotations

from gateway.core.guard import STOPS_WITHIN
from protocols import messages as msg
from protocols.messages import SECOND, Nanos, Request
from protocols.plugin import Driver

IDENTIFY: Nanos = 5 * SECOND
"""Period in which a serial number that is demanded is asked for, until it is known."""


class BusDriver:
    """One driver on its bus. State is plain data, and the driver's."""

    def __init__(
        self, bus: str, protocol: str, motors: frozenset[str], driver: Driver, started: tuple[str, ...] = ()
    ) -> None:
        self.bus, self.protocol, self.motors, self.driver = bus, protocol, motors, driver
        self.started = started
        """Its sensors that it starts (`Spec.set_up`): at the end of a run they are given Idle."""
        self.failing_since: Nanos = 0
        """When it began to raise."""
        self._raised_at: Nanos | None = None
        """When it last raised."""
        self._asked_at: Nanos | None = None
        """When serial numbers that are demanded were last asked for."""

    def takes(self, request: Request) -> bool:
        """True if a request is for it."""
        if isinstance(request, msg.Stop):
            return bool(self.motors)
        if isinstance(request, msg.Scan | msg.SetId):
            return request.bus == self.bus
        return getattr(request, "motor", "") in self.motors

    def on_raised(self, now: Nanos) -> None:
        """Note that it has raised."""
        self.failing_since = self.failing_since if self.is_failing(now) else now
        self._raised_at = now

    def is_failing(self, now: Nanos) -> bool:
        """True if it has raised a short time ago."""
        return self._raised_at is not None and now - self._raised_at <= STOPS_WITHIN

    def asks_identity(self, now: Nanos) -> tuple[bool, bool]:
        """Return whether serial numbers that are demanded are to be asked for now, and whether again."""
        before = self._asked_at
        if before is not None and now - before < IDENTIFY:
            return False, True
        self._asked_at = now
        return True, before is not None
