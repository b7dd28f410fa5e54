"""Silence of the device, which must blind its joint.

Rules. A device that falls silent is told of by the driver itself, in the time that the spec declares: not
later, nor while it still speaks. What our own host sends, given back by the bus, is no sign of life.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial

from protocols.conformance.answers import broken
from protocols.conformance.bench import ARMING, NAMES, STEP, StepResult
from protocols.conformance.case import Case, Failure, Inapplicable, Verdict
from protocols.conformance.fault_injection import (
    SLACK,
    Messages,
    Scene,
    kinds_of,
    named,
    resting,
    scene,
    slack,
    some,
)
from protocols.messages import MILLISECOND, Command, Feedback, Idle, Mode, Nanos
from protocols.plugin import FeedbackKind

ALPHA, BETA = NAMES
BACK = 2000
"""Steps in which a device that speaks again must be told of."""


def silence_loses_feedback(case: Case) -> Verdict:
    """A silent device is told OFFLINE in the declared time, nothing is made up, and its return is told."""
    spec = case.spec
    if spec.kind != "motor":
        return Inapplicable("the spec's kind is sensor: it has no joint that could be blind")
    if spec.feedback is FeedbackKind.NONE:
        return Inapplicable("the spec says that the device gives no feedback")
    tries: list[Callable[[Case], Failure | None]] = [_never_there, partial(_falls_silent, None)]
    tries += [partial(_falls_silent, kind) for kind in kinds_of(spec)[:1]]
    for falls in some(case, tries):
        failure = falls(case)
        if failure:
            return failure
    return None


def _never_there(case: Case) -> Failure | None:
    """Alpha is not on the bus at all; the host calls its driver only when that is due."""
    on = scene(case, 2)
    on.cables[ALPHA].up = on.cables[ALPHA].down = False
    on.step()
    on.host.lazy = True
    return _silent(on, on.now, (), "a device that is not there")


def _falls_silent(kind: type[Command] | None, case: Case) -> Failure | None:
    """Alpha speaks, falls silent, is turned by hand, and speaks again; armed by this command, or not."""
    on, spec, words = scene(case, 2), case.spec, list[Command]()
    if not on.ready():
        return on.failure(f"is not heard to be ready in {ARMING} ms")
    what = "a device that falls silent"
    if kind is not None:
        what += ", armed,"
        words = [resting(kind, spec, name, on.measured.get(name, 0.0)) for name in NAMES]
        if not on.arm(lambda _: words):
            return on.failure(f"{kind.__name__} does not arm in {ARMING} ms")
    on.wait(300, words)
    if on.offline:
        return on.failure(f"{next(iter(on.offline))} speaks, and is told to be offline")
    cable = on.cables[ALPHA]
    cable.up, cable.down = False, kind is None
    on.host.lazy, on.host.echo = kind is None, spec.bus != "serial"
    on.step(words)  # what was on the way arrives
    return _silent(on, cable.spoke, words, what) or _comes_back(on, what)


def _silent(on: Scene, last: Nanos, words: Messages, what: str) -> Failure | None:
    """Nothing is heard of alpha after `last`: OFFLINE in time, beta never, and nothing made up."""
    spec = on.spec
    soonest = last + spec.offline_after - spec.feedback_period - 2 * STEP
    latest = last + spec.offline_after + spec.feedback_period + 5 * STEP
    while on.now < latest + 100 * STEP:
        said = on.step(words)
        made_up = [e for e in named(said.events) if isinstance(e, Feedback)]
        if made_up:
            return on.failure(f"{what} is told to measure something", on.host.sent, made_up[:1])
        for event in said.events:
            if wrong := broken(event, said.now):
                return on.failure(f"{what}: {wrong}", (), [event])
        if BETA in on.offline:
            return on.failure(f"{what}: beta speaks, and is told to be offline too")
        reported = on.offline.get(ALPHA)
        if reported is not None and reported < soonest:
            return on.failure(f"{what} is told to be offline after only {_ms(reported - last)} of silence")
        if reported is None and on.now > latest:
            return on.failure(f"{what} is not told to be offline within {_ms(latest - last)}")
    return None if on.mode() is Mode.OFFLINE else on.failure(f"{what} is then told to be {on.mode()}")


def _comes_back(on: Scene, what: str) -> Failure | None:
    """Turned by hand in the meantime, it is measured where it is now, and told to be more than offline."""
    cable, shaft = on.cables[ALPHA], on.stage.shafts[ALPHA]
    on.turn(0.8)
    for each in on.stage.shafts.values():
        each.locked = True
    cable.up = cable.down = True
    back, received = on.now, list[Feedback]()

    def both(said: StepResult) -> bool:
        received.extend(e for e in named(said.events) if isinstance(e, Feedback) and e.position is not None)
        silent = "Feedback.position" not in on.spec.ranges
        return on.mode() is not Mode.OFFLINE and (bool(received) or silent)

    if not on.until(both, BACK, [Idle(name) for name in NAMES if Idle in on.spec.commands]):
        return on.failure(f"{what} speaks again, and in {BACK} ms is not told to, or not measured")
    room = slack(on.spec, shaft.position) + SLACK
    stale = [e for e in received if e.t < back or abs((e.position or 0.0) - shaft.position) > room]
    if stale:
        text = f"{what} has been turned to {shaft.position:.6g} rad at {back}, and is told where it was"
        return on.failure(text, (), stale[:1])
    return None


def _ms(span: Nanos) -> str:
    return f"{span // MILLISECOND} ms"
