"""Losses: replies that are lost, late, duplicated or reordered, and commands that a full queue has dropped.

Rules. Only alpha's replies are disturbed. Beta must arm, give feedback and answer requests as if nothing had
happened, but for what a shared bus may cost; and when the disturbance ends alpha must arm too. Commands are
dropped on our side of the bus in the first steps of arming, of a change from one type of command to another,
and of Idle, and the driver is notified (`BusState.FULL`). Afterwards the device must obey the latest command.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import TypeAlias

from protocols import messages as msg
from protocols.conformance import bench as tools
from protocols.conformance.bench import ALPHA, ARMING, BETA, NAMES, STEP, Bench, StepResult, TwinWrapper
from protocols.conformance.case import Case, Failure, Inapplicable
from protocols.conformance.fault_injection import Rig, make_rig
from protocols.conformance.random import Random
from protocols.conformance.roundtrip import obeyed
from protocols.frames import BusState, Frame
from protocols.messages import Command, Event, Mode, Nanos, Request
from protocols.plugin import FeedbackKind

LASTS = 600
"""Steps of disturbance after beta is armed."""
GRACE = 60
"""Steps that the disturbance of one may cost another: a poll or two that share the bus."""
DROPPED = (1, 2, 5, 12)
"""Steps of which nothing is sent."""
OBEYED = 300
"""Steps within which a device must then obey."""
Queue: TypeAlias = list[tuple[Nanos, Frame]]
"""Frames in flight, and when they arrive."""


# -- replies ---------------------------------------------------------------------------------------------


@dataclass(slots=True)
class Disturbed(TwinWrapper):
    """A twin whose frames are disturbed on their way to the host."""

    disturb: Callable[[Disturbed, Nanos, Sequence[Frame]], None]
    """Puts what was sent now into the queue, or does not."""
    random: Random
    on: bool = True
    queue: Queue = field(default_factory=list)
    held: list[Frame] = field(default_factory=list)

    def step(self, now: Nanos, truth: Sequence[Event]) -> tuple[Sequence[msg.Torque], Sequence[Frame]]:
        """Step the device; return the frames that arrive now."""
        torques, frames = self.twin.step(now, truth)
        if self.on:
            self.disturb(self, now, frames)
        else:
            self.queue += [(now, frame) for frame in (*self.held, *frames)]
            self.held = []
        arrived = [frame for at, frame in self.queue if at <= now]
        self.queue = [(at, frame) for at, frame in self.queue if at > now]
        return torques, arrived


def _half_lost(it: Disturbed, now: Nanos, frames: Sequence[Frame]) -> None:
    it.queue += [(now, frame) for frame in frames if it.random.below(2)]


def _lost(_: Disturbed, __: Nanos, ___: Sequence[Frame]) -> None:
    """Put nothing into the queue."""


def _late(it: Disturbed, now: Nanos, frames: Sequence[Frame]) -> None:
    it.queue += [(now + 35 * STEP, frame) for frame in frames]


def _very_late(it: Disturbed, now: Nanos, frames: Sequence[Frame]) -> None:
    it.queue += [(now + 700 * STEP, frame) for frame in frames]


def _duplicated(it: Disturbed, now: Nanos, frames: Sequence[Frame]) -> None:
    it.queue += [(now, frame) for frame in frames for _ in range(2)]


def _reordered(it: Disturbed, now: Nanos, frames: Sequence[Frame]) -> None:
    """Swap the frames of each pair."""
    for frame in frames:
        if it.held:
            it.queue += [(now, frame), (now, it.held.pop())]
        else:
            it.held.append(frame)


DISTURBANCES = (
    ("half lost", _half_lost),
    ("lost", _lost),
    ("late", _late),
    ("very late", _very_late),
    ("duplicated", _duplicated),
    ("reordered", _reordered),
)


@dataclass(slots=True)
class _Watch:
    """What is observed of a device, in steps."""

    motor: str
    armed_at: int | None = None
    measured_at: int | None = None
    answered_at: int | None = None
    commanded_at: int | None = None
    feedback_gap: int = 0
    """The longest between two measurements."""
    command_gap: int = 0
    """The longest between two commands that it would obey."""
    fault: msg.Fault | None = None

    def observe(self, at: int, step: StepResult) -> None:
        """Note one step."""
        if any(isinstance(message, Command) and message.motor == self.motor for message in step.received):
            self.commanded_at = at
        for event in step.events:
            if isinstance(event, msg.Feedback) and event.motor == self.motor:
                self.measured_at = at
            elif isinstance(event, msg.Fault) and event.motor == self.motor:
                self.fault = event
            elif isinstance(event, msg.Parameter | msg.Done | msg.Refused):
                name = event.motor if isinstance(event, msg.Parameter) else event.name
                self.answered_at = at if name == self.motor else self.answered_at
        if self.armed_at is not None and self.measured_at is not None:
            self.feedback_gap = max(self.feedback_gap, at - self.measured_at)
        if self.armed_at is not None and self.commanded_at is not None:
            self.command_gap = max(self.command_gap, at - self.commanded_at)


@dataclass(frozen=True, slots=True)
class _Trial:
    """What became of beta while alpha was disturbed, and of alpha afterwards."""

    alpha: _Watch
    beta: _Watch
    answered: int | None
    """Steps after which beta's requests were answered; None: never."""
    stays: bool
    """Beta stays armed."""
    recovered: bool
    last: StepResult


