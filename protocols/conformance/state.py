"""State: the same inputs give the same outputs, and a copy made between any two calls goes on the same."""

from __future__ import annotations

import copy
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Generic, TypeVar

from protocols.conformance import bench as play
from protocols.conformance.bench import NAMES, Bench
from protocols.conformance.case import Case, Failure, Verdict, difference
from protocols.conformance.random import Random
from protocols.frames import BusState, Frame
from protocols.messages import Command, Event, Nanos, Request, Torque
from protocols.plugin import CommandDecoder, Driver, RxCounters, Twin

OFTEN, SELDOM = 6, 25
"""One call in so many is made on a copy: ..."""
AT_FIRST = 400
"""... of the first calls, and of the later ones."""
T = TypeVar("T")
R = TypeVar("R")


def same_in_same_out(case: Case) -> Verdict:
    """Two drivers, ears and twins fed the same say the same, in the same order."""
    if case.part(2) < 2:
        return None  # With options beside the usual ones `copies` tries the same.
    return _alike(case, case.start(), "the first", "the second")


def copies_go_on(case: Case) -> Verdict:
    """State can be copied and put in place of the original between any two calls."""
    stage, random = case.start(), Random(case.seed)
    stage.driver = _CopiedDriver(stage.driver, random)
    stage.decoder = _CopiedDecoder(stage.decoder, random)
    stage.twins = [_CopiedTwin(twin, random) for twin in stage.twins]
    try:
        return _alike(case, stage, "the original", "the copy")
    except _Uncopied as error:
        return Failure(str(error))


def _alike(case: Case, other: Bench, this: str, that: str) -> Verdict:
    """Play the same day on two stages, with a bus that comes and goes."""
    one = case.start()
    if case.spec.bus == "serial":
        one.tearing, other.tearing = case.random(), case.random()
    states = [BusState.PASSIVE, BusState.UP, BusState.FULL, BusState.UP, BusState.OFF, BusState.BACK]
    for at, words in enumerate(play.script(case.spec, NAMES)):
        if at % 97 == 96:
            for stage in (one, other):
                stage.driver.bus(stage.now, states[at // 97 % len(states)])
        left, right = one.step(words), other.step(words)
        if left != right:
            return difference(left, right, f"from {this}", f"from {that}")
    if one.driver.counters != other.driver.counters:
        return Failure(f"{one.driver.counters} of {this}, {other.driver.counters} of {that}")
    return None


class _Uncopied(Exception):
    """A copy could not be made."""


@dataclass(slots=True)
class _Copied(Generic[T]):
    """Before some calls, puts a copy in place of the original.

    The original is called too, and its answer thrown away: if the two share any state, the copy's
    answer is no longer what it should be."""

    inner: T
    random: Random
    calls: int = 0

    def call(self, method: Callable[[T], R]) -> R:
        self.calls += 1
        if self.random.below(OFTEN if self.calls < AT_FIRST else SELDOM) == 0:
            original = self.inner
            try:
                self.inner = copy.deepcopy(original)
            except Exception as error:
                said = f"{type(error).__name__}: {error}"
                raise _Uncopied(f"{type(original).__name__} cannot be copied: {said}") from error
            method(original)
        return method(self.inner)


class _CopiedDriver(_Copied[Driver]):
    @property
    def counters(self) -> RxCounters:
        return self.inner.counters

    @counters.setter
    def counters(self, counters: RxCounters) -> None:
        self.inner.counters = counters

    def receive(self, t: Nanos, frame: Frame) -> Sequence[Event]:
        return self.call(lambda driver: driver.receive(t, frame))

    def bus(self, t: Nanos, state: BusState) -> None:
        self.call(lambda driver: driver.bus(t, state))

    def send(self, now: Nanos, words: Sequence[Command | Request]) -> tuple[Sequence[Event], Sequence[Frame]]:
        return self.call(lambda driver: driver.send(now, words))

    def due(self) -> Nanos | None:
        return self.inner.due()


class _CopiedDecoder(_Copied[CommandDecoder]):
    def decode(self, t: Nanos, frame: Frame) -> Sequence[Command | Request]:
        return self.call(lambda decoder: decoder.decode(t, frame))


class _CopiedTwin(_Copied[Twin]):
    def receive(self, t: Nanos, frame: Frame) -> None:
        self.call(lambda twin: twin.receive(t, frame))

    def step(self, now: Nanos, truth: Sequence[Event]) -> tuple[Sequence[Torque], Sequence[Frame]]:
        return self.call(lambda twin: twin.step(now, truth))

    def due(self) -> Nanos | None:
        return self.inner.due()

    def provoke(self, code: int) -> None:
        self.inner.provoke(code)
