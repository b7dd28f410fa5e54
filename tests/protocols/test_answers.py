from __future__ import annotations

import math

import pytest

from protocols.answers import SMALLEST, Refusals, UnderWay, out_of_range, refusal, subject
from protocols.plugin import Range
from protocols.words import Command, Done, Hold, Position, Refused, Request, Scan, Velocity, Zero

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
def test_what_may_reach_a_wire(command: Command, reason: str) -> None:
    assert out_of_range(command, RANGES) == reason


def test_a_refusal_is_told_when_its_reason_is_new_and_once_for_each_motor() -> None:
    refusals = Refusals()
    said = [("m", "a"), ("m", "a"), ("n", "a"), ("m", "b"), ("m", ""), ("m", "b"), ("n", "a")]
    told = [refusals.hear(t, Hold(motor), reason) for t, (motor, reason) in enumerate(said)]
    assert [[(r.t, r.name, r.reason) for r in each] for each in told] == [
        [(0, "m", "a")], [], [(2, "n", "a")], [(3, "m", "b")], [], [(5, "m", "b")], [],
    ]  # fmt: skip


def test_a_request_under_way_ends_by_its_own_name() -> None:
    waiting = UnderWay(Zero("m"), "m", 1, 9, 5)
    assert waiting.done(7, "at 0") == Done(7, "Zero", "m", "at 0")
    assert waiting.refuse(9, "no answer") == Refused(9, "Zero", "m", "no answer")


@pytest.mark.parametrize(("word", "name"), [(Zero("m"), "m"), (Scan("can0"), "can0"), (Hold("h"), "h")])
def test_what_is_not_begun_names_its_motor_or_its_bus(word: Command | Request, name: str) -> None:
    assert subject(word) == name
    assert refusal(3, word, "not now") == Refused(3, type(word).__name__, name, "not now")
