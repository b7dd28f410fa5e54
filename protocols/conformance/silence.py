"""Silence: of the host, which must trip the device's watchdog; of the device, which must blind its joint.

Rules. Where the spec has a watchdog that is off as the device comes, the kit looks for settings that
switch it on: one bool, Literal or number that is changed, or a bool and a number together. A device that
falls silent is told of by the driver itself, in the time that the spec declares: not later, nor while it
still speaks. What our own host sends, given back by the bus, is no sign of life.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import fields, replace
from functools import partial
from typing import Any, Literal, get_args, get_origin, get_type_hints

from protocols.conformance.case import Case, Failure, Inapplicable, Verdict
from protocols.conformance.rehearsal import ARMING, NAMES, STEP, Said
from protocols.conformance.trouble import (
    SLACK,
    Scene,
    Words,
    kinds_of,
    liveliest,
    moving,
    named,
    resting,
    scene,
    slack,
    some,
    torque_of,
)
from protocols.plugin import Device, FeedbackKind, Spec, Watchdog
from protocols.words import (
    MILLISECOND,
    SECOND,
    ClearFault,
    Command,
    Feedback,
    Idle,
    Mode,
    Nanos,
)

ALPHA, BETA = NAMES
TOLD = 1000
"""Steps in which a driver must tell what its device says."""
FED = 3000
"""Steps at most, instead of ten timeouts, for which a fed watchdog is watched."""
WINDOW = 100
"""Steps over which the work on a shaft is summed."""
SPARED = 0.2
"""Part of the work of a motion that may still be done when the watchdog has ended it."""
BACK = 2000
"""Steps in which a device that speaks again must be told of."""


# -- of the host ---------------------------------------------------------------------------------------


def silence_trips(case: Case) -> Verdict:
    """Silence of the host ends a commanded motion and is told; steady commands never trip the watchdog."""
    if not kinds_of(case.spec):
        return Inapplicable("the spec lists no commands that arm")
    settings = _watched(case)
    if settings is None:
        off = "the spec's watchdog has no timeout, or is off, and no setting switches it on"
        return Inapplicable(off)
    dog = _dog(case, settings)
    trips = [_host_dies]
    trips += [_nothing_said] if dog.fed_by != "any wire" else []
    trips += [_others_fed] if dog.fed_by == "its commands" else []
    for trip in some(case, trips):
        failure = trip(case, settings, dog)
        if failure:
            return replace(failure, text=failure.text + _changed(case.plugin.settings(), settings))
    return None


def _changed(default: Any, settings: Any) -> str:  # noqa: ANN401 -- dataclasses of the plugin's
    """The settings that were changed, to be said with a failure."""
    names = [f.name for f in fields(default) if getattr(default, f.name) != getattr(settings, f.name)]
    said = ", ".join(f"{name}={getattr(settings, name)!r}" for name in names)
    return f" [settings {said}]" if said else ""


def _dog(case: Case, settings: object) -> Watchdog:
    return case.plugin.spec(Device(ALPHA, case.addresses[0], case.options, settings)).watchdog


def _watched(case: Case) -> object | None:
    """The first settings under which the spec says that the watchdog is on, and soon enough to wait for."""
    for settings in _settings(case.plugin.settings()):
        dog = _dog(case, settings)
        if dog.enabled and dog.timeout is not None and 5 * MILLISECOND <= dog.timeout <= 3 * SECOND:
            return settings
    return None


def _settings(default: Any) -> Iterator[object]:  # noqa: ANN401 -- a dataclass of the plugin's
    """The default settings; those with one value changed; those with a bool and a number changed."""
    yield default
    hints = get_type_hints(type(default))
    switches: list[tuple[str, object]] = []
    numbers: list[tuple[str, object]] = []
    for f in fields(default):
        kind, value = hints[f.name], getattr(default, f.name)
        if kind is bool:
            switches.append((f.name, not value))
        elif get_origin(kind) is Literal:
            switches += [(f.name, other) for other in get_args(kind) if other != value]
        elif kind in (int, float) and not value:
            numbers += [(f.name, kind(number)) for number in (0.2, 200.0) if kind(number)]
    changes = [dict([one]) for one in (*switches, *numbers)]
    changes += [dict([switch, number]) for switch in switches for number in numbers]
    for change in changes:
        try:
            yield replace(default, **change)
        except ValueError:
            continue  # They do not go together; the plugin says so itself.


def _patience(dog: Watchdog) -> int:
    """Steps of silence after which it must have tripped."""
    timeout = dog.timeout or 0
    return 1 + (timeout + timeout // 10) // STEP + 10


def _moved(case: Case, settings: object, count: int) -> Scene | Failure:
    """Alpha, or both, armed and turning."""
    on = scene(case, count, settings)
    kind, spec = _kind(on.spec), on.spec
    if not on.ready():
        return on.failure(f"is not heard to be ready in {ARMING} ms")
    rest = [resting(kind, spec, name, on.measured.get(name, 0.0)) for name in on.names]
    if not on.arm(lambda _: rest):
        return on.failure(f"{kind.__name__} does not arm in {ARMING} ms")
    on.faults.clear()
    return on


def _kind(spec: Spec) -> type[Command]:
    return liveliest(spec) or kinds_of(spec)[0]


def _go(on: Scene, count: int, names: list[str] | None = None) -> float:
    """Command these motors to move for so many steps; the work done on alpha's shaft [N·m·rad]."""
    kind, work = _kind(on.spec), 0.0
    start = {name: on.stage.shafts[name].position for name in on.names}
    for at in range(count):
        wanted = on.names if names is None else names
        work += _work(on, on.step([moving(kind, on.spec, name, start[name], at) for name in wanted]))
    return work


