"""An address that two devices hold: the driver notices, and says so by `Found.duplicate_address`.

Rules. The two are different pieces (another seed, so another serial number where the language has one) on
different shafts. Nobody commands them. What each says the other hears too.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

from protocols.conformance.case import Case, Failure, Inapplicable, Verdict
from protocols.frames import Frame
from protocols.messages import Event, Feedback, Found, Nanos, Torque
from protocols.plugin import Twin

BOUND = 12_000
"""Steps in which an address held twice must have been noticed."""
APART = 2.375
"""rad between the two shafts."""


@dataclass(slots=True)
class Pair:
    """Two devices at one address, in the place of one."""

    twin: Twin
    other: Twin
    last: tuple[Frame, ...] = ()
    """A wire of each, the last time that both spoke at once."""

    def receive(self, t: Nanos, frame: Frame) -> None:
        """Both hear it."""
        self.twin.receive(t, frame)
        self.other.receive(t, frame)

    def step(self, now: Nanos, truth: Sequence[Event]) -> tuple[Sequence[Torque], Sequence[Frame]]:
        """Both run; the other's shaft stands elsewhere. The torque is that of the first."""
        elsewhere = [replace(e, position=_there(e.position)) if isinstance(e, Feedback) else e for e in truth]
        torques, frames = self.twin.step(now, truth)
        theirs = self.other.step(now, elsewhere)[1]
        self.last = (frames[-1], theirs[-1]) if frames and theirs else self.last
        for frame in frames:
            self.other.receive(now, frame)
        for frame in theirs:
            self.twin.receive(now, frame)
        return torques, (*frames, *theirs)

    def due(self) -> Nanos | None:
        """Of whichever is due first."""
        moments = [due for due in (self.twin.due(), self.other.due()) if due is not None]
        return min(moments, default=None)

    def provoke(self, code: int) -> None:
        """The first one's."""
        self.twin.provoke(code)


def _there(position: float | None) -> float | None:
    return None if position is None else position + APART


def duplicate_address_is_noticed(case: Case) -> Verdict:
    """Two devices at alpha's address are noticed in bounded time; without them nobody is accused."""
    if case.spec.bus == "serial":
        return Inapplicable("the spec's bus is serial: two that speak at once garble each other's bytes")
    for said in case.day:
        for event in said.events:
            if isinstance(event, Found) and event.duplicate_address:
                return Failure("told to be held twice, and is not", said.up[:4], (event,))
    stage, address = case.start(), case.addresses[0]
    pair = Pair(stage.twins[0], case.plugin.twin(stage.devices[0], 2))
    stage.twins[0] = pair
    for _ in range(BOUND):
        said = stage.step()
        for event in said.events:
            if isinstance(event, Found) and event.duplicate_address and event.address == address:
                return None
    text = f"address {address} is held twice, and in {BOUND // 1000} s no Found says so by `twice`"
    return Failure(text, pair.last)
