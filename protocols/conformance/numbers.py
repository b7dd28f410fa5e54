"""Numbers that must not pass: NaN, infinities, values out of range, −0.0 and denormals.

Rules. On the way down two drivers are in the same state, and one of them gets a bad number where the other
gets none, or zero. On the way up such numbers are patched into valid frames, and observed by devices. A
number is normal if a float32 can hold it with all its bits, whatever the protocol uses: no device means
anything by less.
"""

from __future__ import annotations

import math
import struct
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import Any

from protocols import sensors
from protocols.conformance import bench as tools
from protocols.conformance import noise
from protocols.conformance.bench import NAMES, DriverWrapper, Messages
from protocols.conformance.case import Case, Failure, among, by_name
from protocols.frames import BusState, Frame
from protocols.messages import Command, Event, Feedback, Message, Nanos, Request
from protocols.plugin import Driver, Spec

SMALLEST = 2.0**-126
"""The smallest normal float32."""
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
"""Zero, −0.0 and denormals as float32, float64 and float16."""
CHANGED = 400
"""Steps within which a device has changed to another type of command."""


# -- not finite, or out of range -------------------------------------------------------------------------


def only_finite_numbers(case: Case) -> None:
    """NaN, infinities and values out of range send no frame, and none of them is reported."""
    _bad_commands_are_refused(case)
    bench = case.armed() or case.start()
    for frame in case.random().shuffled(noise.valid_frames(case))[: case.share(120)]:
        for patched in noise.patched(frame, noise.STRANGE):
            _check_finite(bench.driver.receive(bench.now, patched), (patched,))
    bench = case.start()
    for value in (math.nan, math.inf, -math.inf):
        truth: list[Event] = [Feedback(name, bench.now, value, value) for name in NAMES]
        truth += [event for name in NAMES for event in _mad_sensors(name, bench.now, value)]
        for step in [bench.step(truth=truth) for _ in range(30)]:
            _check_finite(step.events, step.up[:2])


def _bad_commands_are_refused(case: Case) -> None:
    """Give one of two equal drivers a bad command: it must send what the other sends without it.

    First before anything is commanded, then armed and running."""
    spec = case.spec
    for make in (case.start, case.armed):
        for kind in by_name(spec.commands):
            bad = list(_bad_commands(kind, spec))
            one, other = make(), make()
            if not bad or one is None or other is None:
                continue
            good = [tools.build(kind, name, spec.ranges) for name in NAMES] if make == case.armed else []
            for command in bad:
                without, given = one.step(good[1:]), other.step([command, *good[1:]])
                if without.down != given.down:
                    new = [frame for frame in given.down if frame not in without.down]
                    raise Failure("a number that must not pass sent a frame", new, (command,))
                if one.step(good).down != other.step(good).down:
                    raise Failure("a number that must not pass changed what was sent next", (), (command,))


def _bad_commands(kind: type[Command], spec: Spec) -> Iterator[Command]:
    """Yield commands of this kind with one number that must not pass."""
    gentle: Any = tools.build(kind, NAMES[0], spec.ranges)
    for name, key in tools.numbers(kind, spec.ranges):
        bounds = spec.ranges[key]
        beyond = 1.0 + 0.01 * max(abs(bounds.low), abs(bounds.high))
        values = [math.nan, math.inf, -math.inf, bounds.high + beyond, bounds.low - beyond, 1e300, -1e300]
        for value in values:
            if not bounds.low <= value <= bounds.high:
                yield replace(gentle, **{name: value})


def _check_finite(events: Sequence[Event], frames: Sequence[Frame]) -> None:
    for event in events:
        if not tools.finite(event):
            raise Failure("a number that is not finite is reported", frames, (event,))


def _mad_sensors(sensor: str, t: Nanos, value: float) -> list[Event]:
    """Return a reading of each kind for each of its numbers, which is this one."""
    return _readings(sensor, t, lambda _: value, 1)


def _readings(sensor: str, t: Nanos, number: Callable[[sensors.Quantity], float], items: int) -> list[Event]:
    """Return a reading of each kind for each of its floats: this number, or of a tuple its first items."""
    found: list[Event] = []
    for kind in sensors.kinds().by_type.values():
        sample: Any = kind.sample(sensor, t, 1)
        for name, quantity in kind.quantities.items():
            old, new = getattr(sample, name), number(quantity)
            if isinstance(old, tuple):
                found.append(replace(sample, **{name: (*[new] * items, *old[items:])}))
            elif isinstance(old, float):
                found.append(replace(sample, **{name: new}))
    return found