def _work(on: Scene, said: Said, name: str = ALPHA) -> float:
    """What a device did in a step to turn its shaft on; nothing if it braked."""
    return max(torque_of(said, name) * on.stage.shafts[name].velocity * STEP * 1e-9, 0.0)


def _tripped(on: Scene, work: float, names: list[str] | None = None) -> str:
    """What is wrong once the watchdog must have tripped: it drives on, or nobody tells; "" if all is well."""
    done = _go(on, WINDOW, names) if names else sum(_work(on, on.step()) for _ in range(WINDOW))
    if done > SPARED * work:
        return "the device still drives its shaft"
    on.host.alive = True
    rest = [resting(_kind(on.spec), on.spec, name, on.measured.get(name, 0.0)) for name in names or ()]
    told = on.until(lambda _: on.mode() is not Mode.ARMED or bool(named(on.faults)), TOLD, rest)
    return "" if told else f"the device has stopped; in {TOLD} ms the driver tells neither State nor Fault"


def _host_dies(case: Case, settings: object, dog: Watchdog) -> Failure | None:
    """Fed for ten timeouts, then through a short gap, then no more."""
    on = _moved(case, settings, 1)
    if isinstance(on, Failure):
        return on
    timeout = (dog.timeout or 0) // STEP
    _go(on, min(10 * timeout, FED))
    if on.mode() is not Mode.ARMED or on.faults:
        return on.failure("with a command in every ms, the device does not stay armed")
    on.host.alive = False
    on.wait(int(0.6 * timeout))
    on.host.alive = True
    work = _go(on, WINDOW)
    if on.mode() is not Mode.ARMED or on.faults:
        return on.failure(f"the host is silent for 0.6 of the declared {timeout} ms, and the device disarms")
    on.host.alive = False
    on.wait(_patience(dog))
    wrong = _tripped(on, work) or _armed_again(on)
    if wrong:
        return on.failure(f"the host is gone for more than the declared {timeout} ms: {wrong}")
    return None


