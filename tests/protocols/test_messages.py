from __future__ import annotations

import copy
import math
import pickle
from dataclasses import MISSING, fields, is_dataclass
from typing import Any, get_args

import pytest

from protocols import messages, sensors
from protocols.messages import COMMANDS, SECOND, Command, Feedback, Message, Mode, Velocity, seconds
from tests.protocols.message_samples import VECTORS, message_of

SENSORS: tuple[Any, ...] = tuple(kind.message for kind in sensors.OURS)
KINDS: tuple[Any, ...] = (*(k for k in get_args(Message) if k is not messages.Measurement), *SENSORS)
SAMPLES: list[Message] = [*(message_of(row) for row in VECTORS["packed"]), messages.Arm("m")]
SAMPLES.append(messages.Kept("m", "a mode", 1.0))


def test_there_is_a_sample_of_every_message() -> None:
    assert {type(message) for message in SAMPLES} == set(KINDS)


@pytest.mark.parametrize("kind", KINDS, ids=lambda kind: str(kind.__name__))
def test_a_message_is_a_slotted_value_without_methods(kind: type[Any]) -> None:
    assert is_dataclass(kind)
    parts = [vars(part) for part in reversed(kind.__mro__[:-1])]
    assert [slot for part in parts for slot in part["__slots__"]] == [f.name for f in fields(kind)]
    own = {name for part in parts for name in part if not name.startswith("_")}
    assert own - {"noun"} == {f.name for f in fields(kind)}
    assert kind.__doc__
    assert not kind.__doc__.startswith(f"{kind.__name__}(")  # what a dataclass writes without one


@pytest.mark.parametrize("message", SAMPLES, ids=lambda message: type(message).__name__)
def test_a_message_takes_no_other_attribute_and_is_equal_to_its_copy(message: Any) -> None:
    with pytest.raises((AttributeError, TypeError)):
        message.another = 1
    for twin in (copy.copy(message), copy.deepcopy(message), pickle.loads(pickle.dumps(message))):
        assert twin == message
        assert hash(twin) == hash(message)


def test_the_type_checker_refuses_to_change_a_message() -> None:
    declared = vars(messages.value)["__dataclass_transform__"]
    assert (declared | declared["kwargs"])["frozen_default"] is True  # before Python 3.12 in kwargs


def test_messages_of_different_kinds_are_never_equal() -> None:
    values: list[Any] = ["m", 1.0, 2.0, 3.0, 4.0, 5.0, 6.0, 7.0]
    made = [(len(fields(kind)), kind(*values[: len(fields(kind))])) for kind in KINDS]
    for size, one in made:
        assert one != tuple(values[:size])
        assert [other for _, other in made if other == one] == [one]
    assert len({one for _, one in made}) == len(KINDS)


def test_what_was_not_measured_is_none() -> None:
    silent = Feedback("m", 5)
    assert [getattr(silent, f.name) for f in fields(silent)][2:] == [None] * 6


def test_feed_forward_is_zero_unless_given() -> None:
    assert Velocity("m", 1.0) == Velocity("m", 1.0, 0.0)
    assert set(COMMANDS) == set(get_args(Command))


def test_no_default_hides_a_measurement() -> None:
    for kind in (*SENSORS, messages.Feedback, messages.Parameter):
        for f in fields(kind):
            instant = f.name == "duration"  # 0 is one that some lidars have
            assert instant or f.default is None or f.default is MISSING, (kind, f.name)


@pytest.mark.parametrize(
    ("span", "expected"),
    [(0, 0.0), (SECOND, 1.0), (-SECOND // 2, -0.5), (1, 1e-9), (86_400 * SECOND, 86_400.0)],
)
def test_seconds(span: int, expected: float) -> None:
    assert math.isclose(seconds(span), expected)


def test_modes_are_their_own_text() -> None:
    assert [f"{mode}" for mode in Mode] == ["initialising", "ready", "armed", "fault", "offline"]
    assert Mode("armed") is Mode.ARMED