def one_delays_no_other(case: Case) -> None:
    """Whatever happens to alpha's replies, beta behaves as without it; and alpha recovers."""
    if not case.kinds:
        raise Inapplicable("the spec lists no commands: nothing waits for a reply")
    commands = [tools.build(case.kinds[0], name, case.spec.ranges) for name in NAMES]
    usual = _try(case, commands, None)
    for what, disturb in DISTURBANCES if case.default else DISTURBANCES[:1]:
        disturbed = Disturbed(case.start().twins[0], disturb, case.random())
        trial = _try(case, commands, disturbed)
        wrong = _worse(usual, trial)
        if wrong:
            text = f"alpha's replies are {what}: {wrong}"
            fault = (trial.alpha.fault,) if trial.alpha.fault else ()
            raise Failure(text, (*trial.last.down, *trial.last.up)[:6], (*commands, *fault))


def _try(case: Case, commands: list[Command], disturbed: Disturbed | None) -> _Trial:
    bench = case.start()
    if disturbed is not None:
        disturbed.twin = bench.twins[0]
        bench.twins[0] = disturbed
    alpha, beta = _Watch(ALPHA), _Watch(BETA)
    requests = _requests(case)
    at, until, step = 0, ARMING, bench.step(commands)
    while at < until:
        beta.observe(at, step)
        alpha.observe(at, step)
        if beta.armed_at is None and _is_armed(bench, BETA, at):
            beta.armed_at, until = at, at + LASTS
        asked: list[Command | Request] = []
        if beta.armed_at is not None and at == beta.armed_at + LASTS // 4:
            beta.answered_at, asked = None, requests
        step = bench.step([*commands, *asked])
        at += 1
    if disturbed is not None:
        disturbed.on = False
    answered = None if requests else 0
    if requests and beta.answered_at is not None and beta.armed_at is not None:
        answered = beta.answered_at - beta.armed_at
    stays = _is_armed(bench, BETA, at)
    recovered = _recovers(case, bench, commands, alpha)
    return _Trial(alpha, beta, answered, stays, recovered, step)


def _requests(case: Case) -> list[Command | Request]:
    """Return requests to both: for a parameter that they do not have, and one that moves nothing."""
    requests: list[Command | Request] = []
    if msg.ReadParameter in case.spec.requests:
        requests += [msg.ReadParameter(name, "no such parameter") for name in NAMES]
    if msg.ClearFault in case.spec.requests and not case.spec.stop_clears_faults:
        requests += [msg.ClearFault(name) for name in NAMES]
    return requests


