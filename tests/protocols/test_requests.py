from __future__ import annotations

import math

import pytest

from protocols.messages import Command, Done, Hold, Position, Refused, Request, Scan, Velocity, Zero
from protocols.plugin import Range
from protocols.toolkit.requests import (
    SMALLEST,
    Pending,
    RejectionFilter,
    RequestQueue,
    bounds_of,
    outside,
    refusal,
    subject,
)

RANGES = {"Velocity.velocity": Range(-10.0, 20.0, 0.0)}


@pytest.mark.parametrize(
    ("command", "reason"),
    [
        (Hold("m"), ""),
        (Velocity("m", 20.0), ""),
        (Velocity("m", -10.0), ""),
        (Velocity("m", math.nextafter(20.0, 30.0)), "velocity 20 lies outside -10 … 20"),
        (Velocity("m", -11.5), "velocity -11.5 lies outside -10 … 20"),
        (Velocity("m", math.nan), "velocity is nan"),
        (Velocity("m", -math.inf), "velocity is -inf"),
        (Velocity("m", 1.0, math.nan), "torque is nan"),
        (Velocity("m", 1.0, -0.0), ""),
        (Velocity("m", 1.0, -SMALLEST / 2), ""),
        (Velocity("m", 1.0, -SMALLEST), "the device has no torque for Velocity"),
        (Position("m", 1.0), "the device has no position for Position"),
    ],
)
def test_what_may_be_sent(command: Command, reason: str) -> None:
    assert outside(command, bounds_of(type(command), RANGES)) == reason


def test_a_refusal_is_reported_when_its_reason_is_new_and_once_for_each_motor() -> None:
    refusals = RejectionFilter()
    given = [("m", "a"), ("m", "a"), ("n", "a"), ("m", "b"), ("m", ""), ("m", "b"), ("n", "a")]
    reported = [refusals.filter(t, Hold(motor), reason) for t, (motor, reason) in enumerate(given)]
    assert [[(r.t, r.name, r.reason) for r in each] for each in reported] == [
        [(0, "m", "a")], [], [(2, "n", "a")], [(3, "m", "b")], [], [(5, "m", "b")], [],
    ]  # fmt: skip


def test_a_request_is_refused_as_often_as_it_comes_and_changes_nothing_for_commands() -> None:
    refusals = RejectionFilter()
    messages: list[Command | Request] = [Hold("m"), Zero("m"), Zero("m"), Hold("m")]
    assert [len(refusals.filter(0, message, "a")) for message in messages] == [1, 1, 1, 0]
    assert refusals.filter(0, Zero("m"), "") == refusals.filter(0, Hold("m"), "a") == []


def pending(name: str, deadline: int, due: int) -> Pending[None]:
    return Pending(Zero(name), name, 0, deadline, due, None)


def test_a_request_under_way_ends_by_its_own_name() -> None:
    waiting = pending("m", 9, 5)
    assert waiting.done(7, "at 0") == Done(7, "Zero", "m", "at 0")
    assert waiting.refuse(9, "no answer") == Refused(9, "Zero", "m", "no answer")


def test_requests_wait_in_order_until_they_end_or_their_deadline_passes() -> None:
    waiting: RequestQueue[None] = RequestQueue()
    first, second = pending("a", 10, 4), pending("a", 7, 9)
    assert waiting.due() == []
    assert waiting.add(first) == waiting.add(second) == []
    assert waiting.due() == [4, 7]
    assert waiting.expired(6) == []
    assert [each.deadline for each in waiting] == [10, 7]
    assert waiting.expired(7) == [second]
    for each in waiting:
        waiting.end(each)
    assert list(waiting) == []


def test_the_one_that_ends_is_that_one_and_not_its_equal() -> None:
    waiting: RequestQueue[None] = RequestQueue()
    first, second = (pending("a", 10, 4) for _ in range(2))
    waiting.add(first)
    waiting.add(second)
    waiting.end(second)
    assert [each is first for each in waiting] == [True]


def test_what_is_not_begun_does_not_wait_and_what_waits_has_a_limit() -> None:
    waiting: RequestQueue[None] = RequestQueue()
    no = refusal(3, Zero("a"), "not now")
    assert waiting.add(no) == [no]
    assert list(waiting) == []
    for _ in range(RequestQueue.CAPACITY):
        assert waiting.full() == ""
        waiting.add(Pending(Scan("can0"), "can0", 0, 10, 4, None))
    assert waiting.full() == "too many requests are under way"
    assert (
        waiting.refuse_all(5, "the bus is off")
        == [Refused(5, "Scan", "can0", "the bus is off")] * RequestQueue.CAPACITY
    )
    assert waiting.full() == ""


@pytest.mark.parametrize(("message", "name"), [(Zero("m"), "m"), (Scan("can0"), "can0"), (Hold("h"), "h")])
def test_what_is_not_begun_names_its_motor_or_its_bus(message: Command | Request, name: str) -> None:
    assert subject(message) == name
    assert refusal(3, message, "not now") == Refused(3, type(message).__name__, name, "not now")
