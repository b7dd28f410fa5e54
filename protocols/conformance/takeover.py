"""Devices that run already: attached to without dropping what they hold, and found without a touch.

Rules. A first host arms the device and leaves it under a constant load; if the device does not hold
unattended, that host stays on the bus until the fresh one takes over. Sagging is measured against what the
shaft gave way when the load first came on: a control without integral gives way as much again.
"""

from __future__ import annotations

from dataclasses import dataclass

from protocols.conformance.bench import ARMING, NAMES, StepResult
from protocols.conformance.case import Case, Failure, Inapplicable, Verdict
from protocols.conformance.fault_injection import (
    SLACK,
    STILL,
    Messages,
    Scene,
    resting,
    scene,
    slack,
    some,
    takeover,
    torque_of,
)
from protocols.conformance.passivity import harmless
from protocols.messages import Command, Done, Found, Hold, Idle, Mode, Position, Reboot, Refused, Scan
from protocols.plugin import Spec

ALPHA, BETA = NAMES
PLACE = 0.7
"""rad where the shafts stand."""
LOAD = 0.05
"""N·m that hang on a shaft."""
SETTLE = 500
"""Steps in which a loaded shaft has given way."""
SCANNED = 8000
"""Steps in which a scan must have ended."""


# -- attaching -----------------------------------------------------------------------------------------


def load_is_held(case: Case) -> Verdict:
    """A fresh host attaches to a device under load, and takes it over with Hold: the load does not drop."""
    kinds = _holding(case.spec)
    if not kinds:
        return Inapplicable("the spec lists neither Hold nor Position: the device holds no load")
    return _attach(case, case.random().choice(kinds), kinds[0])


def _holding(spec: Spec) -> list[type[Command]]:
    kinds: tuple[type[Command], ...] = (Hold, Position)
    return [kind for kind in kinds if kind in spec.commands]


@dataclass(frozen=True, slots=True)
class _Loaded:
    """Devices that a first host holds, with a load on alpha."""

    on: Scene
    words: list[Command]
    """What that host says."""
    given: float
    """rad by which the shaft gave way at most."""


def _loaded(case: Case, kind: type[Command], count: int = 1) -> _Loaded | Failure:
    """Armed by the first host, then loaded."""
    on = scene(case, count, position=PLACE)
    if not on.ready():
        return on.failure(f"is not heard to be ready in {ARMING} ms")
    words = [resting(kind, on.spec, name, on.measured.get(name, PLACE)) for name in on.names]
    if not on.arm(lambda _: words):
        return on.failure(f"{kind.__name__} does not arm in {ARMING} ms")
    shaft = on.stage.shafts[ALPHA]
    place, shaft.load = shaft.position, LOAD
    given = 0.0
    for _ in range(SETTLE):
        on.step(words)
        given = max(given, shaft.position - place)
    return _Loaded(on, words, given)


