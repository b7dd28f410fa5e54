"""The states in which bytes may meet a plugin: every phase of a driver, its devices' too, requests under way.

Rules. What the driver is given in a state goes on while bytes arrive. A state is used many times, each time
as a copy: what bytes have changed in one does not protect the next.
"""

from __future__ import annotations

import copy
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

from protocols import messages as msg
from protocols.conformance import bench as tools
from protocols.conformance.bench import ALPHA, NAMES, Bench, Messages
from protocols.conformance.case import Case, by_name
from protocols.frames import BusState
from protocols.messages import MILLISECOND

KNOWN = 150
"""Steps after which a driver knows its devices."""
ALONE = 20
"""Steps of a driver whose frames nothing answers any more."""
LONG = 250 * MILLISECOND
"""A step of a driver that receives nothing: in `ALONE` of them devices are offline, and requests ended."""
FAULTY = 50
"""Steps after which a fault of the device is reported."""
READ = 4
"""Parameters that are read at once."""


@dataclass(frozen=True, slots=True)
class Situation:
    """A driver, a decoder and twins in one state."""

    name: str
    bench: Bench
    given: Messages = ()
    """What the driver is given in each step."""

    def again(self) -> Bench:
        """Return a copy: whoever gets it may change it. (What cannot be copied, another clause finds.)"""
        try:
            return copy.deepcopy(self.bench)
        except Exception:  # noqa: BLE001 -- a plugin may hold anything
            return self.bench


def situations(case: Case) -> Iterator[Situation]:
    """Yield each state that the device can be brought to."""
    yield Situation("fresh", case.start())
    free = case.start()
    free.steps(KNOWN)
    yield Situation("free", free)
    yield Situation("offline", _alone(free, (), LONG))
    asked = _requests(case)
    if asked:
        yield Situation("with requests under way", _alone(free, asked))
    gone = _copied(free)
    for state in (BusState.OFF, BusState.BACK):
        gone.driver.bus(gone.now, state)
    yield Situation("back on its bus", gone)
    if case.kinds:
        yield from _commanded(case, free)


def _commanded(case: Case, free: Bench) -> Iterator[Situation]:
    kind = case.kinds[case.seed % len(case.kinds)]
    commands = [tools.gentle(kind, case.spec.ranges)(name) for name in NAMES]
    idle = [msg.Idle(name) for name in NAMES]
    yield Situation("arming", _alone(free, commands), commands)
    armed = case.armed()
    if armed is None:
        return
    yield Situation("armed", armed, commands)
    yield Situation("releasing", _alone(armed, idle), idle)
    yield Situation("fallen silent while armed", _alone(armed, commands, LONG), commands)
    if case.spec.faults:
        faulty = _copied(armed)
        codes = sorted(case.spec.faults)
        faulty.twins[0].provoke(codes[case.seed % len(codes)])
        faulty.steps(FAULTY, commands)
        yield Situation("in fault", faulty, commands)


def _requests(case: Case) -> Sequence[msg.Request]:
    """Return one request of each kind, and reads of what there is to be read."""
    kinds = by_name(case.spec.requests)
    made = [request for kind in kinds if (request := tools.request(kind, ALPHA)) is not None]
    reads = [msg.ReadParameter(ALPHA, name) for name in case.spec.parameters[:READ]]
    return [*made, *reads] if msg.ReadParameter in kinds else made


def _alone(bench: Bench, given: Messages, step: int = tools.STEP) -> Bench:
    """Return a copy whose driver goes on alone: requests are given once, commands in each step."""
    bench = _copied(bench)
    bench.in_flight = ()
    for _ in range(ALONE):
        bench.now += step
        bench.driver.send(bench.now, given)
        given = [each for each in given if isinstance(each, msg.Command)]
    return bench


def _copied(bench: Bench) -> Bench:
    return Situation("", bench).again()
