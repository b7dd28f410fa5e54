"""Faults: a device's fault is reported with its text, latches until an operator clears it, and then is gone.

Rules. Faults are tripped in the twin's firmware, as if it had detected them (`Twin.provoke`). All codes
of the spec are reported from a device at rest, or AT_REST of them by the seed where there are more; IN_MOTION
of them, by the seed, are then followed on a device in motion through all that must not clear them. That
the device itself keeps the fault, not only our driver, is tested with a new driver.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import TypeAlias

from protocols.conformance.bench import ALPHA, ARMING, STEP, Messages, StepResult
from protocols.conformance.case import Case, Inapplicable
from protocols.conformance.fault_injection import (
    STILL,
    Rig,
    liveliest,
    make_rig,
    moving,
    named,
    takeover,
    torque_of,
)
from protocols.frames import BusState
from protocols.messages import ClearFault, Fault, Idle, Mode, Reboot
from protocols.plugin import Spec

Trial: TypeAlias = Callable[[Rig], Iterator[Messages]]
"""Yields the messages of each step, and cuts cables or stops hosts in between."""
AT_REST = 16
"""Codes that are reported from a device at rest."""
IN_MOTION = 2
"""Codes that are followed through everything."""
EACH = 30
"""Steps for which a device in fault gets each type of command."""
REPORTED = 1000
"""Steps within which a fault must be reported."""
CLEARED = 2000
"""Steps within which ClearFault must have worked."""


def faults_latch(case: Case) -> None:
    """Faults are reported with code, name, cause and remedy, latch, and are cleared by ClearFault only."""
    spec, random = case.spec, case.random()
    if not spec.faults:
        raise Inapplicable("the spec lists no faults")
    codes = random.shuffled(sorted(spec.faults))
    _each_is_reported(case, spec, case.sample(codes[:AT_REST]))
    if case.kinds:
        for code in case.sample([code for code in codes if spec.faults[code].latching][:IN_MOTION]):
            _InMotion(case, spec, code).test()


def _each_is_reported(case: Case, spec: Spec, codes: list[int]) -> None:
    """Trip one after the other on a device at rest; each is cleared before the next."""
    rig = None
    for code in codes:
        if rig is None:
            rig = make_rig(case)
            rig.get_ready()
            if rig.only_replies:
                rig.must_arm(rig.prompt)
        rig.faults.clear()
        rig.cables[ALPHA].provoke(code)
        _must_report(rig, spec, code, "at rest, ")
        if ClearFault in spec.requests:
            _must_clear(rig, "at rest, ")
        else:
            rig = None


def _must_report(rig: Rig, spec: Spec, code: int, when: str) -> None:
    """The fault is reported with its text, and State FAULT. Raises Failure."""
    fault = spec.faults[code]

    def reported(_: StepResult) -> bool:
        return rig.mode() is Mode.FAULT and any(event.code == code for event in named(rig.faults))

    if rig.until(reported, REPORTED, rig.prompt):
        event: Fault = next(event for event in named(rig.faults) if event.code == code)
        wrong = ""
        if event.name != fault.name:
            wrong = f"name {event.name!r}, not {fault.name!r} as in the spec"
        elif not fault.cause or fault.cause not in event.cause:  # a driver may add to the cause
            wrong = f"cause {event.cause!r}, without {fault.cause!r} of the spec"
        elif not fault.remedy or event.remedy != fault.remedy:
            wrong = f"remedy {event.remedy!r}, not {fault.remedy!r} as in the spec"
        if not wrong:
            return
        text = f"fault {code} is reported with {wrong}"
    else:
        known = sorted({event.code for event in named(rig.faults)})
        text = f"fault {code} ({fault.name}) is not reported in {REPORTED} ms: {rig.mode()}, {known}"
    raise rig.failure(when + text, rig.replies, named(rig.faults)[-2:])


def _must_clear(rig: Rig, when: str) -> None:
    """An operator clears, once. Raises Failure."""
    rig.step([ClearFault(ALPHA)])
    if not rig.until(lambda _: rig.mode() is not Mode.FAULT, CLEARED, rig.prompt):
        text = f"ClearFault does not clear in {CLEARED} ms"
    elif rig.until(lambda _: rig.mode() is Mode.FAULT, REPORTED // 4, rig.prompt):
        text = "ClearFault clears, and a moment later the device is in fault again"
    else:
        return
    raise rig.failure(when + text, rig.replies, named(rig.faults)[-2:])


@dataclass(slots=True)
class _InMotion:
    """One fault in motion, and all that must not clear it."""

    case: Case
    spec: Spec
    code: int

    def test(self) -> None:
        """Trip it, try everything that must not clear it, and at last a new driver. Raises Failure."""
        rig, kind = make_rig(self.case), liveliest(self.spec)
        rig.get_ready()
        start = rig.place()
        rig.must_arm(rig.at_rest(kind))
        rig.until(lambda _: False, 80, lambda at: [moving(kind, self.spec, ALPHA, start, at)])
        rig.cables[ALPHA].provoke(self.code)
        _must_report(rig, self.spec, self.code, "in motion, ")
        self._outlives(rig, "silence of the host", _without_host)
        self._outlives(rig, "commands of every type", self._commands)
        self._outlives(rig, "Idle", lambda _: iter([[Idle(ALPHA)]] * 60))
        self._outlives(rig, "silence of the device", self._without_device)
        self._outlives(rig, "a bus that was off", _without_bus)
        self._outlives(rig, "commands of every type once more", self._commands)
        self._with_new_driver(rig)

    def _outlives(self, rig: Rig, what: str, trial: Trial) -> None:
        """Run a trial, after which the fault must still stand, and in which it must not be cleared."""
        where = f"fault {self.code}: after {what}"
        for messages in trial(rig):
            step = rig.step(messages)
            clearing = [m for m in named(step.received) if isinstance(m, ClearFault | Reboot)]
            if clearing:
                text = f"fault {self.code}: during {what} the device is sent {clearing[0]} without a request"
                raise rig.failure(text, step.down, clearing[:1])
        rig.until(lambda _: rig.mode() is Mode.FAULT, REPORTED, rig.prompt)
        if rig.mode() is not Mode.FAULT:
            raise rig.failure(f"{where} the driver reports {rig.mode()}")
        if abs(torque_of(rig.step())) > STILL:
            raise rig.failure(f"{where} the device applies torque")

    def _commands(self, rig: Rig) -> Iterator[Messages]:
        """Give each type of command for a while: every change may be a change of the device's mode."""
        start = rig.place()
        for kind in self.case.kinds:
            for at in range(EACH):
                yield [moving(kind, self.spec, ALPHA, start, at)]

    def _without_device(self, rig: Rig) -> Iterator[Messages]:
        """Cut its cable until it is reported offline, and connect it again."""
        cable = rig.cables[ALPHA]
        cable.up = cable.down = False
        for _ in range(REPORTED + self.spec.offline_after // STEP):
            if rig.mode() is not Mode.OFFLINE:
                yield rig.prompt
        cable.up = cable.down = True

    def _with_new_driver(self, rig: Rig) -> None:
        """A new driver finds the fault, reports it, leaves it, and clears it when asked."""
        fresh = takeover(self.case, rig)
        _must_report(fresh, self.spec, self.code, "by a new driver: ")
        self._outlives(fresh, "commands of every type from a new driver", self._commands)
        if ClearFault not in self.spec.requests:
            return
        kind = self.case.kinds[0]
        _must_clear(fresh, f"fault {self.code}: ")
        command = fresh.at_rest(kind)
        if not fresh.arm(lambda _: command):
            text = f"cleared, and then {kind.__name__} does not arm within {ARMING} ms"
            raise fresh.failure(f"fault {self.code}: {text}")


def _without_host(rig: Rig) -> Iterator[Messages]:
    rig.host.alive = False
    yield from [()] * 300
    rig.host.alive = True


def _without_bus(rig: Rig) -> Iterator[Messages]:
    rig.host.bus(rig.now, BusState.OFF)
    yield from [()] * 20
    rig.host.bus(rig.now, BusState.BACK)
    yield from [()] * 20
