"""Replies that are lost, late, doubled or out of order: they are their own device's trouble, and no other's.

Rules. Only what alpha says goes wrong, and only on its way up. Beta must arm, be heard and be answered as if
nothing had happened, but for what a shared bus may cost; and when the trouble ends alpha must arm too.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import TypeAlias

from protocols import messages as msg
from protocols.conformance import bench as play
from protocols.conformance.bench import ARMING, NAMES, STEP, Bench, StepResult
from protocols.conformance.case import Case, Failure, Inapplicable, Verdict, by_name
from protocols.conformance.random import Random
from protocols.frames import Frame
from protocols.messages import Command, Event, Mode, Nanos, Request
from protocols.plugin import Twin

ALPHA, BETA = NAMES
LASTS = 600
"""Steps of trouble after beta is armed."""
GRACE = 60
"""Steps that the trouble of one may cost another: a question or two that share the bus."""
Queue: TypeAlias = list[tuple[Nanos, Frame]]
"""What is on its way, and when it arrives."""


@dataclass(slots=True)
class Mishap:
    """A twin whose messages do not arrive as they were said."""

    twin: Twin
    happens: Callable[[Mishap, Nanos, Sequence[Frame]], None]
    """Puts what was said now into the queue, or does not."""
    random: Random
    on: bool = True
    queue: Queue = field(default_factory=list)
    held: list[Frame] = field(default_factory=list)

    def receive(self, t: Nanos, frame: Frame) -> None:
        """All is heard."""
        self.twin.receive(t, frame)

    def step(self, now: Nanos, truth: Sequence[Event]) -> tuple[Sequence[msg.Torque], Sequence[Frame]]:
        """The device runs on; what arrives of its words is told."""
        torques, frames = self.twin.step(now, truth)
        if self.on:
            self.happens(self, now, frames)
        else:
            self.queue += [(now, frame) for frame in (*self.held, *frames)]
            self.held = []
        arrived = [frame for at, frame in self.queue if at <= now]
        self.queue = [(at, frame) for at, frame in self.queue if at > now]
        return torques, arrived

    def due(self) -> Nanos | None:
        """The device's."""
        return self.twin.due()

    def provoke(self, code: int) -> None:
        """The device's."""
        self.twin.provoke(code)


def _lost(_: Mishap, __: Nanos, ___: Sequence[Frame]) -> None:
    """Nothing arrives."""


def _half_lost(it: Mishap, now: Nanos, frames: Sequence[Frame]) -> None:
    it.queue += [(now, frame) for frame in frames if it.random.below(2)]


def _late(it: Mishap, now: Nanos, frames: Sequence[Frame]) -> None:
    it.queue += [(now + 35 * STEP, frame) for frame in frames]


def _too_late(it: Mishap, now: Nanos, frames: Sequence[Frame]) -> None:
    it.queue += [(now + 700 * STEP, frame) for frame in frames]


def _doubled(it: Mishap, now: Nanos, frames: Sequence[Frame]) -> None:
    it.queue += [(now, frame) for frame in frames for _ in range(2)]


def _swapped(it: Mishap, now: Nanos, frames: Sequence[Frame]) -> None:
    """Each pair in the other order."""
    for frame in frames:
        if it.held:
            it.queue += [(now, frame), (now, it.held.pop())]
        else:
            it.held.append(frame)


TROUBLES = (
    ("half lost", _half_lost),
    ("lost", _lost),
    ("late", _late),
    ("very late", _too_late),
    ("doubled", _doubled),
    ("in the wrong order", _swapped),
)


@dataclass(frozen=True, slots=True)
class _Fortune:
    """How a device fared: in steps; None: not at all."""

    armed: int | None
    gap: int
    """The longest between two measurements."""
    answered: int | None
    unspoken: int
    """The longest between two commands that it was to hear."""
    stays: bool
    """It stays armed."""


def one_stalls_no_other(case: Case) -> Verdict:
    """Whatever happens to alpha's replies, beta fares as without it; and alpha recovers."""
    kinds = by_name(case.spec.commands - {msg.Idle})
    if not kinds:
        return Inapplicable("the spec lists no commands: nobody waits for an answer")
    words = [play.gentle(kinds[0], case.spec.ranges)(name) for name in NAMES]
    usual = _fares(case, words, None)
    for what, happens in TROUBLES if case.usual else TROUBLES[:1]:
        mishap = Mishap(case.start().twins[0], happens, case.random())
        failure = _worse(what, usual, _fares(case, words, mishap), words)
        if failure:
            return failure
    return None


