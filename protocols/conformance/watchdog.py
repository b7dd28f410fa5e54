"""Silence of the host, which must trip the device's watchdog; and commands, which must not let it trip.

Rules. Where the spec has a watchdog that is off as the device comes, the kit looks for settings that
switch it on: one bool, Literal or number that is changed, or a bool and a number together. What feeds it,
the spec says: only that is left out.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import fields, replace
from typing import Any, Literal, get_args, get_origin, get_type_hints

from protocols.conformance.bench import ARMING, NAMES, STEP, StepResult
from protocols.conformance.case import Case, Failure, Inapplicable, Verdict
from protocols.conformance.fault_injection import (
    Scene,
    kinds_of,
    liveliest,
    moving,
    named,
    resting,
    scene,
    some,
    torque_of,
)
from protocols.messages import MILLISECOND, SECOND, ClearFault, Command, Idle, Mode
from protocols.plugin import Device, Spec, Watchdog

ALPHA, BETA = NAMES
REPORTED = 1000
"""Steps in which a driver must tell what its device says."""
FED = 3000
"""Steps at most, instead of ten timeouts, for which a fed watchdog is watched."""
WINDOW = 100
"""Steps over which the work on a shaft is summed."""
SPARED = 0.2
"""Part of the work of a motion that may still be done when the watchdog has ended it."""


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


def _work(on: Scene, said: StepResult, name: str = ALPHA) -> float:
    """What a device did in a step to turn its shaft on; nothing if it braked."""
    return max(torque_of(said, name) * on.stage.shafts[name].velocity * STEP * 1e-9, 0.0)


def _tripped(on: Scene, work: float, names: list[str] | None = None) -> str:
    """What is wrong once the watchdog must have tripped: it drives on, or nobody tells; "" if all is well."""
    done = _go(on, WINDOW, names) if names else sum(_work(on, on.step()) for _ in range(WINDOW))
    if done > SPARED * work:
        return "the device still drives its shaft"
    on.host.alive = True
    rest = [resting(_kind(on.spec), on.spec, name, on.measured.get(name, 0.0)) for name in names or ()]
    reported = on.until(lambda _: on.mode() is not Mode.ARMED or bool(named(on.faults)), REPORTED, rest)
    return (
        ""
        if reported
        else f"the device has stopped; in {REPORTED} ms the driver tells neither State nor Fault"
    )


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
    on.wait(REPORTED, [Idle(ALPHA)])
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
