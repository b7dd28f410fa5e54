"""Safety at both ends of a motion: it begins where the shaft is, and Idle ends it, whatever comes between.

Rules. The device's ear and the twin's torque both judge: a set-point that would jump counts even if the
shaft did not move yet. Each command is tried from odd places of the shaft, and arming is cut short after
growing numbers of steps, so that the first that fails is the shortest.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial
from typing import TypeAlias

from protocols import messages as msg
from protocols.conformance.bench import ARMING, NAMES, STEP, StepResult
from protocols.conformance.case import Case, Failure, Inapplicable, Verdict
from protocols.conformance.fault_injection import (
    STILL,
    Messages,
    Scene,
    kinds_of,
    liveliest,
    moving,
    named,
    resting,
    scene,
    slack,
    some,
    takeover,
    torque_of,
)
from protocols.messages import Command, Mode, Request
from protocols.plugin import Spec

Way: TypeAlias = Callable[[Case, Spec], Failure | None]
"""A way out of some state; what is wrong with it."""
ALPHA = NAMES[0]
PLACES = (0.7, -2.9, 61.3, -417.0)
"""rad where shafts stand: none is zero, nor a whole turn."""
BY_HAND = 1.9
"""rad by which a disarmed shaft is turned."""
AFTER = 60
"""Steps for which a shaft is watched after arming."""
CUTS = (0, 1, 2, 3, 4, 5, 6, 8, 11, 15, 20, 28, 40, 55, 75, 100, 140, 200)
"""Steps of arming after which Idle is said: every second of them by each command, by the seed."""
PATIENCE = 1500
"""Steps in which Idle must have disarmed."""
LOST = 60
"""Steps for which replies, or the first words of a disarm, are lost."""


# -- no jump -------------------------------------------------------------------------------------------


def begins_where_it_is(case: Case) -> Verdict:
    """The first command after arming equals the measured position, wherever the shaft stands."""
    spec, random = case.spec, case.random()
    if not kinds_of(spec):
        return Inapplicable("the spec lists no commands that arm")
    if "Feedback.position" not in spec.ranges:
        return Inapplicable("the spec has no range for Feedback.position: the device measures none")
    places = [_within(spec, place) for place in PLACES]
    first = random.below(len(places))
    for at, kind in some(case, list(enumerate(kinds_of(spec), first))):
        failure = _from(case, spec, kind, places[at % len(places)])
        if failure:
            return failure
    return None


def _within(spec: Spec, place: float) -> float:
    """The place, or one that this device can measure and be sent to."""
    bounds = [spec.ranges[key] for key in ("Feedback.position", "Position.position") if key in spec.ranges]
    low, high = max(b.low for b in bounds), min(b.high for b in bounds)
    return place if 0.9 * low <= place <= 0.9 * high else place / 417.0 * 0.7 * min(-low, high)


def _from(case: Case, spec: Spec, kind: type[Command], place: float) -> Failure | None:
    """One command on a shaft at `place`: fresh, after a disarm, and after a fault."""
    on = scene(case, position=place)
    if not on.ready():
        return on.failure(f"is not heard to be ready in {ARMING} ms")
    failure = _arms_still(on, spec, kind, "fresh")
    if failure:
        return failure
    if not on.disarm():
        return on.failure("Idle does not disarm")
    on.turn(BY_HAND)
    failure = _arms_still(on, spec, kind, "after a disarm, turned by hand")
    codes = sorted(code for code, complaint in spec.faults.items() if complaint.latching)
    if failure or not codes or msg.ClearFault not in spec.requests:
        return failure
    on.cables[ALPHA].provoke(case.random().choice(codes))
    if not on.until(lambda _: on.mode() is Mode.FAULT, PATIENCE):
        return on.failure("a fault of the device is not told by State FAULT")
    on.wait(AFTER, [msg.Idle(ALPHA)] if msg.Idle in spec.commands else [])
    on.turn(-2.0 * BY_HAND)
    on.step([msg.ClearFault(ALPHA)])
    if not on.until(lambda _: on.mode() is not Mode.FAULT, PATIENCE):
        return on.failure("ClearFault does not clear")
    return _arms_still(on, spec, kind, "after a fault, turned by hand")


def _arms_still(on: Scene, spec: Spec, kind: type[Command], when: str) -> Failure | None:
    """Arm by a command at rest, at the measured place: nothing may move."""
    shaft = on.stage.shafts[ALPHA]
    place = shaft.position
    word = resting(kind, spec, ALPHA, on.measured.get(ALPHA, place))
    room = slack(spec, place)
    wrong: list[tuple[str, StepResult, Sequence[Command | Request]]] = []

    def jumps(said: StepResult) -> bool:
        away = [w for w in named(said.received) if _leads_away(w, place, room)]
        if away:
            wrong.append((f"the device is told {away[0]}", said, away[:1]))
        elif abs(shaft.position - place) > room:
            wrong.append((f"the shaft goes to {shaft.position:.6g} rad", said, ()))
        return bool(wrong)

    armed = on.arm(lambda _: [word], jumps)
    if armed is False:
        return on.failure(f"{kind.__name__} does not arm in {ARMING} ms ({when})")
    if armed and not on.until(jumps, AFTER, [word]):
        return None
    what, said, received = wrong[0]
    text = f"armed by {kind.__name__} at {place:.6g} rad ({when}), and {what}"
    return on.failure(text, said.down, received)


def _leads_away(word: Command | Request, place: float, room: float) -> bool:
    """Whether obeying this would move a shaft that stands at `place` by more than `room`, or rename it."""
    match word:
        case msg.Position():
            return abs(word.position - place) > room or abs(word.velocity) > room or abs(word.torque) > room
        case msg.Impedance():
            # A set-point that nothing pulls to is no set-point.
            pull = abs(word.position - place) if word.stiffness else 0.0
            drag = abs(word.velocity) if word.damping else 0.0
            return pull > room or drag > room or abs(word.torque) > room
        case msg.Velocity():
            return abs(word.velocity) > room or abs(word.torque) > room
        case msg.Torque():
            return abs(word.torque) > room
    return isinstance(word, msg.Home | msg.Zero)


# -- the way out ---------------------------------------------------------------------------------------


def idle_disarms(case: Case) -> Verdict:
    """Idle, and every word of the safe path, disarm from every state in which we armed the device."""
    spec = case.spec
    if msg.Idle not in spec.commands or not kinds_of(spec):
        return Inapplicable("the spec lists no Idle, or nothing that arms")
    for way in (_cut_short, *some(case, [*_while_moving(spec), *_while_lost(spec), _stop_of_another])):
        failure = way(case, spec)
        if failure:
            return failure
    return None


def _cut_short(case: Case, spec: Spec) -> Failure | None:
    """Arming begins with each command, and is cut short after some steps: all on one device, in turn."""
    on, kinds = scene(case), kinds_of(spec)
    if not on.ready():
        return on.failure(f"is not heard to be ready in {ARMING} ms")
    first = case.random().below(2)
    tries = [(cut, kind) for i, cut in enumerate(CUTS) for j, kind in enumerate(kinds) if (i + j + first) % 2]
    for cut, kind in some(case, tries):
        failure = _cut(on, spec, kind, cut)
        if failure:
            fresh = scene(case)
            fresh.ready()
            return _cut(fresh, spec, kind, cut) or failure
    return None


def _cut(on: Scene, spec: Spec, kind: type[Command], steps: int) -> Failure | None:
    start = on.measured.get(ALPHA, 0.0)
    on.wait(steps, [resting(kind, spec, ALPHA, start)])
    failure = _disarms(on, [msg.Idle(ALPHA)])
    return on.failure(f"{steps} steps of {kind.__name__}, then Idle: {failure}") if failure else None


def _paths(spec: Spec) -> list[tuple[str, list[Messages]]]:
    """The words of each way out; the last is said until it works."""
    idle = msg.Idle(ALPHA)
    hold: list[Messages] = [[msg.Hold(ALPHA)]] * 40 if msg.Hold in spec.commands else []
    return [
        ("Idle", [[idle]]),
        ("Hold, then Idle", [*hold, [idle]]),
        ("Stop", [[msg.Stop("a test"), idle], [idle]]),
        ("Leave", [[msg.Leave("a test"), idle], [idle]]),
    ]


def _while_moving(spec: Spec) -> list[Way]:
    return [partial(_out_of_motion, name, words) for name, words in _paths(spec)]


def _out_of_motion(name: str, words: list[Messages], case: Case, spec: Spec) -> Failure | None:
    on = _in_motion(case, spec)
    if isinstance(on, Failure):
        return on
    for said in words[:-1]:
        on.step(said)
    failure = _disarms(on, words[-1])
    return on.failure(f"{name}, while moving: {failure}") if failure else None


def _in_motion(case: Case, spec: Spec) -> Scene | Failure:
    """Alpha, armed by its liveliest command, and turning."""
    on, kind = scene(case), liveliest(spec) or kinds_of(spec)[0]
    if not on.ready():
        return on.failure(f"is not heard to be ready in {ARMING} ms")
    if not on.arm(lambda _: [resting(kind, spec, ALPHA, on.measured.get(ALPHA, 0.0))]):
        return on.failure(f"{kind.__name__} does not arm in {ARMING} ms")
    start = on.stage.shafts[ALPHA].position
    for at in range(AFTER):
        on.step([moving(kind, spec, ALPHA, start, at)])
    return on


def _while_lost(_: Spec) -> list[Way]:
    return [partial(_lossy, up, down) for up, down in ((False, True), (True, False), (False, False))]


def _lossy(up: bool, down: bool, case: Case, spec: Spec) -> Failure | None:
    """What the device says, or the first that it is told, is lost from the moment when Idle is said."""
    on = _in_motion(case, spec)
    if isinstance(on, Failure):
        return on
    cable, span = on.cables[ALPHA], _lost(spec)
    cable.up, cable.down = up, down
    on.wait(span, [msg.Idle(ALPHA)])
    torque = torque_of(on.step([msg.Idle(ALPHA)]))
    if down and abs(torque) > STILL:
        return on.failure(f"Idle while replies are lost: after {span} ms the torque is {torque:.3g} N·m")
    cable.up = cable.down = True
    failure = _disarms(on, [msg.Idle(ALPHA)])
    if not failure:
        return None
    lost = " and ".join(w for w, passes in (("replies", up), ("words", down)) if not passes)
    return on.failure(f"{lost} lost for the first {span} ms of Idle, then none: {failure}")


def _lost(spec: Spec) -> int:
    """Steps of loss that no watchdog minds: it is Idle that must disarm."""
    patience = spec.watchdog.timeout if spec.watchdog.enabled else None
    return LOST if patience is None else min(LOST, patience // (2 * STEP))


def _stop_of_another(case: Case, spec: Spec) -> Failure | None:
    """An operator's Stop reaches a device that another host has armed."""
    before = _in_motion(case, spec)
    if isinstance(before, Failure):
        return before
    on = takeover(case, before)
    kind = liveliest(spec) or kinds_of(spec)[0]
    on.host.other = before.host.driver
    start = before.stage.shafts[ALPHA].position
    for at in range(300):  # the other goes on, so that no watchdog trips
        on.host.others_words = [moving(kind, spec, ALPHA, start, at)]
        on.step()
    on.host.other = None
    on.step([msg.Stop("a test"), msg.Idle(ALPHA)])
    failure = _disarms(on, [msg.Idle(ALPHA)])
    return on.failure(f"Stop, then Idle, to a device that another host armed: {failure}") if failure else None


