"""Safety at both ends of a motion: it begins where the shaft is, and Idle ends it in every state.

Rules. Both the decoded commands and the twin's torque are checked: a set-point that would jump counts even if
the shaft has not moved yet. Each command is tried from odd positions of the shaft, and arming is interrupted
after growing numbers of steps, so that the first that fails is the shortest.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from functools import partial
from typing import TypeAlias

from protocols import messages as msg
from protocols.conformance.bench import ALPHA, ARMING, STEP, Messages, Shaft, StepResult, numbers
from protocols.conformance.case import Case, Failure, Inapplicable
from protocols.conformance.fault_injection import (
    STILL,
    Rig,
    liveliest,
    make_rig,
    moving,
    named,
    resting,
    slack,
    takeover,
    torque_of,
)
from protocols.frames import Frame
from protocols.messages import Command, Mode, Obeyed, seconds
from protocols.plugin import Spec

Trial: TypeAlias = Callable[[Case], None]
"""Disarms in some state. Raises Failure."""
PLACES = (0.7, -2.9, 61.3, -417.0)
"""rad where shafts stand: none is zero, nor a whole turn."""
BY_HAND = 1.9
"""rad by which a disarmed shaft is turned."""
CLEARED = "after a fault, turned by hand"
AFTER = 60
"""Steps for which a shaft is watched after arming."""
CUTS = (0, 1, 2, 3, 4, 5, 6, 8, 11, 15, 20, 28, 40, 55, 75, 100, 140, 200)
"""Steps of arming after which Idle is given: every second of them with each command, by the seed."""
DISARMED = 1500
"""Steps within which Idle must have disarmed."""
GAINS = {"position": "stiffness", "velocity": "damping"}
"""What makes a set-point of a number of Impedance."""
_UNCLEARED = (Mode.FAULT, Mode.OFFLINE)
"""It restarts to be cleared: it is not back yet."""
LOST = 60
"""Steps for which replies, or the first frames of Idle, are lost."""
LATE = 2000
"""Steps after which a copy of a frame is delivered once more."""
PULL = 0.01
"""N·m on a shaft that nothing should hold."""


# -- no jump -------------------------------------------------------------------------------------------


def arming_does_not_jump(case: Case) -> None:
    """The first command after arming equals the measured position, wherever the shaft stands."""
    spec, random = case.spec, case.random()
    if not case.kinds:
        raise Inapplicable("the spec lists no commands that arm")
    if "Feedback.position" not in spec.ranges:
        raise Inapplicable("the spec has no range for Feedback.position: the device measures none")
    places = [_within(spec, place) for place in PLACES]
    first = random.below(len(places))
    for at, kind in case.sample(list(enumerate(case.kinds, first))):
        _arms_from(case, spec, kind, places[at % len(places)])


def _within(spec: Spec, place: float) -> float:
    """Return the place, or one that this device can measure and be sent to."""
    bounds = [spec.ranges[key] for key in ("Feedback.position", "Position.position") if key in spec.ranges]
    low, high = max(b.low for b in bounds), min(b.high for b in bounds)
    return place if 0.9 * low <= place <= 0.9 * high else place / 417.0 * 0.7 * min(-low, high)


def _arms_from(case: Case, spec: Spec, kind: type[Command], place: float) -> None:
    """Arm by one command a shaft at `place`: at first, after a disarm, and after a fault."""
    rig = make_rig(case, position=place)
    rig.get_ready()
    _arms_still(rig, spec, kind, "at first")
    if not rig.disarm():
        raise rig.failure("Idle does not disarm")
    rig.turn(BY_HAND)
    _arms_still(rig, spec, kind, "after a disarm, turned by hand")
    codes = sorted(code for code, fault in spec.faults.items() if fault.latching)
    if not codes or msg.ClearFault not in spec.requests:
        return
    rig.cables[ALPHA].provoke(case.random().choice(codes))
    if not rig.until(lambda _: rig.mode() is Mode.FAULT, DISARMED, rig.prompt):
        raise rig.failure("a fault of the device is not reported by State FAULT")
    rig.wait(AFTER, [msg.Idle(ALPHA)] if msg.Idle in spec.commands else [])
    rig.turn(-0.5 * BY_HAND)  # a servo may have one turn only
    rig.step([msg.ClearFault(ALPHA)])
    if not rig.only_replies and not rig.until(lambda _: rig.mode() not in _UNCLEARED, DISARMED):
        raise rig.failure("ClearFault does not clear")
    _arms_still(rig, spec, kind, CLEARED)


def _arms_still(rig: Rig, spec: Spec, kind: type[Command], when: str) -> None:
    """Arm by a command at rest, at the measured position: nothing may move."""
    shaft = rig.bench.shafts[ALPHA]
    place = shaft.position
    command = resting(kind, spec, ALPHA, rig.place())
    # A device that restarts to be cleared counts whole turns anew: it has reported where it is.
    anew = round((rig.place() - place) / math.tau) * math.tau if when == CLEARED else 0.0
    jump: list[tuple[str, StepResult, Messages]] = []
    pushed = 0

    def jumps(result: StepResult) -> bool:
        nonlocal pushed
        pushed += torque_of(result) != 0.0
        away = [m for m in named(result.received) if leads_away(m, spec, place + anew)]
        if away:
            jump.append((f"the device is sent {away[0]}", result, away[:1]))
        elif abs(shaft.position - place) > slack(spec, place) + _drift(spec, kind, shaft, pushed):
            jump.append((f"the shaft moves to {shaft.position:.6g} rad", result, ()))
        return bool(jump)

    armed = rig.arm(lambda _: [command], jumps)
    if armed is False:
        raise rig.failure(f"{kind.__name__} does not arm within {ARMING} ms ({when})")
    if armed and not rig.until(jumps, AFTER, [command]):
        return
    what, result, received = jump[0]
    text = f"armed by {kind.__name__} at {place:.6g} rad ({when}), and {what}"
    raise rig.failure(text, result.down, received)


def _drift(spec: Spec, kind: type[Command], shaft: Shaft, steps: int) -> float:
    """Return how far [rad] a shaft may be pushed by a velocity and a torque that are zero but for their
    resolutions: in 12 bits there is no zero."""
    span = seconds(steps * STEP)
    fine = {name: spec.ranges[key].resolution for name, key in numbers(kind, spec.ranges)}
    return fine.get("velocity", 0.0) * span + fine.get("torque", 0.0) / shaft.inertia * span**2 / 2.0


def leads_away(message: Obeyed, spec: Spec, place: float) -> bool:
    """True if obeying this moves a shaft that stands at `place`, or redefines zero.

    Each number may miss by its own resolution; a position also by that with which it was measured."""
    if not isinstance(message, Command):
        return isinstance(message, msg.Home | msg.Zero)
    # Without stiffness the position is no set-point, nor is the velocity without damping.
    loose = isinstance(message, msg.Impedance)
    unused = {name for name, gain in GAINS.items() if loose and _is_zero(message, gain, spec)}
    position: float = getattr(message, "position", place)
    far = abs(position - place) > slack(spec, place, type(message))
    return (far and "position" not in unused) or not all(
        name in unused or _is_zero(message, name, spec) for name in ("velocity", "torque")
    )


def _is_zero(message: Command, name: str, spec: Spec) -> bool:
    """True if a message has no such number, or it is zero but for its resolution."""
    bounds = spec.ranges.get(f"{type(message).__name__}.{name}")
    number: float = getattr(message, name, 0.0)
    return abs(number) <= (bounds.resolution if bounds else 0.0)


# -- disarming -------------------------------------------------------------------------------------------


def idle_disarms(case: Case) -> None:
    """Idle, alone or after Hold, Stop or Leave, disarms from every state in which we armed the device."""
    if msg.Idle not in case.spec.commands or not case.kinds:
        raise Inapplicable("the spec lists no Idle, or nothing that arms")
    others = [*_while_moving(case.spec), *_WHILE_LOSSY, _stop_of_another, _late_copy]
    for trial in (_while_arming, *case.sample(others)):
        trial(case)


def _while_arming(case: Case) -> None:
    """Interrupt arming by each command after some steps: all on one device, in turn."""
    rig, kinds = make_rig(case), case.kinds
    rig.get_ready()
    first = case.random().below(2)
    trials = [
        (cut, kind) for i, cut in enumerate(CUTS) for j, kind in enumerate(kinds) if (i + j + first) % 2
    ]
    for cut, kind in case.sample(trials):
        try:
            _interrupted(rig, kind, cut)
        except Failure:
            fresh = make_rig(case)
            fresh.get_ready()
            _interrupted(fresh, kind, cut)
            raise


def _interrupted(rig: Rig, kind: type[Command], steps: int) -> None:
    rig.wait(steps, rig.at_rest(kind))
    _must_disarm(rig, [msg.Idle(ALPHA)], f"{steps} steps of {kind.__name__}, then Idle")


def _while_moving(spec: Spec) -> list[Trial]:
    """Return the ways to disarm a moving device; the last messages are repeated until it is disarmed."""
    idle = msg.Idle(ALPHA)
    hold: list[Messages] = [[msg.Hold(ALPHA)]] * 40 if msg.Hold in spec.commands else []
    ways: list[tuple[str, list[Messages]]] = [
        ("Idle", [[idle]]),
        ("Hold, then Idle", [*hold, [idle]]),
        ("Stop", [[msg.Stop("a test"), idle], [idle]]),
        ("Leave", [[msg.Leave("a test"), idle], [idle]]),
    ]
    return [partial(_out_of_motion, name, messages) for name, messages in ways]


def _out_of_motion(name: str, messages: list[Messages], case: Case) -> None:
    rig = _in_motion(case)
    for given in messages[:-1]:
        rig.step(given)
    _must_disarm(rig, messages[-1], f"{name}, while moving")


def _in_motion(case: Case) -> Rig:
    """Return a rig with alpha armed by its liveliest command, and turning."""
    rig, kind = make_rig(case), liveliest(case.spec)
    rig.get_ready()
    if not rig.arm(lambda _: rig.at_rest(kind)):
        raise rig.failure(f"{kind.__name__} does not arm within {ARMING} ms")
    start = rig.bench.shafts[ALPHA].position
    for at in range(AFTER):
        rig.step([moving(kind, case.spec, ALPHA, start, at)])
    return rig


def _lossy(up: bool, down: bool, case: Case) -> None:
    """Lose the replies, or the first frames sent, from the moment when Idle is given."""
    rig = _in_motion(case)
    cable, span = rig.cables[ALPHA], _loss(case.spec)
    cable.up, cable.down = up, down
    rig.wait(span, [msg.Idle(ALPHA)])
    torque = torque_of(rig.step([msg.Idle(ALPHA)]))
    if down and abs(torque) > STILL:
        raise rig.failure(f"Idle while replies are lost: after {span} ms the torque is {torque:.3g} N·m")
    cable.up = cable.down = True
    lost = " and ".join(w for w, passes in (("replies", up), ("commands", down)) if not passes)
    _must_disarm(rig, [msg.Idle(ALPHA)], f"{lost} lost for the first {span} ms of Idle, then none")


_WHILE_LOSSY: list[Trial] = [
    partial(_lossy, up, down) for up, down in ((False, True), (True, False), (False, False))
]


def _loss(spec: Spec) -> int:
    """Return steps of loss that trip no watchdog: it is Idle that must disarm."""
    timeout = spec.watchdog.timeout if spec.watchdog.enabled else None
    return LOST if timeout is None else min(LOST, timeout // (2 * STEP))


def _stop_of_another(case: Case) -> None:
    """An operator's Stop reaches a device that another host has armed."""
    before = _in_motion(case)
    rig, kind = takeover(case, before), liveliest(case.spec)
    rig.host.other = before.host.driver
    start = before.bench.shafts[ALPHA].position
    for at in range(300):  # the other host goes on, so that no watchdog trips
        rig.host.others_messages = [moving(kind, case.spec, ALPHA, start, at)]
        rig.step()
    rig.host.other = None
    rig.step([msg.Stop("a test"), msg.Idle(ALPHA)])
    _must_disarm(rig, [msg.Idle(ALPHA)], "Stop, then Idle, to a device that another host armed")


