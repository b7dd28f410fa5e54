"""Duplicate addresses: the driver detects them, and reports them by `Found.duplicate_address`.

Rules. The two devices differ (another seed, so another serial number where the protocol has one) and are on
different shafts. They are not commanded. Each receives what the other sends.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

from protocols.conformance.bench import TwinWrapper
from protocols.conformance.case import Case, Failure, Inapplicable
from protocols.frames import OF_BYTES, Frame
from protocols.messages import Event, Feedback, Found, Nanos, Torque
from protocols.plugin import FeedbackKind, Twin

BOUND = 12_000
"""Steps within which a duplicate address must be detected."""
APART = 2.375
"""rad between the two shafts."""


@dataclass(slots=True)
class Pair(TwinWrapper):
    """Two devices at one address, in the place of one. Faults are provoked in the first."""

    other: Twin
    last: tuple[Frame, ...] = ()
    """A frame of each, from the last time that both sent at once."""

    def receive(self, t: Nanos, frame: Frame) -> None:
        """Pass the frame to both."""
        self.twin.receive(t, frame)
        self.other.receive(t, frame)

    def step(self, now: Nanos, truth: Sequence[Event]) -> tuple[Sequence[Torque], Sequence[Frame]]:
        """Step both; the other's shaft has another position. The torque is that of the first."""
        elsewhere = [
            replace(event, position=event.position + APART)
            if isinstance(event, Feedback) and event.position is not None
            else event
            for event in truth
        ]
        torques, frames = self.twin.step(now, truth)
        theirs = self.other.step(now, elsewhere)[1]
        self.last = (frames[-1], theirs[-1]) if frames and theirs else self.last
        for frame in frames:
            self.other.receive(now, frame)
        for frame in theirs:
            self.twin.receive(now, frame)
        return torques, (*frames, *theirs)

    def due(self) -> Nanos | None:
        """Return when the first of them is due."""
        moments = [due for due in (self.twin.due(), self.other.due()) if due is not None]
        return min(moments, default=None)


def duplicate_address_is_detected(case: Case) -> None:
    """Two devices at alpha's address are detected in bounded time; different addresses are not reported."""
    if case.spec.bus in OF_BYTES:
        raise Inapplicable("the spec's bus is serial: two that send at once garble each other's bytes")
    if case.spec.feedback is FeedbackKind.REPLY:
        raise Inapplicable("the spec's feedback is reply: two that are not commanded report nothing")
    for step in case.baseline:
        for event in step.events:
            if isinstance(event, Found) and event.duplicate_address:
                raise Failure("a duplicate address is reported, and there is none", step.up[:4], (event,))
    bench, address = case.start(), case.addresses[0]
    pair = Pair(bench.twins[0], case.plugin.twin(bench.devices[0], 2))
    bench.twins[0] = pair
    for _ in range(BOUND):
        for event in bench.step().events:
            if isinstance(event, Found) and event.duplicate_address and event.address == address:
                return
    text = f"two devices have address {address}, and in {BOUND // 1000} s no Found has `duplicate_address`"
    raise Failure(text, pair.last)