@dataclass(slots=True)
class _Watch:
    """What is seen of a device."""

    motor: str
    armed_at: int | None = None
    received_at: int | None = None
    gap: int = 0
    answered_at: int | None = None
    spoken_at: int | None = None
    unspoken: int = 0
    fault: msg.Fault | None = None

    def see(self, at: int, said: StepResult) -> None:
        """One step."""
        if any(isinstance(word, Command) and word.motor == self.motor for word in said.received):
            self.spoken_at = at
        for event in said.events:
            if isinstance(event, msg.Feedback) and event.motor == self.motor:
                self.received_at = at
            elif isinstance(event, msg.Fault) and event.motor == self.motor:
                self.fault = event
            elif isinstance(event, msg.Parameter | msg.Done | msg.Refused) and _about(event) == self.motor:
                self.answered_at = at
        if self.armed_at is not None and self.received_at is not None:
            self.gap = max(self.gap, at - self.received_at)
        if self.armed_at is not None and self.spoken_at is not None:
            self.unspoken = max(self.unspoken, at - self.spoken_at)


def _about(event: msg.Parameter | msg.Done | msg.Refused) -> str:
    return event.motor if isinstance(event, msg.Parameter) else event.name


@dataclass(frozen=True, slots=True)
class _Day:
    """What became of both while alpha was in trouble, and of alpha afterwards."""

    beta: _Fortune
    recovered: bool
    fault: msg.Fault | None
    last: StepResult


def _fares(case: Case, words: list[Command], mishap: Mishap | None) -> _Day:
    stage = case.start()
    if mishap is not None:
        mishap.twin = stage.twins[0]
        stage.twins[0] = mishap
    alpha, beta = _Watch(ALPHA), _Watch(BETA)
    questions = _questions(case)
    at, until, said = 0, ARMING, stage.step(words)
    while at < until:
        beta.see(at, said)
        alpha.see(at, said)
        if beta.armed_at is None and _is_armed(stage, BETA, at):
            beta.armed_at, until = at, at + LASTS
        asked: list[Command | Request] = []
        if beta.armed_at is not None and at == beta.armed_at + LASTS // 4:
            beta.answered_at, asked = None, questions
        said = stage.step([*words, *asked])
        at += 1
    if mishap is not None:
        mishap.on = False
    answered = None
    if beta.answered_at is not None and beta.armed_at is not None:
        answered = beta.answered_at - beta.armed_at
    stays = _is_armed(stage, BETA, at)
    fortune = _Fortune(beta.armed_at, beta.gap, answered if questions else 0, beta.unspoken, stays)
    return _Day(fortune, _recovers(case, stage, words, alpha), alpha.fault, said)


def _questions(case: Case) -> list[Command | Request]:
    """What both are asked in the midst of it: something that they do not have, and what moves nothing."""
    asked: list[Command | Request] = []
    if msg.ReadParameter in case.spec.requests:
        asked += [msg.ReadParameter(name, "no such parameter") for name in NAMES]
    if msg.ClearFault in case.spec.requests and not case.spec.stop_clears_faults:
        asked += [msg.ClearFault(name) for name in NAMES]
    return asked


def _is_armed(stage: Bench, name: str, at: int) -> bool:
    return stage.armed.get(name) is Mode.ARMED or (at > ARMING // 10 and not stage.armed)


def _recovers(case: Case, stage: Bench, words: list[Command], alpha: _Watch) -> bool:
    """Alpha arms when the trouble is over. A device that tripped meanwhile is cleared first."""
    for at in range(ARMING):
        clear = (
            at % 1000 == 300 and msg.ClearFault in case.spec.requests and not _is_armed(stage, ALPHA, ARMING)
        )
        said = stage.step([*words, *([msg.ClearFault(ALPHA)] if clear else [])])
        alpha.see(at, said)
        fresh = any(isinstance(event, msg.Feedback) and event.motor == ALPHA for event in said.events)
        if fresh and at > 50 and _is_armed(stage, ALPHA, ARMING):
            return True
    return False


def _worse(what: str, usual: _Day, day: _Day, words: list[Command]) -> Failure | None:
    """Why beta fared worse, or alpha did not recover."""
    were, are = usual.beta, day.beta
    text = ""
    if are.armed is None or (were.armed is not None and are.armed > were.armed + GRACE):
        text = f"beta arms after {_ms(are.armed)} instead of {_ms(were.armed)}"
    elif are.gap > were.gap + GRACE:
        text = f"beta is not heard for {are.gap} ms instead of {were.gap}"
    elif were.answered is not None and (are.answered is None or are.answered > were.answered + GRACE):
        text = f"beta's question is answered after {_ms(are.answered)} instead of {_ms(were.answered)}"
    elif are.unspoken > were.unspoken + GRACE:
        text = f"nothing is said to beta for {are.unspoken} ms instead of {were.unspoken}"
    elif were.stays and not are.stays:
        text = "beta does not stay armed"
    elif not day.recovered:
        text = "alpha does not recover when it is over"
    if not text:
        return None
    reported = (day.fault,) if day.fault else ()
    return Failure(
        f"alpha's replies are {what}: {text}", (*day.last.down, *day.last.up)[:6], (*words, *reported)
    )


def _ms(steps: int | None) -> str:
    return "never" if steps is None else f"{steps} ms"
