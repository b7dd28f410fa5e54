"""One driver of a robot, of all devices of its protocol on a bus: what it is asked, and whether it fails."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TypeVar, cast, get_args

from gateway.core.guard import STOPS_WITHIN
from protocols import messages as msg
from protocols.frames import CanFrame, Frame
from protocols.line import Exchange
from protocols.messages import SECOND, Command, Event, Nanos, Request
from protocols.plugin import Driver, LineDriver

IDENTIFY: Nanos = 5 * SECOND
"""Period in which a serial number that is demanded is asked for, until it is known."""
_EVENTS, _FRAMES = get_args(Event), (CanFrame, bytes)
_T = TypeVar("_T")


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

    # What a plugin returns is looked at here, where it is still known whose it is: a thing of another kind
    # would fail later, in the guard or in a joint, and take the other drivers with it.

    def receive(self, t: Nanos, frame: Frame) -> Sequence[Event]:
        """Return what a frame reports. Raises what the driver raises, and TypeError for what is no event."""
        return _events(self.driver.receive(t, frame))

    def answer(self, t: Nanos, asked: Exchange, data: bytes) -> Sequence[Event]:
        """Return what the answer to an exchange reports; likewise."""
        return _events(cast("LineDriver", self.driver).answer(t, asked, data))

    def send(
        self, now: Nanos, messages: Sequence[Command | Request]
    ) -> tuple[Sequence[Event], Sequence[Frame]]:
        """Return the driver's own events, and what it sends; likewise, also if it sends no frames."""
        events, given = self.driver.send(now, messages)
        frames = _sequence(given)
        for each in frames:
            if not isinstance(each, _FRAMES):
                raise TypeError(f"send returned {each!r} among the frames, which is none")
        return _events(events), frames

    def due(self) -> Nanos | None:
        """Return when it next has to send by itself; likewise."""
        due = self.driver.due()
        if due is not None and not isinstance(due, int):
            raise TypeError(f"due returned {due!r}, which is no time [ns]")
        return due

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


def _events(given: Sequence[Event]) -> Sequence[Event]:
    """Return the events that a driver has returned. Raises TypeError if they are none."""
    events = _sequence(given)
    for each in events:
        if not isinstance(each, _EVENTS):
            raise TypeError(f"{each!r} is returned as an event, which it is not")
    return events


def _sequence(given: Sequence[_T]) -> Sequence[_T]:
    """Return what can be gone through more than once: a generator cannot."""
    return given if isinstance(given, list | tuple) else tuple(given)