def _disarms(on: Scene, words: Messages) -> str:
    """What is wrong after saying this for as long as it may take; "" if the device is disarmed."""
    calm = 0
    on.faults.clear()

    def ended(said: StepResult) -> bool:
        nonlocal calm
        calm = calm + 1 if _calm(on, said) else 0
        return calm >= 20

    if not on.until(ended, PATIENCE, words):
        return _fault_info(on)
    if on.until(lambda said: not _calm(on, said), 20):
        return f"a moment later, with nothing said: {_fault_info(on)}"
    return f"it ends in a fault instead: {on.faults[0].name}" if on.faults else ""


def _calm(on: Scene, said: StepResult) -> bool:
    return abs(torque_of(said)) <= STILL and on.mode() is not Mode.ARMED and not _obeying(on)


def _obeying(on: Scene) -> bool:
    """Whether the last command that the device would obey is another than Idle."""
    return not isinstance(on.obeys.get(ALPHA, msg.Idle(ALPHA)), msg.Idle)


def _fault_info(on: Scene) -> str:
    if _obeying(on):
        return f"the device still obeys {on.obeys[ALPHA]} after {PATIENCE} ms"
    if on.mode() is Mode.ARMED:
        return f"the driver still tells {on.mode()} after {PATIENCE} ms"
    return f"the device still gives torque after {PATIENCE} ms"
