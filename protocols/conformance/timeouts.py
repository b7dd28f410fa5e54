"""Timeouts: silence of the host trips the device's watchdog, and silence of the device is reported offline.

Rules. Where the spec has a watchdog that is off as the device is delivered, settings that switch it on are
searched: one bool, Literal or number that is changed, or a bool and a number together. Only what feeds the
watchdog according to the spec is left out. A silent device is reported by the driver itself, in the time that
the spec declares: not later, nor while the device still sends. What our own host sends, returned by the bus,
is no sign of life.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import fields
from functools import partial
from typing import Any, get_type_hints

from protocols.conformance.bench import ALPHA, BETA, NAMES, STEP, Messages, OnLine, StepResult
from protocols.conformance.case import Case, Failure, Inapplicable, alternatives, valid
from protocols.conformance.fault_injection import (
    SLACK,
    STILL,
    Rig,
    liveliest,
    make_rig,
    moving,
    named,
    slack,
    torque_of,
)
from protocols.conformance.requests import ill_formed
from protocols.frames import OF_BYTES
from protocols.messages import MILLISECOND, SECOND, Arm, ClearFault, Command, Feedback, Idle, Mode, Nanos
from protocols.plugin import Device, FeedbackKind, Watchdog

REPORTED = 1000
"""Steps within which a driver must report what its device sends."""
FED = 3000
"""Steps at most, instead of ten timeouts, for which a fed watchdog is watched."""
WINDOW = 100
"""Steps over which the work on a shaft is summed."""
SPARED = 0.2
"""Part of the work of a motion that may still be done when the watchdog has ended it."""
ABSENT = 500
"""Steps for which a command is given to an absent device, and then none: it has aged."""
IN_FLIGHT = 5
"""Steps at most within which what a device has sent is reported, on a line where others answer behind it."""
RETURNED = 2000
"""Steps within which a device that sends again must be reported."""


# -- silence of the host -----------------------------------------------------------------------------------


def silent_host_trips_watchdog(case: Case) -> None:
    """Silence of the host ends a motion and is reported; steady commands never trip the watchdog."""
    if not case.kinds:
        raise Inapplicable("the spec lists no commands that arm")
    settings = settings_with_watchdog(case)
    if settings is None:
        raise Inapplicable("the spec's watchdog has no timeout, or is off, and no setting switches it on")
    watchdog = watchdog_of(case, settings)
    trials = [_host_stops]
    trials += [_no_commands] if watchdog.fed_by != "any frame" else []
    trials += [_only_another_is_commanded] if watchdog.fed_by == "its commands" else []
    for trial in case.sample(trials):
        try:
            trial(case, settings, watchdog)
        except Failure as failure:
            text = failure.text + _changed(case.plugin.settings(), settings)
            raise Failure(text, failure.frames, failure.messages) from failure


def _changed(default: Any, settings: Any) -> str:  # noqa: ANN401 -- dataclasses of the plugin's
    """Return the settings that were changed, to be shown with a failure."""
    names = [f.name for f in fields(default) if getattr(default, f.name) != getattr(settings, f.name)]
    changed = ", ".join(f"{name}={getattr(settings, name)!r}" for name in names)
    return f" [settings {changed}]" if changed else ""


def watchdog_of(case: Case, settings: object) -> Watchdog:
    """Return the watchdog of alpha with these settings."""
    return case.plugin.spec(Device(ALPHA, case.addresses[0], case.options, settings)).watchdog


def settings_with_watchdog(case: Case) -> object | None:
    """Return the first settings with which the watchdog is on, and has a timeout that is short enough."""
    for settings in _settings(case.plugin.settings()):
        watchdog = watchdog_of(case, settings)
        timeout = watchdog.timeout
        if watchdog.enabled and timeout is not None and 5 * MILLISECOND <= timeout <= 3 * SECOND:
            return settings
    return None


def _settings(default: Any) -> Iterator[object]:  # noqa: ANN401 -- a dataclass of the plugin's
    """Yield the default settings; those with one value changed; those with a bool and a number changed."""
    yield default
    hints = get_type_hints(type(default))
    unset = [(f.name, hints[f.name]) for f in fields(default) if not getattr(default, f.name)]
    numeric = [(name, kind) for name, kind in unset if kind in (int, float)]
    numbers = [(name, kind(value)) for name, kind in numeric for value in (0.2, 200.0) if kind(value)]
    switches = alternatives(default)
    yield from valid(default, [dict([one]) for one in (*switches, *numbers)])
    yield from valid(default, [dict([switch, number]) for switch in switches for number in numbers])


def _armed(case: Case, settings: object, count: int) -> Rig:
    """Return a rig with alpha, or both, armed at rest."""
    rig = make_rig(case, count, settings)
    rig.get_ready()
    rig.must_arm(rig.at_rest(liveliest(rig.spec), *rig.names))
    rig.faults.clear()
    return rig


def _move(rig: Rig, count: int, names: Sequence[str]) -> float:
    """Command these motors to move; return the work done on alpha's shaft [N·m·rad]."""
    kind, work = liveliest(rig.spec), 0.0
    start = {name: rig.bench.shafts[name].position for name in rig.names}
    for at in range(count):
        work += _work(rig, rig.step([moving(kind, rig.spec, name, start[name], at) for name in names]))
    return work


