"""The host's record of one device: what it reported, what we want of it, and the phase that follows.

Rules. The phases and what changes them are the table `TRANSITIONS`, and nothing else changes one. Everything
is a level: what should be is compared with what was last received, and sent again until it is so. No command
is stored, so that none can arm a device later than the step it was given in. A device that was commanded
stays `owned` through silence and bus trouble, until two reports have confirmed that it is disarmed.
"""

from __future__ import annotations

from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from enum import StrEnum
from typing import Any, Generic, TypeVar

from protocols.messages import MILLISECOND, Event, Fault, Feedback, Mode, Nanos, State
from protocols.plugin import Device, FaultInfo
from protocols.toolkit.faults import Faults

Own = TypeVar("Own")
"""What a protocol itself records of a device."""


class Phase(StrEnum):
    """Where a device stands, for the host."""

    FREE = "not commanded"
    """It is sent nothing but read-only frames."""
    ARMING = "arming"
    ARMED = "armed"
    RELEASING = "releasing"
    """It is sent Idle until it reports that it is disarmed."""
    FAULT = "fault"
    """Nothing arms it before ClearFault."""
    OFFLINE = "offline"


class Trigger(StrEnum):
    """What changes the phase."""

    COMMAND = "a command other than Idle, which the device can take"
    IDLE = "Idle, to a device that we own"
    ARMED = "it reports that it is armed"
    DISARMED = "it reports that it is not armed"
    UNASKED = "it is armed although the last command was Idle"
    RELEASED = "it reported often enough that it is disarmed"
    FAULT = "it reports a fault, or does not arm"
    CLEARED = "its faults are gone, or were cleared"
    SILENT = "it sends nothing any more"
    BACK = "it sends again"
    LOST = "frames were lost, or it may have restarted"


P, T = Phase, Trigger
TRANSITIONS: Mapping[tuple[Phase, Trigger], Phase] = {
    (P.FREE, T.COMMAND): P.ARMING,
    (P.FREE, T.IDLE): P.RELEASING,
    (P.FREE, T.UNASKED): P.RELEASING,
    (P.FREE, T.FAULT): P.FAULT,
    (P.FREE, T.SILENT): P.OFFLINE,
    (P.ARMING, T.ARMED): P.ARMED,
    (P.ARMING, T.IDLE): P.RELEASING,
    (P.ARMING, T.FAULT): P.FAULT,
    (P.ARMING, T.SILENT): P.OFFLINE,
    (P.ARMED, T.DISARMED): P.ARMING,
    (P.ARMED, T.LOST): P.ARMING,
    (P.ARMED, T.IDLE): P.RELEASING,
    (P.ARMED, T.FAULT): P.FAULT,
    (P.ARMED, T.SILENT): P.OFFLINE,
    (P.RELEASING, T.COMMAND): P.ARMING,
    (P.RELEASING, T.RELEASED): P.FREE,
    (P.FAULT, T.IDLE): P.RELEASING,
    (P.FAULT, T.UNASKED): P.RELEASING,
    (P.FAULT, T.CLEARED): P.FREE,
    (P.FAULT, T.SILENT): P.OFFLINE,
    (P.OFFLINE, T.IDLE): P.RELEASING,
    (P.OFFLINE, T.BACK): P.FREE,
}
"""The phase that follows; a pair that is not here changes nothing."""
del P, T


ATTEMPTS = 20
"""Commands that a device must have had before it counts as one that does not arm."""


@dataclass(frozen=True, slots=True)
class Timing:
    """Periods and timeouts of one device."""

    offline: Nanos
    """Time without a frame after which it is offline."""
    release: Nanos = 20 * MILLISECOND
    """Period of Idle while it is released."""
    confirmations: int = 2
    """Reports that it is disarmed which end the release: the first may be from before."""
    arming: Nanos = 1000 * MILLISECOND
    """Time after which a device that does not arm is a fault."""
    only_replies: bool = False
    """It reports nothing before it is commanded: until then its silence means nothing."""


@dataclass(slots=True)
class Report(Generic[Own]):
    """What one frame reports of one device. What it does not report is None or empty."""

    host: Host[Own] | None
    """None: it is not in the robot file."""
    address: int
    mode: Mode | None = None
    detail: str = ""
    """The vendor's name for the state."""
    faults: Collection[int] | None = None
    """Codes of all faults that are active."""
    feedback: Feedback | None = None
    duplicate: str = ""
    """Why this address must be held by more than one device."""
    content: Any = None
    """The frame as the protocol decodes it, for its own requests."""
    events: Sequence[Event] = ()
    """Others that are reported as they are: measurements of a sensor."""
    parameters: Mapping[str, float] = field(default_factory=dict)
    """By the vendor's names."""
    written: str = ""
    """The parameter whose writing it confirms."""
    serial: int | None = None
    note: str = ""
    """Hardware and firmware, for `Found`."""
    messages: int = 1
    """That it counts for; 0: the frame is counted with another device's report."""


