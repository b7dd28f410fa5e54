"""Plugins that are broken on purpose: requests without an answer, with two, and words that are not whole."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace

from protocols import messages as msg
from protocols.frames import Frame
from protocols.messages import MILLISECOND, Command, Event, Mode, Nanos, Request
from protocols.plain.decoder import PlainDecoder
from protocols.plain.driver import PlainDriver
from protocols.plugin import Plugin
from tests.protocols.broken import Sent, motors


class Alters(PlainDriver):
    """A driver whose events are altered on their way up."""

    def receive(self, t: Nanos, frame: Frame) -> Sequence[Event]:
        return [each for event in super().receive(t, frame) for each in self.altered(event)]

    def send(self, now: Nanos, words: Sequence[Command | Request]) -> Sent:
        events, frames = super().send(now, words)
        return [each for event in events for each in self.altered(event)], frames

    def altered(self, event: Event) -> Sequence[Event]:
        return [event]


class AnswersTwice(Alters):
    """Says of a parameter what it is, and then that this is done."""

    def altered(self, event: Event) -> Sequence[Event]:
        if isinstance(event, msg.Parameter):
            return [event, msg.Done(event.t, "ReadParameter", event.motor)]
        return [event]


class RefusesWithoutReason(Alters):
    """Says no, and not why."""

    def altered(self, event: Event) -> Sequence[Event]:
        return [replace(event, reason=" ") if isinstance(event, msg.Refused) else event]


class DoesNotRefuse(Alters):
    """Lets the question of an unknown parameter fall."""

    def altered(self, event: Event) -> Sequence[Event]:
        return [] if isinstance(event, msg.Refused) and event.request == "ReadParameter" else [event]


class AnswersForNobody(Alters):
    """Does not say whose request was done."""

    def altered(self, event: Event) -> Sequence[Event]:
        return [replace(event, name="") if isinstance(event, msg.Done) and event.request == "Zero" else event]


class TellsText(Alters):
    """The value of a parameter as a text."""

    def altered(self, event: Event) -> Sequence[Event]:
        value: Callable[[float], float] = str  # type: ignore[assignment]  # what an untyped plugin may do
        return [replace(event, value=value(event.value)) if isinstance(event, msg.Parameter) else event]


class OnlySaysDone(Alters):
    """What is to be written is never sent, and yet done."""

    def send(self, now: Nanos, words: Sequence[Command | Request]) -> Sent:
        events, frames = super().send(now, [w for w in words if not isinstance(w, msg.WriteParameter)])
        written = [w for w in words if isinstance(w, msg.WriteParameter)]
        return [*events, *(msg.Done(now, "WriteParameter", w.motor) for w in written)], frames


class NeverGivesUp(PlainDriver):
    """A driver that waits for ever for what a silent device does not answer."""

    def send(self, now: Nanos, words: Sequence[Command | Request]) -> Sent:
        events, frames = super().send(now, words)
        return [e for e in events if not (isinstance(e, msg.Refused) and "no answer" in e.reason)], frames


class DueLongAgo(PlainDriver):
    """A driver that is due when a second of silence began."""

    def due(self) -> Nanos | None:
        due = super().due()
        return None if due is None else due - 1000 * MILLISECOND


class OfflineWithoutTime(Alters):
    """Does not say when a device fell silent."""

    def altered(self, event: Event) -> Sequence[Event]:
        missing: Nanos = None  # type: ignore[assignment]  # what an untyped plugin may do
        silent = isinstance(event, msg.State) and event.mode is Mode.OFFLINE
        return [replace(event, t=missing) if silent else event]


class NoName(PlainDecoder):
    """The ear hears words for nobody."""

    def decode(self, t: Nanos, frame: Frame) -> Sequence[Command | Request]:
        words = super().decode(t, frame)
        return [replace(w, parameter=None) if isinstance(w, msg.WriteParameter) else w for w in words]  # type: ignore[arg-type]  # as above


def _driver(kind: type[PlainDriver]) -> Plugin:
    return replace(motors, name=kind.__name__, driver=kind)


BROKEN_ANSWERS: tuple[tuple[Plugin, tuple[str, ...]], ...] = (
    (_driver(AnswersTwice), ("answers",)),
    (_driver(RefusesWithoutReason), ("answers",)),
    (_driver(DoesNotRefuse), ("answers",)),
    (_driver(AnswersForNobody), ("answers",)),
    (_driver(TellsText), ("answers",)),
    (_driver(OnlySaysDone), ("answers",)),
    (_driver(NeverGivesUp), ("answers",)),
    (_driver(DueLongAgo), ("answers",)),
    (_driver(OfflineWithoutTime), ("answers", "blind")),
    (replace(motors, name=NoName.__name__, decoder=NoName), ("answers",)),
)
"""Each with all the clauses that find it."""