def _work(rig: Rig, result: StepResult) -> float:
    """Return the work of alpha in a step to turn its shaft on; 0.0 if it braked."""
    return max(torque_of(result) * rig.bench.shafts[ALPHA].velocity * STEP * 1e-9, 0.0)


def _trip_steps(watchdog: Watchdog) -> int:
    """Return the steps of silence after which the watchdog must have tripped."""
    timeout = watchdog.timeout or 0
    return 1 + (timeout + timeout // 10) // STEP + 10


def _must_have_tripped(rig: Rig, work: float, when: str, names: Sequence[str] = ()) -> None:
    """The device no longer drives its shaft, and the driver reports it (but of one that only replies to
    commands, which would arm it again). Raises Failure."""
    done = _move(rig, WINDOW, names) if names else sum(_work(rig, rig.step()) for _ in range(WINDOW))
    if done > SPARED * work:
        raise rig.failure(f"{when}: the device still drives its shaft")
    rig.host.alive = True
    if rig.only_replies:
        return
    rest = rig.at_rest(liveliest(rig.spec), *names) if names else []
    if not rig.until(lambda _: rig.mode() is not Mode.ARMED or bool(named(rig.faults)), REPORTED, rest):
        text = f"the device has stopped; in {REPORTED} ms the driver reports neither State nor Fault"
        raise rig.failure(f"{when}: {text}")


def _host_stops(case: Case, settings: object, watchdog: Watchdog) -> None:
    """Feed for ten timeouts, then through a short gap, then no more."""
    rig = _armed(case, settings, 1)
    timeout = (watchdog.timeout or 0) // STEP
    _move(rig, min(10 * timeout, FED), rig.names)
    if rig.mode() is not Mode.ARMED or rig.faults:
        raise rig.failure("with a command in every ms, the device does not stay armed")
    rig.host.alive = False
    rig.wait(int(0.6 * timeout))
    rig.host.alive = True
    work = _move(rig, WINDOW, rig.names)
    if rig.mode() is not Mode.ARMED or rig.faults:
        raise rig.failure(f"the host is silent for 0.6 of the declared {timeout} ms, and the device disarms")
    rig.host.alive = False
    rig.wait(_trip_steps(watchdog))
    when = f"the host is gone for more than the declared {timeout} ms"
    _must_have_tripped(rig, work, when)
    if ClearFault in rig.spec.requests:
        rig.step([ClearFault(ALPHA)])
    rig.wait(REPORTED, [Idle(ALPHA)])
    again = rig.at_rest(liveliest(rig.spec))
    if not rig.arm(lambda _: again):
        raise rig.failure(f"{when}: after ClearFault and Idle it does not arm again")


def _no_commands(case: Case, settings: object, watchdog: Watchdog) -> None:
    """The driver runs, and gets no command: it must not feed."""
    rig = _armed(case, settings, 1)
    work = _move(rig, WINDOW, rig.names)
    rig.wait(_trip_steps(watchdog))
    _must_have_tripped(rig, work, "the driver gets no command, and feeds the watchdog by itself")


def _only_another_is_commanded(case: Case, settings: object, watchdog: Watchdog) -> None:
    """The driver gets commands for beta, and none for alpha: it must not feed alpha."""
    rig = _armed(case, settings, 2)
    work = _move(rig, WINDOW, rig.names)
    _move(rig, _trip_steps(watchdog), [BETA])
    _must_have_tripped(rig, work, "beta alone is commanded, and alpha is fed", [BETA])
    if rig.mode(BETA) is not Mode.ARMED:
        raise rig.failure("beta is commanded and alpha is not: beta does not stay armed")


# -- silence of the device ---------------------------------------------------------------------------------


def silent_device_is_offline(case: Case) -> None:
    """A silent device is reported OFFLINE in the declared time, without feedback, and so is its return."""
    spec = case.spec
    if spec.kind != "motor":
        raise Inapplicable("the spec's kind is sensor: it has no joint that could lose its feedback")
    if spec.feedback is FeedbackKind.NONE:
        raise Inapplicable("the spec's feedback is none")
    trials: list[Callable[[Case], None]] = [_never_there]
    trials += [partial(_falls_silent, None)] if spec.feedback is not FeedbackKind.REPLY else []
    trials += [partial(_falls_silent, kind) for kind in case.kinds[:1]]
    for trial in case.sample(trials):
        trial(case)


def _never_there(case: Case) -> None:
    """Alpha is not on the bus at all; the host calls its driver only when that is due."""
    rig = make_rig(case, 2)
    rig.cables[ALPHA].up = rig.cables[ALPHA].down = False
    messages = rig.prompt
    rig.step(messages)
    rig.host.lazy = True
    _is_reported_offline(rig, rig.now, messages, "a device that is not there")


def _falls_silent(kind: type[Command] | None, case: Case) -> None:
    """Alpha sends, falls silent, is turned by hand, and sends again; armed by this command, or not."""
    rig, messages, what = make_rig(case, 2), list[Command](), "a device that falls silent"
    rig.get_ready()
    if kind is not None:
        what += ", armed,"
        messages = rig.at_rest(kind, *NAMES)
        rig.must_arm(messages)
    rig.wait(300, messages)
    if rig.offline:
        raise rig.failure(f"{next(iter(rig.offline))} sends, and is reported offline")
    cable = rig.cables[ALPHA]
    cable.up, cable.down = False, kind is None
    rig.host.lazy, rig.host.echo = kind is None, case.spec.bus not in OF_BYTES
    driver = rig.host.driver
    for _ in range(IN_FLIGHT):  # what was in flight arrives; of a chain of answers it is read at the end
        rig.step(messages)
        if not isinstance(driver, OnLine) or not driver.line.held:
            break
    _is_reported_offline(rig, cable.sent_at, messages, what)
    _comes_back(rig, what)


def _is_reported_offline(rig: Rig, last: Nanos, messages: Messages, what: str) -> None:
    """Alpha is silent after `last`: OFFLINE in time, beta never, and no feedback. Raises Failure."""
    spec = rig.spec
    soonest = last + spec.offline_after - spec.feedback_period - 2 * STEP
    latest = last + spec.offline_after + spec.feedback_period + 5 * STEP
    while rig.now < latest + 100 * STEP:
        step = rig.step(messages)
        invented = [e for e in named(step.events) if isinstance(e, Feedback)]
        if invented:
            raise rig.failure(f"feedback of {what} is reported", rig.host.sent, invented[:1])
        for event in step.events:
            if wrong := ill_formed(event, step.now):
                raise rig.failure(f"{what}: {wrong}", (), [event])
        if BETA in rig.offline:
            raise rig.failure(f"{what}: beta sends, and is reported offline too")
        reported = rig.offline.get(ALPHA)
        if reported is not None and reported < soonest:
            raise rig.failure(f"{what} is reported offline after only {_ms(reported - last)} of silence")
        if reported is None and rig.now > latest:
            raise rig.failure(f"{what} is not reported offline within {_ms(latest - last)}")
    if rig.mode() is not Mode.OFFLINE:
        raise rig.failure(f"{what} is then reported {rig.mode()}")


def _comes_back(rig: Rig, what: str) -> None:
    """Turned by hand in the meantime, it is reported at its new position, and no longer offline."""
    cable, shaft = rig.cables[ALPHA], rig.bench.shafts[ALPHA]
    rig.turn(0.8)
    for each in rig.bench.shafts.values():
        each.locked = True
    cable.up = cable.down = True
    back, received = rig.now, list[Feedback]()

    unmeasured = "Feedback.position" not in rig.spec.ranges

    def both(step: StepResult) -> bool:
        received.extend(e for e in named(step.events) if isinstance(e, Feedback) and e.position is not None)
        return rig.mode() is not Mode.OFFLINE and (bool(received) or unmeasured)

    if not rig.until(both, RETURNED, [Idle(name) for name in NAMES if Idle in rig.spec.commands]):
        raise rig.failure(f"{what} sends again, and in {RETURNED} ms no State, or no position, is reported")
    room = slack(rig.spec, shaft.position) + SLACK
    away = [e for e in received if abs((e.position or 0.0) - shaft.position) > room and not unmeasured]
    stale = [e for e in received if e.t < back] or away
    if stale:
        text = f"{what} has been turned to {shaft.position:.6g} rad at {back}, and is reported where it was"
        raise rig.failure(text, (), stale[:1])


def absent_device_is_not_armed_later(case: Case) -> None:
    """A command given to an absent device does not arm it when it comes back, unless it is given again."""
    if not case.kinds:
        raise Inapplicable("the spec lists no commands that arm")
    other = case.random().choice(case.kinds)
    for kind, there in case.sample([(liveliest(case.spec), True), (other, False)]):
        _comes_back_uncommanded(case, kind, there)


def _comes_back_uncommanded(case: Case, kind: type[Command], there: bool) -> None:
    """Cut alpha off, at once or when it is ready; command it; then command nothing, and connect it again."""
    rig = make_rig(case)
    if there:
        rig.get_ready()
    cable = rig.cables[ALPHA]
    cable.up = cable.down = False
    rig.wait(ABSENT + case.spec.offline_after // STEP, rig.at_rest(kind))
    rig.wait(ABSENT)
    cable.up = cable.down = True
    for at in range(RETURNED):
        step = rig.step()
        arming = [message for message in named(step.received) if isinstance(message, Arm)]
        if arming or abs(torque_of(step)) > STILL:
            text = f"given {kind.__name__} while it was absent, and nothing for {ABSENT} ms"
            raise rig.failure(f"{text}, the device is armed {at} ms after it came back", step.down, arming)


def _ms(span: Nanos) -> str:
    return f"{span // MILLISECOND} ms"
