"""Numbers that are next to nothing: −0.0 and denormals are said and told as 0.0.

Rules. Normal is what a binary32 can hold with all its bits, whatever the wire has: less than that no device
means anything by. On the way down two drivers are in the same state, and one is told zero where the other is
told nearly zero. On the way up such numbers are patched into real wires, and shown to devices.
"""

from __future__ import annotations

import math
import struct
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field, fields, is_dataclass, replace
from itertools import chain, pairwise
from typing import Any

from protocols.conformance import bench as play
from protocols.conformance import noise
from protocols.conformance.bench import NAMES
from protocols.conformance.case import Case, Failure, Verdict, by_name
from protocols.frames import BusState, CanFrame, Frame
from protocols.messages import Command, Event, Feedback, Idle, Message, Nanos, Request
from protocols.plugin import Driver, RxCounters, Spec

SMALLEST = 2.0**-126
"""The smallest normal binary32."""
NEARLY_ZERO = (-0.0, 1e-40, -1e-40, 5e-324, -5e-324, -1e-310, math.nextafter(SMALLEST, 0.0))
PATCHES = tuple(
    dict.fromkeys(
        struct.pack(order + code, number)
        for code, numbers in (
            ("f", (0.0, -0.0, 1e-45, -1e-39)),
            ("d", (-0.0, 5e-324, -1e-310, 1e-40)),
            ("e", (-0.0, 6e-8)),
        )
        for order in "<>"
        for number in numbers
    )
)
"""Zero, −0.0 and denormals as they stand in binary32, binary64 and binary16."""
TURN = 400
"""Steps in which a device has changed to another kind of command."""


def only_normal_numbers(case: Case) -> Verdict:
    """Nearly zero is said as zero, and told as zero."""
    return next(chain(_down(case), _up(case)), None)


@dataclass(slots=True)
class _Two:
    """Two drivers alike in the place of one; the other is told something else on the way down."""

    driver: Driver
    other: Driver
    changed: Callable[[Command | Request], Command | Request] = lambda word: word
    difference: tuple[Sequence[Frame], Sequence[Frame]] | None = field(default=None)

    @property
    def counters(self) -> RxCounters:
        return self.driver.counters

    @counters.setter
    def counters(self, counters: RxCounters) -> None:
        self.driver.counters = counters

    def receive(self, t: Nanos, frame: Frame) -> Sequence[Event]:
        self.other.receive(t, frame)
        return self.driver.receive(t, frame)

    def bus(self, t: Nanos, state: BusState) -> None:
        self.other.bus(t, state)
        self.driver.bus(t, state)

    def send(self, now: Nanos, words: Sequence[Command | Request]) -> tuple[Sequence[Event], Sequence[Frame]]:
        said = self.driver.send(now, words)
        theirs = self.other.send(now, [self.changed(word) for word in words])[1]
        if list(said[1]) != list(theirs) and self.difference is None:
            self.difference = (said[1], theirs)
        return said

    def due(self) -> Nanos | None:
        return self.driver.due()


def _down(case: Case) -> Iterator[Failure]:
    """Of two drivers alike one is told nearly zero: it must say what the other says."""
    spec = case.spec
    kinds = [kind for kind in by_name(spec.commands - {Idle}) if play.numbers(kind, spec.ranges)]
    stage = case.start()
    both = _Two(stage.driver, case.start().driver)
    stage.driver = both
    if not kinds or not stage.arm(play.gentle(kinds[0], spec.ranges)):
        return
    for kind in kinds:
        calm = [_zeroed(kind, spec, name) for name in NAMES]
        for _ in range(TURN):
            if any(type(word) is kind for word in stage.step(calm).received):
                break
        for name, key in play.numbers(kind, spec.ranges):
            bounds = spec.ranges[key]
            for number in NEARLY_ZERO:
                if not bounds.low <= number <= bounds.high or not bounds.low <= 0.0 <= bounds.high:
                    continue
                both.changed = lambda word, n=name, x=number: _with(word, n, x)  # type: ignore[misc]
                stage.step(calm)
                if both.difference:
                    left, right = both.difference
                    text = f"{name} {number!r} of {kind.__name__} is not said as 0.0"
                    yield Failure(text, (*left[:1], *right[:1]), (calm[0], _with(calm[0], name, number)))
                    return


def _zeroed(kind: type[Command], spec: Spec, motor: str) -> Command:
    return play.build(
        kind,
        motor,
        {name: play.nearest(spec.ranges[key], 0.0) for name, key in play.numbers(kind, spec.ranges)},
    )


def _with(word: Any, name: str, number: float) -> Any:  # noqa: ANN401 -- a command of any kind
    return replace(word, **{name: number}) if hasattr(word, name) else word


def _up(case: Case) -> Iterator[Failure]:
    """What comes up in a day, of real wires with such numbers patched in, and of devices that see such."""
    for before, said in pairwise(case.day):
        yield from _odd(said.events, before.up)
    stage = case.armed() or case.start()
    expected = [w for w in noise.conversation(case) if not isinstance(w, CanFrame) or w.id in case.expects]
    for frame in case.random().shuffled(expected)[: case.part(60)]:
        for patched in _patched(frame):
            yield from _odd(stage.driver.receive(stage.now, patched), (patched,))
    stage = case.start()
    for number in NEARLY_ZERO:
        for name in NAMES:
            shown = [Feedback(name, stage.now, number, number), *_sights(name, stage.now, number)]
            for _ in range(10):
                arriving = stage.on_the_way
                yield from _odd(stage.step(truth=shown).events, arriving)


def _patched(frame: Frame) -> Iterator[Frame]:
    data = play.data_of(frame)
    for number in PATCHES:
        for at in range(min(len(data), 64) - len(number) + 1):
            yield play.with_data(frame, data[:at] + number + data[at + len(number) :])


def _sights(sensor: str, t: Nanos, number: float) -> list[Event]:
    imu, scan, fix = play.sights(sensor, t, 1)
    small = abs(number) if number else number
    return [
        replace(imu, angular_velocity=(0.0, number, number), linear_acceleration=(number, 0.0, 9.81)),
        replace(scan, ranges=(1.0, small, 1.0), angle_min=number),
        replace(fix, longitude=number, altitude=number),
    ]


def _odd(events: Sequence[Event], frames: Sequence[Frame]) -> Iterator[Failure]:
    for event in events:
        if not normal(event):
            yield Failure("−0.0 or a denormal came up", tuple(frames)[:2], (event,))


def normal(word: Message) -> bool:
    """Whether every number in a word is 0.0 or a normal binary32 (or larger)."""
    return all(_normal(getattr(word, f.name)) for f in fields(word))


def _normal(value: object) -> bool:
    if type(value) is float:
        return not -SMALLEST < value < SMALLEST or (value == 0.0 and math.copysign(1.0, value) > 0.0)
    if isinstance(value, tuple):
        return all(map(_normal, value))
    return not is_dataclass(value) or all(_normal(getattr(value, f.name)) for f in fields(value))