def _late_copy(case: Case) -> None:
    """A queueing adapter delivers the frame that armed the device once more, when Idle is long confirmed."""
    rig, idle, copy = make_rig(case), [msg.Idle(ALPHA)], list[Frame]()
    rig.get_ready()

    def arms(result: StepResult) -> bool:
        if any(isinstance(message, msg.Arm) for message in named(result.received)):
            copy[:] = result.down
        return False

    if not rig.arm(lambda _: rig.at_rest(liveliest(case.spec)), arms) or not rig.disarm():
        raise rig.failure(f"does not arm, or not disarm, within {ARMING} ms")
    rig.wait(LATE, idle)
    rig.faults.clear()
    rig.bench.shafts[ALPHA].load = PULL
    rig.bench.step(idle, extra_down=copy)
    rig.wait(DISARMED, idle)
    if rig.faults or not _disarmed(rig, rig.step(idle)):
        text = f"a fault: {rig.faults[0].name}" if rig.faults else _still_armed(rig)
        raise rig.failure(f"Idle, and {LATE} ms later a copy of the frame that armed it: {text}", copy)


def _must_disarm(rig: Rig, messages: Messages, what: str) -> None:
    """Give these messages until the device is disarmed, and for a while. Raises Failure."""
    disarmed = 0
    rig.faults.clear()

    def done(result: StepResult) -> bool:
        nonlocal disarmed
        if arming := [m for m in named(result.received) if isinstance(m, msg.Arm)]:
            raise rig.failure(f"{what}: the device is armed once more", result.down, arming)
        disarmed = disarmed + 1 if _disarmed(rig, result) else 0
        return disarmed >= 20

    if not rig.until(done, DISARMED, messages):
        raise rig.failure(f"{what}: {_still_armed(rig)}")
    if rig.until(lambda result: not _disarmed(rig, result), 20):
        raise rig.failure(f"{what}: a moment later, without a command: {_still_armed(rig)}")
    if rig.faults:
        raise rig.failure(f"{what}: it ends in a fault instead: {rig.faults[0].name}")


def _disarmed(rig: Rig, result: StepResult) -> bool:
    return abs(torque_of(result)) <= STILL and rig.mode() is not Mode.ARMED and not _obeying(rig)


def _obeying(rig: Rig) -> bool:
    """True if the last command that the device would obey is another than Idle."""
    return not isinstance(rig.obeys.get(ALPHA, msg.Idle(ALPHA)), msg.Idle)


def _still_armed(rig: Rig) -> str:
    if _obeying(rig):
        return f"the device still obeys {rig.obeys[ALPHA]} after {DISARMED} ms"
    if rig.mode() is Mode.ARMED:
        return f"the driver still reports {rig.mode()} after {DISARMED} ms"
    return f"the device still applies torque after {DISARMED} ms"
