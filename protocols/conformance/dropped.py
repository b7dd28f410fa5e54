"""A bus that drops what was sent: the driver is told (`BusState.FULL`), and says again what matters.

Rules. Whatever a driver says in the first steps of arming, of a change from one kind of command to another,
and of Idle is dropped on our side of the bus. Afterwards the device must obey what is said, and nothing else.
"""

from __future__ import annotations

from protocols.conformance.bench import ARMING, NAMES, StepResult
from protocols.conformance.case import Case, Failure, Inapplicable, Verdict
from protocols.conformance.fault_injection import Scene, kinds_of, resting, scene, some
from protocols.conformance.roundtrip import obeyed
from protocols.frames import BusState
from protocols.messages import Command, Idle

ALPHA = NAMES[0]
DROPPED = (1, 2, 5, 12)
"""Steps of which nothing goes out."""
OBEYED = 300
"""Steps in which a device must then obey."""


def dropped_commands_are_repeated(case: Case) -> Verdict:
    """What the bus dropped when its transmit queue was full does not stay unsaid."""
    kinds = kinds_of(case.spec)
    if not kinds:
        return Inapplicable("the spec lists no commands that arm")
    first = case.random().below(len(DROPPED))
    pairs = list(zip(kinds, [*kinds[1:], kinds[0]], strict=True))
    for at, (kind, then) in some(case, list(enumerate(pairs, first))):
        failure = _dropped(case, DROPPED[at % len(DROPPED)], kind, then)
        if failure:
            return failure
    return None


def _dropped(case: Case, steps: int, kind: type[Command], then: type[Command]) -> Failure | None:
    """Arm by one kind of command, change to another, and disarm: the first steps of each are dropped."""
    on = scene(case)
    if not on.ready():
        return on.failure(f"is not heard to be ready in {ARMING} ms")
    word = resting(kind, case.spec, ALPHA, on.measured.get(ALPHA, 0.0))
    _drop(on, steps, word)
    if not on.arm(lambda _: [word]):
        return on.failure(
            f"the first {steps} ms of {kind.__name__} are dropped: it does not arm in {ARMING} ms"
        )
    change = resting(then, case.spec, ALPHA, on.measured.get(ALPHA, 0.0))
    wrong = _misheard(on, word)
    if not wrong:
        _drop(on, steps, change)
        wrong = _misheard(on, change)
    if not wrong and Idle in case.spec.commands:
        _drop(on, steps, Idle(ALPHA))
        wrong = _misheard(on, Idle(ALPHA))
    return on.failure(f"the first {steps} ms of a command are dropped: {wrong}") if wrong else None


def _drop(on: Scene, steps: int, word: Command) -> None:
    """So many steps of a word find no room, of which the driver is told."""
    on.host.dropping = True
    on.wait(steps, [word])
    on.host.dropping = False
    on.host.bus(on.now, BusState.FULL)
    on.step([word])
    on.host.bus(on.now, BusState.UP)


def _misheard(on: Scene, word: Command) -> str:
    """What the device obeys instead; "" if it does what is said."""

    def received(_: StepResult) -> bool:
        return ALPHA in on.obeys and obeyed(on.stage, on.spec, word, on.obeys[ALPHA])

    if on.until(received, OBEYED, [word]):
        return ""
    return f"said {word}, the device obeys {on.obeys.get(ALPHA, 'nothing')}"