def _armed_again(on: Scene) -> str:
    """An operator clears, and the device must arm again."""
    if ClearFault in on.spec.requests:
        on.step([ClearFault(ALPHA)])
    on.wait(TOLD, [Idle(ALPHA)])
    word = resting(_kind(on.spec), on.spec, ALPHA, on.measured.get(ALPHA, 0.0))
    return "" if on.arm(lambda _: [word]) else "after ClearFault and Idle it does not arm again"


def _nothing_said(case: Case, settings: object, dog: Watchdog) -> Failure | None:
    """The driver lives, and gets no command: it must not feed."""
    on = _moved(case, settings, 1)
    if isinstance(on, Failure):
        return on
    work = _go(on, WINDOW)
    on.wait(_patience(dog))
    wrong = _tripped(on, work)
    return on.failure(f"the driver gets no command, and its own words feed: {wrong}") if wrong else None


def _others_fed(case: Case, settings: object, dog: Watchdog) -> Failure | None:
    """The driver gets commands for beta, and none for alpha: it must not feed alpha."""
    on = _moved(case, settings, 2)
    if isinstance(on, Failure):
        return on
    work = _go(on, WINDOW)
    _go(on, _patience(dog), [BETA])
    wrong = _tripped(on, work, [BETA])
    if wrong:
        return on.failure(f"beta alone is commanded, and alpha is fed: {wrong}")
    if on.mode(BETA) is not Mode.ARMED:
        return on.failure("beta is commanded and alpha is not: beta does not stay armed")
    return None


# -- of the device -------------------------------------------------------------------------------------


def silence_blinds(case: Case) -> Verdict:
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


def _silent(on: Scene, last: Nanos, words: Words, what: str) -> Failure | None:
    """Nothing is heard of alpha after `last`: OFFLINE in time, beta never, and nothing made up."""
    spec = on.spec
    soonest = last + spec.offline_after - spec.feedback_period - 2 * STEP
    latest = last + spec.offline_after + spec.feedback_period + 5 * STEP
    while on.now < latest + 100 * STEP:
        said = on.step(words)
        made_up = [e for e in named(said.events) if isinstance(e, Feedback)]
        if made_up:
            return on.failure(f"{what} is told to measure something", on.host.sent, made_up[:1])
        if BETA in on.offline:
            return on.failure(f"{what}: beta speaks, and is told to be offline too")
        told = on.offline.get(ALPHA)
        if told is not None and told < soonest:
            return on.failure(f"{what} is told to be offline after only {_ms(told - last)} of silence")
        if told is None and on.now > latest:
            return on.failure(f"{what} is not told to be offline within {_ms(latest - last)}")
    return None if on.mode() is Mode.OFFLINE else on.failure(f"{what} is then told to be {on.mode()}")


def _comes_back(on: Scene, what: str) -> Failure | None:
    """Turned by hand in the meantime, it is measured where it is now, and told to be more than offline."""
    cable, shaft = on.cables[ALPHA], on.stage.shafts[ALPHA]
    on.turn(0.8)
    for each in on.stage.shafts.values():
        each.locked = True
    cable.up = cable.down = True
    back, heard = on.now, list[Feedback]()

    def both(said: Said) -> bool:
        heard.extend(e for e in named(said.events) if isinstance(e, Feedback) and e.position is not None)
        silent = "Feedback.position" not in on.spec.ranges
        return on.mode() is not Mode.OFFLINE and (bool(heard) or silent)

    if not on.until(both, BACK, [Idle(name) for name in NAMES if Idle in on.spec.commands]):
        return on.failure(f"{what} speaks again, and in {BACK} ms is not told to, or not measured")
    room = slack(on.spec, shaft.position) + SLACK
    stale = [e for e in heard if e.t < back or abs((e.position or 0.0) - shaft.position) > room]
    if stale:
        text = f"{what} has been turned to {shaft.position:.6g} rad at {back}, and is told where it was"
        return on.failure(text, (), stale[:1])
    return None


def _ms(span: Nanos) -> str:
    return f"{span // MILLISECOND} ms"
