"""What the clauses are made of: wrapped twins, checks of numbers and sources, and their counterexamples."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import pytest

from protocols import messages as msg
from protocols.conformance import CLAUSES, check
from protocols.conformance.bench import STEP, fewest, within
from protocols.conformance.case import Case
from protocols.conformance.duplicates import Pair
from protocols.conformance.losses import DISTURBANCES, Disturbed
from protocols.conformance.numbers import normal
from protocols.conformance.obeyed import push
from protocols.conformance.random import Random
from protocols.conformance.reference_vectors import SOURCE
from protocols.frames import Frame
from protocols.messages import Command, Event, Nanos
from protocols.plugin import Plugin, Range
from tests.protocols.broken import motors
from tests.protocols.broken_all import BROKEN

CONCERNED = {"normal", "checksums", "obeyed", "duplicates", "replies", "vectors"}
BROKEN_HERE = [(plugin, clauses) for plugin, clauses in BROKEN if CONCERNED.issuperset(clauses)]


@dataclass
class Counter:
    """A twin that sends the number of its step."""

    count: int = 0
    shown: list[float | None] = field(default_factory=list)
    received: list[Frame] = field(default_factory=list)

    def receive(self, t: Nanos, frame: Frame) -> None:
        self.received.append(frame)

    def step(self, now: Nanos, truth: Sequence[Event]) -> tuple[Sequence[msg.Torque], Sequence[Frame]]:
        self.shown += [event.position for event in truth if isinstance(event, msg.Feedback)]
        self.count += 1
        return [msg.Torque("m", float(self.count))], [self.count.to_bytes(2)]

    def due(self) -> Nanos | None:
        return self.count

    def provoke(self, code: int) -> None:
        raise ValueError(code)


def arrived(what: str, steps: int, disturbed: int) -> list[int]:
    """The numbers that arrive of a counter that is disturbed for some of its steps."""
    twin = Disturbed(Counter(), dict(DISTURBANCES)[what], Random(0))
    numbers: list[int] = []
    for at in range(steps):
        twin.on = at < disturbed
        frames = twin.step(at * STEP, ())[1]
        numbers += [int.from_bytes(frame) for frame in frames if isinstance(frame, bytes)]
    return numbers


def test_disturbances_do_what_they_are_called_and_end() -> None:
    assert arrived("lost", 6, 4) == [5, 6]
    assert arrived("duplicated", 4, 2) == [1, 1, 2, 2, 3, 4]
    assert arrived("reordered", 6, 5) == [2, 1, 4, 3, 5, 6]
    half = arrived("half lost", 200, 200)
    assert 60 < len(half) < 140
    assert half == sorted(half)
    assert arrived("late", 40, 40) == [1, 2, 3, 4, 5]
    assert arrived("very late", 700, 100) == [*range(101, 701)]
    assert set(arrived("very late", 801, 100)) == set(range(1, 802))


def test_both_of_a_pair_receive_everything_and_are_at_different_positions() -> None:
    one, other = Counter(), Counter(count=10)
    pair = Pair(one, other)
    pair.receive(0, b"hello")
    torques, frames = pair.step(1, [msg.Feedback("m", 1, 1.0, 0.0)])
    assert torques == [msg.Torque("m", 1.0)]
    assert frames == (b"\0\1", b"\0\x0b")
    assert (one.received, other.received) == ([b"hello", b"\0\x0b"], [b"hello", b"\0\1"])
    assert one.shown == [1.0]
    assert other.shown != [1.0]
    assert (pair.due(), pair.last) == (1, (b"\0\1", b"\0\x0b"))


def test_fewest_keeps_order_and_only_what_still_fails() -> None:
    assert fewest(range(100), lambda some: {7, 63} <= set(some)) == [7, 63]
    assert fewest([3, 1, 2], lambda some: sum(some) >= 4) == [3, 2]
    assert fewest([5], lambda _: True) == []


@pytest.mark.parametrize("number", [-0.0, 5e-324, -1e-310, 1e-40, -(2.0**-127)])
def test_what_is_nearly_zero_is_not_normal_in_any_field(number: float) -> None:
    scan = msg.LaserScan("l", 0, 0.0, 0.1, 0.0, 10.0, (1.0, 2.0))
    assert normal(scan)
    assert not normal(replace(scan, ranges=(1.0, number)))
    assert not normal(replace(scan, angle_min=number))
    assert not normal(msg.Feedback("m", 0, torque=number))
    assert normal(msg.Feedback("m", 0, 0.0, -(2.0**-126)))


def test_within() -> None:
    ranges = {"Position.position": Range(-1.0, 1.0, 0.0), "Position.torque": Range(0.0, 2.0, 0.0)}
    assert within(msg.Position("m", 1.0, 99.0, 2.0), ranges)
    assert not within(msg.Position("m", 1.1), ranges)
    assert not within(msg.Position("m", float("nan")), ranges)
    assert not within(msg.Position("m", 0.0, 0.0, -0.1), ranges)


@pytest.mark.parametrize(
    ("command", "sign"),
    [
        (msg.Torque("m", 0.5), 1),
        (msg.Torque("m", 1e-6), 0),
        (msg.Velocity("m", -2.0), -1),
        (msg.Velocity("m", -2.0, 1.0), 0),
        (msg.Velocity("m", 0.0, 1.0), 0),
        (msg.Position("m", 3.0), 1),
        (msg.Position("m", 0.75), 0),
        (msg.Position("m", -3.0, 1.0), 0),
        (msg.Impedance("m", 0.75, 0.0, 0.0, 5.0, 1.0), 0),
        (msg.Impedance("m", 0.25, 0.0, 0.0, 5.0, 1.0), -1),
        (msg.Hold("m"), 0),
    ],
    ids=str,
)
def test_which_way_a_command_pushes(command: Command, sign: int) -> None:
    way = push(command, {})
    assert (way > 0) - (way < 0) == sign


def test_what_is_zero_but_for_its_resolution_pushes_nowhere() -> None:
    ranges = {"Velocity.velocity": Range(-45.0, 45.0, 0.011), "Velocity.torque": Range(-18.0, 18.0, 0.0044)}
    assert push(msg.Velocity("m", 2.0, -0.0044), {}) == 0.0
    assert push(msg.Velocity("m", 2.0, -0.0044), ranges) > 0.0


@pytest.mark.parametrize(
    ("source", "good"),
    [
        ("canopen 2.4.1 RemoteNode", True),
        ("odriverobotics/ODrive@f9b5419 can_simple.cpp", True),
        ("CiA 301 §7.2.4", True),
        ("vendor's manual, paragraph 4", True),
        ("made by hand", False),
        ("an/owner main.py", False),
    ],
)
def test_what_counts_as_a_source(source: str, good: bool) -> None:
    assert bool(SOURCE.search(source)) is good


@pytest.mark.sample(6)
@pytest.mark.parametrize(("plugin", "finders"), BROKEN_HERE, ids=[plugin.name for plugin, _ in BROKEN_HERE])
def test_a_counterexample_is_short_and_comes_again(plugin: Plugin, finders: tuple[str, ...]) -> None:
    (finder,) = [clause for clause in CLAUSES if clause.name in finders]
    ((first,), (again,)) = (check(plugin, 3, clauses=[finder]) for _ in range(2))
    assert first == again
    assert (first.outcome, first.seed) == ("failed", 3)
    assert first.frames or first.messages
    assert len(first.frames) <= 6
    assert len(first.messages) <= 4


def test_a_case_keeps_its_baseline() -> None:
    case = Case(motors, motors.options(), 0, (1, 2, 3))
    assert case.baseline is case.baseline
    assert case.specs is case.specs
    assert len(case.baseline) > 500
    assert any(step.received for step in case.baseline)
    assert case.share(100) == 100