# -- −0.0 and denormals ----------------------------------------------------------------------------------


def only_normal_numbers(case: Case) -> None:
    """−0.0 and denormals are sent as 0.0, and reported as 0.0."""
    _denormal_commands_send_zero(case)
    for before, step in pairwise(case.baseline):
        _check_normal(step.events, before.up)
    bench = case.armed() or case.start()
    expected = [frame for frame in noise.valid_frames(case) if among(case.expects, frame)]
    for frame in case.random().shuffled(expected)[: case.share(60)]:
        for patched in noise.patched(frame, PATCHES):
            _check_normal(bench.driver.receive(bench.now, patched), (patched,))
    bench = case.start()
    for number in NEARLY_ZERO:
        for name in NAMES:
            truth = [Feedback(name, bench.now, number, number), *_tiny_sensors(name, bench.now, number)]
            for _ in range(10):
                arriving = bench.in_flight
                _check_normal(bench.step(truth=truth).events, arriving)


@dataclass(slots=True)
class _Two(DriverWrapper):
    """Two equal drivers in the place of one; the other gets changed messages."""

    other: Driver
    changed: Callable[[Command | Request], Command | Request] = lambda message: message
    difference: tuple[Sequence[Frame], Sequence[Frame]] | None = None
    """The frames of both, when they first differed."""

    def receive(self, t: Nanos, frame: Frame) -> Sequence[Event]:
        self.other.receive(t, frame)
        return self.driver.receive(t, frame)

    def bus(self, t: Nanos, state: BusState) -> None:
        self.other.bus(t, state)
        self.driver.bus(t, state)

    def send(self, now: Nanos, messages: Messages) -> tuple[Sequence[Event], Sequence[Frame]]:
        events, frames = self.driver.send(now, messages)
        theirs = self.other.send(now, [self.changed(message) for message in messages])[1]
        if list(frames) != list(theirs) and self.difference is None:
            self.difference = (frames, theirs)
        return events, frames


def _denormal_commands_send_zero(case: Case) -> None:
    """Give one of two equal drivers nearly zero: it must send what the other sends for zero."""
    spec = case.spec
    kinds = [kind for kind in case.kinds if tools.numbers(kind, spec.ranges)]
    bench = case.start()
    both = _Two(bench.driver, case.start().driver)
    bench.driver = both
    if not kinds or not bench.arm(tools.gentle(kinds[0], spec.ranges)):
        return
    for kind in kinds:
        gentle = [tools.build(kind, name, spec.ranges) for name in NAMES]
        for _ in range(CHANGED):
            if any(type(message) is kind for message in bench.step(gentle).received):
                break
        for name, key in tools.numbers(kind, spec.ranges):
            bounds = spec.ranges[key]
            for number in NEARLY_ZERO:
                if not bounds.low <= number <= bounds.high or not bounds.low <= 0.0 <= bounds.high:
                    continue
                both.changed = lambda message, n=name, x=number: _with(message, n, x)  # type: ignore[misc]
                bench.step(gentle)
                if both.difference:
                    left, right = both.difference
                    text = f"{name} {number!r} of {kind.__name__} is not sent as 0.0"
                    raise Failure(text, (*left[:1], *right[:1]), (gentle[0], _with(gentle[0], name, number)))


def _with(message: Any, name: str, number: float) -> Any:  # noqa: ANN401 -- a command of any kind
    return replace(message, **{name: number}) if hasattr(message, name) else message


def _tiny_sensors(sensor: str, t: Nanos, number: float) -> list[Event]:
    small = abs(number) if number else number
    return _readings(sensor, t, lambda quantity: small if quantity.low >= 0.0 else number, 2)


def _check_normal(events: Sequence[Event], frames: Sequence[Frame]) -> None:
    for event in events:
        if not normal(event):
            raise Failure("−0.0 or a denormal is reported", frames[:2], (event,))


def normal(message: Message) -> bool:
    """True if every number in a message is 0.0 or a normal float32 (or larger)."""
    return all(
        not abs(number) < SMALLEST or (number == 0.0 and math.copysign(1.0, number) > 0.0)
        for number in tools.floats(message)
    )