def _attach(case: Case, first: type[Command], second: type[Command]) -> Failure | None:
    loaded = _loaded(case, first)
    if isinstance(loaded, Failure):
        return loaded
    before = loaded.on
    shaft = before.stage.shafts[ALPHA]
    if before.spec.holds_unattended:
        before.host.alive = False
        before.wait(SETTLE)
    on, idle = takeover(case, before), [Idle(ALPHA)] if Idle in before.spec.commands else []
    if not before.spec.holds_unattended:
        on.host.other, on.host.others_words = before.host.driver, loaded.words
    place = shaft.position
    room = 0.5 * SLACK

    def over(_: StepResult) -> bool:
        return shaft.position - place > room or on.mode() is Mode.ARMED

    if not on.until(over, ARMING, idle):
        return on.failure(f"a fresh driver does not tell in {ARMING} ms that the device is armed")
    on.wait(SETTLE // 2, idle)
    if shaft.position - place > room:
        return on.failure(
            f"a fresh driver only listens, and the shaft sags by {shaft.position - place:.3g} rad"
        )
    return _takes_over(on, second, loaded.given)


def _takes_over(on: Scene, kind: type[Command], given: float) -> Failure | None:
    """From now on the fresh host alone commands."""
    shaft = on.stage.shafts[ALPHA]
    place = shaft.position
    room = 1.2 * given + slack(on.spec, place)
    word = resting(kind, on.spec, ALPHA, on.measured.get(ALPHA, place))
    on.host.other = None
    on.obeyed.clear()
    on.faults.clear()  # two hosts on one bus may well be complained of
    limp = 0
    for at in range(2 * SETTLE):
        said = on.step([word])
        limp = limp + 1 if abs(torque_of(said)) <= STILL else 0
        dropping = [w for w in said.received if isinstance(w, Idle | Reboot)]
        wrong = ""
        if dropping:
            wrong = f"the device is told {dropping[0]}"
        elif limp > 3:
            wrong = "the device gives no torque"
        elif shaft.position - place > room:
            wrong = f"the shaft sags by {shaft.position - place:.3g} rad"
        elif on.mode() is not Mode.ARMED or on.faults:
            wrong = f"the driver tells {on.faults[0].name if on.faults else on.mode()}"
        if wrong:
            return on.failure(f"a fresh driver takes over with {kind.__name__}; {at} ms later {wrong}")
    return None


# -- finding -------------------------------------------------------------------------------------------


def scan_only_looks(case: Case) -> Verdict:
    """Scan finds the devices, with read-only wires; what runs runs on, what is in fault stays in fault."""
    if Scan not in case.spec.requests:
        return Inapplicable("the spec lists no request Scan")
    for scan in some(case, [_scan_fresh, *([_scan_running] if _holding(case.spec) else [])]):
        failure = scan(case)
        if failure:
            return failure
    return None


def _scan_fresh(case: Case) -> Failure | None:
    """Devices as they come, by a driver that knows nothing yet."""
    on = scene(case, 2)
    failure = _scan(on, case, "devices as they come")
    if failure or case.spec.kind != "motor":
        return failure
    return None if on.ready() else on.failure(f"after a scan, is not heard to be ready in {ARMING} ms")


def _scan_running(case: Case) -> Failure | None:
    """Alpha holds a load for another host, beta is in fault."""
    loaded = _loaded(case, _holding(case.spec)[0], 2)
    if isinstance(loaded, Failure):
        return loaded
    before, words = loaded.on, loaded.words
    codes = sorted(code for code, said in before.spec.faults.items() if said.latching)
    code = case.random().choice(codes) if codes else None
    if code is not None:
        before.cables[BETA].provoke(code)
        before.wait(20, words[:1])
    place = before.stage.shafts[ALPHA].position
    on = takeover(case, before)
    on.host.other, on.host.others_words = before.host.driver, words[:1]
    failure = _scan(on, case, "a device that runs and one in fault")
    if failure:
        return failure
    sag = before.stage.shafts[ALPHA].position - place
    if sag > 0.5 * SLACK or on.mode() is not Mode.ARMED:
        return on.failure(f"a scan, and the device that ran sags by {sag:.3g} rad, and is {on.mode()}")
    if code is not None and on.mode(BETA) is not Mode.FAULT:
        return on.failure(f"a scan, and the device that was in fault {code} is {on.mode(BETA)}")
    return None


def _scan(on: Scene, case: Case, what: str) -> Failure | None:
    """Scan until it has ended: read-only throughout, with every device found."""
    found, ended = set[int](), list[Done | Refused]()
    words: Messages = [Scan("bus")]
    for _ in range(SCANNED):
        said = on.step(words)
        words = ()
        for frame in on.host.sent:
            if not harmless(on.stage.specs, frame):
                received = tuple(case.plugin.decoder(on.stage.devices).decode(said.now, frame))
                return on.failure(f"a scan of {what} sends what is not read-only", (frame,), received)
        found |= {event.address for event in said.events if isinstance(event, Found)}
        ended += [e for e in said.events if isinstance(e, Done | Refused) and e.request == Scan.__name__]
        if ended:
            break
    if not ended or isinstance(ended[0], Refused):
        return on.failure(f"a scan of {what} ends with {ended or 'nothing'} in {SCANNED} ms")
    missing = set(case.addresses[: len(on.names)]) - found
    return on.failure(f"a scan of {what} does not find address {min(missing)}") if missing else None