Given = TypeVar("Given")


def counted_once(reports: Iterable[Given]) -> list[Given]:
    """Return what one frame reports of several devices: it is counted with the first of them."""
    given = [*reports]
    others = [replace(each, messages=0) if isinstance(each, Report) else each for each in given[1:]]
    return given[:1] + others


class Host(Generic[Own]):
    """One device. Plain data; protocols read it, and change nothing but what is in `own`."""

    def __init__(
        self, device: Device, own: Own, timing: Timing, faults: Mapping[int, FaultInfo], *, latch: bool
    ) -> None:
        self.name = device.name
        self.address = device.address
        self.options: Any = device.options
        self.own = own
        self.timing = timing
        self.faults = faults if isinstance(faults, Faults) else Faults(faults)
        self.latch = latch
        """A fault stays until ClearFault, whatever the device reports."""
        self.phase = Phase.FREE
        self.owned = False
        """We commanded it, and it has not confirmed yet that it was released."""
        self.once_commanded = False
        self.mode: Mode | None = None
        """As last reported; None: not since it may have restarted."""
        self.position: float | None = None
        """rad, as last reported."""
        self.held: float | None = None
        """rad, where the first of the present Holds was given, or where it was once it could hold."""
        self.active: frozenset[int] = frozenset()
        """Codes of the faults that were reported, and are still active."""
        self.received_at: Nanos | None = None
        self.offline = False
        self.tripped = False
        """A latched fault was not cleared yet."""
        self.since: Nanos = 0
        """When the phase began."""
        self.attempts = 0
        """Commands since then, if it is to arm."""
        self.release_at: Nanos = 0
        self._reported: tuple[Mode, str] | None = None
        self._detail = ""
        self._confirmed = 0

    def _fire(self, t: Nanos, trigger: Trigger) -> None:
        phase = TRANSITIONS.get((self.phase, trigger))
        if phase is None:
            return
        self.phase, self.since, self.attempts = phase, t, 0
        if phase in (Phase.ARMING, Phase.RELEASING):
            self.held = None  # where it stops next may be elsewhere
        if phase is Phase.RELEASING:
            self.release_at, self._confirmed, self.owned = t, 0, True

    # -- received ------------------------------------------------------------------------------------

    def on_report(self, t: Nanos, report: Report[Own]) -> list[Event]:
        """Record a report. Returns its events."""
        self.received_at = t
        if self.offline:
            self.offline = False
            self._fire(t, Trigger.BACK)
        feedback = report.feedback
        if feedback is not None and feedback.position is not None:
            self.position = feedback.position
        events: list[Event] = [*report.events] if feedback is None else [feedback, *report.events]
        mode, faults = report.mode, report.faults
        if faults or (self.active and faults is not None):
            events += self._on_faults(t, faults)
        if mode is None or self.knows(mode, report.detail):
            return events
        self._on_mode(t, mode)
        self._detail = report.detail
        return events + self.report_state(t)

    def knows(self, mode: Mode, detail: str) -> bool:
        """True if a reported state changes nothing: the usual case, while a device runs or rests."""
        phase, same = self.phase, mode is self.mode and (mode, detail) == self._reported
        return same and (
            (phase is Phase.ARMED and mode is Mode.ARMED) or (phase is Phase.FREE and mode is Mode.READY)
        )

    def _on_faults(self, t: Nanos, faults: Collection[int]) -> list[Event]:
        active = frozenset(faults)
        new = sorted(active - self.active)
        self.active = active
        return [self._fault(t, code) for code in new]

    def _fault(self, t: Nanos, code: int, cause: str = "") -> Event:
        info = self.faults[code]
        return Fault(self.name, t, code, info.name, cause or info.cause, info.remedy)

    def _on_mode(self, t: Nanos, mode: Mode) -> None:
        self.mode = mode
        if mode is Mode.FAULT:
            self.tripped = self.latch
            self._fire(t, Trigger.FAULT)
        elif mode is Mode.ARMED:
            self._fire(t, Trigger.ARMED)
        else:
            self._fire(t, Trigger.DISARMED)
        if self.phase is Phase.RELEASING:
            self._confirmed = 0 if mode is Mode.ARMED else self._confirmed + 1
            if self._confirmed >= self.timing.confirmations:
                self.owned = False
                self._fire(t, Trigger.RELEASED)
        elif mode is Mode.ARMED and self.once_commanded:
            self._fire(t, Trigger.UNASKED)
        if mode is not Mode.FAULT and not self.tripped:
            self._fire(t, Trigger.CLEARED)

    def report_state(self, t: Nanos) -> list[Event]:
        """Return the state if it changed."""
        if self.mode is None or self.offline:
            return []
        mode, detail = self.mode, self._detail
        if self.tripped and mode is not Mode.FAULT:
            mode, detail = Mode.FAULT, ", ".join(filter(None, (detail, "not cleared yet")))
        if (mode, detail) == self._reported:
            return []
        self._reported = mode, detail
        return [State(self.name, t, mode, detail)]

    # -- commanded -----------------------------------------------------------------------------------

    def on_idle(self, now: Nanos) -> None:
        """Release it, if we own it."""
        if self.owned and self.phase is not Phase.RELEASING:
            self._fire(now, Trigger.IDLE)

    def on_command(self, now: Nanos, *, hold: bool) -> Phase:
        """Record a command other than Idle. Returns the phase: what is to be done about it."""
        if self.offline or self.tripped or self.phase is Phase.FAULT or self.mode is Mode.FAULT:
            return self.phase
        if self.phase is not Phase.ARMED:  # one that is, is ours already
            self.own_unasked()
            self._fire(now, Trigger.COMMAND)
            if self.mode is Mode.ARMED:  # also one that ran before us
                self._fire(now, Trigger.ARMED)
        self.attempts += self.phase is Phase.ARMING
        if not hold:
            self.held = None
        elif self.held is None or self.phase is not Phase.ARMED:  # a load may move it until it holds
            self.held = self.position
        return self.phase

    def own_unasked(self) -> None:
        """Own it without a command: an operator's stop also disarms what another host armed."""
        if not self.once_commanded and self._unasked():
            self.received_at = None  # its silence counts from now on
        self.owned = self.once_commanded = True

    def release_due(self, now: Nanos) -> bool:
        """True if Idle is to be sent now."""
        if self.phase is not Phase.RELEASING or now < self.release_at:
            return False
        self.release_at = now + self.timing.release
        return True

    def overdue(self, now: Nanos) -> bool:
        """True if it should have armed long ago: a loop that has the processor seldom asks seldom, too."""
        late = self.phase is Phase.ARMING and now - self.since > self.timing.arming
        return late and self.attempts >= ATTEMPTS

    def wait(self, now: Nanos) -> None:
        """Begin anew the time in which it must arm: it waits for another device."""
        self.since, self.attempts = now, 0

    def trip(self, t: Nanos, code: int, cause: str = "") -> list[Event]:
        """Latch a fault that the host found, until ClearFault; `cause`: if more is known than of its code."""
        self.tripped = True
        self._fire(t, Trigger.FAULT)
        return [self._fault(t, code, cause), *self.report_state(t)]

    @property
    def running(self) -> bool:
        """True if it is, or may be, armed."""
        return self.owned or self.mode is Mode.ARMED

    @property
    def sound(self) -> bool:
        """True if it is armed, and has no fault."""
        return self.phase is Phase.ARMED and not self.active

    # -- cleared, lost, silent -----------------------------------------------------------------------

    def cleared(self, t: Nanos) -> list[Event]:
        """Record that ClearFault was carried out."""
        self.tripped = False
        if self.mode is not Mode.FAULT:
            self._fire(t, Trigger.CLEARED)
        return self.report_state(t)

    def report_again(self) -> None:
        """Report a fault that stays once more, with cause and remedy."""
        self.active, self._reported = frozenset(), None

    def resend(self, t: Nanos) -> None:
        """Send anew what may have been lost on our side."""
        self.release_at, self._confirmed = t, 0

    def forget(self, t: Nanos) -> None:
        """Forget what it reported: it may have restarted, or been replaced."""
        self.mode, self.position, self.held, self._reported = None, None, None, None
        self.active = frozenset()
        self.resend(t)
        self._fire(t, Trigger.LOST)

    def check_silence(self, now: Nanos, why: str = "") -> list[Event]:
        """Report once that it is offline; `why`, if that is known."""
        timing = self.timing
        if timing.only_replies and self._unasked():
            return []
        if self.received_at is None:
            self.received_at = now  # when we began to receive
        if self.offline or now - self.received_at < timing.offline:
            return []
        self.forget(now)
        self.offline = True
        self._fire(now, Trigger.SILENT)
        silence = f"no message for {self.timing.offline // MILLISECOND} ms"
        return [State(self.name, now, Mode.OFFLINE, f"{silence}: {why}" if why else silence)]

    def _unasked(self) -> bool:
        """True if nothing can be expected of it yet."""
        return self.timing.only_replies and not self.once_commanded

    def due(self) -> list[Nanos]:
        """Return when it is released next, or offline."""
        times = [self.release_at] if self.phase is Phase.RELEASING else []
        if not self.offline and not self._unasked():
            times.append(0 if self.received_at is None else self.received_at + self.timing.offline)
        return times
