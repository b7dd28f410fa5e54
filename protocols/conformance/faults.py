"""Complaints: a device's fault is told with its text, stays until an operator clears it, and then is gone.

Rules. Faults are tripped in the twin's firmware, as if it had found them by itself (`Twin.provoke`). All
codes of the spec are told from a device at rest, or SAMPLE of them by the seed where there are more; LONG
of them, by the seed, are then followed on a device in motion through all that must not clear them. That
the fault is still the device's, and not only remembered by our driver, a fresh driver must tell.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import TypeAlias

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
    some,
    takeover,
    torque_of,
)
from protocols.frames import BusState
from protocols.messages import ClearFault, Fault, Idle, Mode, Reboot
from protocols.plugin import FaultInfo, Spec

Trial: TypeAlias = Callable[[Scene], Iterator[Messages]]
"""What is said step by step, with what happens to cables and hosts in between."""
ALPHA = NAMES[0]
SAMPLE = 16
"""Codes that are told from a device at rest."""
LONG = 2
"""Codes that are followed through everything."""
KIND = 30
"""Steps for which a device in fault is told each kind of command."""
REPORTED = 1000
"""Steps in which a fault must be told."""
CLEARED = 2000
"""Steps in which ClearFault must have worked."""


def faults_latch(case: Case) -> Verdict:
    """Every fault is told with code, name, cause and cure, latches, and goes by ClearFault alone."""
    spec, random = case.spec, case.random()
    if not spec.faults:
        return Inapplicable("the spec lists no faults")
    codes = random.shuffled(sorted(spec.faults))
    failure = _each_is_told(case, spec, some(case, codes[:SAMPLE]))
    if failure or not kinds_of(spec):
        return failure
    for code in some(case, [code for code in codes if spec.faults[code].latching][:LONG]):
        failure = _Story(case, spec, code).report()
        if failure:
            return failure
    return None


def _each_is_told(case: Case, spec: Spec, codes: list[int]) -> Failure | None:
    """One after the other on a device at rest, each cleared before the next."""
    on = None
    for code in codes:
        if on is None:
            on = scene(case)
            if not on.ready():
                return on.failure(f"is not heard to be ready in {ARMING} ms")
        on.faults.clear()
        on.cables[ALPHA].provoke(code)
        wrong = told_wrongly(on, spec, code) or (_cleared(on) if ClearFault in spec.requests else "")
        if wrong:
            return on.failure(f"at rest, {wrong}", on.passed, _complaints(on))
        if ClearFault not in spec.requests:
            on = None
    return None


def told_wrongly(on: Scene, spec: Spec, code: int, motor: str = ALPHA) -> str:
    """What is wrong with how a fault that stands is told; "" if it comes with its text, and State FAULT."""
    complaint = spec.faults[code]

    def reported(_: StepResult) -> bool:
        return on.mode(motor) is Mode.FAULT and any(fault.code == code for fault in named(on.faults, motor))

    if not on.until(reported, REPORTED):
        known = sorted({fault.code for fault in named(on.faults, motor)})
        return f"fault {code} ({complaint.name}) is not told in {REPORTED} ms: State {on.mode(motor)}, Fault {known}"
    said = next(fault for fault in named(on.faults, motor) if fault.code == code)
    return _text_wrong(said, complaint)


def _text_wrong(said: Fault, complaint: FaultInfo) -> str:
    """A driver may add to the cause; name and cure are as the spec has them."""
    if said.name != complaint.name:
        return f"fault {said.code} is told as {said.name!r}, the spec says {complaint.name!r}"
    if not complaint.cause or complaint.cause not in said.cause:
        return f"fault {said.code} is told with cause {said.cause!r}, the spec says {complaint.cause!r}"
    if not complaint.remedy or said.remedy != complaint.remedy:
        return f"fault {said.code} is told with cure {said.remedy!r}, the spec says {complaint.remedy!r}"
    return ""


def _cleared(on: Scene) -> str:
    """An operator clears, once."""
    on.step([ClearFault(ALPHA)])
    if not on.until(lambda _: on.mode() is not Mode.FAULT, CLEARED):
        return f"ClearFault does not clear in {CLEARED} ms"
    for _ in range(REPORTED // 4):  # nor does the fault come back by itself
        on.step()
        if on.mode() is Mode.FAULT:
            return "ClearFault clears, and a moment later the device is in fault again"
    return ""


def _complaints(on: Scene) -> list[Fault]:
    return named(on.faults)[-2:]


@dataclass(slots=True)
class _Story:
    """One fault in motion, and all that must not clear it."""

    case: Case
    spec: Spec
    code: int

    def report(self) -> Failure | None:
        """The whole of it; the first thing that is wrong."""
        on = scene(self.case)
        kind = liveliest(self.spec) or kinds_of(self.spec)[0]
        if not on.ready():
            return on.failure(f"is not heard to be ready in {ARMING} ms")
        start = on.measured.get(ALPHA, 0.0)
        if not on.arm(lambda _: [resting(kind, self.spec, ALPHA, start)]):
            return on.failure(f"{kind.__name__} does not arm in {ARMING} ms")
        on.until(lambda _: False, 80, lambda at: [moving(kind, self.spec, ALPHA, start, at)])
        on.cables[ALPHA].provoke(self.code)
        wrong = told_wrongly(on, self.spec, self.code)
        if wrong:
            return on.failure(f"in motion, {wrong}", on.passed, _complaints(on))
        for what, trial in self._trials():
            failure = self._outlives(on, what, trial)
            if failure:
                return failure
        return self._afresh(on)

    def _trials(self) -> list[tuple[str, Trial]]:
        """What a fault must outlive."""
        return [
            ("silence of the host", _no_host),
            ("commands of every kind", self._commands),
            ("Idle", lambda _: iter([[Idle(ALPHA)]] * 60)),
            ("silence of the device", self._no_device),
            ("a bus that was off", _no_bus),
            ("commands of every kind once more", self._commands),
        ]

    def _outlives(self, on: Scene, what: str, trial: Trial) -> Failure | None:
        """A trial, after which the fault must still stand, and in which nobody may try to clear it."""
        for words in trial(on):
            said = on.step(words)
            clearing = [word for word in named(said.received) if isinstance(word, ClearFault | Reboot)]
            if clearing:
                text = f"fault {self.code}: at {what} the device is told {clearing[0]}, unasked"
                return on.failure(text, said.down, clearing[:1])
        on.until(lambda _: on.mode() is Mode.FAULT, REPORTED)
        if on.mode() is not Mode.FAULT:
            return on.failure(f"fault {self.code}: after {what} the driver tells {on.mode()}")
        if abs(torque_of(on.step())) > STILL:
            return on.failure(f"fault {self.code}: after {what} the device gives torque")
        return None

    def _commands(self, on: Scene) -> Iterator[Messages]:
        """Each kind for a while: every change of kind may be a change of the device's mode."""
        start = on.measured.get(ALPHA, 0.0)
        for kind in kinds_of(self.spec):
            for at in range(KIND):
                yield [moving(kind, self.spec, ALPHA, start, at)]

    def _no_device(self, on: Scene) -> Iterator[Messages]:
        """Its cable is pulled until it is told to be offline, and put back."""
        cable = on.cables[ALPHA]
        cable.up = cable.down = False
        for _ in range(REPORTED + self.spec.offline_after // STEP):
            if on.mode() is not Mode.OFFLINE:
                yield ()
        cable.up = cable.down = True

    def _afresh(self, on: Scene) -> Failure | None:
        """A fresh driver finds the fault, tells it, leaves it, and clears it when asked."""
        fresh = takeover(self.case, on)
        wrong = told_wrongly(fresh, self.spec, self.code)
        if wrong:
            return fresh.failure(f"to a fresh driver: {wrong}", fresh.passed, _complaints(fresh))
        failure = self._outlives(fresh, "commands of every kind from a fresh driver", self._commands)
        if failure or ClearFault not in self.spec.requests:
            return failure
        kind = kinds_of(self.spec)[0]
        wrong = _cleared(fresh)
        word = resting(kind, self.spec, ALPHA, fresh.measured.get(ALPHA, 0.0))
        if not wrong and not fresh.arm(lambda _: [word]):
            wrong = f"cleared, and then {kind.__name__} does not arm in {ARMING} ms"
        return fresh.failure(f"fault {self.code}: {wrong}") if wrong else None


def _no_host(on: Scene) -> Iterator[Messages]:
    on.host.alive = False
    yield from [()] * 300
    on.host.alive = True


def _no_bus(on: Scene) -> Iterator[Messages]:
    on.host.bus(on.now, BusState.OFF)
    yield from [()] * 20
    on.host.bus(on.now, BusState.BACK)
    yield from [()] * 20