def _is_armed(bench: Bench, name: str, at: int) -> bool:
    return bench.modes.get(name) is Mode.ARMED or (at > ARMING // 10 and not bench.modes)


def _recovers(case: Case, bench: Bench, commands: list[Command], alpha: _Watch) -> bool:
    """True if alpha arms when the disturbance is over. A device that tripped meanwhile is cleared first."""
    for at in range(ARMING):
        request = at % 1000 == 300 and msg.ClearFault in case.spec.requests
        clear = [msg.ClearFault(ALPHA)] if request and not _is_armed(bench, ALPHA, ARMING) else []
        step = bench.step([*commands, *clear])
        alpha.observe(at, step)
        measured = case.spec.feedback is FeedbackKind.NONE
        measured |= any(isinstance(event, msg.Feedback) and event.motor == ALPHA for event in step.events)
        if measured and at > 50 and _is_armed(bench, ALPHA, ARMING):
            return True
    return False


def _worse(usual: _Trial, trial: _Trial) -> str:
    """Return how beta behaves worse than usual, or that alpha did not recover; "" if neither."""
    before, beta = usual.beta, trial.beta
    if _later(before.armed_at, beta.armed_at) or beta.armed_at is None:
        return f"beta arms after {_ms(beta.armed_at)} instead of {_ms(before.armed_at)}"
    if _later(before.feedback_gap, beta.feedback_gap):
        return f"beta gives no feedback for {beta.feedback_gap} ms instead of {before.feedback_gap}"
    if _later(usual.answered, trial.answered):
        return f"beta's request is answered after {_ms(trial.answered)} instead of {_ms(usual.answered)}"
    if _later(before.command_gap, beta.command_gap):
        return f"beta is not commanded for {beta.command_gap} ms instead of {before.command_gap}"
    if usual.stays and not trial.stays:
        return "beta does not stay armed"
    return "" if trial.recovered else "alpha does not recover when it is over"


def _later(usual: int | None, steps: int | None) -> bool:
    """True if something took longer than usual, by more than GRACE."""
    return usual is not None and (steps is None or steps > usual + GRACE)


def _ms(steps: int | None) -> str:
    return "never" if steps is None else f"{steps} ms"


# -- dropped commands ------------------------------------------------------------------------------------


def dropped_commands_are_repeated(case: Case) -> None:
    """What was dropped when the transmit queue was full is sent again."""
    kinds = case.kinds
    if not kinds:
        raise Inapplicable("the spec lists no commands that arm")
    first = case.random().below(len(DROPPED))
    pairs = list(zip(kinds, [*kinds[1:], kinds[0]], strict=True))
    for at, (kind, then) in case.sample(list(enumerate(pairs, first))):
        _drops(case, DROPPED[at % len(DROPPED)], kind, then)


def _drops(case: Case, steps: int, kind: type[Command], then: type[Command]) -> None:
    """Arm by one type of command, change to another, and disarm: the first steps of each are dropped."""
    rig = make_rig(case)
    rig.get_ready()
    (command,) = rig.at_rest(kind)
    _drop(rig, steps, command)
    rig.must_arm([command], f"the first {steps} ms are dropped: ")
    (change,) = rig.at_rest(then)
    _must_obey(rig, steps, command)
    idle = [msg.Idle(ALPHA)] if msg.Idle in case.spec.commands else []
    for each in (change, *idle):
        _drop(rig, steps, each)
        _must_obey(rig, steps, each)


def _drop(rig: Rig, steps: int, command: Command) -> None:
    """Give a command for this many steps to a full transmit queue, of which the driver is notified."""
    rig.host.dropping = True
    rig.wait(steps, [command])
    rig.host.dropping = False
    rig.host.bus(rig.now, BusState.FULL)
    rig.step([command])
    rig.host.bus(rig.now, BusState.UP)


def _must_obey(rig: Rig, steps: int, command: Command) -> None:
    """The device obeys this command within OBEYED steps. Raises Failure."""

    def obeys(_: StepResult) -> bool:
        return ALPHA in rig.obeys and obeyed(rig.bench, rig.spec, command, rig.obeys[ALPHA])

    if not rig.until(obeys, OBEYED, [command]):
        text = f"given {command}, the device obeys {rig.obeys.get(ALPHA, 'nothing')}"
        raise rig.failure(f"the first {steps} ms of a command are dropped: {text}")
