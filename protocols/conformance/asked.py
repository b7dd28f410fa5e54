"""What is sent is asked for: read-only, the command that the driver has, a request that is under way, or the
set-up that the spec declares.

Rules. Each frame is read as the devices read it, with a command decoder of its own, and held against
`protocols.asked`, as the guard of a robot does. The driver goes through arming, motion, every change from one
command to another, rest, every request that moves nothing, and Idle.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

from protocols import messages as msg
from protocols.asked import Asked, Reported
from protocols.conformance import bench as tools
from protocols.conformance.bench import ALPHA, Bench, Messages
from protocols.conformance.case import Case, Failure, Inapplicable
from protocols.conformance.fault_injection import moving, resting
from protocols.frames import CanFrame, Frame, any_matches, malformed
from protocols.messages import Event, Mode, Nanos, Obeyed
from protocols.plugin import CommandDecoder, Spec

MOVED, STANDS, RELEASED = 60, 40, 80
"""Steps of each command, of each stop, and of Idle."""
KNOWN = 400
"""Steps after which requests are made."""
WRITTEN = 4
"""Parameters that are written."""
AFTER_REQUEST = 120


@dataclass(slots=True)
class Watched(tools.DriverWrapper):
    """A driver of which each frame is held against what it was given."""

    decoder: CommandDecoder
    specs: dict[str, Spec]
    asked: Asked
    modes: dict[str, Mode]
    places: dict[str, float]

    def receive(self, t: Nanos, frame: Frame) -> Sequence[Event]:
        """Note what the devices report."""
        return self._noted(self.driver.receive(t, frame))

    def send(self, now: Nanos, messages: Messages) -> tuple[Sequence[Event], Sequence[Frame]]:
        """Raise Failure for a frame that nobody asked for."""
        for message in messages:
            self.asked.give(now, message)
        events, frames = self.driver.send(now, messages)
        for frame in frames:
            self._judge(now, frame, messages)
        return self._noted(events), frames

    def _noted(self, events: Sequence[Event]) -> Sequence[Event]:
        for event in events:
            self.asked.answer(event)
            if isinstance(event, msg.State):
                self.modes[event.motor] = event.mode
            elif isinstance(event, msg.Feedback) and event.position is not None:
                self.places[event.motor] = event.position
        return events

    def _judge(self, now: Nanos, frame: Frame, messages: Messages) -> None:
        wrong = malformed(frame, next(iter(self.specs.values())).bus)
        if wrong:
            raise Failure(f"not a frame of this bus: {wrong}", (frame,), messages)
        obeyed = list(self.decoder.decode(now, frame))
        for one in obeyed:
            if found := self.asked.objection(now, one, self._reported(one), self.specs):
                raise Failure(f"{found[0]}: {found[1]}", (frame,), messages)
        for one in obeyed:
            self.asked.passed(one, self._reported(one))
        if not obeyed and not self._is_read_only(frame):
            raise Failure("neither read-only nor decoded as anything", (frame,), messages)

    def _reported(self, one: Obeyed) -> Reported:
        name = getattr(one, "motor", "")
        return Reported(self.modes.get(name) is Mode.ARMED, self.places.get(name))

    def _is_read_only(self, frame: Frame) -> bool:
        listening = [
            spec
            for spec in self.specs.values()
            if not isinstance(frame, CanFrame) or any_matches((*spec.sends, *spec.obeys_also), frame)
        ]
        return bool(listening) and all(spec.read_only(frame) for spec in listening)


def only_what_was_asked(case: Case) -> None:
    """A driver sends nothing but what is read-only, commanded, asked for, or declared as set-up."""
    if not case.spec.commands and not case.spec.requests and not case.spec.set_up:
        raise Inapplicable("the spec lists neither commands nor requests nor set-up")
    for messages in (tools.script(case.spec, case.names), _lively(case)):
        bench = watched(case)
        for given in messages:
            bench.step(given)
    if msg.WriteParameter in case.spec.requests:
        _writes(watched(case), case)


def watched(case: Case) -> Bench:
    """Set up alpha and beta behind a driver that is watched."""
    bench = case.start()
    specs = dict(zip(case.names, bench.specs, strict=True))
    bench.driver = Watched(bench.driver, case.plugin.decoder(bench.devices), specs, Asked(specs), {}, {})
    return bench


def _lively(case: Case) -> Iterator[Messages]:
    """Yield the messages of each step: from each command to each other, to rest, and to Idle."""
    spec, kinds = case.spec, case.kinds
    yield from [()] * KNOWN
    idle = [msg.Idle(ALPHA)] if msg.Idle in spec.commands else []
    for first in kinds:
        for then in kinds:
            for kind in (first, then):
                yield from [[resting(kind, spec, ALPHA, 0.0)]] * STANDS
                for at in range(MOVED):
                    yield [moving(kind, spec, ALPHA, 0.0, at)]
            yield from [[msg.Hold(ALPHA)]] * STANDS if msg.Hold in spec.commands else []
            yield from [idle] * RELEASED


def _writes(bench: Bench, case: Case) -> None:
    """Write some parameters, each with the value that it has."""
    bench.steps(KNOWN)
    names = [name for name, each in case.spec.configuration.items() if not each.protected]
    for name in case.random().shuffled(names)[:WRITTEN]:
        values: list[float] = []
        for request in (msg.ReadParameter(ALPHA, name), None):
            given = request or (msg.WriteParameter(ALPHA, name, values[0]) if values else None)
            for at in range(AFTER_REQUEST):
                step = bench.step([given] if given is not None and at == 0 else ())
                values += [event.value for event in step.events if isinstance(event, msg.Parameter)]
